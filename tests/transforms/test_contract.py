"""What TorchRL asks of a transform: single, serial, parallel, composed, nested, collected."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
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

PAIRS = TensorDict(  # number shown by scene n: 7 n mod 10; the instruction asks for one more
    {
        "scene": torch.arange(20).unsqueeze(-1),
        "instruction": torch.stack([POOL[(n * 7 % 10 + 1) % 10] for n in range(20)]),
    },
    [20],
)


def sampler(nested=False):
    options = {"in_keys": [("agent", "pixels")], "out_keys": [("agent", "instruction")]}
    return InstructionSampler(classifier(nested), POOL, **(options if nested else {}))


def action(nested=False):
    return LearnedReward(reward_model(nested), out_keys=[("agent", "rwd")] if nested else ["rwd"])


def goal(nested=False):
    out_keys = [("agent", "learned_reward")] if nested else None
    return GoalReward(goal_classifier(nested), STOP, out_keys=out_keys)


def pairs():
    return StartingPairs(PAIRS)


MAKERS = {
    "sampler": lambda: [sampler()],
    "sampler and rewards": lambda: [sampler(), action(), goal()],
    "rewards and sampler": lambda: [goal(), action(), sampler()],
    "pairs and rewards": lambda: [pairs(), goal(), action()],
}
OUTSIDE = ("sampler", "sampler and rewards", "rewards and sampler")


def inside(name, batch=(2,)):
    parts = MAKERS[name]()
    return TransformedEnv(CounterWorld(batch), parts[0] if len(parts) == 1 else Compose(*parts))


def consistent(rollout, name):
    """Check what must hold of any rollout, however its environment was put together."""
    started = torch.ones(rollout.shape, dtype=torch.bool)
    started[..., 1:] = rollout["next", "done"][..., :-1, 0]
    assert started[..., 1:].any()
    suitable = rollout["instruction"][..., 0] - 1 > shown(rollout["pixels"])
    if "pairs" in name:  # 9 shown asks for 0
        suitable |= shown(rollout["pixels"]) == 9
    assert suitable[started].all()
    assert torch.equal(rollout["next", "instruction"], rollout["instruction"])
    kept = (rollout["instruction"][..., 1:, :] == rollout["instruction"][..., :-1, :]).all(-1)
    assert kept[~started[..., 1:]].all()
    if "reward" in name:
        assert torch.equal(rollout["initial_pixels"][started], rollout["pixels"][started])
        for transform, key in ((action(), ("next", "rwd")), (goal(), ("next", "learned_reward"))):
            assert torch.equal(transform(rollout.exclude(key))[key], rollout[key])


def check(env, name):
    try:
        check_env_specs(env, break_when_any_done="both")
        rollout = env.rollout(20, break_when_any_done=False)
        consistent(rollout, name)
        flat = rollout.reshape(-1, rollout.shape[-1])
        for key in ("pixels", "instruction"):
            rollout_consistency_assertion(flat, observation_key=key, done_strict=True)
    finally:
        env.close()


pytestmark = pytest.mark.filterwarnings("ignore:A lambda function was passed to ParallelEnv")


@pytest.mark.parametrize("name", MAKERS)
class TestContract:
    @pytest.mark.parametrize("batch", [(), (2, 3)])
    def test_single(self, name, batch):
        check(inside(name, batch), name)

    @pytest.mark.parametrize("batch", [(), (3,)])
    def test_serial_inside(self, name, batch):
        check(SerialEnv(2, lambda: inside(name, batch)), name)

    def test_parallel_inside(self, name):
        check(ParallelEnv(2, lambda: inside(name), mp_start_method="fork"), name)

    def test_parallel_inside_a_plain_transformed_env(self, name):
        # Workers are reset by a command of their own here, which reaches them without entries.
        check(TransformedEnv(ParallelEnv(2, lambda: inside(name), mp_start_method="fork")), name)

    def test_collected(self, name):
        collector = Collector(inside(name, (4,)), frames_per_batch=60, total_frames=120)
        batches = list(collector)
        collector.shutdown()
        for batch in batches:
            assert torch.equal(batch["next", "instruction"], batch["instruction"])


@pytest.mark.parametrize("name", OUTSIDE)
class TestOutside:
    @pytest.mark.parametrize("batch", [(), (3,)])
    def test_serial(self, name, batch):
        env = TransformedEnv(SerialEnv(2, lambda: CounterWorld(batch)), Compose(*MAKERS[name]()))
        check(env, name)

    def test_parallel(self, name):
        workers = ParallelEnv(2, lambda: CounterWorld((2,)), mp_start_method="fork")
        check(TransformedEnv(workers, Compose(*MAKERS[name]())), name)


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
    env = TransformedEnv(SerialEnv(2, CounterWorld), pairs())
    with pytest.raises(ValueError, match="cannot reach the simulators through a SerialEnv"):
        env.reset()


def test_on_a_replay_buffer():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50), batch_size=10)
    for transform in (sampler(), LearnedReward(reward_model())):
        buffer.append_transform(transform)
    buffer.extend(
        TensorDict(
            {
                "pixels": torch.zeros(50, 3, 8, 8, dtype=torch.uint8),
                "action": torch.zeros(50).long(),
            },
            [50],
        )
    )
    assert torch.allclose(buffer.sample()["next", "learned_reward"], torch.tensor(2.0).sigmoid())
    stored = TensorDictReplayBuffer(
        storage=LazyTensorStorage(9), batch_size=9, transform=StartingPairs(PAIRS)
    )
    stored.extend(TensorDict({"pixels": torch.ones(9, 3)}, [9]))
    assert set(stored.sample().keys()) == {"pixels", "index"}
