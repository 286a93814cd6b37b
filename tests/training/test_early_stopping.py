import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ifo_grounding.errors import UserError
from ifo_grounding.training import EarlyStopping, FitConfig, fit


class Square(nn.Module):
    """(weight - target)^2, the mean over a batch, with a little noise in train mode."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, batch):
        drawn = torch.rand(())
        loss = ((self.weight - batch["target"]) ** 2).mean()
        return TensorDict({"loss_square": loss + 1e-3 * drawn * self.training})


def buffer(values):
    found = TensorDictReplayBuffer(storage=LazyTensorStorage(len(values)), batch_size=4)
    found.extend(TensorDict({"target": torch.tensor(values)}, [len(values)]))
    return found


def test_the_loss_is_the_mean_over_all_samples_and_the_best_weights_come_back():
    loss = Square()
    early_stopping = EarlyStopping(loss, buffer([1.0, 2.0, 3.0]), batch_size=2)
    assert early_stopping.measure() == pytest.approx((1 + 4 + 9) / 3)
    loss.weight.data.fill_(2.0)
    assert early_stopping.measure() == pytest.approx(2 / 3)
    loss.weight.data.fill_(5.0)
    assert early_stopping.measure() > 1
    early_stopping.restore()
    assert loss.weight.item() == 2.0


def test_fit_ends_with_the_weights_that_did_best_also_after_a_pause(tmp_path):
    config = FitConfig(steps=100, batch_size=8, lr=0.1, schedule="constant", iteration=5)

    def run(**options):
        loss = Square()
        stop = EarlyStopping(loss, buffer([2.0]))
        history = fit(loss, buffer([10.0] * 8), config, seed=0, held_out=stop, **options)
        return loss.weight.item(), history

    weight, history = run()
    seen = [row["held_out_loss"] for row in history if "held_out_loss" in row]
    assert len(seen) == 5
    assert (weight - 2) ** 2 == pytest.approx(min(seen), rel=1e-4)
    assert min(seen) < seen[-1]
    run(checkpoint=tmp_path / "a.pt", until=60)
    assert run(checkpoint=tmp_path / "a.pt")[0] == weight


def test_a_measure_leaves_mode_and_randomness_alone():
    loss = Square()
    state = torch.random.get_rng_state()
    EarlyStopping(loss, buffer([1.0])).measure()
    assert loss.training
    assert torch.equal(state, torch.random.get_rng_state())


def test_nothing_held_out_is_refused():
    with pytest.raises(UserError, match="no held-out samples"):
        EarlyStopping(Square(), TensorDictReplayBuffer(storage=LazyTensorStorage(3)))
