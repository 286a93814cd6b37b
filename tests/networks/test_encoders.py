import pytest
import torch
from torch import nn
from torch.nn.utils.rnn import pack_padded_sequence

from ifo_grounding.errors import UserError
from ifo_grounding.networks import (
    ConvEncoder,
    ConvInstructionEncoder,
    GRUInstructionEncoder,
    PatchEncoder,
    encoders,
)
from ifo_grounding.networks.encoders import beginnings
from ifo_grounding.networks.patches import distinct_blocks, distinct_windows
from ifo_grounding.tasks import TASKS, VOCABULARY, grammar


def sentences(rows: int, length: int = 16, vocabulary: int = 40, seed: int = 0) -> torch.Tensor:
    source = torch.Generator().manual_seed(seed)
    tokens = torch.randint(1, vocabulary, (rows, length), generator=source)
    lengths = torch.randint(1, length + 1, (rows, 1), generator=source)
    return tokens * (torch.arange(length) < lengths)


@pytest.fixture(params=[GRUInstructionEncoder, ConvInstructionEncoder])
def encoder(request):
    torch.manual_seed(0)
    return request.param(40, embedding=8, hidden=16)


def reference_gru(encoder: GRUInstructionEncoder) -> nn.GRU:
    gru = nn.GRU(8, 16, batch_first=True, bidirectional=True)
    with torch.no_grad():
        for way, suffix in enumerate(("l0", "l0_reverse")):
            getattr(gru, f"weight_ih_{suffix}").copy_(encoder.input_weight[way].T)
            getattr(gru, f"weight_hh_{suffix}").copy_(encoder.state_weight[way].T)
            getattr(gru, f"bias_ih_{suffix}").copy_(encoder.input_bias[way, 0])
            getattr(gru, f"bias_hh_{suffix}").copy_(encoder.state_bias[way, 0])
    return gru


def test_the_papers_encoder_is_the_bidirectional_gru_of_pytorch_over_packed_sentences():
    torch.manual_seed(0)
    encoder = GRUInstructionEncoder(40, embedding=8, hidden=16)
    tokens = sentences(50)
    packed = pack_padded_sequence(
        encoder.embedding(tokens), (tokens != 0).sum(1), batch_first=True, enforce_sorted=False
    )
    _, state = reference_gru(encoder)(packed)
    torch.testing.assert_close(encoder(tokens), torch.cat([state[0], state[1]], -1))


def test_padding_changes_nothing(encoder):
    tokens = torch.tensor([[3, 7, 2]])
    longer = torch.tensor([[3, 7, 2, 0, 0, 0]])
    torch.testing.assert_close(encoder(tokens), encoder(longer))
    mixed = encoder(torch.cat([longer, torch.zeros(2, 6, dtype=torch.int64)]))
    assert torch.equal(mixed[1], mixed[2])
    if isinstance(encoder, GRUInstructionEncoder):
        assert torch.equal(mixed[1:], torch.zeros(2, 32))
    torch.testing.assert_close(mixed[:1], encoder(tokens))


def test_word_order_matters(encoder):
    first, second = encoder(torch.tensor([[3, 7, 2], [2, 7, 3]]))
    assert not torch.allclose(first, second)


def test_no_rows_give_no_features(encoder):
    assert encoder(torch.zeros(0, 16, dtype=torch.int64)).shape == (0, 32)


@pytest.mark.parametrize("bad", [-1, 40])
def test_ids_outside_the_vocabulary_are_refused(encoder, bad):
    with pytest.raises(UserError, match=r"knows 0 to 39"):
        encoder(torch.tensor([[1, bad, 2]]))


def test_each_distinct_instruction_is_encoded_once(encoder, monkeypatch):
    rows = []
    encode = type(encoder)._encode_distinct
    monkeypatch.setattr(
        type(encoder),
        "_encode_distinct",
        lambda self, tokens: rows.append(len(tokens)) or encode(self, tokens),
    )
    pool = sentences(12)
    tokens = pool[torch.randint(12, (200,))]
    features = encoder(tokens)
    assert rows == [len(torch.unique(tokens, dim=0))]
    torch.testing.assert_close(features, encode(encoder, tokens))


def test_gradients_are_those_of_encoding_every_row_and_repeat_exactly(encoder):
    tokens = sentences(12)[torch.randint(12, (200,))]
    target = torch.randn(200, 32)

    def gradients(encode):
        encoder.zero_grad()
        (encode(tokens) * target).sum().backward()
        return [parameter.grad.clone() for parameter in encoder.parameters()]

    once = gradients(encoder)
    for grad, every in zip(once, gradients(encoder._encode), strict=True):
        torch.testing.assert_close(grad, every, rtol=1e-4, atol=1e-5)
    assert all(map(torch.equal, once, gradients(encoder)))


@pytest.mark.parametrize("task", TASKS)
def test_sentences_that_begin_or_end_alike_are_read_once_with_the_same_result(task, monkeypatch):
    monkeypatch.setattr(encoders, "ENOUGH_TO_SHARE", 0)
    torch.manual_seed(0)
    encoder = GRUInstructionEncoder(len(VOCABULARY), embedding=8, hidden=16, rate=0.1).double()
    known = grammar(task).tokens
    tokens = torch.cat([known[torch.randint(len(known), (300,))], known[:1] * 0])
    target = torch.randn(len(tokens), 32, dtype=torch.float64)

    def encoded(encode):
        encoder.zero_grad()
        features = encode(tokens)
        (features * target).sum().backward()
        return [features.detach(), *(parameter.grad.clone() for parameter in encoder.parameters())]

    once = encoded(encoder)
    for part, every in zip(once, encoded(encoder._encode), strict=True):
        torch.testing.assert_close(part, every)
    assert all(map(torch.equal, once, encoded(encoder)))


def test_ids_of_padding_between_words_are_words_of_their_own(monkeypatch):
    monkeypatch.setattr(encoders, "ENOUGH_TO_SHARE", 0)
    torch.manual_seed(0)
    encoder = GRUInstructionEncoder(40, embedding=8, hidden=16)
    rows = torch.cartesian_prod(*[torch.arange(3)] * 5)  # any of five may be padding
    torch.testing.assert_close(encoder._encode_distinct(rows), encoder._encode(rows))


def test_beginnings_are_fewer_than_words():
    tokens = grammar("pick-out").tokens
    lengths = (tokens != 0).sum(1)
    steps, ends = beginnings(tokens, lengths)
    assert len(ends.unique()) == len(tokens)
    for length, (words, _) in enumerate(steps, start=1):
        longer = tokens[lengths >= length, :length]
        assert len(words) == len(longer.unique(dim=0))
    assert sum(len(words) for words, _ in steps) < int(lengths.sum()) / 4


def test_encoder_works_under_vmap(encoder):
    tokens = sentences(8).reshape(2, 4, 16)
    torch.testing.assert_close(
        torch.vmap(encoder)(tokens), encoder(tokens.flatten(0, 1)).reshape(2, 4, 32)
    )


def test_conv_encoder_is_the_papers():
    encoder = ConvEncoder(3, 32, 4)
    convolutions = [layer for layer in encoder.layers if isinstance(layer, nn.Conv2d)]
    assert [(c.out_channels, c.kernel_size, c.stride, c.padding) for c in convolutions] == [
        (32, (3, 3), (2, 2), (1, 1))
    ] * 4
    for height, width in ((48, 48), (96, 96), (33, 70)):
        features = encoder(torch.zeros(1, 3, height, width))
        assert tuple(features.shape[-2:]) == ConvEncoder.grid(height, width, 4)


def tiled(rows, height=6, width=6, kinds=9, channels=3):
    """Images of tiles of noise, some alike in what a neighbour sees of them."""
    draw = torch.Generator().manual_seed(0)
    tiles = torch.randint(256, (kinds, channels, 8, 8), generator=draw, dtype=torch.uint8)
    tiles[1::2, :, :, 5:] = tiles[0, :, :, 5:]
    tiles[2::3, :, 5:] = tiles[0, :, 5:]
    which = torch.randint(kinds, (rows, height, width), generator=draw)
    which[torch.rand(which.shape, generator=draw) < 0.6] = 0
    cells = tiles[which].permute(0, 3, 1, 4, 2, 5)
    return cells.reshape(rows, channels, 8 * height, 8 * width)


def test_images_keep_their_contrast_through_the_convolutions_of_a_new_encoder():
    torch.manual_seed(0)
    images = torch.randn(64, 3, 48, 48)
    powers = [ConvEncoder(3, 32, 4)(images).square().mean().item() for _ in range(8)]
    assert 0.3 < sum(powers) / len(powers) < 1.5  # with PyTorch's own initial weights: 0.0005


@pytest.mark.parametrize("layers", [2, 3, 4])
@pytest.mark.parametrize(("height", "width", "channels"), [(6, 6, 3), (5, 8, 1), (7, 7, 6)])
@pytest.mark.parametrize("zoom", [1, 3])  # enlarged, what the later layers look at repeats too
def test_conv_encoder_computes_windows_that_repeat_once(layers, height, width, channels, zoom):
    torch.manual_seed(0)
    image = tiled(64 // zoom, height, width, channels=channels)
    image = image.repeat_interleave(zoom, -1).repeat_interleave(zoom, -2)
    encoder = ConvEncoder(channels, 16, layers)
    windows = distinct_windows(image)
    assert len(windows.pixels) < windows.where.numel() / 3
    assert zoom == 1 or distinct_blocks(windows.where)
    found, expected = encoder(image), encoder.layers(image / 255)
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected)
    weights = torch.randn_like(expected)
    wanted = torch.autograd.grad((expected * weights).sum(), list(encoder.parameters()))
    got = torch.autograd.grad((found * weights).sum(), list(encoder.parameters()))
    for one, other in zip(got, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_blocks_are_those_of_the_map():
    where = torch.randint(2, (64, 6, 5))
    where[:, :3] = 0
    blocks, which = distinct_blocks(where)
    cut = nn.functional.pad(where + 1, (1, 1, 1, 1)).unfold(1, 3, 2).unfold(2, 3, 2)
    assert torch.equal(blocks[which], cut.flatten(3))
    assert len(blocks.unique(dim=0)) == len(blocks)
    assert distinct_blocks(torch.arange(360).view(2, 12, 15)) is None


def test_windows_are_those_of_the_image():
    image = tiled(32)
    windows = distinct_windows(image)
    padded = nn.functional.pad(image, (3, 0, 3, 0))
    cut = padded.unfold(2, 7, 4).unfold(3, 7, 4).permute(0, 2, 3, 1, 4, 5)
    assert torch.equal(windows.pixels[windows.where], cut)
    row, column = torch.arange(12)[:, None] == 0, torch.arange(12) == 0
    assert torch.equal(windows.top[windows.where], row.expand(32, 12, 12))
    assert torch.equal(windows.side[windows.where], column.expand(32, 12, 12))


@pytest.mark.parametrize(
    "image",
    [
        torch.randint(256, (40, 3, 48, 48), dtype=torch.uint8),  # nothing repeats
        tiled(40, kinds=100)[:, :, 3:-5, 3:-5],  # tiles across the patches
        tiled(8),  # few
        tiled(64)[..., :44],
        tiled(64) / 255,
        tiled(0),
    ],
)
def test_images_that_do_not_repeat_take_the_plain_way(image):
    assert distinct_windows(image) is None
    assert ConvEncoder(3, 8, 4)(image).shape == (len(image), 8, 3, 3)


def test_patch_encoder_is_a_strided_convolution():
    torch.manual_seed(0)
    encoder = PatchEncoder(3, 16, patch=8)
    pixels = torch.randint(256, (4, 3, 40, 56), dtype=torch.uint8)
    kernel = encoder.embed.weight.reshape(16, 3, 8, 8)
    convolved = nn.functional.conv2d(pixels / 255, kernel, encoder.embed.bias, stride=8)
    torch.testing.assert_close(encoder(pixels), convolved)


def test_patches_of_a_ragged_image_are_padded_with_black():
    encoder = PatchEncoder(3, 16, patch=8)
    ragged = torch.randint(256, (1, 3, 9, 15), dtype=torch.uint8)
    padded = torch.zeros(1, 3, 16, 16, dtype=torch.uint8)
    padded[..., :9, :15] = ragged
    torch.testing.assert_close(encoder(ragged), encoder(padded))


def test_one_patch_sees_one_cell():
    encoder = PatchEncoder(3, 16, patch=8)
    pixels = torch.zeros(1, 3, 48, 48, dtype=torch.uint8)
    changed = pixels.clone()
    changed[..., 8:16, 24:32] = 255
    different = (encoder(pixels) != encoder(changed)).any(1)[0]
    assert different.nonzero().tolist() == [[1, 3]]
