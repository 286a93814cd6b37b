"""What was found in the last images is found again only where they differ."""

import pytest
import torch

from ifo_grounding.networks import ConvEncoder, PatchEncoder, patches
from ifo_grounding.seeding import Lots
from ifo_grounding.world import random_layout, render


@pytest.fixture
def images():
    return render(random_layout(Lots(0, torch.arange(64))))


@pytest.fixture(params=[lambda: ConvEncoder(3, 8, 4), lambda: PatchEncoder(3, 8, 8)])
def encoder(request):
    torch.manual_seed(0)
    return request.param()


def test_a_second_network_does_not_search_the_same_images_again(encoder, images, monkeypatch):
    searches, search = [], patches.distinct_rows
    monkeypatch.setattr(patches, "distinct_rows", lambda rows: searches.append(1) or search(rows))
    found = encoder(images)
    assert searches
    searches.clear()
    again = encoder(images.clone())
    assert not searches
    encoder(images[1:])  # forgets them
    searches.clear()
    torch.testing.assert_close(again, encoder(images))
    torch.testing.assert_close(again, found)
    assert searches


def test_images_may_change_in_place_and_begin_anywhere_in_a_buffer(encoder, images):
    before = encoder(images)
    buffer = torch.cat([torch.zeros(3, dtype=torch.uint8), images.flatten()])
    torch.testing.assert_close(encoder(buffer[3:].view_as(images)), before)
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
