"""What the networks share: flattening batches, precision, image encoders, heads, and the trunk."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.errors import UserError
from ifo_grounding.modules import hidden_from_python
from ifo_grounding.networks.cells import Cells, Pairs, look_up, pair_up
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder, PatchEncoder, begin_before_relu
from ifo_grounding.networks.fusion import (
    GatedAttention,
    ResidualBlock,
    ResidualFiLM,
    SpatialReadout,
)
from ifo_grounding.networks.grounding import GroundedTrunk
from ifo_grounding.networks.sentences import (
    ConvInstructionEncoder,
    GRUInstructionEncoder,
    InstructionEncoder,
)
from ifo_grounding.networks.shapes import Shapes, patch_size


@functools.cache
def bf16_is_native(device_type: str) -> bool:
    """Whether the hardware computes in bf16, rather than emulating it slowly."""
    if device_type == "cpu":
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return False


@contextlib.contextmanager
def autocast(device_type: str, precision: str | None) -> Iterator[None]:
    """Compute in ``precision``; None, or ``"auto"`` without native bf16, is the caller's choice."""
    if precision is None or (precision == "auto" and not bf16_is_native(device_type)):
        yield
        return
    with torch.autocast(device_type, torch.bfloat16, enabled=precision != "fp32"):
        yield


class Network(nn.Module):
    """Base of the networks: takes any leading batch dims, checks shapes, computes in precision."""

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__()
        self.shapes = shapes
        self.config = config

    def flat_pixels(self, pixels: Tensor) -> tuple[Tensor, torch.Size]:
        """Return pixels [*B, C, H, W] as [N, C, H, W], and B.

        Raises:
            UserError: for an image of another size than this network was built for.
        """
        if tuple(pixels.shape[-3:]) != self.shapes.image_shape:
            raise UserError(
                f"this network was built for images of {self.shapes.image_shape}, got "
                f"{tuple(pixels.shape[-3:])}: build another for this env or dataset"
            )
        return pixels.reshape(-1, *pixels.shape[-3:]), pixels.shape[:-3]

    def autocast(self, tensor: Tensor) -> contextlib.AbstractContextManager[None]:
        """Compute in the configured precision on the device of ``tensor``."""
        return autocast(tensor.device.type, self.config.precision)


def same_batch(**batches: torch.Size) -> None:
    """Raise :class:`UserError` unless all inputs have the same leading dims."""
    if len(set(batches.values())) > 1:
        listed = ", ".join(f"{name} {list(batch)}" for name, batch in batches.items())
        raise UserError(f"inputs must have the same batch dims, got {listed}: expand them first")


def encode_instruction(encoder: InstructionEncoder, tokens: Tensor) -> Tensor:
    """Encode tokens [*B, L] to [*B, D], in float32: a recurrence is too small to gain from bf16."""
    with torch.autocast(tokens.device.type, enabled=False):
        flat = encoder(tokens.reshape(-1, tokens.shape[-1]))
    return flat.reshape(*tokens.shape[:-1], encoder.size)


def distinct_cells(encoder: nn.Module, image: Tensor) -> Cells | None:
    """Encode the distinct cells of [N, C, H, W]; None where there are none, or it does not pay."""
    return encoder.cells(image) if isinstance(encoder, PatchEncoder) else None


def distinct_instructions(encoder: InstructionEncoder, tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Encode the distinct instructions of [N, L]: float32 [P, D], and which each row has."""
    with torch.autocast(tokens.device.type, enabled=False):
        return encoder.distinct(tokens)


def fuse_pairs(fusion: nn.ModuleList, features: Tensor, words: Tensor, pairs: Pairs) -> Tensor:
    """Fuse distinct pairs of a cell and an instruction, where no cell sees another.

    Args:
        fusion: blocks of :class:`~ifo_grounding.networks.ResidualFiLM` of kernel 1.
        features: of distinct cells [U, F].
        words: encoded instructions [P, D].
        pairs: which of them belong together, [Q].

    Returns:
        Fused features of each pair, as images of one cell, [Q, F, 1, 1].
    """
    fused = look_up(features, pairs.cell)[..., None, None]
    for block in fusion:
        assert isinstance(block, ResidualFiLM)
        fused = block.modulate(fused, look_up(block.film(words), pairs.instruction))
    return F.relu(fused)


def cells_are_alone(config: NetworkConfig) -> bool:
    """Whether no cell of a trunk of this configuration sees another."""
    return config.preset != "paper" and config.kernel == 1 and config.context == 0


def image_encoder(shapes: Shapes, config: NetworkConfig, images: int = 1) -> nn.Module:
    """Return the preset's encoder of ``images`` images laid on top of each other."""
    channels = images * shapes.image_shape[0]
    if config.preset == "paper":
        return ConvEncoder(channels, config.features, config.conv_layers)
    patch = patch_size(shapes, config)
    return PatchEncoder(channels, config.features, patch)


def grid(shapes: Shapes, config: NetworkConfig) -> tuple[int, int]:
    """Return the height and width of the feature map."""
    _, height, width = shapes.image_shape
    if config.preset == "paper":
        return ConvEncoder.grid(height, width, config.conv_layers)
    return PatchEncoder.grid(height, width, patch_size(shapes, config))


def flatten_cells(features: Tensor) -> Tensor:
    """Flatten [N, F, h, w] to [N, h * w * F], the order in which it lies in memory."""
    return features.permute(0, 2, 3, 1).flatten(1)


def head(size: int, config: NetworkConfig, outputs: int) -> nn.Sequential:
    """Return several linear layers with ReLU between them and dropout before each.

    With ``paper`` they begin as its convolutions do.
    """
    layers: list[nn.Module] = []
    for hidden in config.head_hidden:
        layer = nn.Linear(size, hidden)
        if config.preset == "paper":
            begin_before_relu(layer)
        layers += [nn.Dropout(config.dropout), layer, nn.ReLU()]
        size = hidden
    return nn.Sequential(*layers, nn.Dropout(config.dropout), nn.Linear(size, outputs))


def instruction_encoder(shapes: Shapes, config: NetworkConfig) -> InstructionEncoder:
    """Return the configured encoder of instructions."""
    sizes = shapes.vocabulary_size, config.embedding, config.hidden
    if config.words == "conv":
        return ConvInstructionEncoder(*sizes)
    return GRUInstructionEncoder(*sizes, config.sentence_rate, config.sentence_pooling)


class Trunk(nn.Module):
    """Features of an image in the light of an instruction, with the places they come from."""

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__()
        self.image = image_encoder(shapes, config)
        self.instruction = instruction_encoder(shapes, config)
        size, features = self.instruction.size, config.features
        self.context = nn.Sequential(*(ResidualBlock(features) for _ in range(config.context)))
        self.readout: SpatialReadout | None = None
        self.alone = cells_are_alone(config)
        if config.preset == "paper":
            self.fusion = nn.ModuleList([GatedAttention(size, features, config.sentence_rate)])
            self.size = features * math.prod(grid(shapes, config))
        else:
            self.fusion = nn.ModuleList(
                ResidualFiLM(size, features, config.kernel) for _ in range(config.n_blocks)
            )
            self.readout = SpatialReadout(
                features, config.heads, config.values, grid(shapes, config)
            )
            self.size = self.readout.size

    def fuse(self, image: Tensor, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to fused features [N, F, h, w]."""
        instruction = encode_instruction(self.instruction, tokens)
        features = self.context(self.image(image))
        for fuse in self.fusion:
            features = fuse(features, instruction)
        return F.relu(features)

    def cells(self, image: Tensor) -> Tensor:
        """Return the features of each cell of [N, C, H, W] before any word: [N, h * w, F]."""
        return self.context(self.image(image)).flatten(2).transpose(1, 2)

    def maps(self, image: Tensor, tokens: Tensor) -> Tensor:
        """Return how each head weighs the cells of an image: [N, heads, h * w].

        The paper's network has no heads: its one map is what all gates together let through.
        """
        fused = self.fuse(image, tokens)
        if self.readout is not None:
            return self.readout.maps(fused).flatten(2)
        let_through = fused.sum(1, keepdim=True).flatten(2)
        return let_through / let_through.sum(-1, keepdim=True).clamp_min(1e-9)

    def forward(self, image: Tensor, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to [N, size]."""
        if self.readout is None:
            return flatten_cells(self.fuse(image, tokens))
        if self.alone and not hidden_from_python(tokens):
            cells = distinct_cells(self.image, image)
            if cells is not None:
                words, which = distinct_instructions(self.instruction, tokens)
                pairs = pair_up(cells.index, which, len(cells.features), len(words))
                fused = fuse_pairs(self.fusion, cells.features, words, pairs)
                parts = (part.flatten(1) for part in self.readout.outlook(fused))
                logits, seen = (look_up(part, pairs.index) for part in parts)
                return self.readout.read(logits, seen, self.readout.place)
        return self.readout(self.fuse(image, tokens))


class InstructedNetwork(Network):
    """The trunk and a head: what policy, critic and reward model are made of."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, outputs: int) -> None:
        super().__init__(shapes, config)
        by_word = config.matching == "words"
        self.trunk = GroundedTrunk(shapes, config) if by_word else Trunk(shapes, config)
        self.head = head(self.trunk.size, config, outputs)

    def forward(self, pixels: Tensor, instruction: Tensor) -> Tensor:
        """Map pixels [*B, C, H, W] and token ids [*B, L] to float32 [*B, outputs]."""
        image, batch = self.flat_pixels(pixels)
        same_batch(pixels=batch, instruction=instruction.shape[:-1])
        with self.autocast(pixels):
            outputs = self.head(self.trunk(image, instruction.reshape(-1, instruction.shape[-1])))
        return outputs.float().reshape(*batch, outputs.shape[-1])
