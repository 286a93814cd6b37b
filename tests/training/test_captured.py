"""CUDA graphs need a GPU; without one, what prepares for them is tested."""

import pytest
import torch

from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.networks import make_policy, make_reward_model
from ifo_grounding.objectives import ImitationLoss, RewardLoss
from ifo_grounding.training import FitConfig, fit
from ifo_grounding.training.captured import let_capture, set_rate
from ifo_grounding.training.supervised import make_optimizer

NETWORKS = {ImitationLoss: make_policy, RewardLoss: make_reward_model}


def test_an_optimizer_is_captured_or_not_whatever_a_checkpoint_says():
    weight = torch.nn.Parameter(torch.ones(2))
    optimizer = make_optimizer([weight], 0.1)
    let_capture(optimizer, True)
    rate = optimizer.param_groups[0]["lr"]
    set_rate(optimizer, 0.25)
    assert rate.item() == 0.25
    saved = optimizer.state_dict()
    other = make_optimizer([weight], 0.1)
    other.load_state_dict(saved)
    let_capture(other, False)
    assert (other.param_groups[0]["lr"], other.param_groups[0]["capturable"]) == (0.25, False)
    set_rate(other, 0.5)
    assert other.param_groups[0]["lr"] == 0.5
    weight.grad = torch.ones(2)
    other.step()
    assert (weight < 1).all()


def test_only_steps_that_are_all_the_same_can_be_captured():
    demos = record_demonstrations("move", 2, seed=0)
    for kind, make in NETWORKS.items():
        assert kind(make(demos, "paper", seed=0)).capturable
    assert not ImitationLoss(make_policy(demos, "strong", seed=0)).capturable  # charges for words
    drawn = RewardLoss(make_reward_model(demos, "paper", seed=0), generator=torch.Generator())
    assert not drawn.capturable


@pytest.mark.gpu
@pytest.mark.parametrize(("kind", "tolerance"), [(ImitationLoss, 0.02), (RewardLoss, 0.1)])
def test_a_captured_step_learns_what_single_kernels_learn(kind, tolerance, tmp_path):
    demos, truth = record_demonstrations("move", 200, seed=0, keep_truth=True)
    make = NETWORKS[kind]
    config = FitConfig(steps=60, batch_size=64, iteration=10)
    found = {}
    for cudagraph in (False, True):
        buffer = labelled_buffer(demos, truth.actions)
        buffer.transform.to("cuda")
        for until in (30, None):  # paused, and continued with other weights to begin with
            network = make(demos, "paper", seed=0, device="cuda", dropout=0.0, precision="fp32")
            history = fit(
                kind(network),
                buffer,
                config,
                seed=0,
                cudagraph=cudagraph,
                checkpoint=tmp_path / f"{cudagraph}.pt",
                until=until,
            )
        found[cudagraph] = torch.tensor([list(row.values())[1] for row in history])
    assert (found[True] - found[False]).abs().max() < tolerance, found
    assert found[True][-1] < found[True][0]
