"""What the losses share: one network, its mode while the loss computes, and means."""

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

from ifo_grounding.errors import UserError
from ifo_grounding.modules import has_word_penalty, output_key


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
        network: the network to train, used as it is: nothing is copied or made stateless.

    Raises:
        UserError: where it is unclear which output of the network is to learn.
    """

    @dataclass
    class _AcceptedKeys:
        """No keys but the network's."""

    default_keys: Any = _AcceptedKeys
    tensor_keys: Any
    written: str | None = None
    """How the output that is learned is named, where a network writes several."""

    def __init__(self, network: TensorDictModule) -> None:
        super().__init__()
        self.network = network
        self.reduction = "mean"
        self.output = None if self.written is None else output_key(network, self.written)

    @property
    def functional(self) -> bool:
        """Not functional: the network is used as it is."""
        return False

    @property
    def capturable(self) -> bool:
        """Whether a training step can be captured as a CUDA graph: all steps do the same.

        They do not where a network looks at which words a batch says, or where random numbers come
        from a generator of the loss.
        """
        own = any(getattr(part, "generator", None) is not None for part in self.modules())
        return not own and not has_word_penalty(self.network)

    def _own_keys(self) -> list[NestedKey]:
        """Return the keys that are read because the network reads them."""
        return list(self.network.in_keys)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Every key that :meth:`forward` reads: the network's, and those of ``set_keys``."""
        own = self._own_keys()
        return own + [key for key in vars(self.tensor_keys).values() if key not in own]

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
        return self._reduce_loss(values.detach().float(), tensordict)

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

    Where ``count`` actions are known, indices have to be of them. On a GPU, which would have to be
    waited for, they are not checked.
    """
    if tuple(action.shape) != tuple(expected):
        raise UserError(
            f"actions must have shape {list(expected)}, got {list(action.shape)}: indices have no "
            "trailing dim, and one-hot actions fit a one-hot policy alone"
        )
    if count is not None and action.is_floating_point():
        raise UserError(f"actions are whole numbers 0..{count - 1}, got {action.dtype}")
    if count is None or action.is_cuda or not action.numel():
        return
    for number in map(int, action.aminmax()):
        if not 0 <= number < count:
            raise UserError(
                f"action {number} is none of the network's 0..{count - 1}: make the network for "
                "the environment whose actions these are"
            )
