"""Parts that several threads use at once, or that a fresh process is given."""

import multiprocessing
import threading
from pathlib import Path

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import exploration_type

from ifo_grounding import networks
from ifo_grounding.data import label_demonstrations, labelled_buffer, record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.evaluation import success_rate
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.transforms import InstructionSampler, LearnedReward, PoolScorer

THREADS = 3


@pytest.fixture(scope="module")
def parts():
    demos, truth = record_demonstrations("move", 30, keep_truth=True)
    buffer = labelled_buffer(demos, truth.actions)
    return {
        "demos": demos,
        "batch": buffer[:32],
        "first": torch.stack([demos[number]["pixels"][0] for number in range(len(demos))]),
        "policy": networks.make_policy(demos, "strong", seed=0),
        "classifier": networks.make_instruction_classifier(demos, "strong", seed=0),
        "reward": networks.make_reward_model(demos, "strong", seed=0),
        "inverse": networks.make_inverse(demos, "strong", seed=0),
    }


def imitation_loss(parts):
    return ImitationLoss(parts["policy"]).eval()(parts["batch"])["loss_imitation"].detach()


def chosen(parts):
    scorer = PoolScorer(parts["classifier"], parts["demos"].pool())
    return scorer.choose(parts["first"], threshold=0.3, choose="best").chosen


def paid(parts):
    return LearnedReward(parts["reward"])(parts["batch"].clone())["next", "learned_reward"]


def labelled(parts):
    return label_demonstrations(parts["demos"], parts["inverse"])[1].actions


def succeeded(parts):
    env = PickAndPlaceEnv("move", num_envs=8, seed=3)
    return success_rate(parts["policy"], env, episodes=16, max_steps=8).outcomes


def practised(parts):
    sampler = InstructionSampler(parts["classifier"], parts["demos"].pool(), threshold=0.01)
    env = PickAndPlaceEnv("move", num_envs=4, seed=5, instructed=False)
    env = TransformedEnv(env, Compose(sampler, LearnedReward(parts["reward"])))
    return env.reset()["instruction"]


USES = (imitation_loss, chosen, paid, labelled, succeeded, practised)


def modes(parts):
    """Return the mode of each module, and how policies act."""
    made = (part for part in parts.values() if isinstance(part, torch.nn.Module))
    return [exploration_type(), *(module.training for part in made for module in part.modules())]


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("use", USES)
def test_threads_find_what_one_finds_and_leave_modes_alone(use, training, parts):
    for part in parts.values():
        if isinstance(part, torch.nn.Module):
            part.train(training)
    alone, before = use(parts), modes(parts)
    found, wrong = [], []

    def work():
        try:
            found.extend(use(parts) for _ in range(2))
        except Exception as error:
            wrong.append(error)

    threads = [threading.Thread(target=work) for _ in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and len(found) == 2 * THREADS
    assert all(torch.equal(one, alone) for one in found)
    assert modes(parts) == before


def all_uses(parts, answers):
    torch.set_num_threads(1)
    answers.put([use(parts).tolist() for use in USES])


def test_a_fresh_process_finds_the_same(parts, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # where it finds this very file
    context = multiprocessing.get_context("spawn")
    answers = context.Queue()
    process = context.Process(target=all_uses, args=(parts, answers))
    process.start()
    found = answers.get(timeout=120)
    process.join()
    assert found == [use(parts).tolist() for use in USES]
