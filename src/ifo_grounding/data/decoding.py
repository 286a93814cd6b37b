"""Replay buffer transforms that turn what is stored into what is sampled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from ifo_grounding import keys, mosaic
from ifo_grounding.data.codec import FrameCodec

FRAME_KEYS: tuple[NestedKey, ...] = (keys.PIXELS, keys.NEXT_PIXELS)


class Lookup(Transform):
    """Replaces row numbers by rows of a table when a replay buffer is sampled, where the table is.

    ``buffer.transform.to(device)`` moves the table, and samples follow it.

    Args:
        table: [N, *S].
        in_keys: entries with row numbers, integer [*B], in whose place come the rows, [*B, *S].

    >>> import torch
    >>> from tensordict import TensorDict
    >>> lookup = Lookup(torch.tensor([[5, 6], [7, 8]]), in_keys=["instruction"])
    >>> lookup(TensorDict({"instruction": torch.tensor([1, 1, 0])}, [3]))["instruction"].tolist()
    [[7, 8], [7, 8], [5, 6]]
    """

    table: Any
    """[N, *S]; None where what a decoder reads are the pixels."""

    def __init__(self, table: Tensor | None, in_keys: Sequence[NestedKey]) -> None:
        super().__init__(in_keys=[*in_keys], out_keys=[*in_keys])
        self.register_buffer("table", table, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look up the entries of a copy of a sample: a full buffer may hand out its storage."""
        if self.table is None or tensordict.device in (None, self.table.device):
            return super().forward(tensordict.clone(recurse=False))
        return super().forward(tensordict.to(self.table.device))

    def _apply_transform(self, number: Tensor) -> Tensor:
        return self.table[number.to(self.table.device).long()]


class FrameDecoder(Lookup):
    """Decodes frames when a replay buffer is sampled.

    The buffer stores codes of a :class:`~ifo_grounding.data.FrameCodec`. Where it stores numbers of
    frames, so that transitions share them, put a :class:`Lookup` of the codes before this.

    Args:
        in_keys: entries with codes; by default ``pixels`` and ``("next", "pixels")``.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    >>> codec, codes = FrameCodec.compress(torch.zeros(10, 3, 48, 48, dtype=torch.uint8))
    >>> decoder = FrameDecoder(codec, in_keys=["pixels"])
    >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), transform=decoder)
    >>> indices = buffer.extend(TensorDict({"pixels": codes}, [10]))
    >>> buffer.storage.get(slice(None))["pixels"].shape, buffer.sample(4)["pixels"].shape
    (torch.Size([10, 6, 6]), torch.Size([4, 3, 48, 48]))
    """

    def __init__(self, codec: FrameCodec, in_keys: Sequence[NestedKey] = FRAME_KEYS) -> None:
        super().__init__(codec.words, in_keys)
        self.codec = codec

    def show_codes(self, tiles: Tensor) -> None:
        """Give numbers of these tiles in place of pixels, see :func:`show_codes`."""
        numbers = self.codec.numbers_among(tiles)
        if numbers is not None:
            self.table = numbers.to(self.table.device)

    def _apply_transform(self, codes: Tensor) -> Tensor:
        if self.table is None:
            return codes
        if self.table.ndim == 1:
            return super()._apply_transform(codes)
        return mosaic.assemble(self.table, codes.to(self.table.device))


def show_codes(buffer: Any, tiles: Tensor) -> None:
    """Let a buffer give, in place of pixels, which tile lies where, int16 [*B, h, w].

    Networks read that faster (:func:`ifo_grounding.networks.read_codes`). Where frames are not made
    of these tiles, pixels come as before.

    Args:
        buffer: a replay buffer of this package, such as :func:`labelled_buffer` returns.
        tiles: ``env.tiles`` of an environment that shows codes, uint8 [K, C, T, T].

    >>> from ifo_grounding.data import first_frame_buffer, record_demonstrations, show_codes
    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> buffer = first_frame_buffer(record_demonstrations("move", 4, seed=0))
    >>> show_codes(buffer, PickAndPlaceEnv(codes=True).tiles)
    >>> buffer[:]["pixels"].shape
    torch.Size([4, 6, 6])
    """
    mosaic.check_tiles(tiles)
    for part in buffer.transform.modules():
        if isinstance(part, FrameDecoder):
            part.show_codes(tiles)
