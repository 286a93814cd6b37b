"""Replay buffers that store codes and sample pixels."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import Compose

from ifo_grounding.data import FrameCodec, FrameDecoder
from ifo_grounding.data.decoding import Lookup
from ifo_grounding.world import random_layout, render


@pytest.fixture
def frames() -> torch.Tensor:
    return render(random_layout(40, generator=torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
def test_codes_are_stored_and_pixels_come_out(frames, storage):
    codec, codes = FrameCodec.compress(frames, tile_size=8)
    buffer = TensorDictReplayBuffer(storage=storage(39), transform=FrameDecoder(codec))
    number = torch.arange(39)
    stored = {"pixels": codes[:-1], "next": {"pixels": codes[1:]}, "number": number}
    buffer.extend(TensorDict(stored, [39]))
    for _ in range(2):  # reading all of a full buffer leaves it as it was
        for sample in (buffer.sample(30), buffer[:], buffer[torch.tensor([5, 3])]):
            assert torch.equal(sample["pixels"], frames[sample["number"]])
            assert torch.equal(sample["next", "pixels"], frames[sample["number"] + 1])
    assert torch.equal(buffer.storage.get(slice(None))["pixels"], codes[:-1])


def test_entries_can_be_rows_of_shared_frames(frames):
    codec, codes = FrameCodec.compress(frames, tile_size=8)
    rows, shown = ["row", ("next", "row")], ["seen", ("next", "seen")]
    names = torch.arange(80, dtype=torch.int16).view(40, 2)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(39),
        transform=Compose(
            Lookup(names, ["row"], ["name"]), Lookup(codes, rows, shown), FrameDecoder(codec, shown)
        ),
        sampler=SamplerWithoutReplacement(),
        batch_size=13,
    )
    row = torch.arange(39, dtype=torch.int32)
    buffer.extend(TensorDict({"row": row, "next": {"row": row + 1}}, [39]))
    seen = []
    for sample in buffer:
        assert torch.equal(sample["seen"], frames[sample["row"].long()])
        assert torch.equal(sample["next", "seen"], frames[sample["row"].long() + 1])
        assert torch.equal(sample["name"], names[sample["row"].long()])
        seen += sample["row"].tolist()
    assert sorted(seen) == list(range(39))


def test_samples_follow_the_tables_to_their_device(frames):
    codec, codes = FrameCodec.compress(frames, tile_size=8)
    lookups = Lookup(codes, ["pixels"]), Lookup(torch.arange(40).float(), ["name"])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40),
        transform=Compose(*lookups, FrameDecoder(codec, ["pixels"])),
        batch_size=4,
    )
    buffer.extend(TensorDict({"pixels": torch.arange(40), "name": torch.arange(40)}, [40]))
    buffer.transform.to("meta")
    sample = buffer.sample()
    assert sample["pixels"].device.type == sample["name"].device.type == "meta"
    assert sample["pixels"].shape == (4, 3, 48, 48)
    assert sample["name"].dtype == torch.float32
