"""StartingPairs: every pair once, with its own scene, before any is used again."""

from collections import Counter

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from ifo_grounding.errors import UserError
from ifo_grounding.transforms import StartingPairs
from ifo_grounding.transforms.starts import frame_hash
from transforms.counter_world import CounterWorld, shown


def make_pairs(count=7, length=4):
    scene = torch.arange(count).unsqueeze(-1) * 3 + 1
    instruction = torch.ones(count, length, dtype=torch.int64)
    instruction[:, 1] = scene[:, 0]  # tells which scene it belongs to
    return TensorDict({"scene": scene, "instruction": instruction}, [count])


def make(batch=(4,), pairs=None, seed=0, world=None, **options):
    transform = StartingPairs(make_pairs() if pairs is None else pairs, seed=seed, **options)
    return TransformedEnv(world or CounterWorld(batch), transform)


def starts(env, resets):
    """Scenes that full resets begin with, checked against their instructions."""
    scenes = []
    for _ in range(resets):
        instruction = env.reset()["instruction"].reshape(-1, 4)
        assert torch.equal(instruction[:, 1], env.scene_numbers)
        scenes += instruction[:, 1].tolist()
    return scenes


@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 5)])
def test_each_pair_is_used_once_before_any_again(batch):
    env = make(batch)
    scenes = starts(env, 70)
    for begin in range(0, len(scenes) - 6, 7):
        assert sorted(scenes[begin : begin + 7]) == list(range(1, 22, 3))


def test_order_is_new_in_each_epoch_and_a_function_of_the_seed():
    first = starts(make((7,)), 5)
    epochs = {tuple(first[begin : begin + 7]) for begin in range(0, 35, 7)}
    assert len(epochs) == 5
    assert starts(make((7,)), 5) == first
    assert starts(make((7,), seed=1), 5) != first
    assert starts(make((5,)), 7) == first


def test_episodes_of_a_rollout_begin_with_pairs():
    rollout = make((4,)).rollout(60, break_when_any_done=False)
    started = torch.ones(4, 60, dtype=torch.bool)
    started[:, 1:] = rollout["next", "done"][:, :-1, 0]
    scene = rollout["instruction"][..., 1]
    assert (shown(rollout["pixels"])[started] == scene[started] * 7 % 10).all()
    counts = Counter(scene[started].tolist())
    assert len(counts) == 7 and max(counts.values()) - min(counts.values()) <= 1


def test_other_scenes_than_the_stored_ones_are_noticed():
    pairs = make_pairs()
    world = CounterWorld((7,), seed=1)
    first = world.reset(TensorDict({"scene": pairs["scene"]}, [7]))["pixels"]
    pairs["frame_hash"] = frame_hash(first).unsqueeze(-1)
    make(pairs=pairs, world=CounterWorld((4,), seed=1)).rollout(30, break_when_any_done=False)
    with pytest.raises(UserError, match="not the one that its pair was stored with"):
        make(pairs=pairs, world=CounterWorld((4,), seed=2)).reset()


def test_an_environment_that_exposes_its_state_is_refused():
    with pytest.raises(UserError, match="exposes its true state"):
        make(world=CounterWorld((2,), expose_state=True)).reset()


def test_frame_hash_tells_images_apart():
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(2, (3000, 3, 5, 5), generator=generator, dtype=torch.uint8) * 255
    images = images.unique(dim=0)
    assert frame_hash(images).unique().numel() == len(images)
    assert torch.equal(frame_hash(images), frame_hash(images.clone()))
    swapped = images[:, :, :, [1, 0, 2, 3, 4]]
    differs = (swapped != images).flatten(1).any(1)
    assert (frame_hash(swapped) != frame_hash(images))[differs].all()
    balanced = torch.zeros(2, 1, 8, 8, dtype=torch.uint8)  # 5 + 3 x 5 + 5 x 5 = 6 + 3 x 3 + 5 x 6
    balanced[:, 0, :3, 0] = torch.tensor([[5, 5, 5], [6, 3, 6]])
    assert frame_hash(balanced).unique().numel() == 2


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (make_pairs().exclude("scene"), r"pairs lack \['scene'\]"),
        (make_pairs().exclude("instruction"), r"pairs lack \['instruction'\]"),
        (make_pairs()[:0], "pool is empty"),
        (make_pairs().set("scene", torch.rand(7, 1)), "scene must be int64"),
        (make_pairs().set("scene", torch.ones(7, 2).long()), "scene must be int64"),
    ],
)
def test_impossible_pairs(pairs, message):
    with pytest.raises(UserError, match=message):
        StartingPairs(pairs)
