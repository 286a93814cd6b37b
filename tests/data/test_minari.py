import os

import numpy as np
import pyarrow.parquet
import pytest
import torch
from gymnasium import spaces

from comparing import all_frames, assert_same
from ifo_grounding.data import Demonstrations, _episodes, from_minari, to_minari
from ifo_grounding.errors import UserError
from ifo_grounding.tasks import VOCABULARY

minari = pytest.importorskip("minari", reason="the extra minari needs Python 3.11")
h5py = pytest.importorskip("h5py")

pytestmark = pytest.mark.filterwarnings("ignore:.*None")
BOX = spaces.Box(0, 255, (40, 48, 3), np.uint8)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def test_a_dataset_comes_back_with_placeholders_for_actions(demos):
    dataset = to_minari(demos, "mine/move-v0")
    assert_same(from_minari("mine/move-v0", vocabulary=VOCABULARY), demos)
    words = set(" ".join(demos.sentences()).split())
    assert set(from_minari(dataset).vocabulary.words) == words
    assert dataset.storage.metadata["actions_absent"] is True
    assert "actions and rewards are absent" in dataset.storage.metadata["description"]
    assert dataset.action_space == spaces.Discrete(1)
    for length, sentence, episode in zip(demos.lengths, demos.sentences(), dataset, strict=True):
        assert not episode.actions.any() and not episode.rewards.any()
        assert len(episode.actions) == length - 1
        assert episode.observations["mission"] == [sentence] * int(length)
        assert episode.observations["image"][0] in dataset.observation_space["image"]


def space(*shape):
    return spaces.Dict({"view": spaces.Box(0, 255, shape, np.uint8)})


def another(name, n=4, space=None, make=None, cut=(), **storing):
    """Make a dataset with real actions, such as somebody else would; some episodes are cut."""
    observed = space or spaces.Dict({"view": BOX, "mission": spaces.Text(9)})
    make = make or (lambda views, n: {"view": views, "mission": [f"go {'on' * n}"] * len(views)})
    draw = np.random.default_rng(0)
    views = [draw.integers(256, size=(3 + k, *BOX.shape), dtype=np.uint8) for k in range(n)]
    buffers = [
        minari.data_collector.EpisodeBuffer(
            observations=make(shown, number),
            actions=np.arange(1, len(shown)),
            rewards=[1.0] * (len(shown) - 1),
            terminations=[False] * (len(shown) - 2) + [number not in cut],
            truncations=[False] * (len(shown) - 2) + [number in cut],
        )
        for number, shown in enumerate(views)
    ]
    storing = {"jpeg_encoding": False, **storing}
    dataset = minari.create_dataset_from_buffers(
        name, buffers, observation_space=observed, action_space=spaces.Discrete(20), **storing
    )
    return dataset, [views.transpose(0, 3, 1, 2) for views in views]


@pytest.mark.parametrize("kind", ["hdf5", "arrow", "parquet"])
@pytest.mark.parametrize("jpeg", [False, True])
def test_datasets_of_others_are_read_as_they_were_recorded(kind, jpeg):
    dataset, views = another("other-v0", n=2, data_format=kind, jpeg_encoding=jpeg)
    storing = {"data_format": kind, "jpeg_encoding": jpeg}
    alone, _ = another("alone-v0", 2, BOX, lambda views, _: views, **storing)
    alone.storage.update_metadata({"task": "go on"})
    for demos in (
        from_minari(dataset, image="view", close=False),
        from_minari(alone, image=None, instruction="task", close=False),
    ):
        # Noise comes back as other noise from a lossy format.
        lossy = [one.observations.transpose(0, 3, 1, 2) for one in alone]
        assert np.array_equal(all_frames(demos), np.concatenate(lossy if jpeg else views))


def test_actions_are_never_read(folder):
    whole, _ = another("other-v0")
    expected = from_minari(whole, image="view")
    path = folder / "other-v0" / "data" / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        for episode in file.values():
            for name in ("actions", "rewards", "terminations", "truncations"):
                del episode[name]
    with pytest.raises(KeyError):
        whole[0]
    assert torch.equal(all_frames(from_minari(whole, image="view")), all_frames(expected))

    table, _ = another("table-v0", data_format="parquet")
    for path in (folder / "table-v0" / "data").glob("*/*.parquet"):
        pyarrow.parquet.write_table(
            pyarrow.parquet.read_table(path, columns=["observations"], partitioning=None), path
        )
    assert torch.equal(all_frames(from_minari(table, image="view")), all_frames(expected))


@pytest.mark.parametrize("kind", ["hdf5", "arrow"])
def test_a_part_is_read_and_truncated_episodes_stay_open(kind):
    dataset, views = another("other-v0", cut=(2,), data_format=kind)
    long = dataset.filter_episodes(lambda episode: len(episode.rewards) > 2)
    demos = from_minari(long, image="view")
    assert demos.lengths.tolist() == [5, 5, 7]  # of 4, 5 and 6 frames, and the stop of two
    assert demos.closed.tolist() == [True, False, True]
    assert np.array_equal(demos.first_frames(), np.stack([shown[0] for shown in views[1:]]))


@pytest.mark.parametrize("where", ["link", "storage"])
def test_what_lies_in_another_file_is_not_read(where, folder, tmp_path):
    dataset, _ = another("other-v0")
    with h5py.File(tmp_path / "other.hdf5", "w") as other:
        other["view"] = np.zeros((4, *BOX.shape), np.uint8)
    (tmp_path / "raw").write_bytes(bytes(4 * 40 * 48 * 3))
    with h5py.File(folder / "other-v0" / "data" / "main_data.hdf5", "a") as file:
        observed = file["episode_1/observations"]
        del observed["view"]
        if where == "link":
            observed["view"] = h5py.ExternalLink(tmp_path / "other.hdf5", "view")
        else:
            stored = [(str(tmp_path / "raw"), 0, 4 * 40 * 48 * 3)]
            observed.create_dataset("view", (4, *BOX.shape), np.uint8, external=stored)
    with pytest.raises(UserError, match=r"episode 1 cannot be read .*(is a link|in another file)"):
        from_minari(dataset, image="view")


def test_grey_and_channels_first_images_are_read():
    grey = another("grey-v0", 1, space(40, 48), lambda views, _: {"view": views[..., 0]})[0]
    turned = lambda views, _: {"view": views.transpose(0, 3, 1, 2)}  # noqa: E731
    first, views = another("first-v0", 2, space(3, 40, 48), turned)
    for dataset in (grey, first):
        dataset.storage.update_metadata({"mission": "go on"})
    assert from_minari(grey, image="view").image_shape == (1, 40, 48)
    assert np.array_equal(from_minari(first, image="view").first_frames()[1], views[1][0])


def test_the_instruction_may_be_in_the_metadata_of_an_episode():
    dataset, _ = another("other-v0", 3, space(*BOX.shape), lambda views, _: {"view": views})
    for number in range(3):
        dataset.storage.update_episode_metadata([{"task": f"step {number}"}], [number])
    demos = from_minari(dataset, image="view", instruction="task")
    assert demos.sentences() == ["step 0", "step 1", "step 2"]


def changing(views, number):
    last = "go back" if number == 1 else "go on"
    return {"view": views, "mission": ["go on"] * (len(views) - 1) + [last]}


@pytest.mark.parametrize(
    ("make", "options", "said"),
    [
        (None, {"image": "image"}, r"no image 'image' in the observation \(\['mission', 'view'\]"),
        (None, {"image": "mission"}, "no image 'mission'"),
        (None, {"image": None}, "no image None"),
        (None, {"instruction": "task"}, r"no instruction 'task' .* episode 0: name it"),
        (changing, {}, "episode 1 has 2 instructions"),
        (lambda views, n: {"view": views, "mission": [""] * len(views)}, {}, "episode 0 has no in"),
    ],
)
def test_what_does_not_fit_is_said(make, options, said):
    dataset, _ = another("other-v0", make=make)
    with pytest.raises(UserError, match=said):
        from_minari(dataset, **{"image": "view", **options})


def test_damaged_and_missing_datasets_are_refused(folder):
    with pytest.raises(UserError, match=r"no dataset 'nothing-v0' .* 'minari download nothing-v0'"):
        from_minari("nothing-v0")
    with pytest.raises(UserError, match="3 is no dataset of Minari: give one, or its id"):
        from_minari(3)
    dataset, _ = another("other-v0")
    path = folder / "other-v0" / "data" / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        del file["episode_2"]
    with pytest.raises(UserError, match="episode 2 cannot be read"):
        from_minari(dataset, image="view")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match="data cannot be read"):
        from_minari(dataset, image="view")


@pytest.mark.parametrize(
    "damage", ["[1]", "{}", '{"total_episodes": 1e12}', '{"total_episodes": 1}', "[" * 9999, None]
)
def test_damaged_metadata_is_refused(damage, folder):
    another("other-v0", 1)
    path = folder / "other-v0" / "data" / "metadata.json"
    path.unlink()
    os.mkfifo(path) if damage is None else path.write_text(damage)
    with pytest.raises(UserError, match="data cannot be read"):
        from_minari("other-v0")


@pytest.mark.parametrize("kind", ["hdf5", "arrow"])
def test_an_episode_that_claims_too_much_is_not_read(kind, folder, monkeypatch):
    dataset, _ = another("other-v0", data_format=kind)
    if kind == "arrow":
        monkeypatch.setattr(_episodes, "MOST_BYTES", 5 * BOX.shape[0] * BOX.shape[1] * 3)
    else:  # 58 GB
        with h5py.File(folder / "other-v0" / "data" / "main_data.hdf5", "a") as file:
            del file["episode_3/observations/view"]
            file.create_dataset("episode_3/observations/view", (10**7, *BOX.shape), np.uint8)
    with pytest.raises(UserError, match=r"episode 3 cannot be read .*MiB of pixels: cut it into"):
        from_minari(dataset, image="view")


class Interrupted(Demonstrations):
    """Demonstrations whose reader presses Ctrl-C at number 3."""

    def __getitem__(self, which):
        if which == 3:
            self.listed = minari.list_local_datasets()
            raise KeyboardInterrupt
        return super().__getitem__(which)


def test_a_dataset_appears_when_everything_is_written(demos, folder):
    parts = demos.codec, demos.codes, demos.lengths, demos.tokens
    broken = Interrupted(*parts, vocabulary=VOCABULARY)
    with pytest.raises(KeyboardInterrupt):
        to_minari(broken, "mine/move-v0")
    assert broken.listed == {}
    assert [path.name for path in (folder / "mine").iterdir()] == ["namespace_metadata.json"]
    dataset = to_minari(demos[:2], "mine/move-v0", data_format="arrow", author="me")
    assert list(minari.list_local_datasets()) == ["mine/move-v0"]
    assert dataset.total_episodes == 2 and dataset.storage.metadata["author"] == {"me"}
    with pytest.raises(UserError, match="'mine/move-v0' exists: choose another name or version"):
        to_minari(demos, "mine/move-v0")


def test_nothing_half_written_stays_behind(demos, folder):
    for name in ("no name", "../move-v0", "move"):
        with pytest.raises(UserError, match=rf"'{name}' is no id of a dataset: it has to be"):
            to_minari(demos, name)
    with pytest.raises(UserError, match=r"'move-v0' cannot be written: No storage .* for csv"):
        to_minari(demos, "move-v0", data_format="csv")
    with pytest.raises(TypeError, match="colour"):
        to_minari(demos, "move-v0", colour="red")
    assert not any(folder.iterdir())
