import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    RandomSampler,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)

from ifo_grounding.errors import UserError
from ifo_grounding.networks import Shapes, make_instruction_classifier, make_policy
from ifo_grounding.networks.warm_start import inherited
from ifo_grounding.objectives import ImitationLoss, InstructionLoss
from ifo_grounding.training import FitConfig, fit
from ifo_grounding.training.updates import total_loss
from training import tiny
from training.tiny import kill_at, same, weights

SHAPES = Shapes(image_shape=(3, 16, 16), vocabulary_size=10, tile_size=8)


@pytest.fixture
def buffer():
    """Brightness of the picture and first word decide the action together."""
    draw = torch.Generator().manual_seed(0)
    bright = torch.randint(2, (256,), generator=draw)
    word = torch.randint(2, (256,), generator=draw)
    pixels = (bright * 255).to(torch.uint8).view(-1, 1, 1, 1).expand(-1, 3, 16, 16)
    instruction = torch.zeros(256, 16, dtype=torch.int64)
    instruction[:, 0] = 1 + word
    data = {"pixels": pixels.clone(), "instruction": instruction, "action": 2 * bright + word}
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(256))
    buffer.extend(TensorDict(data, [256]))
    return buffer


def imitation(dropout=0.0):
    return ImitationLoss(tiny.make_policy(dropout))


def test_fit_learns_and_reports_each_iteration(buffer):
    loss = imitation()
    seen = []
    config = FitConfig(steps=60, batch_size=64, lr=1e-1, iteration=20)
    history = fit(loss, buffer, config, seed=0, log=lambda metrics, step: seen.append(step))
    assert [metrics["step"] for metrics in history] == [20, 40, 60] == seen
    assert history[-1]["loss_imitation"] < 0.1 < history[0]["loss_imitation"]
    assert history[-1]["accuracy"] == 1.0
    assert history[-1]["samples_per_second"] > 0


@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement])
def test_a_killed_run_continues_to_the_same_weights(buffer, tmp_path, sampler):
    """Also within a round of all samples, which has eight steps."""

    def learn(loss, **options):
        stored = TensorDictReplayBuffer(storage=LazyTensorStorage(256), sampler=sampler())
        stored.extend(buffer[:256])
        return fit(loss, stored, FitConfig(steps=12, batch_size=32, iteration=3), seed=0, **options)

    whole = imitation(0.25)
    expected = learn(whole)
    options = {"checkpoint": tmp_path / "run.pt", "checkpoint_seconds": 0.0}
    with pytest.raises(KeyboardInterrupt):
        learn(imitation(0.25), log=kill_at(9), **options)
    resumed, steps = imitation(0.25), []
    history = learn(resumed, log=lambda _, step: steps.append(step), **options)
    assert steps == [9, 12]  # the iteration that was cut is done again
    for row in (*history, *expected):
        row.pop("samples_per_second")
    assert history == expected
    assert same(weights(whole), weights(resumed))


def test_the_schedule_warms_up_and_ends_near_zero():
    config = FitConfig(steps=100)
    assert config.rate(0) == pytest.approx(0.1)
    assert config.rate(9) == 1.0
    assert config.rate(55) == pytest.approx(0.5 * (1 + math.cos(math.pi / 2)))
    assert config.rate(99) < 0.001
    assert FitConfig(schedule="constant").rate(1234) == 1.0


@pytest.mark.parametrize(
    "wrong",
    [
        *({"steps": 0}, {"batch_size": -1}, {"schedule": "linear"}, {"prior": -1}),
        *({"iteration": 0}, {"lr": 0}, {"lr": math.nan}, {"weight_decay": math.inf}),
    ],
    ids=str,
)
def test_impossible_configs_are_refused(wrong):
    with pytest.raises(UserError):
        FitConfig(**wrong)


def test_the_prior_counts_for_the_more_the_fewer_the_samples(buffer):
    def size_of_weights(samples, prior):
        loss = imitation()
        few = TensorDictReplayBuffer(storage=LazyTensorStorage(samples))
        few.extend(buffer[:samples])
        fit(loss, few, FitConfig(steps=20, batch_size=32, lr=1e-2, prior=prior), seed=0)
        return sum(weight.square().sum().item() for weight in loss.parameters())

    assert size_of_weights(16, prior=200) < size_of_weights(256, prior=200)
    assert size_of_weights(256, prior=200) < size_of_weights(256, prior=0)
    assert FitConfig(weight_decay=0.5, prior=1).decay(10) == 0.5
    assert FitConfig(prior=1).decay(0) == 1.0


def test_what_was_inherited_decays_to_what_it_was(buffer, tmp_path):
    """And all else to zero, through a pause as well."""
    policy = make_policy(SHAPES, "strong", seed=0)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(0.5)  # far from zero
    config = FitConfig(steps=20, batch_size=16, lr=1e-3, schedule="constant", prior=256 * 100)
    loss, begun = suitability(policy), suitability(policy)
    for until in (10, None):
        fit(loss, buffer, config, seed=0, checkpoint=tmp_path / "fit.pt", until=until)
    origins = inherited(loss)
    assert len(origins) > 10
    for weight, then in origins:
        torch.testing.assert_close(weight, then, atol=0.05, rtol=0)
    now, before = loss.network.module.head[1].weight, begun.network.module.head[1].weight
    assert now.norm() < before.norm() / 4


def suitability(policy):
    words = torch.tensor([[1], [2]]).expand(2, 16)
    network = make_instruction_classifier(SHAPES, seed=0, init_from=policy, roles=True)
    return InstructionLoss(network, words, removal_rate=0.0)


def test_only_losses_are_minimised_and_only_buffers_sampled():
    losses = TensorDict({"loss_a": torch.tensor(2.0), "loss_b": torch.tensor([1.0, 3.0])}, [])
    losses["accuracy"] = torch.tensor(100.0)
    assert total_loss(losses) == 4.0
    for none in (torch.ones(()), None, losses.select("accuracy")):
        with pytest.raises(UserError, match=r"entries named loss_\*, got (T|NoneT).* without"):
            total_loss(none)
    with pytest.raises(UserError, match="got list: demonstrations become one by labelled_buffer"):
        fit(torch.nn.Linear(1, 1), [1, 2], FitConfig(steps=1), seed=0)


def test_a_network_that_diverges_is_not_learned_on(buffer):
    with pytest.raises(UserError, match="fit diverged: loss_imitation no longer finite by step"):
        fit(imitation(), buffer, FitConfig(steps=40, iteration=5, batch_size=16, lr=1e30), seed=0)
