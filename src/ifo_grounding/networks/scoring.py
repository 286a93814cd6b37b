"""Scoring how images and instructions go together, each encoded without the other."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.base import ImageNetwork, same_batch
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.layers import head
from ifo_grounding.networks.patches import as_pixels
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.trunk import GatedTrunk

SUREST = 0.98
"""The most that an estimate of densities alone lets one believe."""
PAIRS_AT_ONCE = 1 << 11
"""Pairs of a scene and an instruction that are scored together: they fit a core's cache."""


class PairScorer(ImageNetwork):
    """Base of the networks that score how images and an instruction go together, in two halves.

    Images are encoded without the instruction and instructions without the images, so that N
    scenes against P instructions cost N + P encodings and N x P light scores. ``images`` is how
    many images are seen with one instruction.
    """

    prior: Tensor
    """Added to every logit: what is known of suitability before anything is seen."""
    mixed: Tensor
    """1 where logits were learned against pairs of which some were suitable, else 0."""
    head: nn.Module
    """Maps what :meth:`_read` returns to a logit."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__(shapes, config)
        self.images = images
        self.expects = True
        self.register_buffer("prior", torch.zeros(()))
        self.register_buffer("mixed", torch.zeros(()))

    def expect(self, share: float, mixed: bool) -> None:
        r"""Make probabilities those of pairs of which a share is suitable.

        A logit z is learned with positives as frequent as negatives. Against unsuitable pairs,
        Bayes' rule gives :math:`\log\frac{p}{1-p} = z + \log\frac{\pi}{1-\pi}`. Against a
        mixture that holds the share :math:`\pi` of suitable ones, :math:`p = \pi e^z`
        (Elkan and Noto 2008), at most 1. Beyond :data:`SUREST` scores keep their order.
        """
        self.prior.fill_(math.log(share) if mixed else math.log(share / (1 - share)))
        self.mixed.fill_(mixed)

    @contextlib.contextmanager
    def as_learned(self) -> Iterator[None]:
        """Score without what :meth:`expect` said, as a loss that goes on training has to."""
        before, self.expects = self.expects, False
        try:
            yield
        finally:
            self.expects = before

    def _expected(self, scores: Tensor) -> Tensor:
        """Return logits in the light of what :meth:`expect` said."""
        scores = scores.float()
        if not self.expects:
            return scores
        scores = scores + self.prior
        return scores - self.mixed * torch.log1p(-scores.clamp(max=math.log(SUREST)).exp())

    def encode_scenes(self, *pixels: Tensor) -> Any:
        """Encode images, each [*B, C, H, W], for :meth:`score_candidates`."""
        raise NotImplementedError

    def encode_instruction(self, instruction: Tensor) -> Tensor:
        """Map token ids [*B, L] to features [*B, D]; each distinct instruction is encoded once."""
        raise NotImplementedError

    def score_candidates(self, scenes: Any, words: Tensor, index: Tensor) -> Tensor:
        """Score some instructions of a pool for each scene.

        Args:
            scenes: N encoded scenes, from :meth:`encode_scenes`.
            words: encoded instructions [P, D], from :meth:`encode_instruction`.
            index: candidates of each scene, int64 [N, K].

        Returns logits, float32 [N, K].
        """
        rows = max(1, PAIRS_AT_ONCE // max(index.shape[1], 1))
        some = [slice(begin, begin + rows) for begin in range(0, max(len(index), 1), rows)]
        read = [self.head(self._read(scenes[part], words, index[part])) for part in some]
        return self._expected(torch.cat(read).squeeze(-1))

    def _read(self, scenes: Any, words: Tensor, index: Tensor) -> Tensor:
        """Read N scenes in the light of some instructions [N, K]: [N, K, size]."""
        raise NotImplementedError

    def forward(self, *inputs: Tensor) -> Tensor:
        """Score images, each [*B, C, H, W], with token ids [*B, L], the last input: [*B, 1]."""
        *pixels, instruction = inputs
        batch = instruction.shape[:-1]
        images = {f"image {number}": self.batch_of(image) for number, image in enumerate(pixels)}
        same_batch(**images, instruction=batch)
        words = self.encode_instruction(instruction.reshape(-1, instruction.shape[-1]))
        own = torch.arange(len(words), device=words.device).unsqueeze(1)
        return self.score_candidates(self.encode_scenes(*pixels), words, own).reshape(*batch, 1)


class GatedScorer(PairScorer):
    """Scores images with an instruction that gates their features (``paper``)."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__(shapes, config, images)
        self.trunk = GatedTrunk(shapes, config, images)
        self.head = head(self.trunk.size, config, 1)

    def encode_scenes(self, *pixels: Tensor) -> Tensor:
        """Map images, each [*B, C, H, W], to features [N, F, h, w]."""
        images = [as_pixels(self.flat_pixels(image)[0]) for image in pixels]
        features: Tensor = self.trunk.image(torch.cat(images, -3))
        return features

    def encode_instruction(self, instruction: Tensor) -> Tensor:  # noqa: D102
        encoded: Tensor = self.trunk.instruction(instruction)
        return encoded

    def _read(self, scenes: Tensor, words: Tensor, index: Tensor) -> Tensor:
        cells = scenes.flatten(2).transpose(1, 2).unsqueeze(1)  # [N, 1, h * w, F]
        gates = self.trunk.fusion.gates(words)[index].unsqueeze(2)  # [N, K, 1, F]
        return F.relu(cells * gates).flatten(2)
