"""Replay buffer transforms that turn what is stored into what is sampled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from ifo_grounding import keys, mosaic
from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.errors import UserError

FRAME_KEYS: tuple[NestedKey, ...] = (keys.PIXELS, (keys.NEXT, keys.PIXELS))


class FrameDecoder(Transform):
    """Decodes frames when a replay buffer is sampled, and encodes them when it is extended.

    The buffer stores codes of a :class:`~ifo_grounding.data.FrameCodec`. Where it stores numbers of
    frames, so that transitions share them, put a :class:`Lookup` of the codes before this.
    ``buffer.transform.to(device)`` makes it decode there.

    Args:
        codec: decodes codes, and encodes the pixels of new entries.
        in_keys: entries with codes; by default ``pixels`` and ``("next", "pixels")``.
        out_keys: where the pixels go; by default the same entries.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    >>> pixels = torch.zeros(10, 3, 48, 48, dtype=torch.uint8)
    >>> decoder = FrameDecoder(FrameCodec.fit(pixels), in_keys=["pixels"])
    >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), transform=decoder)
    >>> indices = buffer.extend(TensorDict({"pixels": pixels}, [10]))
    >>> buffer.storage.get(slice(None))["pixels"].shape, buffer.sample(4)["pixels"].shape
    (torch.Size([10, 6, 6]), torch.Size([4, 3, 48, 48]))
    """

    words: Tensor | None

    def __init__(
        self,
        codec: FrameCodec,
        in_keys: Sequence[NestedKey] = FRAME_KEYS,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        out_keys = list(in_keys if out_keys is None else out_keys)
        super().__init__(
            in_keys=list(in_keys),
            out_keys=out_keys,
            in_keys_inv=list(in_keys),
            out_keys_inv=list(out_keys),
        )
        self.codec, self._code_dtype = codec, codec.code_dtype
        self.register_buffer("words", codec.words)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Decode the entries of a sample."""
        words = self.codec.words
        if self.words is not None and words is not None and len(words) > len(self.words):
            self.words = words.to(self.words.device)  # the dictionary grew
        return super().forward(_follow(tensordict, self.words))

    def _apply_transform(self, codes: Tensor) -> Tensor:
        if self.words is None:
            return codes
        return mosaic.assemble(self.words, codes.to(self.words.device))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        encoded = super()._inv_call(tensordict)
        pixels = set(self.out_keys_inv) - set(self.in_keys_inv)
        return encoded.exclude(*pixels) if pixels else encoded

    def _inv_apply_transform(self, pixels: Tensor) -> Tensor:
        codes = self.codec.encode(pixels.cpu())
        if codes.dtype != self._code_dtype:
            raise UserError(
                f"{self.codec} has grown beyond the numbers of type {self._code_dtype} that this "
                "buffer stores: make a new buffer for it"
            )
        return codes

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Load a dictionary as a new one, for that of the codec may be in use elsewhere."""
        words = state_dict.get(f"{prefix}words")
        if self.words is not None and words is not None:
            tiles = words.cpu().clone().view(torch.uint8)
            self.codec = FrameCodec(self.codec.image_shape, tiles)
            self._code_dtype = self.codec.code_dtype
            self.words = torch.empty_like(words, device=self.words.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class Lookup(Transform):
    """Replaces row numbers by rows of a table when a replay buffer is sampled.

    Args:
        table: [N, *S].
        in_keys: entries with row numbers, integer [*B].
        out_keys: where the rows go, [*B, *S]; by default the same entries.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> lookup = Lookup(torch.tensor([[5, 6], [7, 8]]), in_keys=["instruction"])
    >>> lookup(TensorDict({"instruction": torch.tensor([1, 1, 0])}, [3]))["instruction"].tolist()
    [[7, 8], [7, 8], [5, 6]]
    """

    table: Tensor

    def __init__(
        self,
        table: Tensor,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(
            in_keys=list(in_keys), out_keys=list(in_keys if out_keys is None else out_keys)
        )
        self.register_buffer("table", table, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look up the entries of a sample."""
        return super().forward(_follow(tensordict, self.table))

    def _apply_transform(self, number: Tensor) -> Tensor:
        return self.table[number.to(self.table.device).long()]


def _follow(tensordict: TensorDictBase, table: Tensor | None) -> TensorDictBase:
    """Copy a sample, without its tensors, to where the table is.

    A full buffer hands out its own storage when all of it is asked for: writing there would spoil
    it.
    """
    if table is None or tensordict.device in (None, table.device):
        return tensordict.clone(recurse=False)
    return tensordict.to(table.device)
