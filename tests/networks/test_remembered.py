"""What was found in the last images is found again only where they differ."""

import pytest
import torch

from ifo_grounding.networks import ConvEncoder, PatchEncoder, patches
from ifo_grounding.world import random_layout, render


@pytest.fixture
def images():
    return render(random_layout(64, generator=torch.Generator().manual_seed(0)))


@pytest.fixture
def searches(monkeypatch):
    """Count how often rows are compared with one another."""
    found = []
    search = patches.distinct_rows
    monkeypatch.setattr(patches, "distinct_rows", lambda rows: found.append(rows) or search(rows))
    return found


def encoder_of(kind):
    torch.manual_seed(0)
    if kind is ConvEncoder:
        return ConvEncoder(3, 8, 4)
    return PatchEncoder(3, 8, 8)


@pytest.mark.parametrize("kind", [ConvEncoder, PatchEncoder])
def test_a_second_network_does_not_search_the_same_images_again(kind, images, searches):
    first, second = encoder_of(kind), encoder_of(kind)
    first(images)
    assert searches
    searches.clear()
    again = second(images.clone())
    assert not searches
    second(images[1:])  # forgets them
    searches.clear()
    torch.testing.assert_close(again, second(images))
    assert searches


@pytest.mark.parametrize("kind", [ConvEncoder, PatchEncoder])
def test_images_that_change_in_place_are_searched_again(kind, images):
    encoder = encoder_of(kind)
    before = encoder(images)
    images[3] = images[4]
    changed = encoder(images)
    torch.testing.assert_close(changed[3], before[4])
    torch.testing.assert_close(changed[4:], before[4:])


def test_what_inference_mode_finds_is_not_kept_for_training(images):
    encoder = ConvEncoder(3, 8, 4)
    with torch.inference_mode():
        encoder(images)
    encoder(images).sum().backward()  # tensors of inference mode cannot be saved for this
    assert encoder.convolutions[0].weight.grad.abs().sum() > 0


@pytest.mark.parametrize("kind", [ConvEncoder, PatchEncoder])
def test_images_may_begin_anywhere_in_a_buffer(kind, images):
    encoder = encoder_of(kind)
    buffer = torch.cat([torch.zeros(3, dtype=torch.uint8), images.flatten()])
    torch.testing.assert_close(encoder(buffer[3:].view_as(images)), encoder(images))
