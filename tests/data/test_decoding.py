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

from ifo_grounding.data import FrameCodec, FrameDecoder, Lookup
from ifo_grounding.errors import UserError
from ifo_grounding.world import random_layout, render


@pytest.fixture
def frames() -> torch.Tensor:
    return render(random_layout(40, generator=torch.Generator().manual_seed(0)))


def transitions(frames: torch.Tensor) -> TensorDict:
    number = torch.arange(len(frames) - 1)
    return TensorDict(
        {"pixels": frames[:-1], "next": {"pixels": frames[1:]}, "number": number}, [len(number)]
    )


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
def test_pixels_go_in_and_come_out_and_codes_are_stored(frames, storage):
    codec = FrameCodec.fit(frames, tile_size=8)
    buffer = TensorDictReplayBuffer(storage=storage(39), transform=FrameDecoder(codec))
    given = transitions(frames)
    buffer.extend(given)
    assert given["pixels"].shape == (39, 3, 48, 48)
    stored = buffer.storage.get(slice(None))
    assert stored["pixels"].shape == stored["next", "pixels"].shape == (39, 6, 6)
    assert stored["pixels"].dtype == codec.code_dtype
    for sample in (buffer.sample(30), buffer[:], buffer[torch.tensor([5, 3])]):
        assert torch.equal(sample["pixels"], frames[sample["number"]])
        assert torch.equal(sample["next", "pixels"], frames[sample["number"] + 1])
    assert torch.equal(buffer[7]["pixels"], frames[7])
    assert buffer.storage.get(slice(None))["pixels"].shape == (39, 6, 6)


def test_reading_a_full_buffer_leaves_it_as_it_was(frames):
    codec, codes = FrameCodec.compress(frames, tile_size=8)
    for decoder in (FrameDecoder(codec, ["pixels"]), Lookup(frames, ["pixels"])):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(40))
        stored = codes if isinstance(decoder, FrameDecoder) else torch.arange(40)
        buffer.extend(TensorDict({"pixels": stored}, [40]))
        buffer.append_transform(decoder)
        for _ in range(2):
            assert torch.equal(buffer[:]["pixels"].to(torch.uint8), frames)
        assert torch.equal(buffer.storage.get(slice(None))["pixels"], stored)


def test_frames_that_the_codec_does_not_know_are_refused(frames):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(39), transform=FrameDecoder(FrameCodec.fit(frames))
    )
    with pytest.raises(UserError, match="not in the dictionary"):
        buffer.extend(transitions(255 - frames))


def test_entries_can_be_rows_of_shared_frames(frames):
    codec, codes = FrameCodec.compress(frames, tile_size=8)
    shown = ["row", ("next", "row")]
    decoded = ["seen", ("next", "seen")]
    names = torch.arange(80, dtype=torch.int16).view(40, 2)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(39), sampler=SamplerWithoutReplacement(), batch_size=13
    )
    row = torch.arange(39, dtype=torch.int32)
    buffer.extend(TensorDict({"row": row, "next": {"row": row + 1}}, [39]))
    for transform in (
        Lookup(names, ["row"], ["name"]),
        Lookup(codes, shown, decoded),
        FrameDecoder(codec, decoded),
    ):
        buffer.append_transform(transform)
    seen = []
    for sample in buffer:
        assert torch.equal(sample["seen"], frames[sample["row"].long()])
        assert torch.equal(sample["next", "seen"], frames[sample["row"].long() + 1])
        assert sample["name"].dtype == torch.int16
        assert torch.equal(sample["name"][:, 0], sample["row"].long() * 2)
        seen += sample["row"].tolist()
    assert sorted(seen) == list(range(39))


def test_raw_frames_pass_through():
    noise = torch.randint(256, (12, 3, 20, 20), dtype=torch.uint8)
    decoder = FrameDecoder(FrameCodec.fit(noise))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(11), transform=decoder)
    buffer.extend(transitions(noise))
    sample = buffer.sample(20)
    assert torch.equal(sample["pixels"], noise[sample["number"]])


def test_a_dumped_buffer_is_loaded_with_its_dictionary(frames, tmp_path):
    codec = FrameCodec.fit(frames, tile_size=8)

    def make():
        blank = FrameCodec(codec.image_shape, codec.tiles.flip(0))
        return TensorDictReplayBuffer(
            storage=LazyTensorStorage(39), transform=FrameDecoder(blank), batch_size=8
        )

    buffer = make()
    buffer.extend(transitions(frames))
    buffer.dumps(tmp_path)
    loaded = make()
    loaded.loads(tmp_path)
    assert torch.equal(loaded[:]["pixels"], frames[:-1])


def test_missing_entries_are_named(frames):
    decoder = FrameDecoder(FrameCodec.fit(frames), ["pixels"])
    with pytest.raises(KeyError, match="'pixels' not found"):
        decoder(TensorDict({}, []))


def test_it_moves_samples_to_where_it_is(frames):
    codec, codes = FrameCodec.compress(frames, tile_size=8)
    decoder = FrameDecoder(codec, ["pixels"])
    lookups = Lookup(codes, ["pixels"]), Lookup(torch.arange(40).float(), ["name"])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(40), batch_size=4)
    buffer.extend(TensorDict({"pixels": torch.arange(40), "name": torch.arange(40)}, [40]))
    buffer.append_transform(Compose(*lookups, decoder))
    buffer.transform.to("meta")
    sample = buffer.sample()
    assert sample["pixels"].device.type == sample["name"].device.type == "meta"
    assert sample["pixels"].shape == (4, 3, 48, 48)
    assert sample["name"].dtype == torch.float32


def numbered(*numbers: int) -> torch.Tensor:
    """Images of one colour each, which are one tile."""
    column = torch.tensor(numbers, dtype=torch.uint8).view(-1, 1, 1, 1)
    return column.expand(-1, 3, 16, 16).contiguous()


def stores(codec: FrameCodec) -> TensorDictReplayBuffer:
    decoder = FrameDecoder(codec, ["pixels"])
    return TensorDictReplayBuffer(storage=LazyTensorStorage(12), transform=decoder)


def test_a_loaded_buffer_goes_on_and_leaves_the_codec_it_was_made_with():
    first, second = numbered(0, 1, 2), numbered(3, 4, 5)
    saved = stores(FrameCodec.fit([first, second]))
    saved.extend(TensorDict({"pixels": first}, [3]))
    codec = FrameCodec.fit([second, first])  # the same tiles in another order
    loaded = stores(codec)
    loaded.load_state_dict(saved.state_dict())
    loaded.extend(TensorDict({"pixels": second}, [3]))
    assert torch.equal(loaded[:]["pixels"], torch.cat([first, second]))
    assert torch.equal(codec.decode(codec.encode(first)), first)


def test_a_buffer_follows_a_dictionary_that_grows_as_long_as_numbers_fit():
    codec = FrameCodec.fit(numbered(0))
    buffer = stores(codec)
    buffer.extend(TensorDict({"pixels": numbered(0)}, [1]))
    with pytest.raises(UserError, match="not in the dictionary"):
        buffer.extend(TensorDict({"pixels": numbered(1)}, [1]))
    codec.update(numbered(1))
    buffer.extend(TensorDict({"pixels": numbered(1)}, [1]))
    assert torch.equal(buffer[:]["pixels"], numbered(0, 1))
    codec.update(torch.randint(256, (80, 3, 16, 16), dtype=torch.uint8))
    with pytest.raises(UserError, match=r"grown beyond the numbers of type torch\.uint8"):
        buffer.extend(TensorDict({"pixels": numbered(0)}, [1]))


def test_codes_under_another_key_are_stored_alone():
    pixels = numbered(0, 1, 2)
    decoder = FrameDecoder(FrameCodec.fit(pixels), ["codes"], ["pixels"])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(3), transform=decoder)
    buffer.extend(TensorDict({"pixels": pixels}, [3]))
    assert "pixels" not in buffer.storage.get(slice(None))
    assert torch.equal(buffer[:]["pixels"], pixels)
