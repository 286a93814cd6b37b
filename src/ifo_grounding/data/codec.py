"""Frames stored without loss as mosaics: distinct tiles once, and per frame their numbers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from ifo_grounding import mosaic
from ifo_grounding.data import _spool
from ifo_grounding.data._spool import Spool, join
from ifo_grounding.distinct import distinct_rows
from ifo_grounding.errors import UserError, check_below

TILE_SIZES = (8, 16, 32, 64)
CODE_DTYPES = (torch.uint8, torch.int16, torch.int32)
CHUNK_BYTES = 4 << 20
SAMPLE_FRAMES = 256
PATIENCE_BYTES = 64 << 20
WORTH = 0.5
"""Share of the pixels that a dictionary and codes may take once patience is at its end."""
PIECE_FRAMES = 2048


class FrameCodec:
    """Lossless codec of uint8 images, a dictionary of tiles learned from the images themselves.

    An image [C, H, W] is cut into T x T tiles; its code is the grid of their numbers in the
    dictionary, as uint8, int16 or int32, whichever is the smallest that fits. Images of a simulator
    shrink about a hundredfold. Where tiles do not repeat, or no tile size divides the image, the
    codec is *raw*: codes are the pixels themselves, and every method works just the same.

    Args:
        image_shape: (C, H, W) of the images.
        tiles: distinct tiles, uint8 [N, C, T, T]; None for a raw codec.

    Raises:
        UserError: where tiles and image shape do not fit.

    >>> frames = torch.zeros(100, 3, 48, 48, dtype=torch.uint8)
    >>> codec, codes = FrameCodec.compress(frames)
    >>> codes.dtype, codes.shape
    (torch.uint8, torch.Size([100, 3, 3]))
    >>> bool((codec.decode(codes) == frames).all())
    True
    """

    def __init__(self, image_shape: Sequence[int], tiles: Tensor | None = None) -> None:
        channels, height, width = (int(side) for side in image_shape)
        self.image_shape = (channels, height, width)
        self.tile_size: int | None = None
        self.words: Tensor | None = None
        """Tiles as 64-bit words, int64 [N, C, T, T / 8]; None where the codec is raw."""
        self._numbers: dict[bytes, int] = {}
        if tiles is not None:
            side = self.tile_size = int(tiles.shape[-1])
            fits = tiles.shape[1:] == (channels, side, side) and not (height % side or width % side)
            if not fits or tiles.dtype != torch.uint8 or side % mosaic.PIXELS_PER_WORD:
                raise UserError(
                    f"tiles {tiles.dtype} {list(tiles.shape)} do not cover images "
                    f"{list(self.image_shape)}: give uint8 [N, {channels}, T, T] with T a multiple "
                    "of 8 and a divisor of height and width"
                )
            self.words = mosaic.as_words(tiles.cpu())
            self._numbers = {tile.tobytes(): n for n, tile in enumerate(self.words.numpy())}
            if len(self._numbers) != len(tiles):
                raise UserError("tiles are not distinct: give each tile once")

    @property
    def tiles(self) -> Tensor | None:
        """Distinct tiles, uint8 [N, C, T, T]; None where the codec is raw."""
        return None if self.words is None else self.words.view(torch.uint8)

    @property
    def code_shape(self) -> tuple[int, ...]:
        """Shape of one image's code: (rows, columns), or (C, H, W) where the codec is raw."""
        _, height, width = self.image_shape
        if self.tile_size is None:
            return self.image_shape
        return (height // self.tile_size, width // self.tile_size)

    @property
    def code_dtype(self) -> torch.dtype:
        """Smallest integer type that holds every tile number."""
        largest = 0 if self.words is None else len(self.words) - 1
        return next(dtype for dtype in CODE_DTYPES if largest <= torch.iinfo(dtype).max)

    def __repr__(self) -> str:
        kind = "raw" if self.words is None else f"{len(self.words)} tiles of {self.tile_size}"
        return f"FrameCodec({'x'.join(map(str, self.image_shape))}, {kind})"

    @classmethod
    def compress(
        cls, frames: Tensor | Iterable[Tensor], tile_size: int | None = None
    ) -> tuple[FrameCodec, Tensor]:
        """Return a codec of ``frames`` and their codes.

        Args:
            frames: images, uint8 [F, C, H, W], or an iterable of such pieces, which may come from
                disk: pixels of one piece are in memory at a time. Codes of more than 128 MiB, such
                as raw pixels, are kept in a scratch file that is mapped into memory.
            tile_size: 8, 16, 32 or 64; the cheapest one by default.

        Returns:
            The codec and codes [F, *code_shape]. It is raw where dictionary and codes take more
            than the pixels, or more than half of them after the first 64 MiB of pixels.

        Raises:
            UserError: for images of another type or shape, or a tile size that does not fit them.
        """
        pieces = map(_checked, [frames] if isinstance(frames, Tensor) else frames)
        first = next(pieces, None)
        if first is None:
            raise UserError("no frames: give at least one piece, uint8 [F, C, H, W]")
        image_shape = first.shape[1:]
        codec = cls._empty(image_shape, _tile_size(first, tile_size))
        patience = PATIENCE_BYTES // max(image_shape.numel(), 1)
        codes = Spool()
        seen = 0
        for piece in itertools.chain([first], pieces):
            code = codec._encode(piece)
            # Whoever gives pieces one by one may write to their memory again.
            codes.append(code.clone() if code is piece else code)
            seen += len(piece)
            if seen >= patience and codec._share(seen) > WORTH:
                codec, codes = codec._give_up(codes)
        if codec._share(seen) > 1:
            codec, codes = codec._give_up(codes)
        return codec, codes.tensor(codec.code_dtype)

    @classmethod
    def from_tiles(
        cls, tiles: Tensor, parts: list[Tensor], generator: torch.Generator | None = None
    ) -> tuple[FrameCodec, Tensor]:
        """Return a codec and codes from tile numbers that a renderer gave.

        Tiles that no frame shows are left out, and numbers are drawn at random: codes then say
        nothing that pixels do not.

        Args:
            tiles: pictures, all different, uint8 [N, C, T, T].
            parts: tile numbers, integer [F, rows, columns] each; the list is emptied on the way.
            generator: decides the new numbers.

        >>> tiles = torch.arange(3, dtype=torch.uint8).view(3, 1, 1, 1).expand(3, 3, 8, 8)
        >>> codec, codes = FrameCodec.from_tiles(tiles, [torch.tensor([[[0, 2], [2, 2]]])])
        >>> codec.decode(codes)[0, 0, ::8, ::8].tolist(), len(codec.tiles)
        ([[0, 2], [2, 2]], 2)
        """
        given = join(parts, parts[0].dtype)
        used = torch.zeros(len(tiles), dtype=torch.bool)
        for piece in given.split(PIECE_FRAMES):
            used[piece.flatten().long()] = True
        shown = used.nonzero().squeeze(-1)
        shown = shown[torch.randperm(len(shown), generator=generator)]
        height, width = (tiles.shape[-1] * count for count in given.shape[1:])
        codec = cls((tiles.shape[1], height, width), tiles[shown])
        numbers = torch.zeros(len(tiles), dtype=codec.code_dtype)
        numbers[shown] = torch.arange(len(shown)).to(codec.code_dtype)
        codes = [numbers[piece.long()] for piece in given.split(PIECE_FRAMES)]
        return codec, join(codes, codec.code_dtype)

    def decode(self, codes: Tensor) -> Tensor:
        """Return the pixels of ``codes`` [*B, *code_shape], uint8 [*B, C, H, W]."""
        if self.words is None:
            return codes
        return mosaic.assemble(self.words.to(codes.device), codes)

    def numbers_among(self, tiles: Tensor) -> Tensor | None:
        """Return which of some tiles each of the dictionary is, int16 [K].

        None where one is none of them, uint8 [N, C, T, T], or the codec is raw.
        """
        if self.tiles is None or tiles.shape[1:] != self.tiles.shape[1:]:
            return None
        known = {tile.tobytes(): number for number, tile in enumerate(tiles.cpu().numpy())}
        found = [known.get(tile, -1) for tile in self._numbers]  # in the order of their numbers
        return None if -1 in found else torch.tensor(found, dtype=torch.int16)

    def check(self, codes: Tensor) -> None:
        """Refuse codes, [F, *code_shape], that this codec cannot have made."""
        raw = self.words is None
        fits = codes.dtype == torch.uint8 if raw else not codes.is_floating_point()
        if codes.shape[1:] != self.code_shape or not fits:
            kind = "uint8" if raw else "integers"
            raise UserError(
                f"codes are {codes.dtype} {list(codes.shape)}, {self} makes {kind} "
                f"[F, {', '.join(map(str, self.code_shape))}]"
            )
        if not raw:
            check_below("codes hold tile", codes, len(self._numbers))

    def _encode(self, frames: Tensor) -> Tensor:
        """Add the tiles of ``frames`` [F, C, H, W] to the dictionary and return their codes.

        Earlier codes stay valid; their type may become too small for the later ones.
        """
        if frames.shape[1:] != self.image_shape:
            raise UserError(
                f"frames are {list(frames.shape[1:])}, the first ones are {list(self.image_shape)}"
            )
        if self.tile_size is None:
            return frames.cpu()
        parts = []
        frames = frames.cpu().reshape(-1, *self.image_shape)  # strides as words need them
        for piece in frames.split(max(1, CHUNK_BYTES // math.prod(self.image_shape))):
            across = self.tile_size // mosaic.PIXELS_PER_WORD
            tiles = mosaic.cut(mosaic.as_words(piece), self.tile_size, across)
            numbers = self._number(tiles.flatten(0, 2))
            parts.append(numbers.to(self.code_dtype))
        return join(parts, self.code_dtype).view(-1, *self.code_shape)

    def _number(self, rows: Tensor) -> Tensor:
        """Return the numbers of tiles as rows of words [M, K], int64 [M], adding new tiles."""
        assert self.words is not None
        distinct, index = distinct_rows(rows)
        known = len(self._numbers)
        tiles = (row.tobytes() for row in distinct.numpy())
        found = [self._numbers.setdefault(tile, len(self._numbers)) for tile in tiles]
        numbers = torch.tensor(found, dtype=torch.int64)
        if len(self._numbers) > known:
            new = distinct[numbers >= known].view(-1, *self.words.shape[1:])
            self.words = torch.cat([self.words, new])
        return numbers[index]

    @classmethod
    def _empty(cls, image_shape: Sequence[int], tile_size: int | None) -> FrameCodec:
        if tile_size is None:
            return cls(image_shape)
        shape = (0, image_shape[0], tile_size, tile_size)
        return cls(image_shape, torch.empty(shape, dtype=torch.uint8))

    def _share(self, frames: int) -> float:
        """Return the bytes of dictionary and codes of so many frames as a share of their pixels.

        The dictionary is always in memory: one beyond the bound counts as endless.
        """
        if self.words is None or not frames:
            return 0.0
        pixels, tiles = math.prod(self.image_shape), self.words.nbytes
        codes = frames * math.prod(self.code_shape) * self.code_dtype.itemsize
        return math.inf if tiles > _spool.MEMORY_BYTES else (tiles + codes) / (frames * pixels)

    def _give_up(self, codes: Spool) -> tuple[FrameCodec, Spool]:
        """Turn codes back into pixels and return them with a raw codec."""
        return FrameCodec(self.image_shape), codes.map(self.decode)


def _checked(frames: Tensor) -> Tensor:
    if not isinstance(frames, Tensor) or frames.dtype != torch.uint8 or frames.ndim != 4:
        kind = getattr(frames, "dtype", type(frames).__name__)
        shape = list(getattr(frames, "shape", []))
        raise UserError(f"frames must be a uint8 tensor [F, C, H, W], got {kind} {shape}")
    return frames


def _tile_size(frames: Tensor, asked: int | None) -> int | None:
    """Return the tile size that seems cheapest on a sample of the frames; None where none fits."""
    height, width = frames.shape[-2:]
    fitting = [size for size in TILE_SIZES if height % size == 0 and width % size == 0 and height]
    if asked is not None and asked not in fitting:
        raise UserError(
            f"tile size {asked} does not divide images of {height} x {width} pixels: "
            f"choose one of {fitting}, or none for pixels as they are"
        )
    sample = frames[:: max(1, -(-len(frames) // SAMPLE_FRAMES))]

    def cost(size: int) -> float:
        codec = FrameCodec._empty(frames.shape[1:], size)
        codec._encode(sample)
        return codec._share(len(frames))

    return asked or min(fitting, key=cost, default=None)
