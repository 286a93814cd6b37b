"""Negatives for classifiers of pairs: drawing other instructions, scoring, removing false ones."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_entries, distinct_rows
from ifo_grounding.errors import UserError, share
from ifo_grounding.modules import halves_of
from ifo_grounding.objectives.mixture import MixtureEstimate

MOST_REMOVED = 0.5
LEAST_REMOVED = 0.05
"""Where fewer pairs than this are suitable, a classifier would remove mostly true negatives."""
NEAREST = 64
WORDS_AT_ONCE = 1 << 20
"""Words that are compared together, to bound memory."""


class NegativeInstructions(nn.Module):
    """Draws instructions from a pool that differ from a given one, and removes likely mistakes.

    A random other instruction may suit a scene just as well. So after a warm-up the share
    ``removal_rate`` of a batch's negatives with the highest scores is dropped (Bahdanau et al.
    2019). Whether any are dropped, and how many at most, is settled when the warm-up ends: what is
    dropped is no longer held down, scores higher, and would make an estimate rise further.

    Args:
        pool: token ids [P, L]; repeated rows count once.
        removal_rate: share of negatives to drop, in [0, 1); None estimates it from the scores of
            positives and negatives (:func:`~ifo_grounding.objectives.mixture.best_bin_estimate`).
        warmup: share of training before which none is dropped.
        near: share of the negatives that are drawn among the ``NEAREST`` instructions of the pool
            that differ from the given one in the fewest words, instead of among all.

    Raises:
        UserError: for a pool of fewer than two different instructions, or values out of range.

    >>> negatives = NegativeInstructions(torch.tensor([[1, 0], [2, 0], [2, 0]]), removal_rate=0.5)
    >>> negatives.draw(torch.tensor([[1, 0], [2, 0]]), 1).tolist()
    [[[2, 0]], [[1, 0]]]
    >>> negatives.keep(torch.tensor([0.1, 0.9])).tolist()
    [True, False]
    """

    pool: Tensor
    bound: Tensor
    """The largest share that may still be dropped; 1 until the warm-up is over."""

    def __init__(
        self,
        pool: Tensor,
        removal_rate: float | None,
        warmup: float = 1 / 3,
        near: float = 0.0,
    ) -> None:
        super().__init__()
        if not isinstance(pool, Tensor) or pool.ndim != 2 or pool.dtype.is_floating_point:
            found = (pool.dtype, [*pool.shape]) if isinstance(pool, Tensor) else type(pool).__name__
            raise UserError(f"pool must be token ids [P, L], such as demos.pool(), got {found}")
        distinct = torch.unique(pool, dim=0)
        if len(distinct) < 2:
            raise UserError("pool holds fewer than two different instructions: no negatives exist")
        self.register_buffer("pool", distinct, persistent=False)
        self.register_buffer("bound", torch.ones(()))
        self.given = share("removal_rate", removal_rate or 0.0, full=False)
        self.estimate = MixtureEstimate() if removal_rate is None else None
        self.warmup, self.near = warmup, share("near", near, full=False)
        self.progress = 1.0
        self.neighbours: dict[tuple[int, ...], Tensor] = {}

    def draw(self, instruction: Tensor, count: int) -> Tensor:
        """Draw ``count`` instructions per row of [N, L], other than the row's own: [N, K, L].

        Raises:
            UserError: where instructions have another length than those of the pool.
        """
        if instruction.shape[-1] != self.pool.shape[1]:
            raise UserError(
                f"instructions have {instruction.shape[-1]} tokens, and those of the pool "
                f"{self.pool.shape[1]}: encode both with one vocabulary"
            )
        uniform = self.uniform(count)
        drawn = self._among_all(instruction, uniform)
        if uniform == count:
            return drawn
        return torch.cat([drawn, self._nearby(instruction, count - uniform)], 1)

    def uniform(self, count: int) -> int:
        """Return how many of ``count`` drawn instructions, the first ones, are from all others."""
        return max(1, round((1 - self.near) * count))

    def _among_all(self, instruction: Tensor, count: int) -> Tensor:
        """Draw uniformly among all others: the own one is moved on by a random number of places."""
        size, shape, device = len(self.pool), (len(instruction), count), self.pool.device
        index = torch.randint(size, shape, device=device)
        moved = (index + torch.randint(1, size, shape, device=device)) % size
        same = (self.pool[index] == instruction.unsqueeze(1)).all(-1)
        return self.pool[torch.where(same, moved, index)]

    def _nearby(self, instruction: Tensor, count: int) -> Tensor:
        """Draw uniformly among the nearest others."""
        nearest = self._nearest(instruction) if instruction.is_cuda else self._known(instruction)
        shape = (len(instruction), count)
        chosen = torch.randint(nearest.shape[1], shape, device=nearest.device)
        return self.pool[nearest.gather(1, chosen)]

    def _known(self, instruction: Tensor) -> Tensor:
        """Return what :meth:`_nearest` does, which is found once for each distinct instruction."""
        rows = [tuple(row) for row in instruction.tolist()]
        new = [place for place, row in enumerate(rows) if row not in self.neighbours]
        if new:
            found = self._nearest(instruction[new])
            self.neighbours |= {rows[place]: each for place, each in zip(new, found, strict=True)}
        return torch.stack([self.neighbours[row] for row in rows])

    def _nearest(self, instruction: Tensor) -> Tensor:
        """Return which others differ from each of [N, L] in the fewest words: indices [N, M]."""
        some = instruction.split(max(1, WORDS_AT_ONCE // self.pool.numel()))
        differing = torch.cat([(self.pool != rows.unsqueeze(1)).sum(-1) for rows in some])
        differing = torch.where(differing == 0, self.pool.shape[1] + 1, differing)
        return differing.topk(min(NEAREST, len(self.pool) - 1), largest=False).indices

    def watch(self, own: Tensor, other: Tensor) -> None:
        """Learn the share of suitable ones from scores of positives [N] and random others [*, K].

        Both reach back as far: scores grow while a classifier learns, and later ones of one kind
        would pass for better ones.
        """
        if self.estimate is not None:
            count = other.shape[-1]
            as_far = self.estimate.ratio * own.numel() * count // max(other.numel(), 1)
            self.estimate.add(own, other[..., : max(as_far, 1)])

    @property
    def keeps_all(self) -> bool:
        """Whether none is ever dropped."""
        return self.estimate is None and not self.given

    def suitable_share(self) -> float:
        """Return the share of suitable ones as it is estimated by now, at most ``MOST_REMOVED``."""
        if self.estimate is None:
            raise UserError("the share of suitable pairs needs removal_rate=None")
        bound = float(self.bound) or 1.0  # none are dropped, and the estimate is free to move
        return min(self.estimate.share(), MOST_REMOVED, bound)

    @property
    def removal_rate(self) -> float:
        """Share of negatives to drop by now: none before the warm-up is over."""
        if self.progress < self.warmup:
            return 0.0
        if self.estimate is None:
            return self.given
        share, bound = self.suitable_share(), float(self.bound)
        return 0.0 if bound == 1 and share < LEAST_REMOVED else min(share, bound)

    def keep(self, scores: Tensor) -> Tensor:
        """Return a mask of ``scores`` [*] without the top share that is likely suitable."""
        share = self.removal_rate
        over = self.training and self.progress >= self.warmup
        if over and self.estimate is not None and float(self.bound) == 1:
            self.bound.fill_(share)
        mask = torch.ones(scores.numel(), dtype=torch.bool, device=scores.device)
        if drop := int(share * scores.numel()):
            mask[scores.detach().flatten().topk(drop).indices] = False
        return mask.reshape(scores.shape)


def pair_scores(
    network: TensorDictModule, batch: TensorDictBase, others: Tensor, output: NestedKey
) -> tuple[Tensor, Tensor]:
    """Score each row's own instruction and others, token ids [N, K, L]: logits [N] and [N, K].

    Each row's images and each distinct instruction are encoded once, and each distinct pair is
    scored once where scenes repeat. On a GPU, where finding the distinct ones would wait for it,
    all are.
    """
    *pixel_keys, instruction_key = network.in_keys
    images = [batch.get(key) for key in pixel_keys]
    both = torch.cat([batch.get(instruction_key).unsqueeze(1), others], 1)
    halves, tokens, shape = halves_of(network, output), both.flatten(0, 1).long(), both.shape[:2]
    if tokens.is_cuda:
        which = torch.arange(len(tokens), device=tokens.device).view(shape)
        words = halves.encode_instruction(tokens)
        scores = halves.score_candidates(halves.encode_scenes(*images), words, which).reshape(shape)
        return scores[:, 0], scores[:, 1:]
    tokens, which = distinct_rows(tokens)
    words, which = halves.encode_instruction(tokens), which.view(shape)
    first, scene = distinct_entries(images)
    if len(first) * len(words) < which.numel():
        every = torch.arange(len(words)).expand(len(first), -1)
        scenes = halves.encode_scenes(*(image[first] for image in images))
        table = halves.score_candidates(scenes, words, every).flatten()
        scores = table[scene.unsqueeze(1) * len(words) + which]
    else:
        scores = halves.score_candidates(halves.encode_scenes(*images), words, which)
    scores = scores.reshape(shape)
    return scores[:, 0], scores[:, 1:]


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of ``values`` where ``mask``, 0 where nowhere."""
    return torch.where(mask, values, 0).sum() / mask.sum().clamp_min(1)
