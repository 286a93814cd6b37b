"""Which instruction suits a scene (the paper's instruction module)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ifo_grounding import keys
from ifo_grounding.errors import UserError
from ifo_grounding.networks.building import (
    Blueprint,
    blueprint,
    check_keys,
    construct,
    wrap,
)
from ifo_grounding.networks.cells import Cells, hidden_from_python, look_up, pair_up
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.fusion import (
    CellCount,
    GatedAttention,
    ResidualBlock,
    ResidualFiLM,
    SpatialReadout,
)
from ifo_grounding.networks.grounding import GroundedTrunk
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.transfer import copy_weights, trunk_of
from ifo_grounding.networks.trunk import (
    Network,
    cells_are_alone,
    distinct_cells,
    distinct_instructions,
    encode_instruction,
    flatten_cells,
    fuse_pairs,
    grid,
    head,
    image_encoder,
    instruction_encoder,
    same_batch,
)

CELLS_AT_ONCE, ROWS_AT_ONCE = 1 << 16, 1 << 12
"""Cells and pairs that are computed together, to bound memory."""


def slices(size: int, at_once: int) -> list[slice]:
    """Cut a range into parts; an empty range is one part.

    >>> slices(5, 3)
    [slice(0, 3, None), slice(3, 6, None)]
    """
    return [slice(begin, begin + at_once) for begin in range(0, max(size, 1), at_once)]


class PairScorer(Network):
    """Scores how images and an instruction go together, in two halves.

    Images are encoded without the instruction and instructions without the images, so that N
    scenes against P instructions cost N + P encodings and N x P light scores. ``strong`` scores by
    residual FiLM, attention maps that tell places, and counts of the cells that fit; ``paper`` by
    gated attention.
    """

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__(shapes, config)
        self.images = images
        self.image = image_encoder(shapes, config, images)
        features = config.features
        self.context = nn.Sequential(*(ResidualBlock(features) for _ in range(config.context)))
        self.instruction = instruction_encoder(shapes, config)
        self.strong = config.preset != "paper"
        self.alone = cells_are_alone(config)
        size = self.instruction.size
        if self.strong:
            self.fusion = nn.ModuleList(
                ResidualFiLM(size, features, config.kernel) for _ in range(config.n_blocks)
            )
            self.readout = SpatialReadout(
                features, config.heads, config.values, grid(shapes, config)
            )
            self.count = CellCount(features, config.detectors)
            size = self.readout.size + self.count.size
        else:
            self.fusion = nn.ModuleList([GatedAttention(size, features)])
            size = features * math.prod(grid(shapes, config))
        self.head = head(size, config, 1)
        self.register_buffer("prior", torch.zeros(()))

    prior: Tensor
    """Added to every logit: the log-odds of suitability before anything is seen, once known."""

    def encode_pixels(self, *pixels: Tensor) -> Tensor:
        """Map images, each [*B, C, H, W], to features [*B, F, h, w] that know no instruction."""
        flat = [self.flat_pixels(image) for image in pixels]
        same_batch(**{f"image {number}": batch for number, (_, batch) in enumerate(flat)})
        with self.autocast(pixels[0]):
            features = self.context(self.image(torch.cat([image for image, _ in flat], -3)))
        return features.reshape(*flat[0][1], *features.shape[1:])

    def encode_instruction(self, instruction: Tensor) -> Tensor:
        """Map token ids [*B, L] to features [*B, D]; each distinct instruction is encoded once."""
        return encode_instruction(self.instruction, instruction)

    def encode_scenes(self, *pixels: Tensor) -> Cells | Tensor:
        """Encode images, each [N, C, H, W], for :meth:`score_candidates`.

        Returns:
            Their distinct cells where these repeat, else features [N, F, h, w].
        """
        if self.alone:
            flat = [self.flat_pixels(image)[0] for image in pixels]
            with self.autocast(pixels[0]):
                cells = distinct_cells(self.image, torch.cat(flat, -3))
            if cells is not None:
                return cells
        return self.encode_pixels(*pixels)

    def score_candidates(self, scenes: Cells | Tensor, words: Tensor, index: Tensor) -> Tensor:
        """Score some instructions of a pool for each scene.

        Args:
            scenes: N encoded scenes, from :meth:`encode_scenes`.
            words: encoded instructions [P, D], from :meth:`encode_instruction`.
            index: candidates of each scene, int64 [N, K].

        Returns:
            Logits, float32 [N, K].
        """
        rows, count = index.shape
        which = index.flatten()
        if not isinstance(scenes, Cells):
            repeated = scenes.unsqueeze(1).expand(-1, count, *scenes.shape[1:]).flatten(0, 1)
            return self.score(repeated, words[which]).reshape(rows, count)
        places = scenes.index.repeat_interleave(count, 0)
        pairs = pair_up(places, which, len(scenes.features), len(words))
        with self.autocast(words):
            parts = [
                self._outlook(fuse_pairs(self.fusion, scenes.features, words, pairs[some]))
                for some in slices(len(pairs), CELLS_AT_ONCE)
            ]
            outlook = torch.cat(parts)
            outputs = [
                self.head(self._read(look_up(outlook, pairs.index[some])))
                for some in slices(len(which), ROWS_AT_ONCE)
            ]
        return torch.cat(outputs).float().reshape(rows, count) + self.prior

    def _outlook(self, fused: Tensor) -> Tensor:
        """Return all that is read of each cell, [Q, ...], of features [Q, F, 1, 1]."""
        parts = [part.outlook(fused).flatten(1) for part in (self.readout, self.count)]
        return torch.cat(parts, -1)

    def _read(self, outlook: Tensor) -> Tensor:
        """Read the cells of scenes, [N, h * w, ...]."""
        sizes = [outlook.shape[-1] - self.config.detectors, self.config.detectors]
        looked, counted = outlook.split(sizes, -1)
        return torch.cat([self.readout.read(looked), self.count.read(counted)], -1)

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
        return outputs.float().reshape(*batch, 1) + self.prior

    def _summary(self, fused: Tensor) -> Tensor:
        if not self.strong:
            return flatten_cells(fused)
        return torch.cat([self.readout(fused), self.count(fused)], -1)

    def score_all(self, features: Tensor, instruction: Tensor, chunk: int = 2048) -> Tensor:
        """Score every scene [N, F, h, w] with every instruction [P, D]: logits [N, P].

        ``chunk`` bounds the pairs scored at once, so that they stay in the processor's cache.
        """
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

    def forward(self, *inputs: Tensor) -> Tensor:
        """Score images, each [*B, C, H, W], with token ids [*B, L], the last input."""
        *pixels, instruction = inputs
        if self.alone and not hidden_from_python(instruction):
            flat = [self.flat_pixels(image) for image in pixels]
            batch = instruction.shape[:-1]
            same_batch(**{f"image {n}": size for n, (_, size) in enumerate(flat)}, words=batch)
            tokens = instruction.reshape(-1, instruction.shape[-1])
            words, which = distinct_instructions(self.instruction, tokens)
            scenes = self.encode_scenes(*(image for image, _ in flat))
            return self.score_candidates(scenes, words, which.unsqueeze(1)).reshape(*batch, 1)
        return self.score(self.encode_pixels(*pixels), self.encode_instruction(instruction))


def begin_with_policy(network: PairScorer, policy: nn.Module, plan: Blueprint) -> None:
    """Copy what a policy has learned of words, cells and places; of several images, to the last.

    Raises:
        UserError: where the weights do not fit.
    """
    trunk = trunk_of(policy)
    if isinstance(trunk, GroundedTrunk):
        raise UserError(
            "init_from reads word by word (preset 'grounded'), this network reads sentences: begin "
            "without it"
        )
    parts: list[tuple[nn.Module, nn.Module]] = [
        (trunk.context, network.context),
        (trunk.instruction, network.instruction),
        (trunk.fusion, network.fusion),
    ]
    if trunk.readout is not None:
        parts.append((trunk.readout, network.readout))
    copy_weights(parts, policy, plan)
    mine, theirs = network.image.state_dict(), trunk.image.state_dict()
    for name, weight in theirs.items():
        if mine[name].shape == weight.shape:
            mine[name].copy_(weight)
        else:  # the first layer, whose inputs are the images' channels, one image after the other
            mine[name].zero_()
            mine[name][:, -weight.shape[1] :].copy_(weight)


def make_instruction_classifier(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = (keys.PIXELS, keys.INSTRUCTION),
    out_key: NestedKey = keys.SUITABILITY,
    init_from: nn.Module | None = None,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the instruction module: an image and an instruction to a logit of suitability [*B, 1].

    ``encode_pixels``, ``encode_instruction``, ``score`` and ``score_all`` of the result score many
    instructions per image cheaply.

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"``, ``"grounded"`` or ``"paper"``.
        in_keys: the image, uint8 [*B, C, H, W], and the instruction, int64 [*B, L].
        out_key: where the logit goes; the paper's threshold of 0.8 is on its sigmoid.
        init_from: a policy of the same preset and sizes whose weights it begins with. It has
            learned what the words look like, which first frames alone teach slowly (an extension
            of the paper).
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or a policy that
            does not fit.

    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_instruction_classifier(shapes, seed=0)
    >>> scenes = classifier.encode_pixels(torch.zeros(5, 3, 48, 48, dtype=torch.uint8))
    >>> pool = classifier.encode_instruction(torch.randint(40, (7, 16)))
    >>> classifier.score_all(scenes, pool).shape
    torch.Size([5, 7])
    """
    check_keys(in_keys, ("image", "instruction"))
    options = {"in_keys": list(in_keys), "out_key": out_key}
    plan = blueprint("instruction", spec_source, preset, options, overrides)
    network = construct(PairScorer, plan, device, seed)
    if init_from is not None:
        begin_with_policy(network, init_from, plan)
    return wrap(network, plan, in_keys, [out_key])
