import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ifo_grounding.data import first_frame_buffer, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_instruction_classifier
from ifo_grounding.objectives import InstructionLoss
from ifo_grounding.training import FitConfig, HeldOut, fit


class Square(nn.Module):
    """(weight - target)^2, the mean over a batch."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, batch):
        return TensorDict({"loss_square": ((self.weight - batch["target"]) ** 2).mean()})


def buffer(values):
    found = TensorDictReplayBuffer(storage=LazyTensorStorage(len(values)), batch_size=4)
    found.extend(TensorDict({"target": torch.tensor(values)}, [len(values)]))
    return found


def test_the_loss_is_the_mean_over_all_samples_and_the_best_weights_come_back():
    loss = Square()
    held_out = HeldOut(loss, buffer([1.0, 2.0, 3.0]), batch_size=2)
    assert held_out.look() == pytest.approx((1 + 4 + 9) / 3)
    loss.weight.data.fill_(2.0)
    assert held_out.look() == pytest.approx(2 / 3)
    loss.weight.data.fill_(5.0)
    assert held_out.look() > 1
    held_out.restore()
    assert loss.weight.item() == 2.0


def test_fit_ends_with_the_weights_that_did_best_on_held_out_samples(tmp_path):
    config = FitConfig(steps=100, batch_size=8, lr=0.1, schedule="constant", iteration=5)

    def run(**options):
        loss = Square()
        history = fit(
            loss,
            buffer([10.0] * 8),
            config,
            seed=0,
            held_out=HeldOut(loss, buffer([2.0])),
            **options,
        )
        return loss.weight.item(), history

    weight, history = run()
    seen = [row["held_out_loss"] for row in history if "held_out_loss" in row]
    assert len(seen) == 5
    assert (weight - 2) ** 2 == pytest.approx(min(seen), rel=1e-4)
    assert min(seen) < seen[-1]
    assert run(checkpoint=tmp_path / "a.pt")[0] == weight


def test_a_look_leaves_mode_and_randomness_alone():
    loss = Square()
    state = torch.random.get_rng_state()
    HeldOut(loss, buffer([1.0])).look()
    assert loss.training
    assert torch.equal(state, torch.random.get_rng_state())


def test_a_look_leaves_the_network_and_generators_of_its_own_alone():
    demos = record_demonstrations("move", 20, seed=0)
    classifier = make_instruction_classifier(demos, "paper", seed=0).eval()
    generator = torch.Generator().manual_seed(7)
    loss = InstructionLoss(classifier, demos.pool(), generator=generator)
    held_out = HeldOut(loss, first_frame_buffer(demos))
    assert held_out.look() == held_out.look()
    assert not classifier.training
    assert torch.equal(generator.get_state(), torch.Generator().manual_seed(7).get_state())


def test_nothing_held_out_is_refused():
    with pytest.raises(UserError, match="no held-out samples"):
        HeldOut(Square(), TensorDictReplayBuffer(storage=LazyTensorStorage(3)))
