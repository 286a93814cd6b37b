import pytest
import torch

pytest.importorskip("minigrid")

from ifo_grounding.data import babyai, record_babyai
from ifo_grounding.data.babyai import DONE
from ifo_grounding.envs import from_gymnasium
from ifo_grounding.errors import UserError


def test_the_bot_is_recorded_without_actions():
    demos = record_babyai("GoToObj", 6, seed=0)
    assert len(demos) == 6
    assert demos.image_shape == (3, 64, 64)
    assert all(text.startswith("go to the") for text in demos.sentences())
    for number in range(6):
        frames = demos[number]["pixels"]
        assert torch.equal(frames[-1], frames[-2])  # the stop
        assert (frames[1:-1] != frames[:-2]).flatten(1).any(1).all()  # no step is wasted
    again = record_babyai("GoToObj", 6, seed=0)
    assert torch.equal(again.frames(torch.arange(20)), demos.frames(torch.arange(20)))
    other = record_babyai("GoToObj", 6, seed=0, stream="evaluation")
    assert not torch.equal(other.first_frames(), demos.first_frames())


def test_processes_record_what_one_process_records():
    alone, side_by_side = (record_babyai("GoToLocal", 4, seed=1, processes=n) for n in (1, 2))
    assert side_by_side.sentences() == alone.sentences()
    assert torch.equal(side_by_side.lengths, alone.lengths)
    numbers = torch.arange(alone.n_frames)
    assert torch.equal(side_by_side.frames(numbers), alone.frames(numbers))


def test_a_bot_s_steps_are_steps_of_the_environment():
    demos = record_babyai("GoToObj", 3, seed=0)
    env = from_gymnasium(
        babyai("GoToObj"),
        vocabulary=demos.vocabulary,
        num_envs=2,
        instructed=False,
        stop=DONE,
        seed=0,
    )
    td = env.reset()
    assert td["pixels"].shape[1:] == demos.image_shape
    after = env.step(td.set("action", torch.tensor([0, DONE])))["next"]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert (after["pixels"][0] != td["pixels"][0]).any()


def test_a_mission_of_unknown_words_names_them():
    demos = record_babyai("GoToObj", 1, seed=0)
    with pytest.raises(UserError, match="unknown word"):
        record_babyai("PickupLoc", 3, seed=0, vocabulary=demos.vocabulary)


def test_what_cannot_be_recorded_is_refused():
    with pytest.raises(UserError, match=r"no level 'BabyAI-GoToMoon-v0'.*GoToLocal"):
        babyai("GoToMoon")
    with pytest.raises(UserError, match="at least 1"):
        record_babyai("GoToObj", 0)
