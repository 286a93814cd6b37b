"""Learning to do what the labelled demonstrations do."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential, dispatch
from torch.distributions import Categorical

from ifo_grounding.errors import UserError, share
from ifo_grounding.modules import has_word_penalty, set_word_swapping, take_word_penalty
from ifo_grounding.objectives.base import ActionKeys, SupervisedLoss, check_action

CONFIDENCE = 4
"""Power of the likelihood that weighs the word penalty: a policy that knows little pays little."""


class ImitationLoss(SupervisedLoss):
    """Negative log-likelihood of the labelled actions under the policy (1st phase of the paper).

    Writes ``loss_imitation``, ``accuracy`` and ``entropy``. TorchRL's ``BCLoss`` does not fit: it
    takes integer actions for logits.

    Of a network with word maps (``strong``) it also writes ``loss_words``, which regularises what
    words say about colours and about form; its weight grows with the likelihood of the actions. A
    word that needs but one of the two then keeps to it.

    Args:
        network: a policy with ``get_dist``, such as ``make_policy`` or TorchRL's
            ``ProbabilisticActor`` give, or a ``TensorDictSequential`` that contains one.
        word_penalty: weight of ``loss_words``.
        words_from: share of training before which words are neither penalised nor swapped. Where
            actions are easy to guess without words, they would be held to one meaning too early.

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

    _AcceptedKeys = ActionKeys

    def __init__(
        self,
        network: TensorDictModuleBase,
        *,
        word_penalty: float = 0.02,
        words_from: float = 0.0,
    ) -> None:
        parts = _parts(network)
        while parts and not hasattr(parts[-1], "get_dist"):
            parts.pop()
        if not parts:
            raise UserError(
                f"ImitationLoss trains policies with get_dist, as make_policy or TorchRL's "
                f"ProbabilisticActor give, or a TensorDictSequential with one in it, got "
                f"{type(network).__name__}"
            )
        super().__init__(network)
        self.parts = parts
        words = ["loss_words"] if has_word_penalty(network) else []
        self.out_keys = ["loss_imitation", *words, "accuracy", "entropy"]
        self.word_penalty, self.words_from = word_penalty, share("words_from", words_from)
        self.set_progress(0.0)

    @property
    def capturable(self) -> bool:
        """Whether all training steps do the same: not where words are held to it later on."""
        return super().capturable or not self.words_from

    def set_progress(self, fraction: float) -> None:
        """Say which share of training is done."""
        self.holds_words = fraction >= self.words_from
        set_word_swapping(self.network, self.holds_words)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of a batch of labelled transitions."""
        self._require(tensordict)
        action = tensordict.get(self.tensor_keys.action)
        take_word_penalty(self.network)  # that another loss left
        inputs = tensordict.select(*self.network.in_keys)
        *before, policy = self.parts
        with self._mode():
            for part in before:
                inputs = part(inputs)
            dist = policy.get_dist(inputs)
        likeliest = dist.mode
        count = dist.logits.shape[-1] if isinstance(dist, Categorical) else None
        check_action(action, likeliest.shape, count)
        loss = -dist.log_prob(action)
        right = (likeliest == action).reshape(*loss.shape, -1).all(-1)
        penalty = take_word_penalty(self.network)  # none in eval mode
        losses = TensorDict({"loss_imitation": self._reduce_loss(loss, tensordict)})
        if "loss_words" in self.out_keys:
            likelihood = (-self._mean(loss, tensordict)).exp()
            weight = self.word_penalty if self.holds_words else 0.0
            penalty = likelihood.new_zeros(()) if penalty is None else penalty
            losses["loss_words"] = weight * likelihood**CONFIDENCE * penalty
        losses["accuracy"] = self._mean(right, tensordict)
        losses["entropy"] = self._mean(dist.entropy(), tensordict)
        return losses


def _parts(module: TensorDictModuleBase) -> list[TensorDictModuleBase]:
    """Return what a sequence does one after the other; a policy is one part."""
    if hasattr(module, "get_dist") or not isinstance(module, TensorDictSequential):
        return [module]
    return [part for child in module.module for part in _parts(child)]
