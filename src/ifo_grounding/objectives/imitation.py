"""Learning to do what the labelled demonstrations do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch.distributions import Categorical

from ifo_grounding import keys
from ifo_grounding.errors import UserError
from ifo_grounding.modules import charges, set_lenient, take_charge
from ifo_grounding.objectives.base import SupervisedLoss, check_action, scalars

CONFIDENCE = 4
"""Power of the likelihood by which words are charged: who is still at sea pays little."""


class ImitationLoss(SupervisedLoss):
    """Negative log-likelihood of the labelled actions under the policy (1st phase of the paper).

    Writes ``loss_imitation``, ``accuracy`` and ``entropy``. TorchRL's ``BCLoss`` does not fit: it
    takes integer actions for logits.

    Of a network with :class:`~ifo_grounding.networks.WordMaps`, which reads word by word, it also
    writes ``loss_words``: what its words say about colours and about form is charged for, the more
    the better the actions are predicted. A word that needs but one of the two then keeps to it.
    Train such a network eagerly: inside ``torch.compile`` it does not tell words apart that occur
    from those that do not, and nothing is charged.

    Args:
        network: a policy with ``get_dist``, as ``make_policy`` builds it.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        charge: weight of ``loss_words``.
        strict_from: share of training, see :meth:`set_progress`, before which words are neither
            charged for nor swapped. Where actions are easy to guess without words, they are
            otherwise held to one meaning before they have any.

    >>> import torch
    >>> from ifo_grounding.networks import Shapes, make_policy
    >>> policy = make_policy(Shapes(image_shape=(3, 48, 48), vocabulary_size=40))
    >>> losses = ImitationLoss(policy)(TensorDict({
    ...     "pixels": torch.zeros(2, 3, 48, 48, dtype=torch.uint8),
    ...     "instruction": torch.ones(2, 16, dtype=torch.int64),
    ...     "action": torch.tensor([0, 5]),
    ... }, [2]))
    >>> losses["loss_imitation"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` changes; the inputs' keys are the policy's."""

        action: NestedKey = keys.ACTION
        """The labelled action, integer [*B]."""

    default_keys: Any = _AcceptedKeys
    _selected: list[NestedKey] | None = None

    def __init__(
        self,
        network: TensorDictModule,
        *,
        reduction: str = "mean",
        charge: float = 0.02,
        strict_from: float = 0.0,
    ) -> None:
        super().__init__(network, reduction=reduction)
        if not 0 <= strict_from <= 1:
            raise UserError(f"strict_from is a share of training in [0, 1], got {strict_from}")
        self.charge = charge
        self.strict_from = strict_from
        self.strict: bool | None = None  # nobody knows how an earlier loss left the network
        self.set_progress(0.0)

    @property
    def capturable(self) -> bool:
        """Whether all steps do the same: where words are charged for, they are looked at."""
        return self._steps_alike()

    @property
    def out_keys(self) -> list[NestedKey]:
        """What is written, ``loss_words`` while a network learns that reads word by word."""
        return self._all_out_keys() if self._selected is None else self._selected

    @out_keys.setter
    def out_keys(self, names: Sequence[NestedKey]) -> None:
        """Write these alone (``select_out_keys``), or all again."""
        self._selected = None if list(names) == self._all_out_keys() else list(names)

    def _all_out_keys(self) -> list[NestedKey]:
        charged = self.training and charges(self.network)
        words: list[NestedKey] = ["loss_words"] if charged else []
        return ["loss_imitation", *words, "accuracy", "entropy"]

    def set_progress(self, fraction: float) -> None:
        """Say which share of training is done."""
        strict = fraction >= self.strict_from
        if strict == self.strict:
            return
        self.strict = strict
        set_lenient(self.network, not strict)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of a batch of labelled transitions."""
        self._require(tensordict)
        action = tensordict.get(self.tensor_keys.action)
        take_charge(self.network)  # of what another loss looked at
        with self._mode():
            dist = self.network.get_dist(tensordict.select(*self.network.in_keys))
        likeliest = dist.mode
        count = dist.logits.shape[-1] if isinstance(dist, Categorical) else None
        check_action(action, likeliest.shape, count)
        loss = -dist.log_prob(action)
        right = (likeliest == action).reshape(*loss.shape, -1).all(-1)
        charged = take_charge(self.network)
        words = {}
        if charged is not None:
            likelihood = (-self._mean(loss, tensordict)).exp()
            weight = self.charge if self.strict else 0.0
            words = {"loss_words": weight * likelihood**CONFIDENCE * charged}
        return scalars(
            loss_imitation=self._reduce_loss(loss, tensordict),
            **words,
            accuracy=self._mean(right, tensordict),
            entropy=self._mean(dist.entropy(), tensordict),
        )
