import pytest
import torch
from torchrl.envs import Compose, SerialEnv, TransformedEnv

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_goal_classifier, make_instruction_classifier, make_policy
from ifo_grounding.seeding import derive
from ifo_grounding.training import accepted, accepted_steps
from ifo_grounding.training.environment import make_collector, reseed
from ifo_grounding.transforms import InstructionSampler, LearnedReward


def test_episodes_are_accepted_by_their_own_return():
    reward = torch.tensor([[0.3, 0.3, 0.0, 0.9, 0.4, 0.9], [0.0, 0.4, 0.6, 0.0, 0.0, 0.5]])
    done = torch.tensor([[0, 1, 0, 1, 0, 0], [0, 1, 1, 0, 0, 1]]).bool()
    assert accepted(reward, done, 0.5).int().tolist() == [[1, 1, 1, 1, 0, 0], [0, 0, 1, 1, 1, 1]]


def practice(bias):
    simulator = PickAndPlaceEnv("move", num_envs=8, seed=0, instructed=False)
    small = {"features": 16, "seed": 0}
    classifier = make_instruction_classifier(simulator, **small)
    judge = make_goal_classifier(simulator, **small)
    judge.module.prior.fill_(bias)  # accepts everything, or nothing
    pool = torch.randint(1, 20, (4, 16))
    sampler = InstructionSampler(classifier, pool, threshold=0.0)
    env = TransformedEnv(simulator, Compose(sampler, LearnedReward(judge, "goal")))
    return env, make_policy(simulator, **small)


def test_steps_of_accepted_episodes_come_with_what_imitation_needs():
    env, policy = practice(50.0)
    steps = accepted_steps(env, policy, iterations=2, steps=15, seed=0)
    assert set(steps.keys()) == {keys.PIXELS, keys.INSTRUCTION, keys.ACTION}
    stops = int((steps[keys.ACTION] == 5).sum())
    assert 0 < stops <= len(steps) <= 2 * 8 * 15
    again = accepted_steps(env, policy, iterations=2, steps=15, seed=0)
    assert (steps == again).all()


def test_a_judge_that_accepts_nothing_is_an_error():
    env, policy = practice(-50.0)
    with pytest.raises(UserError, match="accepted no episode"):
        accepted_steps(env, policy, iterations=1, steps=15, seed=0)


def test_worlds_in_workers_are_as_those_side_by_side():
    def world(seed):
        return PickAndPlaceEnv("move", num_envs=3, seed=seed, instructed=False)

    _, policy = practice(0.0)
    judge = make_goal_classifier(world(0), features=16, seed=0)
    judge.module.prior.fill_(50.0)  # a goal is reached whenever the policy stops
    classifier = make_instruction_classifier(world(0), features=16, seed=0)
    sampler = InstructionSampler(classifier, torch.randint(1, 20, (4, 16)), threshold=0.0)
    workers = SerialEnv(2, [lambda: world(0), lambda: world(1)])
    env = TransformedEnv(workers, Compose(sampler, LearnedReward(judge, "goal", stop_action=5)))
    steps = accepted_steps(env, policy, iterations=1, steps=10, seed=0)

    batches = iter(make_collector(env, policy, 10))
    reseed(env, derive(0, "accepted steps", 0))
    batch = next(batches)
    expected = []
    for row in batch.reshape(-1, 10):
        stops = (row["action"] == 5).nonzero().flatten().tolist()
        expected.append(row["action"][: max(stops, default=-1) + 1])
    assert torch.equal(steps["action"], torch.cat(expected))
