"""Choosing instructions of a pool for states (paper, "Instruction Module")."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one, check_choice, share
from ifo_grounding.keys import SUITABILITY
from ifo_grounding.modules import device_of, evaluating, halves_of, output_key
from ifo_grounding.transforms.base import check_pool, flat_logit

CHOICES = ("random", "best")
AT_ONCE = 2048
"""States, instructions or pairs that pass a network together, to bound memory."""
FIRST_LOOK = 4
"""Candidates of each state that are scored first; then twice as many, and so on."""


class Choices(NamedTuple):
    """An instruction for each state, or none."""

    chosen: Tensor
    """Index into the pool, int64 [B]; -1 where no candidate was above the threshold."""
    score: Tensor
    """Its probability of being suitable, float32 [B]; the best one seen where there is none."""


class PoolScorer:
    """Scores pairs of a state and an instruction of a pool, and chooses among them.

    A classifier of the library encodes each state and each instruction once
    (:func:`~ifo_grounding.modules.halves_of`); encodings of the pool are kept until a weight
    changes.

    Args:
        classifier: TensorDictModule from (pixels, instruction), in this order, to one logit.
        pool: token ids, int64 [N, L].

    >>> from tensordict.nn import TensorDictModule
    >>> def same(pixels, instruction):  # suitable where the first token is the brightness
    ...     equal = pixels.flatten(1)[:, :1] == instruction[:, :1]
    ...     return equal * 8.0 - 4.0
    >>> classifier = TensorDictModule(same, ["pixels", "instruction"], ["suitability"])
    >>> scorer = PoolScorer(classifier, torch.tensor([[1], [2], [3]]))
    >>> pixels = torch.tensor([3, 7, 1], dtype=torch.uint8).view(3, 1, 1, 1).expand(3, 3, 8, 8)
    >>> scorer.choose(pixels).chosen.tolist()
    [2, -1, 0]
    """

    def __init__(self, classifier: TensorDictModuleBase, pool: Tensor) -> None:
        self.logit_key = output_key(classifier, SUITABILITY)
        if len(classifier.in_keys) != 2:
            raise UserError(
                f"a classifier reads pixels and an instruction, not {classifier.in_keys}"
            )
        self.classifier = classifier
        self.pool = check_pool(pool)
        self.scored = 0
        self._encodings: Tensor | None = None
        self._weights: list[Tensor] = []

    @property
    def halves(self) -> Any:
        """What encodes states and instructions apart, and scores them."""
        return halves_of(self.classifier, self.logit_key)

    def encode(self, pixels: Tensor) -> Any:
        """Encode states [B, ...] for :meth:`score`."""
        with evaluating(self.classifier):
            return self.halves.encode_scenes(pixels.to(device_of(self.classifier) or pixels.device))

    def score(self, states: Any, index: Tensor, words: Tensor | None = None) -> Tensor:
        """Score candidates.

        Args:
            states: B encoded states, from :meth:`encode`.
            index: candidates of each state in the pool, int64 [B, K].
            words: the encoded pool, where one has asked for it already (:meth:`words`).

        Returns:
            Logits, float32 [B, K] on the device of ``index``.
        """
        self.scored += index.numel()
        device = device_of(self.classifier) or index.device
        # Encoded scenes that are no tensors bound their memory themselves, and gain from many rows.
        bounded = not isinstance(states, Tensor | TensorDictBase)
        rows = max(1, len(index) if bounded else AT_ONCE // max(1, index.shape[1]))
        halves, parts = self.halves, []
        with evaluating(self.classifier):
            words = self.words(device) if words is None else words
            for begin in range(0, len(index), rows):
                some = index[begin : begin + rows].to(device)
                logit = halves.score_candidates(states[begin : begin + rows], words, some)
                parts.append(flat_logit(logit, some.numel(), self.logit_key).view(some.shape))
        return torch.cat(parts).to(index.device)

    def words(self, device: torch.device) -> Tensor:
        """Encode the pool, or return what was kept if no weight has changed since."""
        weights = [*self.classifier.parameters(), *self.classifier.buffers()]
        # Values are compared, not version counters: updates through `.data` or from another
        # process do not count.
        fresh = equal(weights, self._weights)
        if self._encodings is None or not fresh or self._encodings.device != device:
            self._weights = [weight.detach().clone() for weight in weights]
            chunks = self.pool.to(device).split(AT_ONCE)
            encode = self.halves.encode_instruction
            self._encodings = torch.cat([encode(chunk) for chunk in chunks])
        return self._encodings

    def choose(
        self,
        pixels: Tensor,
        *,
        threshold: float = 0.8,
        candidates: int = 64,
        choose: str = "random",
        generator: torch.Generator | None = None,
    ) -> Choices:
        """Choose a suitable instruction for each state (paper, "Instruction Module").

        Args:
            pixels: states, uint8 [B, 3, H, W].
            threshold: least probability of a suitable pair; 0.8 in the paper.
            candidates: instructions drawn for each state; the whole pool if it is smaller.
            choose: ``random`` among the suitable candidates, or the ``best`` of them.
            generator: source of randomness, on the CPU.

        Raises:
            UserError: on impossible options, or logits of another shape.
        """
        check_options(threshold, candidates, choose)
        limit = math.log(threshold / (1 - threshold)) if threshold else -math.inf
        parts = []
        for some in pixels.split(AT_ONCE):
            index = draw_candidates(len(some), len(self.pool), candidates, generator)
            parts.append(self._search(some, index.to(some.device), limit, choose == "best"))
        return Choices(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def _search(self, pixels: Tensor, index: Tensor, limit: float, best: bool) -> Choices:
        """Look at the candidates of each state in growing parts until one holds a suitable one.

        The first suitable candidate of a random order is a random suitable one, so that most
        candidates need no score. The best one is known when all are scored.
        """
        look = index.shape[1] if best else FIRST_LOOK
        chosen = torch.full((len(pixels),), -1, dtype=torch.int64, device=pixels.device)
        score = torch.full((len(pixels),), -math.inf, device=pixels.device)
        waiting = torch.arange(len(pixels), device=pixels.device)
        states = self.encode(pixels) if len(pixels) else pixels
        home = device_of(self.classifier) or pixels.device
        with evaluating(self.classifier):
            words = self.words(home) if len(pixels) else None  # weights stay as they are in here
        begin = 0
        while len(waiting) and begin < index.shape[1]:
            candidates = index[waiting, begin : begin + look]
            logits = self.score(states[waiting.to(home)], candidates, words)
            suitable = logits > limit
            found = suitable.any(1)
            place = logits.argmax(1)
            if not best:
                place = torch.where(found, suitable.int().argmax(1), place)
            logit = logits.gather(1, place.unsqueeze(1)).squeeze(1)
            picked = candidates.gather(1, place.unsqueeze(1)).squeeze(1)
            chosen[waiting] = torch.where(found, picked, -1)
            score[waiting] = torch.where(found, logit, torch.maximum(logit, score[waiting]))
            waiting = waiting[~found]
            begin, look = begin + look, 2 * look
        return Choices(chosen, score.sigmoid())

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_encodings": None, "_weights": []}  # a copy makes its own


def equal(some: list[Tensor], others: list[Tensor]) -> bool:
    """Whether tensors lie in the same places and hold the same values; a GPU is asked once."""
    places = [[(each.device, each.shape) for each in tensors] for tensors in (some, others)]
    if places[0] != places[1]:
        return False
    if all(one.device.type == "cpu" for one in some):
        return all(map(torch.equal, some, others))
    same = [(one == other).all() for one, other in zip(some, others, strict=True)]
    return bool(torch.stack(same).all())


def check_options(threshold: float, candidates: int, choose: str) -> None:
    """Raise :class:`UserError` where an option of the choice is impossible."""
    check_choice("choose", choose, CHOICES)
    share("threshold", threshold, full=False)
    at_least_one("candidates", candidates)


def draw_candidates(
    states: int, pool_size: int, candidates: int, generator: torch.Generator | None
) -> Tensor:
    """Draw ``candidates``, or all, for each state, distinct, in random order: int64 [states, K]."""
    lots = torch.rand(states, pool_size, generator=generator)
    return lots.topk(min(candidates, pool_size), dim=1).indices
