"""What TorchRL asks of a transform: single, serial, parallel, composed, nested, collected."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv, check_env_specs
from torchrl.testing import rollout_consistency_assertion

from ifo_grounding.transforms import GoalReward, InstructionSampler, LearnedReward, StartingPairs
from transforms.counter_world import (
    POOL,
    STOP,
    CounterWorld,
    classifier,
    goal_classifier,
    reward_model,
    shown,
)

# Number shown by scene n: 7 n mod 10; the instruction asks for one more.
ASKED = torch.stack([POOL[(n * 7 % 10 + 1) % 10] for n in range(20)])
PAIRS = TensorDict({"scene": torch.arange(20).unsqueeze(-1), "instruction": ASKED}, [20])


def sampler(nested=False):
    options = {"in_keys": [("agent", "pixels")], "out_keys": [("agent", "instruction")]}
    return InstructionSampler(classifier(nested), POOL, **(options if nested else {}))


def action(nested=False):
    return LearnedReward(reward_model(nested), out_keys=[("agent", "rwd")] if nested else ["rwd"])


def goal(nested=False):
    out_keys = [("agent", "learned_reward")] if nested else None
    return GoalReward(goal_classifier(nested), STOP, out_keys=out_keys)


MAKERS = {
    "sampler": lambda: [sampler()],
    "sampler and rewards": lambda: [sampler(), action(), goal()],
    "rewards and sampler": lambda: [goal(), action(), sampler()],
    "pairs and rewards": lambda: [StartingPairs(PAIRS), goal(), action()],
}


def inside(name, batch=(2,)):
    parts = MAKERS[name]()
    return TransformedEnv(CounterWorld(batch), parts[0] if len(parts) == 1 else Compose(*parts))


def around(workers, name):
    return TransformedEnv(workers, Compose(*MAKERS[name]()))


def check(env, name):
    """Check what must hold of any rollout, however its environment was put together."""
    check_env_specs(env, break_when_any_done="both")
    rollout = env.rollout(20, break_when_any_done=False)
    started = torch.ones(rollout.shape, dtype=torch.bool)
    started[..., 1:] = rollout["next", "done"][..., :-1, 0]
    assert started[..., 1:].any()
    suitable = rollout["instruction"][..., 0] - 1 > shown(rollout["pixels"])
    if "pairs" in name:  # 9 shown asks for 0
        suitable |= shown(rollout["pixels"]) == 9
    assert suitable[started].all()
    for key in ("instruction", "initial_pixels") if "reward" in name else ("instruction",):
        assert torch.equal(rollout["next", key], rollout[key])
        values = rollout[key].flatten(rollout.ndim)
        kept = (values[..., 1:, :] == values[..., :-1, :]).all(-1)
        assert kept[~started[..., 1:]].all() and not kept.all()
    if "reward" in name:
        assert torch.equal(rollout["initial_pixels"][started], rollout["pixels"][started])
        for transform, key in ((action(), ("next", "rwd")), (goal(), ("next", "learned_reward"))):
            assert torch.equal(transform(rollout.exclude(key))[key], rollout[key])
    flat = rollout.reshape(-1, rollout.shape[-1])
    for key in ("pixels", "instruction"):
        rollout_consistency_assertion(flat, observation_key=key, done_strict=True)


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize(
    "make",
    [
        lambda name: inside(name, ()),
        lambda name: inside(name, (2, 3)),
        lambda name: SerialEnv(2, lambda: inside(name, ())),
        lambda name: SerialEnv(2, lambda: inside(name, (3,))),
    ],
)
def test_around_one_world_or_in_serial_workers(name, make):
    check(make(name), name)


@pytest.mark.parametrize("name", ["sampler", "sampler and rewards", "rewards and sampler"])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_around_serial_workers(name, batch):
    check(around(SerialEnv(2, lambda: CounterWorld(batch)), name), name)


@pytest.mark.filterwarnings("ignore:A lambda function was passed to ParallelEnv")
@pytest.mark.parametrize(
    ("name", "world"),
    [
        ("sampler and rewards", inside),
        ("pairs and rewards", inside),
        ("sampler and rewards", lambda _: CounterWorld((2,))),
    ],
)
def test_with_parallel_workers(name, world):
    workers = ParallelEnv(2, lambda: world(name), mp_start_method="fork")
    try:
        if world is inside:
            check(workers, name)
        # In a plain TransformedEnv workers are reset by a command that reaches them without entries
        check(TransformedEnv(workers) if world is inside else around(workers, name), name)
    finally:
        workers.close()


@pytest.mark.parametrize("order", [(sampler, action, goal), (goal, action, sampler)])
def test_nested_keys(order):
    world = CounterWorld((3,), nested=True)
    env = TransformedEnv(world, Compose(*(make(nested=True) for make in order)))
    check_env_specs(env, break_when_any_done="both")
    rollout = env.rollout(30, break_when_any_done=False)
    assert rollout["agent", "instruction"].shape == (3, 30, 4)
    gap = rollout["agent", "instruction"][..., 0] - 1 - shown(rollout["agent", "pixels"])
    wanted = torch.where(gap > 0, 0, torch.where(gap < 0, 1, STOP))
    right = wanted == rollout["action"]
    expected = torch.where(right, torch.tensor(2.0).sigmoid(), torch.tensor(-1.0).sigmoid())
    assert torch.allclose(rollout["next", "agent", "rwd"][..., 0], expected)
    paid = rollout["next", "agent", "learned_reward"][..., 0] > 0
    assert paid.any() and torch.equal(paid, rollout["action"] == STOP)


def test_pairs_outside_of_workers_are_refused():
    env = TransformedEnv(SerialEnv(2, CounterWorld), StartingPairs(PAIRS))
    with pytest.raises(ValueError, match="cannot reach the simulators through a SerialEnv"):
        env.reset()


def test_on_a_replay_buffer():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50), batch_size=10)
    for transform in (sampler(), LearnedReward(reward_model())):
        buffer.append_transform(transform)
    pixels = torch.zeros(50, 3, 8, 8, dtype=torch.uint8)
    buffer.extend(TensorDict({"pixels": pixels, "action": torch.zeros(50).long()}, [50]))
    assert torch.allclose(buffer.sample()["next", "learned_reward"], torch.tensor(2.0).sigmoid())
    stored = TensorDictReplayBuffer(storage=LazyTensorStorage(9), batch_size=9)
    stored.append_transform(StartingPairs(PAIRS))
    stored.extend(TensorDict({"pixels": torch.ones(9, 3)}, [9]))
    assert set(stored.sample().keys()) == {"pixels", "index"}
