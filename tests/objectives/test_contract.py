"""What every loss must do, whatever it is for."""

import re

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import LossModule

from ifo_grounding.errors import UserError
from objectives.conftest import POOL, batch, make_loss, seeded, total


def test_it_writes_what_it_says_and_only_losses_carry_gradients(kind, preset):
    loss = make_loss(kind, preset)
    assert isinstance(loss, LossModule)
    out = loss(batch())
    assert list(out.keys()) == loss.out_keys
    for key, value in out.items():
        assert value.shape == ()
        assert value.requires_grad == key.startswith("loss_")


def test_it_reads_what_it_says_and_leaves_its_input_alone(kind):
    loss = make_loss(kind)
    data = batch().select(*loss.in_keys)
    before = data.clone()
    loss(data)
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()
    for key in loss.in_keys:
        with pytest.raises(UserError, match=f"lacks .{re.escape(repr(key))}"):
            loss(data.exclude(key))
    with pytest.raises(UserError, match="the batch is empty"):
        loss(data[:0])


def test_it_can_be_called_without_a_tensordict(kind):
    loss = make_loss(kind)
    data = batch().select(*loss.in_keys)
    named = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    out, values = seeded(loss, data), seeded(loss, **named)
    assert all(map(torch.equal, (out[key] for key in loss.out_keys), values))


@pytest.mark.parametrize("size", [(), (1,), (3, 4)], ids=str)
def test_any_batch_dims_give_what_one_dim_gives(kind, size):
    loss = make_loss(kind)
    data = batch(size)
    flat = data.reshape(-1) if size else data.unsqueeze(0)
    torch.testing.assert_close(seeded(loss, data).to_dict(), seeded(loss, flat).to_dict())


def test_gradients_reach_every_parameter(kind, preset):
    loss = make_loss(kind, preset)
    total(loss(batch((64,)))).backward()
    for name, parameter in loss.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_it_may_be_of_another_precision(kind, preset, dtype):
    loss = make_loss(kind, preset).to(dtype)
    total(loss(batch())).backward()
    assert all(parameter.grad.isfinite().all() for parameter in loss.parameters())


@pytest.mark.parametrize("network_training", [True, False])
@pytest.mark.parametrize("loss_training", [True, False])
def test_the_network_computes_in_the_mode_of_the_loss_and_keeps_its_own(
    kind, loss_training, network_training
):
    loss = make_loss(kind, make_options={"dropout": 0.25}).train(loss_training)
    loss.network.train(network_training)
    seen = []
    hook = next(part for part in loss.network.modules() if isinstance(part, torch.nn.Dropout))
    hook.register_forward_hook(lambda part, *_: seen.append(part.training))
    loss(batch())
    assert set(seen) == {loss_training}
    with pytest.raises((UserError, RuntimeError)):
        loss(batch().set("pixels", torch.zeros(12, 3, 8, 8)))
    assert {part.training for part in loss.network.modules()} == {network_training}


def test_keys_of_networks_and_losses_can_be_nested(kind):
    plain = make_loss(kind)
    names = plain.network.in_keys
    nested = [("agent", *([key] if isinstance(key, str) else key)) for key in names]
    loss = make_loss(kind, make_options={"in_keys": nested})
    own = {"action": ("agent", "action"), "final": ("agent", "final")}
    loss.set_keys(**{name: key for name, key in own.items() if hasattr(loss.tensor_keys, name)})
    out = seeded(loss, TensorDict({"agent": batch()}, [12]))
    torch.testing.assert_close(out.to_dict(), seeded(plain, batch()).to_dict())
    assert all(key[0] == "agent" for key in loss.in_keys)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(nonsense="a")


@pytest.mark.parametrize("kind", ["inverse", "imitation", "reward"])
def test_padding_that_torchrl_marks_does_not_count(kind):
    loss = make_loss(kind).eval()
    data, real = batch((3, 4)), (torch.arange(4) < 2).expand(3, 4)
    padded = data.clone().set(("collector", "mask"), real)
    masked = seeded(loss, padded)
    padded["pixels"][:, 2:] = 0
    torch.testing.assert_close(seeded(loss, padded).to_dict(), masked.to_dict())
    assert not torch.equal(total(seeded(loss, data)), total(masked))


def test_it_learns_a_small_batch_by_heart(kind):
    torch.manual_seed(0)
    loss = make_loss(kind, make_options={"features": 32})
    data = batch((12,))
    data["instruction"] = POOL
    if hasattr(loss, "set_progress"):
        loss.set_progress(0.0)
    first = float(total(loss(data)).detach())
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    for _ in range(400):
        optimizer.zero_grad()
        out = loss(data)
        total(out).backward()
        optimizer.step()
        if float(total(out).detach()) < 0.03 * first:
            break
    checked = loss.eval()(data)
    assert float(total(checked).detach()) < 0.15 * first
    assert float(checked.get("accuracy", torch.ones(()))) == 1


def test_its_outputs_can_be_selected(kind):
    loss = make_loss(kind)
    every = list(loss.out_keys)
    name = next(key for key in every if key.startswith("loss_"))
    loss.select_out_keys(name)
    assert list(loss(batch()).keys()) == [name] == list(loss.out_keys)
    loss.reset_out_keys()
    assert list(loss(batch()).keys()) == every == list(loss.out_keys)
