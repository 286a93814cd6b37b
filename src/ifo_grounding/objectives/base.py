"""What the losses share: one network, its mode while the loss computes, and means."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from ifo_grounding import keys
from ifo_grounding.errors import UserError, check_below
from ifo_grounding.modules import TURNS, has_word_penalty, in_mode, output_key


@dataclass
class ActionKeys:
    """Key of the actions, which ``set_keys`` changes; the other keys are the network's."""

    action: NestedKey = keys.ACTION
    """The action taken, or the labelled one, integer [*B]."""


class SupervisedLoss(LossModule):
    """Base of the supervised losses of one network.

    The network computes in the mode of the loss: with dropout after ``loss.train()`` (as built),
    without after ``loss.eval()``. Afterwards each of its parts is back in the mode it had.

    Args:
        network: the network to train; it is not copied.

    Raises:
        UserError: where it is unclear which output of the network is to learn.
    """

    _AcceptedKeys: Any
    tensor_keys: Any
    functional = False
    """The network is used as it is."""
    written: str | None = None
    """How the output that is learned is named, where a network writes several."""

    def __init__(self, network: TensorDictModule) -> None:
        super().__init__()
        self.network = network
        self.own_keys: list[NestedKey] = list(network.in_keys)
        self.reduction = "mean"
        self.output = None if self.written is None else output_key(network, self.written)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Compute the loss. TorchRL sets meanwhile how policies act, for all threads: in turns."""
        with TURNS:
            return super().__call__(*args, **kwargs)

    @property
    def default_keys(self) -> Any:
        """What ``set_keys`` goes back to."""
        return self._AcceptedKeys

    @property
    def capturable(self) -> bool:
        """Whether all training steps do the same, and one can be captured as a CUDA graph."""
        return not has_word_penalty(self.network)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Every key that :meth:`forward` reads: the network's, and those of ``set_keys``."""
        return list(dict.fromkeys([*self.own_keys, *vars(self.tensor_keys).values()]))

    def _require(self, tensordict: TensorDictBase) -> None:
        """Raise :class:`UserError` for an empty batch, or where a key is missing."""
        if not tensordict.batch_size.numel():
            raise UserError(f"the batch is empty: {type(self).__name__} takes a mean over samples")
        missing = [key for key in self.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise UserError(
                f"the batch lacks {missing}: {type(self).__name__} reads {self.in_keys}; set_keys "
                "and the in_keys of the network change the names"
            )

    def _mode(self) -> contextlib.AbstractContextManager[None]:
        """Put every part of the network into the mode of the loss, and back afterwards."""
        return in_mode(self.training, self.network)

    def _mean(self, values: Tensor, tensordict: TensorDictBase | None = None) -> Tensor:
        """Return the mean of a metric over the samples that a mask of TorchRL leaves."""
        return self._reduce_loss(values.detach().float(), tensordict)


def check_action(action: Tensor, expected: tuple[int, ...], count: int | None = None) -> None:
    """Raise :class:`UserError` unless ``action`` has this shape and is one of ``count``, if given.

    On a GPU, which would have to be waited for, indices are not checked.
    """
    if tuple(action.shape) != tuple(expected):
        raise UserError(
            f"actions must have shape {list(expected)}, got {list(action.shape)}: indices have no "
            "trailing dim, and one-hot actions fit a one-hot policy alone"
        )
    if count is not None and action.is_floating_point():
        raise UserError(f"actions are whole numbers 0..{count - 1}, got {action.dtype}")
    if count is not None and not action.is_cuda:
        check_below("actions for this network hold", action, count)
