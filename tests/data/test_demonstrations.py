"""Demonstrations: what they give, what they refuse, and that there is no place for actions."""

import inspect
import json
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from comparing import assert_same
from ifo_grounding import data
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import Lots
from ifo_grounding.tasks.vocabulary import VOCABULARY, Vocabulary
from ifo_grounding.world import random_layout, render

LENGTHS = [3, 1, 5, 2]
SENTENCES = ["go up", "go left", "go up", "take it"]


def episodes(seed: int = 0) -> list[torch.Tensor]:
    """Frames of four episodes, all different."""
    lots = Lots(seed, torch.arange(sum(LENGTHS)))
    return list(render(random_layout(lots)).split(LENGTHS))


def made(frames: list[torch.Tensor], tile_size: int | None = None) -> data.Demonstrations:
    """Demonstrations of which some may be single frames, as recordings of others may not."""
    codec, codes = data.FrameCodec.compress(torch.cat(frames), tile_size)
    vocabulary = Vocabulary.from_sentences(SENTENCES)
    lengths, tokens = torch.tensor([len(part) for part in frames]), vocabulary.encode(SENTENCES)
    return data.Demonstrations(codec, codes, lengths, tokens, vocabulary=vocabulary)


@pytest.fixture
def demos() -> data.Demonstrations:
    return made(episodes())


def numbered(n: int = 50, length: int = 4) -> data.Demonstrations:
    """Episodes whose frames say (episode, time), stored as pixels."""
    frames = torch.zeros(n, length, 2, 3, 3, dtype=torch.uint8)
    frames[:, :, 0] = torch.arange(n).view(n, 1, 1, 1)
    frames[:, :, 1] = torch.arange(length).view(1, length, 1, 1)
    return data.Demonstrations.from_arrays(list(frames), torch.arange(n).view(n, 1))


def test_frames_and_instructions_come_back(demos):
    assert (len(demos), demos.n_frames, demos.transitions) == (4, 11, 7)
    assert demos.lengths.tolist() == LENGTHS
    assert demos.starts.tolist() == [0, 3, 4, 9]
    assert demos.image_shape == (3, 48, 48)
    assert demos.instruction_length == 16
    assert demos.sentences() == SENTENCES
    assert demos.vocabulary_size == len(demos.vocabulary) == 6
    assert demos.instructions.dtype == torch.int64
    for number, frames in enumerate(episodes()):
        one = demos[number]
        assert one.batch_size == (LENGTHS[number],)
        assert torch.equal(one["pixels"], frames)
        assert (one["instruction"] == demos.instructions[number]).all()
        assert demos.vocabulary.decode(one["instruction"])[0] == SENTENCES[number]
    assert torch.equal(demos.first_frames(), torch.stack([one[0] for one in episodes()]))
    assert torch.equal(demos.frames(torch.tensor([[4, 5]]))[0], episodes()[2][:2])
    for index in (-1, np.int64(3), np.array(3), torch.tensor(3)):
        assert torch.equal(demos[index]["pixels"], episodes()[3])
    assert demos.pool().dtype == torch.int64  # of each instruction once
    assert sorted(demos.vocabulary.decode(demos.pool())) == ["go left", "go up", "take it"]


@pytest.mark.parametrize(
    ("index", "chosen"),
    [
        (torch.tensor([2, 0]), [2, 0]),
        ([2, 0], [2, 0]),
        (slice(2, None), [2, 3]),
        (torch.tensor([0, 0, 1, 1]).bool(), [2, 3]),
        (slice(None, None, -1), [3, 2, 1, 0]),
    ],
)
def test_a_selection_shares_the_frames(demos, index, chosen):
    some = demos[index]
    assert some.codes is demos.codes
    assert some.sentences() == [SENTENCES[number] for number in chosen]
    for one, number in zip(some, chosen, strict=True):
        assert torch.equal(one["pixels"], episodes()[number])
    assert torch.equal(some[[1]][0]["pixels"], episodes()[chosen[1]])


def test_transitions_are_located_episode_by_episode(demos):
    episode, frame = demos.locate()
    assert episode.tolist() == [0, 0, 2, 2, 2, 2, 3]
    assert frame.tolist() == [0, 1, 4, 5, 6, 7, 9]
    episode, frame = demos[[3, 1, 0]].locate()
    assert episode.tolist() == [0, 2, 2]
    assert frame.tolist() == [9, 0, 1]


def test_episodes_are_closed_where_they_do_not_end_with_a_repeated_frame():
    first, alone, second, closed = episodes()
    closed = closed[[0, 0]]
    demos = made([first, alone, second, closed]).close_episodes()
    assert demos.lengths.tolist() == [4, 2, 6, 2]
    for number, frames in enumerate((first, alone, second)):
        assert torch.equal(demos[number]["pixels"], torch.cat([frames, frames[-1:]]))
    assert torch.equal(demos[3]["pixels"], closed)
    assert demos.sentences() == SENTENCES
    again = demos.close_episodes()
    assert torch.equal(again.codes, demos.codes) and torch.equal(again.lengths, demos.lengths)


def test_frames_may_come_as_a_generator_of_numpy_arrays():
    given = (frames.repeat(2, 1, 1, 1).numpy() for frames in episodes())
    demos = data.Demonstrations.from_arrays(given, VOCABULARY.encode(["go up"] * 4), tile_size=16)
    assert torch.equal(demos[2]["pixels"], episodes()[2].repeat(2, 1, 1, 1))
    assert demos.vocabulary is None and demos.tile_size == 16
    assert demos.vocabulary_size == int(VOCABULARY.encode("go up").max()) + 1
    with pytest.raises(UserError, match="without a vocabulary"):
        demos.sentences()


def test_there_is_no_place_for_actions(demos):
    makers = (
        data.Demonstrations.from_arrays,
        data.Demonstrations.from_episodes,
        data.Demonstrations.load,
    )
    for call in (data.Demonstrations, *makers):
        assert not any("action" in name for name in inspect.signature(call).parameters)
    with pytest.raises(AttributeError):
        demos.actions = torch.zeros(7)
    with pytest.raises(UserError, match="number must be a whole number, got 'action'"):
        demos["action"]
    with pytest.raises(TypeError):
        demos["action"] = torch.zeros(4)
    assert set(demos[0].keys(True, True)) == {"pixels", "instruction"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lengths": torch.tensor([3, 1, 5, 3])}, "add up to 12 frames, there are 11"),
        ({"lengths": torch.tensor([3, 0, 6, 2])}, "at least 1"),
        ({"lengths": torch.tensor([3.0, 1, 5, 2])}, "integer tensor"),
        ({"codes": torch.zeros(11, 5, 6, dtype=torch.uint8)}, r"makes integers \[F, 6, 6\]"),
        ({"codes": torch.full((11, 6, 6), 200)}, "codes hold tile 200: allowed are"),
        ({"instructions": torch.zeros(3, 16).long()}, "for 4 episodes"),
        ({"instructions": torch.zeros(4, 16)}, "integer token ids"),
        ({"instructions": torch.full((4, 16), 99)}, r"token 99: allowed are 0\.\.5"),
        ({"instructions": torch.full((4, 16), -2)}, "token -2"),
    ],
)
def test_parts_that_do_not_fit_are_refused(change, message):
    codec, codes = data.FrameCodec.compress(torch.cat(episodes()), tile_size=8)
    tokens = Vocabulary.from_sentences(SENTENCES).encode(SENTENCES)
    parts = {"codes": codes, "lengths": torch.tensor(LENGTHS), "instructions": tokens}
    with pytest.raises(UserError, match=message):
        data.Demonstrations(codec, **{**parts, **change}, vocabulary_size=6)


GOOD = np.zeros((3, 3, 16, 24), np.uint8)


@pytest.mark.parametrize(
    ("frames", "sentence", "said"),
    [
        (GOOD[:0], "go", "at least one frame"),
        (GOOD, " ", r"has no instruction \(found ' '\)"),
        (GOOD, None, r"has no instruction \(found None\)"),
        (GOOD, GOOD, r"has no instruction \(found a ndarray\): give a sentence"),
        (GOOD, "go go", "of 2 words, 1 are allowed: shorten it, or give"),
        (None, "go", "has no frames"),
        (GOOD, "jump", "unknown word 'jump'"),
        (GOOD[..., :8], "go", r"\[3, 16, 8\], the others have \[3, 16, 24\] \(such as episode 'a'"),
        (GOOD.transpose(0, 2, 3, 1), "go", "with the colours last"),
        (GOOD[:, 0], "go", "C is 1 for grey"),
        (GOOD / np.float32(1), "go", r"float32 .* give uint8 .* np.round\(255 \* frames\)"),
        (GOOD.astype(np.int64), "go", "is torch.int64"),
        ([GOOD[0], GOOD[0, :, :8]], "go", "not arrays of one size"),
    ],
)
def test_what_is_wrong_with_an_episode_is_said_with_its_name(frames, sentence, said):
    words = Vocabulary(["go"], length=1)
    given = [("a", GOOD, "go"), ("b", frames, sentence)]
    with pytest.raises(UserError, match=f"^episode 'b'.*{said}"):
        data.Demonstrations.from_episodes(given, vocabulary=words)
    said = said.replace("'a'", "0")
    with pytest.raises(UserError, match=f"^episode 1.*{said}") as error:
        data.Demonstrations.from_arrays([GOOD, frames], ["go", sentence], vocabulary=words)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("episode", "said"), [(("b", GOOD), "a tuple of 2"), (None, "a NoneType")])
def test_other_things_than_episodes_are_refused(episode, said):
    with pytest.raises(UserError, match=f"^episode 1 is {said}: give a tuple of three, name"):
        data.Demonstrations.from_episodes([("a", GOOD, "go"), episode])
    with pytest.raises(UserError, match=r"^episode 0 is named by a ndarray: give name, frames"):
        data.Demonstrations.from_episodes([(GOOD, "go", "a")])
    with pytest.raises(UserError, match="a sentence for each episode, got one text"):
        data.Demonstrations.from_arrays([GOOD, GOOD], "go")


def test_instructions_are_as_long_as_the_longest_as_told_or_as_the_vocabulary_s(tmp_path):
    sentences = ["go", " - ".join(["on"] * 20)]
    demos = data.Demonstrations.from_arrays([GOOD] * 2, sentences)
    assert demos.instruction_length == 20 and demos.sentences()[1] == " ".join(["on"] * 20)
    assert (
        data.Demonstrations.from_arrays([GOOD] * 2, sentences, length=24).instruction_length == 24
    )
    with pytest.raises(
        UserError, match=r"^episode 1 .* 20 words, 8 are allowed: shorten it, or give"
    ):
        data.Demonstrations.from_arrays([GOOD] * 2, sentences, length=8)
    words = Vocabulary(["go", "up"], length=5)
    demos = data.Demonstrations.from_arrays([GOOD], torch.tensor([[1, 2, 0]]), vocabulary=words)
    assert demos.instructions.tolist() == [[1, 2, 0, 0, 0]]
    demos.save(tmp_path / "kept")
    assert data.Demonstrations.load(tmp_path / "kept").vocabulary == words
    with pytest.raises(UserError, match="instructions have 6 tokens, those of the vocabulary 5"):
        data.Demonstrations.from_arrays([GOOD], torch.ones(1, 6).long(), vocabulary=words)


def edit(folder, change):
    path = folder / "meta.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def resave(folder, name, array):
    """Replace an array and make the checksum agree."""
    np.save(folder / f"{name}.npy", array, allow_pickle=True)
    crc32 = zlib.crc32((folder / f"{name}.npy").read_bytes())
    edit(folder, lambda meta: meta["arrays"].update({name: {"crc32": crc32}}))


def test_saved_demonstrations_are_the_same_and_stay_on_disk(demos, tmp_path):
    demos.save(tmp_path / "d")
    loaded = data.Demonstrations.load(tmp_path / "d")
    assert_same(loaded, demos)
    assert (loaded.vocabulary, loaded.vocabulary_size) == (demos.vocabulary, 6)
    assert f"{tmp_path}/d/codes.npy" in Path("/proc/self/maps").read_text()
    loaded.save(tmp_path / "d")
    assert_same(data.Demonstrations.load(tmp_path / "d"), demos)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d"]


@pytest.mark.parametrize("kind", ["selection", "raw", "empty"])
def test_a_part_is_saved_alone(demos, kind, tmp_path):
    part = {"selection": demos[[2, 0]], "raw": numbered(), "empty": demos[:0]}[kind]
    part.save(tmp_path / "d")
    loaded = data.Demonstrations.load(tmp_path / "d")
    assert_same(loaded, part)
    assert len(loaded.codes) == part.n_frames


def edit_facts(folder, change):
    """Change facts of a folder, as of one that an older version wrote: without their checksum."""
    edit(folder, lambda meta: (meta.pop("facts_crc32"), change(meta["facts"])))


DAMAGE = {
    "no folder": (lambda f: f.rename(f.with_name("moved")), "is not a folder of"),
    "other kind": (lambda f: edit(f, lambda m: m.update(format="hats")), "holds 'hats', not"),
    "version": (lambda f: edit(f, lambda m: m.update(version=9)), "version 9, this library"),
    "no arrays": (lambda f: edit(f, lambda m: m.pop("arrays")), "is damaged: 'arrays'"),
    "unlisted": (lambda f: edit(f, lambda m: m["arrays"].pop("lengths")), "does not list lengths"),
    "no entry": (lambda f: edit(f, lambda m: m["arrays"].update(codes=3)), "is damaged"),
    "missing file": (lambda f: (f / "codes.npy").unlink(), "codes.npy is missing"),
    "pickle": (lambda f: resave(f, "lengths", np.array([{}])), "is damaged: .* allow_pickle=False"),
    "no words": (lambda f: edit_facts(f, lambda m: m.pop("words")), "is damaged: 'words'"),
    "words": (lambda f: edit_facts(f, lambda m: m.update(words=["a", "a"])), "word twice"),
    "actions": (lambda f: resave(f, "actions", np.zeros(7, np.int64)), "holds actions, .* place f"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_or_foreign_folder_is_refused_with_what_is_wrong(name, tmp_path):
    demos, folder = made(episodes(), tile_size=8), tmp_path / "d"
    demos.save(folder)
    damage, message = DAMAGE[name]
    damage(folder)
    with pytest.raises(UserError, match=message) as error:
        data.Demonstrations.load(folder)
    assert str(folder) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("close", [False, True])
def test_a_generator_may_write_to_its_array_again(close):
    def recorded():
        frames = np.empty((3, 3, 32, 32), np.uint8)
        for number in range(4):
            frames[0], frames[1:] = number, number + 100  # the stop is shown
            yield number, frames, "go up"

    demos = data.Demonstrations.from_episodes(recorded(), close=close)
    shown = [demos[number]["pixels"][:, 0, 0, 0].tolist() for number in range(4)]
    assert shown == [[number, number + 100, number + 100] for number in range(4)]


def test_a_single_frame_teaches_to_stop_where_it_is_closed():
    one = data.Demonstrations.from_episodes([("a", GOOD[:1], "go"), ("b", GOOD, "go")])
    assert one.lengths.tolist() == [2, 3] and one.closed.all()
    assert len(data.labelled_buffer(one, torch.zeros(3).long())) == 3
    assert data.Demonstrations.from_arrays([GOOD[:1]], ["go"]).transitions == 0


def test_a_recording_that_was_cut_stays_open_and_shows_no_success():
    frames = np.arange(3, dtype=np.uint8).repeat(3 * 8 * 8).reshape(3, 3, 8, 8)
    demos = data.Demonstrations.from_episodes([("a", frames, "go", True), ("b", frames, "up")])
    assert demos.lengths.tolist() == [3, 4] and demos.closed.tolist() == [False, True]
    seen = data.goal_buffer(demos)[:]
    said = demos.vocabulary.decode(seen["instruction"][seen["final"].flatten()])
    assert said == ["up", "up"] and len(seen) == 6
    with pytest.raises(UserError, match="no demonstration shows its stop: close_episodes"):
        data.goal_buffer(demos[:1])


@pytest.mark.parametrize(
    "again",
    [
        lambda demos, path: data.save_pictures(demos, path) or data.load_pictures(path),
        lambda demos, path: data.save_lerobot(demos, path) or data.load_lerobot(path),
        lambda demos, path: data.from_huggingface(data.to_huggingface(demos, cache_dir=path)),
        lambda demos, path: data.from_minari(data.to_minari(demos, "cut-v0")),
    ],
)
def test_a_recording_that_was_cut_stays_so_however_it_is_written(again, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    shown = np.arange(9, dtype=np.uint8).repeat(3 * 40 * 40).reshape(3, 3, 3, 40, 40)
    mixed = [(0, shown[0], "go", True), (1, shown[1], "up"), (2, shown[2], "go", True)]
    demos = data.Demonstrations.from_episodes(mixed)
    assert demos.cut.tolist() == [True, False, True]
    assert_same(again(demos, tmp_path / "d"), demos)
    assert not demos[[0, 2]].cut.any()  # of none that shows it, the stop was not recorded


@pytest.mark.parametrize(
    "use",
    [
        data.first_frame_buffer,
        data.goal_buffer,
        data.to_huggingface,
        lambda demos: data.label_demonstrations(demos, None),
        lambda demos: data.labelled_buffer(demos, torch.zeros(0)),
        lambda demos: data.save_pictures(demos, "nowhere"),
        lambda demos: data.to_minari(demos, "mine/none-v0"),
    ],
)
def test_no_demonstrations_and_other_things_are_refused(use):
    none = data.record_demonstrations("move", 4, seed=0)[:0]
    with pytest.raises(UserError, match="there are no demonstrations: is a selection, or"):
        use(none)
    with pytest.raises(UserError, match="'shown' is a str: give Demonstrations, such as load_pic"):
        use("shown")


def test_folders_of_others_and_the_current_one_are_left_alone(demos, tmp_path, monkeypatch):
    demos.save(tmp_path / "d")
    demos.save(tmp_path / "d")  # an older one is replaced
    (tmp_path / "d" / "thesis.tex").touch()
    data.LabelReport(torch.zeros(1), torch.zeros(1), 1).save(tmp_path / "labels")
    for folder, said in (
        ("d", r"d holds 'thesis\.tex', which would be deleted"),
        ("labels", r"labels holds 'actions\.npy', which would be deleted"),
        ("d/thesis.tex", "is a file: name a folder"),
    ):
        with pytest.raises(UserError, match=said):
            demos.save(tmp_path / folder)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(UserError, match="current folder"):
        demos.save(".")
    assert list(Path.cwd().iterdir()) == []
