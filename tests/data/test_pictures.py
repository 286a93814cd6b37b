import json
import os
import random
import struct
from io import BytesIO

import av
import numpy as np
import pytest
import torch
from PIL import Image

from comparing import all_frames, assert_same
from ifo_grounding.data import Demonstrations, _episodes, load_pictures, save_pictures
from ifo_grounding.data._video import read_video
from ifo_grounding.errors import UserError
from ifo_grounding.tasks import VOCABULARY, Vocabulary


def picture(path, value, size=(24, 16), mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((size[1], size[0], 3), value, np.uint8)).convert(mode).save(path)


def line(name, instruction="go", **more):
    return json.dumps({"episode": name, "instruction": instruction, **more}).encode()


def list_of(folder, *names):
    (folder / "episodes.jsonl").write_bytes(b"\n".join(map(line, names)))


def write(folder, *names):
    """Write episodes of two frames."""
    for name in names:
        for step in range(2):
            picture(folder / name / f"{step}.png", step)
    list_of(folder, *names)


def make_video(path, frames=20, size=(32, 16), codec="libx264", **tags):
    """Make a video of plain or noisy frames, four a second, with its index in front."""
    draw = np.random.default_rng(0)
    with av.open(path, "w", options={"movflags": "faststart"}) as video:
        video.metadata.update(tags)
        options = {"qscale": "1"} if codec == "mjpeg" else {"g": "5", "bf": "0"}
        stream = video.add_stream(codec, rate=4, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for number in range(frames):
            shown = np.full((*size[::-1], 3), 10 * number, np.uint8)
            shown[: size[1] // 2] = 255
            if codec == "mjpeg":
                shown = draw.integers(256, size=shown.shape, dtype=np.uint8)
            video.mux(stream.encode(av.VideoFrame.from_ndarray(shown)))
        video.mux(stream.encode())
    return path


def test_pictures_come_back_as_they_were_and_videos_at_twice_the_size(demos, tmp_path):
    save_pictures(demos, tmp_path / "shown")
    back = load_pictures(tmp_path / "shown", vocabulary=VOCABULARY)
    assert_same(back, demos)
    assert torch.equal(back.tokens, demos.tokens)
    save_pictures(demos, tmp_path / "moving", kind="gif")
    assert_same(load_pictures(tmp_path / "moving", vocabulary=VOCABULARY), demos)
    demos = demos[:2]
    save_pictures(demos, tmp_path / "filmed", kind="mp4", scale=2)
    back = load_pictures(tmp_path / "filmed", close=False)
    assert back.sentences() == demos.sentences()
    assert torch.equal(back.lengths, demos.lengths)
    assert back.image_shape == (3, 96, 96)
    large = all_frames(demos).repeat_interleave(2, -1).repeat_interleave(2, -2)
    assert (all_frames(back).float() - large.float()).abs().mean() < 8


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_pictures_come_back_with_as_many_channels(channels, tmp_path):
    frames = torch.randint(256, (4, channels, 16, 24), dtype=torch.uint8)
    save_pictures(Demonstrations.from_arrays([frames], ["go on"]), tmp_path / "shown")
    back = load_pictures(tmp_path / "shown", channels=channels, close=False)
    assert torch.equal(all_frames(back), frames)


@pytest.mark.parametrize(
    ("kind", "shape", "said"),
    [
        ("png", (2, 16, 24), "number of channels 2: choose one of 1, 3, 4"),
        ("mp4", (4, 16, 24), "number of channels 4: choose one of 1, 3"),
        ("mp4", (3, 15, 24), "even numbers of pixels, these images have 24x15: give scale=2"),
    ],
)
def test_frames_that_cannot_be_written_are_refused(kind, shape, said, tmp_path):
    demos = Demonstrations.from_arrays([torch.zeros(4, *shape, dtype=torch.uint8)], ["go"])
    with pytest.raises(UserError, match=said):
        save_pictures(demos, tmp_path / "shown", kind=kind)
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_not_replaced_and_what_has_no_instruction_not_written(demos, tmp_path):
    save_pictures(demos[:1], tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match="holds '0', which would be deleted: name another folder"):
        save_pictures(demos, tmp_path)
    with pytest.raises(UserError, match="is a file: name a folder"):
        save_pictures(demos, tmp_path / "episodes.jsonl")
    frames = [torch.zeros(2, 3, 8, 8, dtype=torch.uint8)] * 2
    tokens, words = torch.tensor([[1], [0]]), Vocabulary(["up"], length=1)
    silent = Demonstrations.from_arrays(frames, tokens, vocabulary=words)
    with pytest.raises(UserError, match="demonstration 1 has no instruction"):
        save_pictures(silent, tmp_path / "pictures")
    assert sorted(tmp_path.rglob("*")) == before


def test_animations_show_each_frame_or_are_refused_where_they_are_cut_short(tmp_path):
    noise = np.random.default_rng(0).integers(256, size=(2, 3, 3, 3), dtype=np.uint8)
    first, *others = map(Image.fromarray, noise)
    # A transparent colour with the number of the trailer byte: a cut right after it must not pass.
    saving = {"save_all": True, "append_images": others, "transparency": 59, "disposal": 2}
    first.save(tmp_path / "a.gif", duration=[590, 0], **saving)
    list_of(tmp_path, "a")
    path = tmp_path / "a.gif"
    content = path.read_bytes()
    assert load_pictures(tmp_path, close=False).lengths.tolist() == [2]
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(UserError, match=r"^episode 'a': .*a\.gif.* cannot be read"):
            load_pictures(tmp_path)


@pytest.mark.parametrize("suffix", ["mkv", "avi", "mov", "mp4"])
def test_videos_are_whole_or_refused(suffix, tmp_path):
    codec = {"avi": "mpeg4", "mp4": "mjpeg"}.get(suffix, "libx264")
    path = make_video(tmp_path / f"a.{suffix}", size=(64, 64), codec=codec)
    list_of(tmp_path, "a")
    assert load_pictures(tmp_path, close=False).lengths.tolist() == [20]
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(UserError, match=r"^episode 'a': .* (is cut short|cannot be read)"):
        load_pictures(tmp_path)
    if codec == "mjpeg":  # of frames that are as long as the cut
        path.write_bytes(content[:-300])
        with pytest.raises(UserError, match=r"cut short: it ends at 4\.75 s and says 5\.00 s"):
            load_pictures(tmp_path)


def test_any_path_colour_mode_and_line_break_will_do(tmp_path):
    picture(tmp_path / "one" / "0.png", 7, mode="L")
    picture(tmp_path / "one" / "1.PNG", 8, mode="RGBA")
    line = '{"episode": "first", "instruction": "Go\u2028on", "frames": "one"}\r\n\n'
    (tmp_path / "episodes.jsonl").write_bytes(line.encode("utf-8-sig"))
    demos = load_pictures(tmp_path, close=False)
    assert demos.image_shape == (3, 16, 24)
    assert all_frames(demos).amax((1, 2, 3)).tolist() == [7, 8]
    assert demos.sentences() == ["go on"]


@pytest.mark.parametrize(
    "names",
    [
        [f"{number}.png" for number in range(12)],
        [f"cam2-{number}.png" for number in range(0, 60, 5)],
        [f"{number}.{half}.png" for number in range(9, 12) for half in (0, 5)],
        ["start.png", "step 2.png", "step 10.png", "stop.png"],
    ],
)
def test_frames_are_in_the_order_of_their_numbers(names, tmp_path):
    values = {name: 9 * value for value, name in enumerate(names)}
    for name in random.Random(0).sample(names, len(names)):
        picture(tmp_path / "a" / name, values[name])
    list_of(tmp_path, "a")
    demos = load_pictures(tmp_path, close=False)
    assert all_frames(demos)[:, 0, 0, 0].tolist() == list(values.values())


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("0000 0001 0003 0005", r"0002\.png is missing between 0001\.png and 0003\.png"),
        ("cam-8 cam-9 cam-11", r"cam-10\.png is missing between cam-9\.png and cam-11"),
        ("0 5 10 20", r"15\.png is missing between 10\.png and 20\.png"),
        ("0 1 01 3", r"01\.png and 1\.png have the same number"),
    ],
)
def test_missing_frames_are_named(names, said, tmp_path):
    for name in names.split():
        picture(tmp_path / "a" / f"{name}.png", 7)
    list_of(tmp_path, "a")
    with pytest.raises(UserError, match=f"^episode 'a': {said}"):
        load_pictures(tmp_path)


def png(array):
    file = BytesIO()
    Image.fromarray(array).save(file, "PNG")
    return file.getvalue()


NOISE = np.random.default_rng(0).integers(256, size=(16, 24, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("episodes.jsonl", None, "jsonl does not exist: write one"),
        ("episodes.jsonl", b"\n", "lists no episode"),
        ("episodes.jsonl", b"[" * 100_000, "line 1: a line is a JSON object"),
        ("episodes.jsonl", "{é}".encode("latin-1"), r"jsonl cannot be read .*: save it as UTF-8"),
        ("episodes.jsonl", line("a") + b"\n" + line("a"), "lists episode 'a' twice"),
        ("episodes.jsonl", line("a", truncated="no"), "line 1: .* 'truncated', .* true or false"),
        ("episodes.jsonl", line("a", frames="x" * 999), r"'a': it has no frames \(File name too"),
        ("episodes.jsonl", line("c"), "episode 'c': it has no frames: neither .*c nor"),
        ("episodes.jsonl", line("a", None), "'a' has no instruction .*found None"),
        ("episodes.jsonl", line("a", frames="."), "'a': .* holds none of .png.* but .jsonl"),
        ("episodes.jsonl", line("a", frames="episodes.jsonl"), "is of a kind that is not read: gi"),
        ("a/1.png", os.mkfifo, r"episode 'a': 1\.png cannot be read .*no regular file"),
        ("a/1.png", png(NOISE[:8, :8]), r"'a': 1\.png has 8x8 pixels, the first frame has 24x16"),
        ("a/1.png", png(NOISE)[:700], r"'a': 1\.png cannot be read \((Trunc|image file is trunc)"),
        ("a/1.png", png(NOISE[..., 0].astype(np.uint16)), r"1\.png .* mode 'I\S*: save 8 bits"),
    ],
)
def test_what_is_wrong_is_said_with_the_name_of_the_episode(name, content, said, tmp_path):
    write(tmp_path, "a")
    (tmp_path / name).unlink()
    if callable(content):
        content(tmp_path / name)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=said) as error:
        load_pictures(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "content", ["ffconcat version 1.0\nfile {}\n", "#EXTM3U\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n"]
)
def test_a_list_of_other_files_is_no_video(content, tmp_path):
    other = make_video(tmp_path / "other.mp4", frames=3)
    (tmp_path / "a.mp4").write_text(content.format(other.name))
    with pytest.raises(UserError, match="cannot be read"):
        list(read_video(tmp_path / "a.mp4"))
    os.mkfifo(tmp_path / "b.mp4")
    with pytest.raises(UserError, match="no regular file"):
        list(read_video(tmp_path / "b.mp4"))


@pytest.mark.parametrize(("limit", "value"), [("MOST_FRAMES", 1), ("MOST_BYTES", 2000)])
def test_episodes_have_bounds(limit, value, tmp_path, monkeypatch):
    write(tmp_path, "a")
    assert load_pictures(tmp_path, close=False).lengths.tolist() == [2]
    monkeypatch.setattr(_episodes, limit, value)
    with pytest.raises(UserError, match=r"^episode 'a': it has more than .* cut it into shorter"):
        load_pictures(tmp_path)


def test_a_video_may_have_a_title_that_is_no_text(tmp_path):
    path = make_video(tmp_path / "a.mkv", frames=2, title="abc")
    path.write_bytes(path.read_bytes().replace(b"abc", b"a\xffc"))
    assert len(list(read_video(path))) == 2


def test_a_video_may_hold_frames_that_are_not_shown(tmp_path):
    # Editors that cut without encoding anew keep what comes before, from a whole frame on.
    whole, part = make_video(tmp_path / "whole.mp4"), tmp_path / "part.mp4"
    with av.open(whole) as source, av.open(part, "w") as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        away = round(1.75 / stream.time_base)
        for packet in source.demux(stream):
            if packet.dts is not None and packet.pts * stream.time_base >= 1.25:
                packet.pts, packet.dts, packet.stream = packet.pts - away, packet.dts - away, copy
                target.mux(packet)
    with av.open(part) as video:
        says, shows = video.streams.video[0].frames, len(list(video.decode(video=0)))
    assert shows < says
    assert len(list(read_video(part))) == shows


def test_pictures_and_videos_come_the_right_way_up(tmp_path):
    path = make_video(tmp_path / "a.mp4", frames=2)
    content = bytearray(path.read_bytes())
    at = content.index(b"tkhd") + 44  # the matrix by which a player turns the frames
    content[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 16 << 16, 0, 1 << 30)
    path.write_bytes(content)
    (tmp_path / "b").mkdir()
    for number in range(2):
        shown = Image.new("RGB", (32, 16))
        shown.paste((255, 255, 255), (0, 0, 32, 8))
        exif = shown.getexif()
        exif[0x0112] = 6  # a phone held upright
        shown.save(tmp_path / "b" / f"{number}.jpg", exif=exif)
    list_of(tmp_path, "a", "b")
    frames = all_frames(load_pictures(tmp_path, close=False))
    assert frames.shape == (4, 3, 32, 16)
    # What was above is on the right.
    assert frames[..., 8:].min() > 200 and frames[..., :8].max() < 50


def test_a_photo_may_hold_a_preview_and_an_animation_is_no_frame(tmp_path):
    (tmp_path / "a").mkdir()
    for number in range(3):
        shown, preview = Image.new("RGB", (16, 16), (number, 0, 0)), Image.new("RGB", (4, 4))
        path = tmp_path / "a" / f"{number}.jpg"
        shown.save(path, format="MPO", save_all=True, append_images=[preview])
    list_of(tmp_path, "a")
    assert load_pictures(tmp_path, close=False).lengths.tolist() == [3]
    shown = [Image.new("RGB", (16, 16), colour) for colour in ("red", "blue")]
    shown[0].save(tmp_path / "a" / "3.webp", save_all=True, append_images=shown[1:])
    with pytest.raises(UserError, match=r"episode 'a': 3\.webp .* \(it holds 2 pictures"):
        load_pictures(tmp_path)
