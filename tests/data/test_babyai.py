import multiprocessing
import sys

import numpy as np
import pytest
import torch

pytest.importorskip("minigrid")

from comparing import assert_same
from ifo_grounding.data import Truth, babyai, bot_outcomes, record_babyai
from ifo_grounding.data.babyai import DONE
from ifo_grounding.envs import from_gymnasium
from ifo_grounding.envs.wrapping import world_seed
from ifo_grounding.errors import UserError
from ifo_grounding.mosaic import as_words, assemble
from ifo_grounding.seeding import derive
from ifo_grounding.tasks import Vocabulary


def test_the_bot_is_recorded_without_actions():
    demos = record_babyai("GoToObj", 6, seed=0, tile_size=10)
    assert len(demos) == 6 and demos.image_shape == (3, 80, 80)
    assert all(text.startswith("go to the") for text in demos.sentences())
    assert demos.instruction_length == max(len(text.split()) for text in demos.sentences())
    for number in range(6):
        frames = demos[number]["pixels"]
        assert torch.equal(frames[-1], frames[-2])  # the stop
        assert (frames[1:-1] != frames[:-2]).flatten(1).any(1).all()  # no step is wasted
    assert_same(record_babyai("BabyAI-GoToObj-v0", 6, seed=0, tile_size=10), demos)
    other = record_babyai("GoToObj", 6, seed=0, tile_size=10, stream="evaluation")
    assert not torch.equal(other.first_frames(), demos.first_frames())


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_processes_record_what_one_process_records(method, monkeypatch):
    module = sys.modules[babyai.__module__]
    monkeypatch.setattr(module, "get_context", lambda _: multiprocessing.get_context(method))
    assert_same(*(record_babyai("GoToLocal", 4, seed=1, processes=n) for n in (1, 2)))


def test_true_actions_lead_from_frame_to_frame(tmp_path):
    demos, truth = record_babyai("PutNextLocalS5N3", 3, seed=0, keep_truth=True)
    truth.save(tmp_path / "truth")
    truth = Truth.load(tmp_path / "truth")
    assert len(truth.actions) == demos.transitions
    taken = truth.actions.long().split((demos.lengths - 1).tolist())
    for number, actions in enumerate(taken):
        assert actions[-1] == DONE and (actions[:-1] != DONE).all()
        room = babyai("PutNextLocalS5N3")()
        seed = derive(0, "babyai", "PutNextLocalS5N3 training", number) % 2**31
        seen = [room.reset(seed=seed)[0], *(room.step(a)[0] for a in actions.tolist())]
        frames = np.stack([shown["image"].transpose(2, 0, 1) for shown in seen])
        assert np.array_equal(frames, demos[number]["pixels"].numpy())


def test_a_picture_is_minigrid_s_own_and_shows_what_is_carried():
    room = babyai("PickupLoc", tile_size=16)()
    level = room.unwrapped
    seen = room.reset(seed=1)[0]["image"]
    assert np.array_equal(seen, level.get_frame(highlight=False, tile_size=16))
    assert room.observation_space["image"].contains(seen)
    level.carrying = next(thing for thing in level.grid.grid if thing and thing.type != "wall")
    seen, plain = room.step(0)[0]["image"], level.get_frame(highlight=False, tile_size=16)
    assert (seen != plain).any(-1).nonzero()[0].max() < 16
    assert np.array_equal(seen[16:], plain[16:]) and np.array_equal(seen[:, 16:], plain[:, 16:])


@pytest.mark.parametrize("level", ["PutNextLocal", "UnlockPickup", "GoToDoor"])
def test_codes_are_numbers_of_the_tiles_that_a_picture_shows(level):
    drawn, coded = (babyai(level, codes=codes)() for codes in (False, True))
    tiles = as_words(coded.tiles)
    assert len(torch.unique(tiles, dim=0)) == len(tiles)
    draw, kinds = np.random.default_rng(0), set()
    for seed in range(6):
        seen = [room.reset(seed=seed)[0]["image"] for room in (drawn, coded)]
        for action in draw.integers(DONE, size=60):
            picture, codes = seen
            assert coded.observation_space["image"].contains(codes)
            shown = assemble(tiles, torch.from_numpy(codes)).permute(1, 2, 0)
            assert np.array_equal(shown, picture)
            kinds |= set(codes.flatten().tolist())
            seen = [room.step(action)[0]["image"] for room in (drawn, coded)]
    assert len(kinds) > 15


@pytest.mark.parametrize("level", ["GoToObj", "PickupLoc"])
def test_what_becomes_of_a_room_whose_mission_is_fulfilled(level):
    _, truth = record_babyai(level, 1, seed=0, keep_truth=True)
    seed = derive(0, "babyai", f"{level} training", 0) % 2**31
    ends = {}
    for mission in ("ends", "waits", "none"):
        room = babyai(level, mission=mission)()
        room.reset(seed=seed)
        steps = [room.step(action) for action in truth.actions.tolist()]
        ends[mission] = [(reward > 0, terminated) for _, reward, terminated, _, _ in steps]
    quiet = [(False, False)] * (len(truth.actions) - 2)
    assert ends["ends"][:-1] == [*quiet, (True, True)]
    assert ends["waits"] == [*quiet, (False, False), (True, False)]
    assert ends["none"] == [(False, False)] * len(truth.actions)


def test_the_bot_plays_the_rooms_of_the_environment():
    assert bot_outcomes("GoToObj", 3, seed=5).tolist() == [True] * 3
    with pytest.raises(UserError, match="unknown stream"):
        bot_outcomes("GoToObj", 3, stream="test")
    demos = record_babyai("GoToObj", 1, seed=0)
    options = {"vocabulary": demos.vocabulary, "num_envs": 3, "skip_unknown": True, "stop": DONE}
    rooms = from_gymnasium(babyai("GoToObj"), seed=5, stream="evaluation", **options)
    shown = rooms.reset()
    assert shown["pixels"].shape[1:] == demos.image_shape
    for number in range(3):
        first = babyai("GoToObj")().reset(seed=world_seed(5, "evaluation", number))[0]["image"]
        assert np.array_equal(first.transpose(2, 0, 1), shown["pixels"][number])
    after = rooms.step(shown.set("action", torch.tensor([0, 1, DONE])))["next"]
    assert after["terminated"].flatten().tolist() == [False, False, True]


def test_what_cannot_be_recorded_is_refused():
    with pytest.raises(UserError, match=r"unknown level 'GoToMoon'.*GoToLocal"):
        babyai("GoToMoon")
    with pytest.raises(UserError, match="at least 1"):
        record_babyai("GoToObj", 0)
    with pytest.raises(UserError, match="unknown word"):
        record_babyai("PickupLoc", 1, seed=0, vocabulary=Vocabulary(["go"], length=9))
