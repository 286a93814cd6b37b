"""Scoring how images and instructions go together, each encoded without the other."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_rows
from ifo_grounding.modules import hidden_from_python
from ifo_grounding.networks.base import ImageNetwork, same_batch
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.layers import head
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.trunk import GatedTrunk

SUREST = 0.98
"""The most that an estimate of densities alone lets one believe."""
PAIRS_AT_ONCE = 1 << 12
"""Pairs of a scene and an instruction that are scored together, to bound memory."""


class PairScorer(ImageNetwork):
    """Base of the networks that score how images and an instruction go together, in two halves.

    Images are encoded without the instruction and instructions without the images, so that N
    scenes against P instructions cost N + P encodings and N x P light scores.

    Args:
        shapes: sizes of inputs.
        config: sizes of the network.
        images: how many images are seen with one instruction.
    """

    prior: Tensor
    """Added to every logit: what is known of suitability before anything is seen, see below."""
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
        mixture that holds the share :math:`\pi` of suitable ones, :math:`e^z` is how much more
        frequent a pair is among positives than in the mixture, so that :math:`p = \pi e^z`
        (Elkan and Noto 2008), at most 1. Beyond :data:`SUREST` scores keep their order.

        Args:
            share: :math:`\pi`.
            mixed: whether negatives were such a mixture.
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

    def flat_images(self, *pixels: Tensor) -> tuple[list[Tensor], torch.Size]:
        """Return images, each [*B, C, H, W], as [N, C, H, W], and the B that they share."""
        flat = [self.flat_pixels(image) for image in pixels]
        same_batch(**{f"image {number}": batch for number, (_, batch) in enumerate(flat)})
        return [image for image, _ in flat], flat[0][1]

    def encode_scenes(self, *pixels: Tensor) -> Any:
        """Encode images, each [N, C, H, W], for :meth:`score_candidates`."""
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

        Returns:
            Logits, float32 [N, K].
        """
        rows = max(1, PAIRS_AT_ONCE // max(index.shape[1], 1))
        with self.autocast(words):
            some = [slice(begin, begin + rows) for begin in range(0, max(len(index), 1), rows)]
            parts = [
                self.head(self._read(scenes[part], words, index[part])).squeeze(-1) for part in some
            ]
        return self._expected(torch.cat(parts))

    def _read(self, scenes: Any, words: Tensor, index: Tensor) -> Tensor:
        """Read N scenes in the light of some instructions [N, K]: [N, K, size]."""
        raise NotImplementedError

    def forward(self, *inputs: Tensor) -> Tensor:
        """Score images, each [*B, C, H, W], with token ids [*B, L], the last input."""
        *pixels, instruction = inputs
        images, batch = self.flat_images(*pixels)
        same_batch(images=batch, instruction=instruction.shape[:-1])
        tokens = instruction.reshape(-1, instruction.shape[-1]).long()
        if hidden_from_python(tokens):
            which = torch.arange(len(tokens), device=tokens.device)
        else:
            tokens, which = distinct_rows(tokens)
        scenes, words = self.encode_scenes(*images), self.encode_instruction(tokens)
        return self.score_candidates(scenes, words, which.unsqueeze(1)).reshape(*batch, 1)


class GatedScorer(PairScorer):
    """Scores images with an instruction that gates their features (``paper``)."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__(shapes, config, images)
        self.trunk = GatedTrunk(shapes, config, images)
        self.head = head(self.trunk.size, config, 1)

    def encode_scenes(self, *pixels: Tensor) -> Tensor:
        """Map images, each [N, C, H, W], to features [N, F, h, w]."""
        images, _ = self.flat_images(*pixels)
        with self.autocast(pixels[0]):
            features: Tensor = self.trunk.image(torch.cat(images, -3))
        return features

    def encode_instruction(self, instruction: Tensor) -> Tensor:  # noqa: D102
        encoded: Tensor = self.trunk.instruction(instruction)
        return encoded

    def _read(self, scenes: Tensor, words: Tensor, index: Tensor) -> Tensor:
        cells = scenes.flatten(2).transpose(1, 2).unsqueeze(1)  # [N, 1, h * w, F]
        gates = self.trunk.fusion.gates(words)[index].unsqueeze(2)  # [N, K, 1, F]
        return F.relu(cells * gates).flatten(2)
