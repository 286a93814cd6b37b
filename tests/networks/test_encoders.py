import pytest
import torch
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks import NetworkConfig, Shapes, make_policy
from ifo_grounding.networks.encoders import ConvEncoder, PatchEncoder
from ifo_grounding.networks.patches import distinct_views, distinct_windows
from ifo_grounding.networks.shapes import grid_of
from networks.conftest import tiled


def test_conv_encoder_is_the_papers():
    encoder = ConvEncoder(3, 32, 4)
    convolutions = [layer for layer in encoder.layers if isinstance(layer, nn.Conv2d)]
    assert [(c.out_channels, c.kernel_size, c.stride, c.padding) for c in convolutions] == [
        (32, (3, 3), (2, 2), (1, 1))
    ] * 4
    for height, width in ((48, 48), (96, 96), (33, 70)):
        features = encoder(torch.zeros(1, 3, height, width))
        config = NetworkConfig.of("policy", "paper")
        assert tuple(features.shape[-2:]) == grid_of(Shapes((3, height, width), 9), config)


def test_images_keep_their_contrast_through_the_convolutions_of_a_new_encoder():
    torch.manual_seed(0)
    images = torch.randn(64, 3, 48, 48)
    powers = [ConvEncoder(3, 32, 4).layers(images).square().mean().item() for _ in range(8)]
    assert 0.3 < sum(powers) / len(powers) < 1.5  # with PyTorch's own initial weights: 0.0005


@pytest.mark.parametrize(
    ("layers", "height", "width", "channels"), [(2, 5, 8, 1), (4, 7, 7, 6), (4, 6, 6, 3)]
)
@pytest.mark.parametrize("zoom", [1, 3])  # enlarged, what the later layers look at repeats too
def test_conv_encoder_computes_windows_that_repeat_once(layers, height, width, channels, zoom):
    torch.manual_seed(0)
    image = tiled(64 // zoom, height, width, channels=channels)
    image = image.repeat_interleave(zoom, -1).repeat_interleave(zoom, -2)
    encoder = ConvEncoder(channels, 16, layers)
    windows = distinct_windows(image)
    assert len(windows.pixels) < windows.where.numel() / 3
    assert zoom == 1 or layers == 2 or distinct_views(image, layers).blocks
    found, expected = encoder(image), encoder.layers(image / 255)
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected)
    weights = torch.randn_like(expected)
    wanted = torch.autograd.grad((expected * weights).sum(), list(encoder.parameters()))
    got = torch.autograd.grad((found * weights).sum(), list(encoder.parameters()))
    for one, other in zip(got, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


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


def test_patch_encoder_is_a_strided_convolution_of_two_images_and_their_difference():
    torch.manual_seed(0)
    encoder = PatchEncoder(3, 16, patch=8)
    both = torch.randint(256, (4, 6, 40, 56), dtype=torch.uint8)
    change = (both[:, :3].int() - both[:, 3:].int()).abs()
    kernel = encoder.embed.weight.reshape(16, 9, 8, 8)
    pixels = torch.cat([both, change], 1) / 255
    convolved = nn.functional.conv2d(pixels, kernel, encoder.embed.bias, stride=8)
    torch.testing.assert_close(encoder(both), convolved)


def test_patches_of_a_ragged_image_are_padded_with_black():
    encoder = PatchEncoder(3, 16, patch=8)
    ragged = torch.randint(256, (1, 6, 9, 15), dtype=torch.uint8)
    padded = torch.zeros(1, 6, 16, 16, dtype=torch.uint8)
    padded[..., :9, :15] = ragged
    torch.testing.assert_close(encoder(ragged), encoder(padded))


@pytest.mark.parametrize(
    ("dtype", "value", "said"),
    [
        *[(t, 0, r"are bytes \(uint8\) or floats") for t in (torch.int64, torch.int16, torch.bool)],
        *[(torch.float32, v, r"within 0\.\.1, got .*: divide") for v in (-1.0, 255.0, torch.nan)],
    ],
)
def test_other_numbers_are_no_images(dtype, value, said):
    policy = make_policy(Shapes((3, 16, 16), vocabulary_size=9), "paper", seed=0)
    pixels = torch.full((2, 3, 16, 16), value, dtype=dtype)
    with pytest.raises(UserError, match=said):
        policy(pixels=pixels, instruction=torch.ones(2, 16).long())


@pytest.mark.parametrize("make", [lambda: ConvEncoder(6, 8, 4), lambda: PatchEncoder(3, 8, 8)])
def test_remembered_images_may_change_in_place_and_begin_anywhere_in_a_buffer(make):
    encoder, images = make(), tiled(64, channels=6)
    before = encoder(images)
    buffer = torch.cat([torch.zeros(3, dtype=torch.uint8), images.flatten()])
    torch.testing.assert_close(encoder(buffer[3:].view_as(images)), before)
    images[3] = images[4]
    changed = encoder(images)
    torch.testing.assert_close(changed[3], before[4])
    torch.testing.assert_close(changed[4:], before[4:])


def test_what_inference_mode_finds_is_not_kept_for_training():
    encoder, images = ConvEncoder(3, 8, 4), tiled(64)
    with torch.inference_mode():
        encoder(images)
    encoder(images).sum().backward()  # tensors of inference mode cannot be saved for this
    assert encoder.convolutions[0].weight.grad.abs().sum() > 0
