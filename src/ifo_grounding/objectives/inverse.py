"""Learning which action led from one image to the next."""

from __future__ import annotations

import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch

from ifo_grounding import keys
from ifo_grounding.objectives.base import ActionKeys, SupervisedLoss, check_action


class InverseLoss(SupervisedLoss):
    """Cross entropy of the inverse module's action and the true one (1st phase of the paper).

    Writes ``loss_inverse`` and ``accuracy``.

    Args:
        network: two images to logits, as ``make_inverse`` builds it.

    >>> import torch
    >>> from ifo_grounding.networks import Shapes, make_inverse
    >>> inverse = make_inverse(Shapes(image_shape=(3, 48, 48), vocabulary_size=40))
    >>> frames = torch.zeros(2, 3, 48, 48, dtype=torch.uint8)
    >>> losses = InverseLoss(inverse)(TensorDict({
    ...     "pixels": frames, "next": {"pixels": frames}, "action": torch.tensor([0, 5]),
    ... }, [2]))
    >>> losses["loss_inverse"].backward()
    """

    _AcceptedKeys = ActionKeys
    out_keys = ["loss_inverse", "accuracy"]  # noqa: RUF012
    written = keys.LOGITS

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of a batch of transitions."""
        self._require(tensordict)
        action = tensordict.get(self.tensor_keys.action)
        with self._mode():
            out = self.network(tensordict.select(*self.network.in_keys))
        logits = out.get(self.output)
        check_action(action, logits.shape[:-1], logits.shape[-1])
        action = action.long()
        loss = F.cross_entropy(
            logits.reshape(-1, logits.shape[-1]), action.flatten(), reduction="none"
        )
        return TensorDict(
            {
                "loss_inverse": self._reduce_loss(loss.view_as(action), tensordict),
                "accuracy": self._mean(logits.argmax(-1) == action, tensordict),
            }
        )
