"""What the losses share: one network, its mode while the loss computes, and reductions."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.modules import charges, hidden_from_python, output_key


@contextlib.contextmanager
def mode(network: nn.Module, training: bool) -> Iterator[None]:
    """Put every part of ``network`` into train or eval mode, and back into its own afterwards.

    >>> network = nn.Sequential(nn.Dropout(), nn.Linear(1, 1)).eval()
    >>> with mode(network, training=True):
    ...     inside = network[0].training
    >>> inside, network[0].training
    (True, False)
    """
    before = {part: part.training for part in network.modules()}
    network.train(training)
    try:
        yield
    finally:
        for part, was in before.items():
            part.training = was


class SupervisedLoss(LossModule):
    """Base of the supervised losses of one network.

    The network computes in the mode of the loss, whatever its own: with dropout after
    ``loss.train()`` (as built), without after ``loss.eval()``. Afterwards each part of the network
    is back in the mode it had, so a policy that collects in eval mode stays in it.

    Args:
        network: the network to train.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over the losses of the samples. Metrics are
            always means.

    Raises:
        UserError: where it is unclear which output of the network is to learn.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"

    default_keys: Any = _AcceptedKeys
    tensor_keys: Any
    written: str | None = None
    """How the output that is learned is named, where a network writes several."""

    def __init__(self, network: TensorDictModule, *, reduction: str = "mean") -> None:
        super().__init__()
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        self.network = network
        self.reduction = reduction
        self.output = None if self.written is None else output_key(network, self.written)

    @property
    def functional(self) -> bool:
        """The network is used as it is: nothing is copied or made stateless."""
        return False

    @property
    def capturable(self) -> bool:
        """Whether all steps do the same, so that a GPU may be told of them once (a CUDA graph)."""
        return False

    def _steps_alike(self) -> bool:
        """Whether no words are charged for, and no numbers drawn from a generator of its own."""
        parts = [getattr(part, "generator", None) for part in self.modules()]
        return not charges(self.network) and all(part is None for part in parts)

    def _own_keys(self) -> list[NestedKey]:
        """Return the keys that are read because the network reads them."""
        return list(self.network.in_keys)

    def _extra_keys(self) -> list[NestedKey]:
        """Return the keys read besides the network's own."""
        return [self.tensor_keys.action]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Every key that :meth:`forward` reads."""
        own = self._own_keys()
        return own + [key for key in self._extra_keys() if key not in own]

    @in_keys.setter
    def in_keys(self, values: object) -> None:
        raise UserError("in_keys follow from the network and set_keys: use set_keys")

    def _require(self, tensordict: TensorDictBase) -> None:
        """Raise :class:`UserError` where a key is missing, for ``get`` would return None."""
        missing = [key for key in self.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise UserError(
                f"the batch lacks {missing}: {type(self).__name__} reads {self.in_keys}; set_keys "
                "and the in_keys of the network change the names"
            )

    def _mode(self) -> contextlib.AbstractContextManager[None]:
        return mode(self.network, self.training)

    def _mean(self, values: Tensor, tensordict: TensorDictBase | None = None) -> Tensor:
        """Return the mean of a metric over the samples that a mask of TorchRL leaves."""
        return self._reduce_loss(values.detach().float(), tensordict, reduction="mean")

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """No value estimator: nothing to forward."""


def flat(tensordict: TensorDictBase, keys: list[NestedKey]) -> TensorDictBase:
    """Return the entries at ``keys`` with one batch dim."""
    chosen = tensordict.select(*keys)
    return chosen.reshape(chosen.batch_size.numel()) if chosen.ndim else chosen.unsqueeze(0)


def scalars(**values: Tensor) -> TensorDict:
    """Return a tensordict without batch dims."""
    return TensorDict(dict(values), [])


def check_action(action: Tensor, expected: tuple[int, ...], count: int | None = None) -> None:
    """Raise :class:`UserError` unless ``action`` has the shape that the network acts in.

    Where ``count`` actions are known, indices have to be of them; on a CPU, for elsewhere to look
    is to wait, and not where ``torch.vmap`` or the compiler hides them.
    """
    if tuple(action.shape) != tuple(expected):
        raise UserError(
            f"actions must have shape {list(expected)}, got {list(action.shape)}: indices have no "
            "trailing dim, and one-hot actions fit a one-hot policy alone"
        )
    seen = action.device.type == "cpu" and not hidden_from_python(action)
    if count is not None and action.is_floating_point():
        raise UserError(f"actions are whole numbers 0..{count - 1}, got {action.dtype}")
    if count is None or not seen or not action.numel():
        return
    for number in map(int, action.aminmax()):
        if not 0 <= number < count:
            raise UserError(
                f"action {number} is none of the network's 0..{count - 1}: make the network for "
                "the environment whose actions these are"
            )
