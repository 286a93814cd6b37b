"""select_pairs: scenes and instructions that were chosen and stored."""

import re

import pytest
import torch
from tensordict.nn import TensorDictModule

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.training import pairs as pairs_module
from ifo_grounding.training import select_pairs
from ifo_grounding.transforms import NothingSuitableError
from ifo_grounding.transforms.starts import frame_hash
from transforms.counter_world import POOL, CounterWorld, classifier


def test_pairs_are_distinct_scenes_with_suitable_instructions():
    world = CounterWorld((8,), seed=3)
    pairs = select_pairs(world, classifier(), POOL, 50)
    assert pairs.shape == (50,)
    assert {key: (value.shape[1:], value.dtype) for key, value in pairs.items()} == {
        "scene": ((1,), torch.int64),
        "instruction": ((4,), torch.int64),
        "frame_hash": ((1,), torch.int64),
    }
    assert pairs["scene"].unique().numel() == 50
    number = (pairs["scene"] * 7 + 3) % 10
    assert (pairs["instruction"][:, :1] - 1 > number).all()
    assert (number != 9).all()


@pytest.mark.parametrize("codes", [False, True])
def test_pairs_hold_the_scene_that_the_simulator_draws_again(codes):
    world = PickAndPlaceEnv("move", num_envs=16, seed=7, instructed=False, codes=codes)
    sure = TensorDictModule(
        lambda pixels, instruction: 2.0 * (pixels.flatten(1).sum(1, keepdim=True) // 64 % 2) - 0.5,
        ["pixels", "instruction"],
        ["suitability"],
    )
    pairs = select_pairs(world, sure, torch.ones(2, 16).long(), 40)
    assert torch.cat([pairs["scene"][1:] - pairs["scene"][:-1]]).max() > 1  # some were passed over
    fresh = PickAndPlaceEnv("move", num_envs=40, seed=7, instructed=False, codes=codes)
    pixels = fresh.reset(pairs.select("scene"))["pixels"]
    assert torch.equal(frame_hash(pixels), pairs["frame_hash"][:, 0])


def test_a_search_that_would_take_forever_is_given_up(monkeypatch):
    monkeypatch.setattr(pairs_module, "PATIENCE", 10)
    monkeypatch.setattr(pairs_module, "LEAST_SERVED", 0.3)  # two of ten numbers get a pair
    pool, options = POOL[2:3], {"threshold": 0.5}
    message = r"only (\d+) of 400 states .*best score seen: 0\.95.*find 1,000 pairs"
    with pytest.raises(NothingSuitableError, match=message) as given_up:
        select_pairs(CounterWorld((40,)), classifier(), pool, 1000, **options)
    found = int(re.search(message, str(given_up.value))[1])
    enough = select_pairs(CounterWorld((40,)), classifier(), pool, found, **options)
    assert len(enough) == found  # however rare


def test_environments_that_do_not_suit_are_refused():
    with pytest.raises(UserError, match="use instructed=False"):
        select_pairs(CounterWorld((4,), instructed=True), classifier(), POOL, 5)
    with pytest.raises(UserError, match="at least 1"):
        select_pairs(CounterWorld((4,)), classifier(), POOL, 0)
    nameless = CounterWorld((4,))
    del nameless.scene_numbers
    with pytest.raises(UserError, match="needs an environment with scene_numbers"):
        select_pairs(nameless, classifier(), POOL, 5)
