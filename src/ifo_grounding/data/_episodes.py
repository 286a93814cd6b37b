"""Parts of demonstrations: checking them, and rows of episodes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.errors import UserError


def check_parts(
    codec: FrameCodec, codes: Tensor, lengths: Tensor, instructions: Tensor, vocabulary_size: int
) -> None:
    """Refuse parts that do not fit each other."""
    if codes.shape[1:] != codec.code_shape or codes.dtype.is_floating_point:
        raise UserError(
            f"codes are {codes.dtype} {list(codes.shape)}, {codec} makes integers "
            f"[F, {', '.join(map(str, codec.code_shape))}]"
        )
    if codec.tiles is None and codes.dtype != torch.uint8:
        raise UserError(f"codes of {codec} are the pixels themselves, uint8, got {codes.dtype}")
    if lengths.ndim != 1 or lengths.dtype.is_floating_point or (lengths < 1).any():
        raise UserError("lengths must be an integer tensor [N] of frames per episode, at least 1")
    if int(lengths.sum()) != len(codes):
        raise UserError(f"lengths add up to {int(lengths.sum())} frames, there are {len(codes)}")
    if instructions.ndim != 2 or len(instructions) != len(lengths):
        raise UserError(
            f"instructions are {list(instructions.shape)}: give [N, L] for {len(lengths)} episodes"
        )
    if instructions.dtype.is_floating_point:
        raise UserError(f"instructions must be integer token ids, got {instructions.dtype}")
    if instructions.numel():
        low, high = (int(value) for value in instructions.aminmax())
        if low < 0 or high >= vocabulary_size:
            raise UserError(
                f"instructions hold token {low if low < 0 else high}: the vocabulary has ids "
                f"0..{vocabulary_size - 1}"
            )
    if codec.tiles is not None and codes.numel():
        low, high = (int(value) for value in codes.aminmax())
        if low < 0 or high >= len(codec.tiles):
            raise UserError(
                f"codes hold tile {low if low < 0 else high}: the dictionary has {len(codec.tiles)}"
            )


def refuse_empty(count: int, things: str = "demonstrations") -> None:
    """Raise :class:`UserError` where there is nothing to make something of."""
    if not count:
        raise UserError(f"there are no {things}: is a selection, or the share of a split, empty?")


def row_numbers(starts: Tensor, lengths: Tensor, padded: Tensor | None = None) -> Tensor:
    """Return frame numbers of episodes in a row, the last one repeated up to ``padded`` lengths."""
    padded = lengths if padded is None else padded
    begin = padded.cumsum(0) - padded
    step = torch.arange(int(padded.sum())) - begin.repeat_interleave(padded)
    return starts.repeat_interleave(padded) + step.minimum((lengths - 1).repeat_interleave(padded))


def distinct_rows(tokens: Tensor) -> Tensor:
    """Return the distinct rows in lexical order (rows are sorted as bytes: fast for many rows)."""
    rows = np.ascontiguousarray(tokens.numpy().astype(">i4"))
    as_bytes = rows.view([("", f"V{rows.shape[1] * 4}")]).reshape(-1)
    return torch.from_numpy(rows[np.unique(as_bytes, return_index=True)[1]].astype(np.int64))
