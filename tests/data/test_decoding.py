"""Replay buffers that store codes and sample pixels."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose

from ifo_grounding.data import FrameCodec, FrameDecoder
from ifo_grounding.data.decoding import Lookup
from ifo_grounding.mosaic import as_words, assemble
from ifo_grounding.seeding import Lots
from ifo_grounding.world import random_layout, render, tile_table

FRAMES = render(random_layout(Lots(0, torch.arange(40))))
CODEC, CODES = FrameCodec.compress(FRAMES, tile_size=8)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
def test_codes_are_stored_and_pixels_come_out(storage):
    buffer = TensorDictReplayBuffer(storage=storage(39), transform=FrameDecoder(CODEC))
    stored = {"pixels": CODES[:-1], "next": {"pixels": CODES[1:]}, "number": torch.arange(39)}
    buffer.extend(TensorDict(stored, [39]))
    for _ in range(2):  # reading all of a full buffer leaves it as it was
        for sample in (buffer.sample(30), buffer[:], buffer[torch.tensor([5, 3])]):
            assert torch.equal(sample["pixels"], FRAMES[sample["number"]])
            assert torch.equal(sample["next", "pixels"], FRAMES[sample["number"] + 1])
    assert torch.equal(buffer.storage.get(slice(None))["pixels"], CODES[:-1])


def test_codes_of_a_simulator_come_out_where_it_has_all_tiles():
    known = tile_table().roll(5, 0)
    decoder = FrameDecoder(CODEC, ["pixels"])
    decoder.show_codes(known[6:])  # which lack the floor
    stored = TensorDict({"pixels": CODES}, [40])
    assert torch.equal(decoder(stored)["pixels"], FRAMES)
    decoder.show_codes(tile_table(16))  # of another size
    assert torch.equal(decoder(stored)["pixels"], FRAMES)
    decoder.show_codes(known)
    codes = decoder(stored)["pixels"]
    assert codes.dtype == torch.int16 and codes.shape == (40, 6, 6)
    assert torch.equal(assemble(as_words(known), codes), FRAMES)
    raw = FrameDecoder(FrameCodec((3, 48, 48)), ["pixels"])
    raw.show_codes(known)
    pixels = TensorDict({"pixels": FRAMES}, [40])
    assert torch.equal(raw(pixels)["pixels"], FRAMES)


def test_entries_can_be_rows_of_shared_frames():
    shown = ["seen", ("next", "seen")]
    names = torch.arange(80, dtype=torch.int16).view(40, 2)
    lookups = Lookup(names, ["name"]), Lookup(CODES, shown)
    row = torch.arange(39, dtype=torch.int32)
    entries = TensorDict({"name": row, "seen": row, "next": {"seen": row + 1}}, [39])
    sample = Compose(*lookups, FrameDecoder(CODEC, shown))(entries)
    assert torch.equal(sample["seen"], FRAMES[:-1])
    assert torch.equal(sample["next", "seen"], FRAMES[1:])
    assert torch.equal(sample["name"], names[:-1])
