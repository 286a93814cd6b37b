"""Scoring how images and instructions go together, each encoded without the other."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_rows
from ifo_grounding.modules import hidden_from_python
from ifo_grounding.networks.cells import (
    Cells,
    Groups,
    Kinds,
    group_cells,
    look_up,
    pair_up,
)
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.fusion import (
    CellCount,
    GatedAttention,
    ResidualBlock,
    ResidualFiLM,
    SpatialReadout,
)
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.trunk import (
    Network,
    cells_are_alone,
    distinct_cells,
    encode_instruction,
    flatten_cells,
    fuse_pairs,
    grid,
    head,
    image_encoder,
    instruction_encoder,
    same_batch,
)

SUREST = 0.98
"""The most that an estimate of densities alone lets one believe."""
CELLS_AT_ONCE, ROWS_AT_ONCE = 1 << 16, 1 << 12
"""Cells and pairs that are computed together, to bound memory."""


def slices(size: int, at_once: int) -> list[slice]:
    """Cut a range into parts; an empty range is one part.

    >>> slices(5, 3)
    [slice(0, 3, None), slice(3, 6, None)]
    """
    return [slice(begin, begin + at_once) for begin in range(0, max(size, 1), at_once)]


class PairScorer(Network):
    """Base of the networks that score how images and an instruction go together, in two halves.

    Images are encoded without the instruction and instructions without the images, so that N
    scenes against P instructions cost N + P encodings and N x P light scores.
    """

    prior: Tensor
    """Added to every logit: what is known of suitability before anything is seen, see below."""
    mixed: Tensor
    """1 where logits were learned against pairs of which some were suitable, else 0."""

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

    def encode_pixels(self, *pixels: Tensor) -> Tensor:
        """Map images, each [*B, C, H, W], to features [*B, F, h, w] that know no instruction."""
        images, batch = self.flat_images(*pixels)
        with self.autocast(pixels[0]):
            features = self._features(images)
        return features.reshape(*batch, *features.shape[1:])

    def flat_images(self, *pixels: Tensor) -> tuple[list[Tensor], torch.Size]:
        """Return images, each [*B, C, H, W], as [N, C, H, W], and the B that they share."""
        flat = [self.flat_pixels(image) for image in pixels]
        same_batch(**{f"image {number}": batch for number, (_, batch) in enumerate(flat)})
        return [image for image, _ in flat], flat[0][1]

    def _features(self, images: list[Tensor]) -> Tensor:
        """Map images, each [N, C, H, W], to features [N, F, h, w]."""
        raise NotImplementedError

    def encode_instruction(self, instruction: Tensor) -> Tensor:
        """Map token ids [*B, L] to features [*B, D]; each distinct instruction is encoded once."""
        raise NotImplementedError

    def encode_scenes(self, *pixels: Tensor) -> Cells | Kinds | Tensor:
        """Encode images, each [N, C, H, W], for :meth:`score_candidates`.

        Returns:
            Features [N, F, h, w], or what stands for them where cells repeat and that pays.
        """
        return self.encode_pixels(*pixels)

    def score_candidates(
        self, scenes: Cells | Kinds | Tensor, words: Tensor, index: Tensor
    ) -> Tensor:
        """Score some instructions of a pool for each scene.

        Args:
            scenes: N encoded scenes, from :meth:`encode_scenes`.
            words: encoded instructions [P, D], from :meth:`encode_instruction`.
            index: candidates of each scene, int64 [N, K].

        Returns:
            Logits, float32 [N, K].
        """
        raise NotImplementedError

    def score(self, features: Tensor, instruction: Tensor) -> Tensor:
        """Score features [*B, F, h, w] and [*B, D] that belong together: logits [*B, 1]."""
        raise NotImplementedError

    def score_all(self, features: Tensor, instruction: Tensor, chunk: int = 2048) -> Tensor:
        """Score every scene [N, F, h, w] with every instruction [P, D]: logits [N, P].

        ``chunk`` bounds the pairs scored at once, so that they stay in the processor's cache.
        """
        raise NotImplementedError

    def forward(self, *inputs: Tensor) -> Tensor:
        """Score images, each [*B, C, H, W], with token ids [*B, L], the last input."""
        *pixels, instruction = inputs
        if hidden_from_python(instruction):
            return self.score(self.encode_pixels(*pixels), self.encode_instruction(instruction))
        images, batch = self.flat_images(*pixels)
        same_batch(images=batch, instruction=instruction.shape[:-1])
        tokens, which = distinct_rows(instruction.reshape(-1, instruction.shape[-1]).long())
        scenes, words = self.encode_scenes(*images), self.encode_instruction(tokens)
        return self.score_candidates(scenes, words, which.unsqueeze(1)).reshape(*batch, 1)


class SentenceScorer(PairScorer):
    """Scores images with an instruction that is one vector.

    ``film`` scores by residual FiLM, attention maps that tell places, and counts of the cells
    that fit; ``paper`` by gated attention.
    """

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__(shapes, config, images)
        self.image = image_encoder(shapes, config, images)
        features = config.features
        self.context = nn.Sequential(*(ResidualBlock(features) for _ in range(config.context)))
        self.instruction = instruction_encoder(shapes, config)
        self.paper = config.preset == "paper"
        self.alone = cells_are_alone(config)
        size = self.instruction.size
        if self.paper:
            self.fusion = nn.ModuleList([GatedAttention(size, features, config.sentence_rate)])
            size = features * math.prod(grid(shapes, config))
        else:
            self.fusion = nn.ModuleList(
                ResidualFiLM(size, features, config.kernel) for _ in range(config.n_blocks)
            )
            self.readout = SpatialReadout(
                features, config.heads, config.values, grid(shapes, config)
            )
            self.count = CellCount(features, config.detectors)
            size = self.readout.size + self.count.size
        self.head = head(size, config, 1)

    def _features(self, images: list[Tensor]) -> Tensor:
        features: Tensor = self.context(self.image(torch.cat(images, -3)))
        return features

    def encode_instruction(self, instruction: Tensor) -> Tensor:  # noqa: D102
        return encode_instruction(self.instruction, instruction)

    def encode_scenes(self, *pixels: Tensor) -> Cells | Kinds | Tensor:  # noqa: D102
        if self.alone:
            images, _ = self.flat_images(*pixels)
            with self.autocast(pixels[0]):
                cells = distinct_cells(self.image, torch.cat(images, -3))
            if cells is not None:
                return cells
        return self.encode_pixels(*pixels)

    def score_candidates(
        self, scenes: Cells | Kinds | Tensor, words: Tensor, index: Tensor
    ) -> Tensor:
        """Score some instructions of a pool for each scene: logits [N, K]; see the base class."""
        rows, count = index.shape
        which = index.flatten()
        if isinstance(scenes, Tensor):
            repeated = scenes.unsqueeze(1).expand(-1, count, *scenes.shape[1:]).flatten(0, 1)
            return self.score(repeated, words[which]).reshape(rows, count)
        assert isinstance(scenes, Cells)
        groups = group_cells(scenes.index, self.readout.place).repeated(count)
        pairs = pair_up(groups.cell, which, len(scenes.features), len(words))
        with self.autocast(words):
            parts = [
                self._outlook(fuse_pairs(self.fusion, scenes.features, words, pairs[some]))
                for some in slices(len(pairs), CELLS_AT_ONCE)
            ]
            outlook = [torch.cat(part) for part in zip(*parts, strict=True)]
            outputs = [
                self.head(self._read(outlook, pairs.index[some], groups[some]))
                for some in slices(len(which), ROWS_AT_ONCE)
            ]
        return self._expected(torch.cat(outputs).reshape(rows, count))

    def _outlook(self, fused: Tensor) -> list[Tensor]:
        """Return all that is read of each cell, [Q, ...] each, of features [Q, F, 1, 1]."""
        parts = (*self.readout.outlook(fused), self.count.outlook(fused))
        return [part.flatten(1) for part in parts]

    def _read(self, outlook: list[Tensor], index: Tensor, groups: Groups) -> Tensor:
        """Read the cells of scenes, which lie at ``index`` [N, J] in the tables of the outlook."""
        logits, seen, detected = (look_up(table, index) for table in outlook)
        looked = self.readout.read(logits, seen, groups.mean, groups.number)
        return torch.cat([looked, self.count.read(detected, groups.number)], -1)

    def score(self, features: Tensor, instruction: Tensor) -> Tensor:
        """Score features [*B, F, h, w] and [*B, D] that belong together: logits [*B, 1]."""
        batch = features.shape[:-3]
        same_batch(features=batch, instruction=instruction.shape[:-1])
        with self.autocast(features):
            cells = features.movedim(-3, -1)
            fused = cells.reshape(-1, *cells.shape[-3:]).contiguous().movedim(-1, -3)
            words = instruction.reshape(-1, instruction.shape[-1])
            for fuse in self.fusion:
                fused = fuse(fused, words)
            outputs = self.head(self._summary(F.relu(fused)))
        return self._expected(outputs.reshape(*batch, 1))

    def _summary(self, fused: Tensor) -> Tensor:
        if self.paper:
            return flatten_cells(fused)
        return torch.cat([self.readout(fused), self.count(fused)], -1)

    def score_all(self, features: Tensor, instruction: Tensor, chunk: int = 2048) -> Tensor:  # noqa: D102
        scenes, pool = len(features), len(instruction)
        pairs = torch.arange(scenes * pool, device=features.device)
        cells = features.movedim(-3, -1).contiguous()
        parts = [
            self.score(
                cells.index_select(0, part // pool).movedim(-1, -3), instruction[part % pool]
            )
            for part in pairs.split(chunk)
        ]
        return torch.cat(parts).reshape(scenes, pool) if parts else features.new_zeros(scenes, pool)
