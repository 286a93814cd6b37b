"""Learning which instructions suit a scene."""

from __future__ import annotations

import contextlib

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.modules import set_word_swapping
from ifo_grounding.objectives.base import SupervisedLoss
from ifo_grounding.objectives.pairs import NegativeInstructions, masked_mean, pair_scores

UNLABELLED = ("removal", "mixture")
"""What can be done about false negatives."""


class InstructionLoss(SupervisedLoss):
    """Binary cross entropy of a scene's own instruction against others of the pool (2nd phase).

    Positives are the first frames of demonstrations with their instructions; negatives are other
    instructions of the pool. Positives and negatives weigh the same. Writes ``loss_instruction``,
    ``positive_probability``, ``negative_probability`` and ``removed``, a share.

    Args:
        network: an image and an instruction to a logit, as ``make_instruction_classifier`` builds.
        pool: token ids [P, L] of the instructions of the demonstrations.
        negatives: how many negatives each scene is scored with, at most as many as there are other
            instructions; they share its image's encoding. For ``removal_rate``, ``warmup`` and
            ``near`` see :class:`~ifo_grounding.objectives.NegativeInstructions`.
        contrast: weight of the cross entropy of finding a scene's own instruction among its
            negatives, in nats (InfoNCE, van den Oord et al. 2018): for large pools, where nearly
            all negatives name things that the scene lacks. An extension of the paper.
        unlabelled: what is done about false negatives. ``"removal"`` drops the negatives scored
            highest; ``"mixture"`` drops none: :meth:`calibrate` then counts how many suitable ones
            they hold (Elkan and Noto 2008).
        states: images of fresh states of the simulator, uint8 [S, C, H, W], or their codes, int16
            [S, h, w], from which each demonstration's scene is told apart, too, given its own
            instruction: for few demonstrations, whose scenes are soon known by heart. An extension.
        fresh: how many of these, drawn anew for each batch, every instruction of it is scored with.
        swap_words: whether training swaps words for others where the network reads word by word
            (``"strong"``): for combinations that no demonstration names. It takes many
            demonstrations to learn so.

    Raises:
        UserError: for states that are no images, or values out of range.

    >>> from ifo_grounding.networks import Shapes, make_instruction_classifier
    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> pool = torch.arange(1, 13).unsqueeze(1).expand(12, 16)
    >>> loss = InstructionLoss(make_instruction_classifier(shapes), pool, removal_rate=0.3)
    >>> batch = {"pixels": torch.zeros(4, 3, 48, 48), "instruction": pool[:4]}
    >>> losses = loss(TensorDict(batch, [4]))
    >>> round(float(losses["removed"]), 2)
    0.28
    """

    states: Tensor | None
    written = keys.SUITABILITY
    out_keys = [  # noqa: RUF012
        "loss_instruction",
        "positive_probability",
        "negative_probability",
        "removed",
    ]

    def __init__(
        self,
        network: TensorDictModule,
        pool: Tensor,
        *,
        negatives: int = 8,
        removal_rate: float | None = None,
        warmup: float = 1 / 3,
        contrast: float = 0.0,
        unlabelled: str = "removal",
        near: float = 0.0,
        states: Tensor | None = None,
        fresh: int = 32,
        swap_words: bool = False,
    ) -> None:
        super().__init__(network)
        if contrast < 0:
            raise UserError(f"contrast is a weight of at least 0, got {contrast}")
        if states is not None:
            coded = states.dtype == torch.int16 and states.ndim == 3
            if (not coded and states.ndim != 4) or not len(states):
                shape = list(states.shape)
                raise UserError(f"states must be images [S, C, H, W], got shape {shape}")
        check_choice("treatment of unlabelled pairs", unlabelled, UNLABELLED)
        self.contrast, self.unlabelled = contrast, unlabelled
        self.negatives = NegativeInstructions(pool, removal_rate, warmup, near)
        self.count = min(at_least_one("negatives", negatives), len(self.negatives.pool) - 1)
        self.fresh = at_least_one("fresh", fresh)
        set_word_swapping(network, swap_words)
        self.register_buffer("states", states, persistent=False)

    def set_progress(self, fraction: float) -> None:
        """Say which share of training is done, in [0, 1]; until told, training counts as late."""
        self.negatives.progress = fraction

    def calibrate(self) -> float:
        """Let the network's probabilities count how rare suitable pairs are; return their share.

        In training positives and negatives weigh the same, as if every second pair suited.
        Afterwards a probability is that of a random pair of a fresh scene and the pool. Where no
        negatives were removed, they are a mixture that holds suitable pairs. One instruction of the
        pool at least suits a demonstration's scene, its own. Training goes on from logits as they
        were learned.

        Raises:
            UserError: where the share is unknown, for the removal rate was given, or the network
                has no ``expect`` to be told it by, as those of ``make_instruction_classifier`` do.
        """
        expect = getattr(self.network.module, "expect", None)
        if expect is None:
            raise UserError(
                f"{type(self.network.module).__name__} has no method expect(share, mixed), which "
                "shifts its logits: see PairScorer.expect in networks/scoring.py"
            )
        share = max(self.negatives.suitable_share(), 1 / len(self.negatives.pool))
        expect(share, self.unlabelled == "mixture" or not self.negatives.removal_rate)
        return share

    @property
    def capturable(self) -> bool:
        """Whether a step can be captured: removal would have to count what it drops."""
        keeps_all = self.unlabelled == "mixture" or self.negatives.keeps_all
        return keeps_all and super().capturable

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of a batch of first frames with their instructions."""
        self._require(tensordict)
        batch = tensordict.select(*self.network.in_keys).reshape(-1)
        others = self.negatives.draw(batch.get(self.network.in_keys[-1]), self.count)
        as_learned = getattr(self.network.module, "as_learned", contextlib.nullcontext)
        with self._mode(), as_learned():
            own, other = pair_scores(self.network, batch, others, self.output)
            if self.states is not None:
                other = torch.cat([other, self._elsewhere(batch)], 1)
        if self.training:
            near = slice(self.negatives.uniform(self.count), self.count)
            random = torch.cat([other[:, : near.start], other[:, near.stop :]], 1)
            self.negatives.watch(own, random)
        mixture = self.unlabelled == "mixture"
        kept = torch.ones_like(other).bool() if mixture else self.negatives.keep(other)
        loss = (F.softplus(-own).mean() + masked_mean(F.softplus(other), kept)) / 2
        if self.contrast:
            told = other.masked_fill(~kept, -torch.inf)
            kinds = [self.count] if self.states is None else [self.count, self.fresh]
            for rivals in told.split(kinds, 1):
                logits = torch.cat([own.unsqueeze(1), rivals], 1)
                loss = loss + self.contrast * (logits.logsumexp(1) - own).mean()
        return TensorDict(
            {
                "loss_instruction": loss,
                "positive_probability": self._mean(own.sigmoid()),
                "negative_probability": self._mean(other.sigmoid()),
                "removed": 1 - self._mean(kept),
            }
        )

    def _elsewhere(self, batch: TensorDictBase) -> Tensor:
        """Score each row's own instruction in some fresh states: logits [N, fresh]."""
        assert self.states is not None
        image, instruction = self.network.in_keys
        spoken = batch.get(instruction).expand(self.fresh, -1, -1)
        rows = torch.randint(len(self.states), (self.fresh,), device=self.states.device)
        scenes = TensorDict({image: self.states[rows], instruction: spoken[:, 0]}, [self.fresh])
        first, others = pair_scores(self.network, scenes, spoken[:, 1:], self.output)
        return torch.cat([first.unsqueeze(1), others], 1).T
