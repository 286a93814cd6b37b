"""Replay buffers of demonstrations for the classifiers, which need no actions."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Transform

from ifo_grounding import keys
from ifo_grounding.data._episodes import rows_of
from ifo_grounding.data._spool import same_rows
from ifo_grounding.data.decoding import FrameDecoder, Lookup
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.errors import UserError


def first_frame_buffer(demos: Demonstrations, **options: Any) -> TensorDictReplayBuffer:
    """Put first frames and instructions into a replay buffer, for the instruction classifier.

    A sample holds ``pixels`` uint8 [B, C, H, W] and ``instruction`` int64 [B, L].

    Args:
        demos: demonstrations; the buffer shares their frames.
        options: for ``TensorDictReplayBuffer``, such as ``batch_size`` or ``sampler``.

    >>> frames = [torch.zeros(3, 3, 48, 48, dtype=torch.uint8) for _ in range(5)]
    >>> demos = Demonstrations.from_arrays(frames, ["go up"] * 5)
    >>> len(first_frame_buffer(demos))
    5
    """
    check_demonstrations(demos)
    stored = {keys.PIXELS: demos.starts, keys.INSTRUCTION: torch.arange(len(demos))}
    return frame_buffer(demos, stored, [keys.PIXELS], **options)


def goal_buffer(demos: Demonstrations, **options: Any) -> TensorDictReplayBuffer:
    """Put final and earlier frames into a replay buffer, half of each, for the goal classifier.

    A sample holds ``initial_pixels`` and ``pixels`` uint8 [B, C, H, W], ``instruction`` int64
    [B, L] and ``final`` bool [B, 1]. Earlier frames that are equal to the last one are left out:
    the stop repeats it. Demonstrations that are open, without a stop, have no final frame here: a
    recording that was cut shows no success.

    Args:
        demos: demonstrations; the buffer shares their frames.
        options: for ``TensorDictReplayBuffer``, such as ``batch_size`` or ``sampler``.

    Raises:
        UserError: where no demonstration is closed.

    >>> frames = [torch.arange(3, dtype=torch.uint8).view(3, 1, 1, 1).expand(3, 3, 48, 48)]
    >>> buffer = goal_buffer(Demonstrations.from_arrays(frames, ["go up"]).close_episodes())
    >>> buffer[:]["final"].flatten().tolist()
    [False, False, True, True]
    """
    check_demonstrations(demos)
    closed = demos.closed
    if not closed.any():
        raise UserError("no demonstration shows its stop: close_episodes() adds it")
    episode, frame = rows_of(demos.starts, demos.lengths)
    last = demos.starts + demos.lengths - 1
    earlier = ~same_rows(demos.codes, frame, last[episode])
    balance = episode[earlier].bincount(minlength=len(demos))
    finished = torch.arange(len(demos)).repeat_interleave(balance.clamp(min=1) * closed)
    episodes = torch.cat([episode[earlier], finished])
    final = torch.arange(len(episodes)).unsqueeze(-1) >= earlier.sum()
    stored = {
        keys.INITIAL_PIXELS: demos.starts[episodes],
        keys.PIXELS: torch.cat([frame[earlier], last[finished]]),
        keys.INSTRUCTION: episodes,
        keys.FINAL: final,
    }
    return frame_buffer(demos, stored, [keys.INITIAL_PIXELS, keys.PIXELS], **options)


def frame_buffer(
    demos: Demonstrations,
    stored: dict[NestedKey, Tensor],
    frame_keys: list[NestedKey],
    **options: Any,
) -> TensorDictReplayBuffer:
    """Put entries that name frames and episodes by number into a buffer that looks them up.

    Entries are [N, ...]: numbers of frames at ``frame_keys``, the number of the episode at
    ``instruction``, and whatever else. None at all is a :class:`UserError`.
    """
    if not len(stored[keys.INSTRUCTION]):
        raise UserError("there are no transitions: no episode has two frames")
    entries = TensorDict(stored, [len(stored[keys.INSTRUCTION])])
    for key in [*frame_keys, keys.INSTRUCTION]:
        entries[key] = entries[key].int()
    lookups = Lookup(demos.codes, frame_keys), Lookup(demos.instructions, [keys.INSTRUCTION])
    return encoded_buffer(entries, [*lookups, FrameDecoder(demos.codec, frame_keys)], options)


def encoded_buffer(
    entries: TensorDict, transforms: list[Transform], options: dict[str, Any]
) -> TensorDictReplayBuffer:
    """Put entries [N] that are encoded already into a buffer, which decodes what is sampled.

    A ``transform`` among the options sees what is decoded; a ``storage`` is a :class:`UserError`.
    """
    if "storage" in options:
        raise UserError(
            "the storage is the buffer's own, which holds frames as codes or numbers: leave "
            "storage out"
        )
    further = options.pop("transform", None)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(entries)), **options)
    buffer.extend(entries)
    for transform in transforms if further is None else [*transforms, further]:
        buffer.append_transform(transform)
    return buffer


def check_demonstrations(demos: object) -> None:
    """Refuse what is no demonstrations, or none."""
    if not isinstance(demos, Demonstrations):
        raise UserError(
            f"{demos!r:.80} is a {type(demos).__name__}: give Demonstrations, such as "
            "load_pictures or Demonstrations.load returns"
        )
    if not len(demos):
        raise UserError("there are no demonstrations: is a selection, or a share, empty?")
