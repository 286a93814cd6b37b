"""The frame codec gives back every pixel, whatever the frames."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ifo_grounding.data import FrameCodec
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import Lots
from ifo_grounding.world import random_layout, render
from ifo_grounding.world.tiles import tile_index, tile_table


@st.composite
def any_frames(draw) -> torch.Tensor:
    """Frames of any small shape; of few colours in 8-pixel blocks, or noise."""
    frames, channels = draw(st.integers(0, 6)), draw(st.integers(1, 4))
    side = st.sampled_from([1, 5, 8, 16, 24, 32, 33, 48])
    height, width = draw(side), draw(side)
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    shape = (frames, channels, height, width)
    if draw(st.booleans()):
        return torch.randint(256, shape, dtype=torch.uint8, generator=generator)
    blocks = torch.randint(3, (frames, channels, -(-height // 8), -(-width // 8)))
    pixels = blocks.repeat_interleave(8, 2).repeat_interleave(8, 3)
    return (pixels[..., :height, :width] * 127).to(torch.uint8)


@settings(max_examples=60, deadline=None)
@given(any_frames(), st.none() | st.integers(1, 4))
def test_any_frames_come_back_given_whole_or_in_pieces(frames, size):
    codec, codes = FrameCodec.compress(frames if size is None else iter(frames.split(size)))
    assert codes.shape == (len(frames), *codec.code_shape)
    decoded = codec.decode(codes)
    assert decoded.dtype == torch.uint8
    assert torch.equal(decoded, frames)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
def test_frames_of_the_world_shrink_a_hundredfold(tile_size):
    frames = render(random_layout(Lots(0, torch.arange(300))), tile_size)
    codec, codes = FrameCodec.compress(frames)
    assert codec.tile_size is not None
    assert torch.equal(codec.decode(codes), frames)
    assert codes.nbytes * 100 < frames.nbytes


def test_codes_of_a_renderer_say_nothing_that_pixels_do_not():
    state = random_layout(Lots(0, torch.arange(300)))
    index, frames = tile_index(state), render(state)
    codecs = [
        FrameCodec.from_tiles(
            tile_table(8), list(index.split(100)), torch.Generator().manual_seed(s)
        )
        for s in (0, 0, 1)
    ]
    for codec, codes in codecs:
        assert torch.equal(codec.decode(codes), frames)
        assert len(codec.tiles) == len(index.unique()) < len(tile_table(8))
        assert codes.flatten().unique().tolist() == list(range(len(codec.tiles)))
    assert torch.equal(codecs[0][1], codecs[1][1])
    assert not torch.equal(codecs[0][1], codecs[2][1])
    pairs = torch.stack([codecs[0][1].flatten().long(), index.flatten()]).unique(dim=1)
    assert pairs.shape[1] == len(codecs[0][0].tiles)
    assert abs(pairs.double().corrcoef()[0, 1]) < 0.3


def test_misfits_are_refused():
    frames = torch.zeros(2, 3, 24, 16, dtype=torch.uint8)
    for wrong, said in ((frames.float(), "got torch.float32"), ([], "no frames"), ([[1]], "list")):
        with pytest.raises(UserError, match=said):
            FrameCodec.compress(wrong)
    with pytest.raises(UserError, match=r"tile size 16 does not divide .* 24 x 16 .* \[8\]"):
        FrameCodec.compress(frames, tile_size=16)
    with pytest.raises(UserError, match=r"frames are \[3, 16, 24\], the first .* \[3, 24, 16\]"):
        FrameCodec.compress([frames, frames.transpose(2, 3)])
    with pytest.raises(UserError, match="do not cover images"):
        FrameCodec((3, 24, 16), torch.zeros(1, 3, 16, 16, dtype=torch.uint8))
    with pytest.raises(UserError, match="give each tile once"):
        FrameCodec((3, 24, 16), torch.zeros(2, 3, 8, 8, dtype=torch.uint8))


def test_frames_may_begin_anywhere_in_a_buffer():
    frames = torch.arange(4 * 3 * 16 * 16).view(4, 3, 16, 16).to(torch.uint8)
    buffer = torch.cat([torch.zeros(3, dtype=torch.uint8), frames.flatten()])
    shifted = FrameCodec.compress(buffer[3:].view_as(frames), 8)[1]
    assert torch.equal(shifted, FrameCodec.compress(frames, 8)[1])
