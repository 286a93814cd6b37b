"""How many labels of the inverse model are right, action by action."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.data import LabelReport, Truth
from ifo_grounding.errors import UserError, check_below
from ifo_grounding.stats import Described, Rate, wilson


@dataclass(frozen=True)
class LabelAccuracy(Described):
    """Accuracy of labelled actions against the true ones."""

    rate: Rate
    """Share of right labels."""
    per_action: dict[str, Rate]
    """Share of right labels among the transitions of each action."""
    worst: str
    """The action that is labelled worst, of those that occur."""

    def __str__(self) -> str:
        """Return the accuracy, and the worst action's."""
        return f"{self.rate}, worst {self.worst}: {self.per_action[self.worst]}"


def actions_of(source: Tensor | LabelReport | Truth) -> Tensor:
    """Return actions, int64 [N], from a tensor or from what has them as ``actions``."""
    actions = source if isinstance(source, Tensor) else source.actions
    return actions.cpu().long().reshape(-1)


def label_accuracy(
    labelled_actions: Tensor | LabelReport,
    truth: Tensor | Truth,
    *,
    names: Sequence[str] = keys.ACTIONS,
) -> LabelAccuracy:
    """Compare labels with the truth that a recorder kept aside.

    Args:
        labelled_actions: the inverse model's labels, integer [N], in the order of the transitions,
            or the report of :func:`~ifo_grounding.data.label_demonstrations`.
        truth: the true actions, integer [N], or the :class:`~ifo_grounding.data.Truth`.

    Raises:
        UserError: where the two do not have one action per transition.

    >>> accuracy = label_accuracy(torch.tensor([0, 0, 1, 5]), torch.tensor([0, 1, 1, 5]))
    >>> print(accuracy.rate, accuracy.worst)
    75.0% [30.1, 95.4] (n=4) R
    """
    given, right = actions_of(labelled_actions), actions_of(truth)
    if given.shape != right.shape or not len(given):
        raise UserError(
            f"labels and truth must be one action per transition of the same demonstrations, got "
            f"{len(given)} and {len(right)}"
        )
    n = len(names)
    check_below("actions with names hold", torch.stack([given, right]), n)
    hits = right[given == right].bincount(minlength=n).tolist()
    counts = right.bincount(minlength=n).tolist()
    per_action = {name: wilson(*pair) for name, *pair in zip(names, hits, counts, strict=True)}
    seen = {name: rate for name, rate in per_action.items() if rate.count}
    return LabelAccuracy(
        rate=wilson(sum(hits), sum(counts)),
        per_action=per_action,
        worst=min(seen, key=lambda name: seen[name].rate),
    )
