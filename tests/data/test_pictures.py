import json

import av
import numpy as np
import pytest
import torch
from PIL import Image

from comparing import all_frames, assert_same
from ifo_grounding.data import Demonstrations, load_pictures, save_pictures
from ifo_grounding.errors import UserError
from ifo_grounding.tasks import VOCABULARY, Vocabulary


def test_pictures_come_back_as_they_were(demos, tmp_path):
    save_pictures(demos, tmp_path / "shown")
    back = load_pictures(tmp_path / "shown", vocabulary=VOCABULARY)
    assert_same(back, demos)
    assert torch.equal(back.tokens, demos.tokens)


def test_animations_hold_every_frame(tmp_path):
    frames = [torch.randint(0, 2, (5, 3, 16, 24), dtype=torch.uint8) * 255 for _ in range(3)]
    demos = Demonstrations.from_arrays(frames, ["go on", "go back", "stay"])
    save_pictures(demos, tmp_path / "shown", kind="gif", scale=2)
    back = load_pictures(tmp_path / "shown", close=False)
    large = all_frames(demos).repeat_interleave(2, -1).repeat_interleave(2, -2)
    assert torch.equal(all_frames(back), large)
    assert back.sentences() == demos.sentences()


def test_videos_show_every_frame_at_twice_the_size(demos, tmp_path):
    demos = demos[:8]
    save_pictures(demos, tmp_path / "shown", kind="mp4", scale=2)
    assert {path.suffix for path in (tmp_path / "shown").iterdir()} == {".mp4", ".jsonl"}
    back = load_pictures(tmp_path / "shown", close=False)
    assert back.sentences() == demos.sentences()
    assert torch.equal(back.lengths, demos.lengths)
    assert back.image_shape == (3, 96, 96)
    large = all_frames(demos).repeat_interleave(2, -1).repeat_interleave(2, -2)
    assert (all_frames(back).float() - large.float()).abs().mean() < 8


def test_grey_frames_become_pictures(tmp_path):
    frames = torch.randint(256, (4, 1, 16, 24), dtype=torch.uint8)
    demos = Demonstrations.from_arrays([frames], ["go on"])
    save_pictures(demos, tmp_path / "shown")
    assert torch.equal(
        all_frames(load_pictures(tmp_path / "shown"))[:4], frames.expand(4, 3, 16, 24)
    )


@pytest.mark.parametrize("kind", ["png", "gif", "mp4"])
def test_frames_that_are_no_pictures_are_refused(kind, tmp_path):
    frames = torch.zeros(4, 2, 16, 24, dtype=torch.uint8)
    with pytest.raises(UserError, match="1 or 3 colours, these frames have 2"):
        save_pictures(Demonstrations.from_arrays([frames], ["go"]), tmp_path / "shown", kind=kind)
    assert not list(tmp_path.iterdir())


def test_videos_with_odd_sides_are_refused(tmp_path):
    demos = Demonstrations.from_arrays([torch.zeros(4, 3, 15, 24, dtype=torch.uint8)], ["go"])
    with pytest.raises(UserError, match="even numbers of pixels, these images have 24x15: give sc"):
        save_pictures(demos, tmp_path / "shown", kind="mp4")
    assert not list(tmp_path.iterdir())
    save_pictures(demos, tmp_path / "shown", kind="mp4", scale=2)
    assert load_pictures(tmp_path / "shown").image_shape == (3, 30, 48)


def test_videos_that_are_cut_short_are_refused(demos, tmp_path):
    save_pictures(demos[:1], tmp_path / "shown", kind="mp4")
    path = tmp_path / "shown" / "0.mp4"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match=r"^episode '0': .*0\.mp4 cannot be read"):
        load_pictures(tmp_path / "shown")
    with av.open(path, "w", options={"movflags": "faststart"}) as video:
        stream = video.add_stream("mjpeg", rate=4, options={"qscale": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuvj420p"
        for _ in range(9):
            noise = np.random.default_rng(0).integers(256, size=(64, 64, 3), dtype=np.uint8)
            video.mux(stream.encode(av.VideoFrame.from_ndarray(noise)))
        video.mux(stream.encode())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(
        UserError, match=r"^episode '0': .* is cut short: it has . frames and says 9"
    ):
        load_pictures(tmp_path / "shown")


def test_episodes_that_do_not_show_their_stop_are_closed(tmp_path):
    write(tmp_path, [("a", "go", [0, 1, 2])])
    assert load_pictures(tmp_path).lengths.tolist() == [4]
    assert load_pictures(tmp_path, close=False).lengths.tolist() == [3]


def test_any_path_and_colour_mode_will_do(tmp_path):
    picture(tmp_path / "one" / "0.png", 7, mode="L")
    picture(tmp_path / "one" / "1.png", 8, mode="RGBA")
    lines = [{"episode": "first", "instruction": "Go on", "frames": "one"}]
    (tmp_path / "episodes.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n\n")
    demos = load_pictures(tmp_path, close=False)
    assert demos.image_shape == (3, 16, 24)
    assert all_frames(demos).amax((1, 2, 3)).tolist() == [7, 8]
    assert demos.sentences() == ["go on"]


def picture(path, value, size=(24, 16), mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((size[1], size[0], 3), value, np.uint8)).convert(mode).save(path)


def write(folder, episodes):
    lines = []
    for name, instruction, values in episodes:
        for step, value in enumerate(values):
            picture(folder / name / f"{step}.png", value)
        lines.append(json.dumps({"episode": name, "instruction": instruction}))
    (folder / "episodes.jsonl").write_text("\n".join(lines))


def damage(folder, how):
    write(folder, [("a", "go", [0, 1]), ("b", "stop", [2, 3])])
    how(folder)


def small(folder):
    picture(folder / "b" / "1.png", 3, size=(8, 8))


def all_small(folder):
    for step in range(2):
        picture(folder / "b" / f"{step}.png", 3, size=(8, 8))


def cut(folder):
    path = folder / "b" / "1.png"
    noise = np.random.default_rng(0).integers(256, size=(16, 24, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    path.write_bytes(path.read_bytes()[:700])


def deep(folder):
    Image.fromarray(np.full((16, 24), 1000, np.uint16)).save(folder / "b" / "1.png")


@pytest.mark.parametrize(
    ("how", "said"),
    [
        (
            lambda f: (f / "episodes.jsonl").unlink(),
            "jsonl does not exist: write one",
        ),
        (lambda f: (f / "episodes.jsonl").write_text("\n"), "lists no episode"),
        (lambda f: (f / "episodes.jsonl").write_text("go"), "line 1: a line is a JSON object"),
        (lambda f: (f / "episodes.jsonl").write_text('["a"]'), "line 1: a line is a JSON object"),
        (lambda f: write(f, [("a", " ", [0, 1])]), "episode 'a' has no instruction"),
        (lambda f: write(f, [("a", "go", [0, 1])] * 2), "lists episode 'a' 2 times"),
        (lambda f: write(f, [("a", "go", [0, 1]), ("c", "go", [])]), "episode 'c' has no frames"),
        (lambda f: [p.unlink() for p in (f / "b").iterdir()], "episode 'b' has no frames"),
        (lambda f: (f / "b" / "1.png").unlink(), "episode 'b' has 1 frame"),
        (small, "episode 'b': 1.png has 8x8 pixels, the first frame has 24x16"),
        (
            all_small,
            r"episode 'b' has images \[3, 8, 8\], the others have \[3, 16, 24\] .*'a'",
        ),
        (cut, r"episode 'b': 1\.png cannot be read \(image file is truncated"),
        (deep, "episode 'b': 1.png has numbers of mode 'I;16': save it with 8 bits"),
        (
            lambda f: (f / "b" / "1.png").write_bytes(b"no picture"),
            "episode 'b': .* cannot be read",
        ),
    ],
)
def test_what_is_wrong_is_said_with_the_name_of_the_episode(how, said, tmp_path):
    damage(tmp_path, how)
    with pytest.raises(UserError, match=said):
        load_pictures(tmp_path)


def test_an_unknown_word_names_its_episode(tmp_path):
    write(tmp_path, [("a", "go", [0, 1]), ("b", "jump", [0, 1])])
    with pytest.raises(UserError, match="episode 'b': unknown word 'jump'"):
        load_pictures(tmp_path, vocabulary=Vocabulary(["go"]))


def test_nothing_half_written_stays_behind(demos, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        save_pictures(demos, tmp_path / "shown")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("options", "said"), [({"kind": "tiff"}, "kind"), ({"scale": 0}, "scale")])
def test_bad_options_are_refused(options, said, demos, tmp_path):
    with pytest.raises(UserError, match=said):
        save_pictures(demos, tmp_path / "shown", **options)


def test_arrays_with_the_colours_last_are_recognised():
    with pytest.raises(UserError, match=r"episode 0 .*colours last"):
        Demonstrations.from_arrays([np.zeros((3, 16, 24, 3), np.uint8)], ["go"])
