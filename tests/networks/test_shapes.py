from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    OneHot,
    Unbounded,
)
from torchrl.envs import ParallelEnv, RenameTransform, StepCounter, TransformedEnv

from ifo_grounding.attributes import attribute
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.networks import Shapes, make_inverse, make_policy
from ifo_grounding.tasks.vocabulary import VOCABULARY


def env(instruction, action, batch=(5,), **attributes):
    pixels = Bounded(0, 255, (*batch, 3, 40, 56), dtype=torch.uint8)
    return SimpleNamespace(
        observation_spec=Composite(pixels=pixels, instruction=instruction, shape=batch),
        full_action_spec=Composite(action=action, shape=batch),
        **attributes,
    )


INSTRUCTIONS = {
    "categorical": Categorical(23, shape=(5, 12)),
    "bounded": Bounded(0, 22, (5, 12), dtype=torch.int64),
    "multi": MultiCategorical([23] * 12, shape=(5, 12)),
}


@pytest.mark.parametrize("instruction", INSTRUCTIONS.values(), ids=INSTRUCTIONS)
@pytest.mark.parametrize("action", [Categorical(4, shape=(5,)), OneHot(4, shape=(5, 4))])
def test_sizes_are_read_from_specs(instruction, action):
    assert Shapes.of(env(instruction, action)) == Shapes((3, 40, 56), 23, 12, 4)


def test_networks_are_made_for_entries_of_other_names():
    theirs = TransformedEnv(
        PickAndPlaceEnv("move", num_envs=2, seed=0, tile_size=16),
        RenameTransform(["pixels", "instruction"], ["camera", "words"], ["action"], ["move"]),
    )
    names = {"in_keys": ["camera", "words"], "action_key": "move"}
    policy = make_policy(theirs, seed=0, **names)
    assert policy.network_config.shapes == Shapes.of(PickAndPlaceEnv("move", tile_size=16))
    assert theirs.rollout(3, policy, break_when_any_done=False)["move"].shape == (2, 3)
    assert make_inverse(theirs, in_keys=["camera", ("next", "camera")]) is not None
    one = env(INSTRUCTIONS["categorical"], Categorical(4, shape=(5,)))
    one.full_action_spec = Composite(move=Categorical(7, shape=(5,)), shape=(5,))
    assert Shapes.of(one).n_actions == 7


def test_attributes_win_over_specs():
    source = env(INSTRUCTIONS["categorical"], Categorical(4, shape=(5,)))
    source.vocabulary_size, source.tile_size, source.instruction_length = 30, 16, 9
    assert Shapes.of(source) == Shapes((3, 40, 56), 30, 9, 4, tile_size=16)


def test_an_env_without_instructions_says_its_vocabulary():
    source = SimpleNamespace(
        observation_spec=Composite(pixels=Unbounded((2, 3, 8, 8), dtype=torch.uint8), shape=(2,)),
        vocabulary_size=30,
    )
    assert Shapes.of(source) == Shapes((3, 8, 8), 30)
    del source.vocabulary_size
    with pytest.raises(UserError, match=r"cannot read vocabulary_size.*'instruction'"):
        Shapes.of(source)


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({"image_shape": (3, 8)}, r"image_shape must be \(channels, height, width\)"),
        ({"image_shape": (48, 40, 3)}, r"\(48, 40, 3\) looks like.*PermuteTransform"),
        ({"vocabulary_size": 0}, "vocabulary_size must be at least 1, got 0"),
    ],
)
def test_impossible_sizes_are_refused(bad, said):
    with pytest.raises(UserError, match=said):
        Shapes(**{"image_shape": (12, 48, 40), "vocabulary_size": 3, **bad})


def test_patches_are_tiles_unless_told_otherwise():
    def patch(shapes, **options):
        return make_policy(shapes, **options).network_config.config.patch_size

    assert patch(Shapes((3, 96, 96), 9, tile_size=16)) == 16
    assert patch(Shapes((3, 96, 96), 9)) == 8
    assert patch(Shapes((3, 96, 96), 9, tile_size=16), patch_size=12) == 12


@pytest.mark.parametrize("instructed", [True, False])
def test_the_real_env_says_it_all_however_it_is_wrapped(instructed):
    make = partial(PickAndPlaceEnv, "move", num_envs=2, tile_size=16, instructed=instructed)
    workers = ParallelEnv(3, make, mp_start_method="fork")  # none is started
    transformed = [TransformedEnv(each, StepCounter()) for each in (make(), workers)]
    for env in (make(), workers, *transformed):
        assert Shapes.of(env) == Shapes((3, 96, 96), len(VOCABULARY), tile_size=16)
    assert attribute(workers, "stop_action") == 5


def test_one_hot_actions_are_refused():
    env = PickAndPlaceEnv("move", num_envs=2)
    env.action_spec = OneHot(6, shape=(2, 6))
    with pytest.raises(UserError, match="categorical_action_encoding=True"):
        make_policy(env)


@pytest.mark.parametrize(
    "action",
    [
        Bounded(-1.0, 1.0, (5, 2)),
        Bounded(1, 4, (5,), dtype=torch.int64),
        MultiCategorical([3, 2], shape=(5, 2)),
        Binary(4, shape=(5, 4)),
        Categorical(4, shape=(5, 1)),
        Unbounded((5,), dtype=torch.int64),
    ],
    ids=lambda spec: type(spec).__name__,
)
def test_actions_that_are_no_number_of_a_choice_are_refused(action):
    source = env(INSTRUCTIONS["categorical"], action)
    with pytest.raises(UserError, match=r"'action' is \w+ of shape \[5.*one discrete action"):
        Shapes.of(source)
    source.n_actions = 4  # of an environment that says so itself
    assert Shapes.of(source).n_actions == 4
