"""What is computed once for cells that look alike is what a plain pass over all cells computes."""

import pytest
import torch
from torch import Tensor

from ifo_grounding.data import record_demonstrations
from ifo_grounding.networks import (
    PatchEncoder,
    Shapes,
    make_goal_judge,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_value,
)
from ifo_grounding.networks import cells as cells_module
from ifo_grounding.networks.cells import Cells, Kinds, group_cells, pair_up


def plainly(monkeypatch) -> None:
    monkeypatch.setattr(PatchEncoder, "cells", lambda self, image, complete=None: None)


@pytest.fixture(scope="module")
def scenes():
    """First frames [24] of demonstrations, which repeat their tiles, and their instructions."""
    demos = record_demonstrations("pick-out", 24, seed=0)
    first = torch.stack([demos[i]["pixels"][0] for i in range(24)])
    return first, demos.tokens, Shapes.of(demos)


def outputs_and_gradients(network, *inputs) -> tuple[Tensor, dict[str, Tensor]]:
    network.zero_grad()
    output = network(*inputs)
    (output * torch.linspace(-1, 1, output.numel()).view_as(output)).sum().backward()
    return output.detach(), {n: p.grad.clone() for n, p in network.named_parameters()}


@pytest.mark.parametrize("make", [make_policy, make_value, make_instruction_classifier])
def test_outputs_and_gradients_are_those_of_a_plain_pass(make, scenes, monkeypatch):
    pixels, tokens, shapes = scenes
    module = make(shapes, "film", seed=0)
    network = module.module[0].module if make is make_policy else module.module
    assert network_looks_up_cells(network, pixels)
    quick, gradients = outputs_and_gradients(network, pixels, tokens)
    plainly(monkeypatch)
    plain, expected = outputs_and_gradients(network, pixels, tokens)
    torch.testing.assert_close(quick, plain)
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected[name], atol=1e-5, rtol=1e-4)


def network_looks_up_cells(network, pixels) -> bool:
    encoder = next(part for part in network.modules() if isinstance(part, PatchEncoder))
    return isinstance(encoder.cells(pixels), Cells)


def test_the_inverse_module_looks_up_what_changed(scenes, monkeypatch):
    pixels, _, shapes = scenes
    after = pixels.clone()
    after[::2] = pixels[1::2]  # every other pair of frames differs, the rest show a stop
    network = make_inverse(shapes, seed=0).module
    looked_up = []
    maps = Cells.maps
    monkeypatch.setattr(Cells, "maps", lambda *args: looked_up.append(1) or maps(*args))
    quick, gradients = outputs_and_gradients(network, pixels, after)
    assert looked_up
    plainly(monkeypatch)
    plain, expected = outputs_and_gradients(network, pixels, after)
    torch.testing.assert_close(quick, plain)
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected[name], atol=1e-5, rtol=1e-4)


def test_two_images_at_once(scenes, monkeypatch):
    pixels, tokens, shapes = scenes
    judge = make_goal_judge(shapes, "film", seed=0).module
    quick, _ = outputs_and_gradients(judge, pixels, pixels.flip(0), tokens)
    plainly(monkeypatch)
    plain, _ = outputs_and_gradients(judge, pixels, pixels.flip(0), tokens)
    torch.testing.assert_close(quick, plain)


@pytest.mark.parametrize("make", [make_instruction_classifier, make_goal_judge])
def test_scenes_are_read_by_kinds_of_cells_as_cell_by_cell(make, scenes):
    pixels, tokens, shapes = scenes
    network = make(shapes, "strong", seed=0).module
    images = (pixels, pixels.flip(0))[: network.images]
    index = torch.randint(len(tokens), (len(pixels), 5), generator=torch.Generator().manual_seed(0))

    def scored(*images):
        words = network.encode_instruction(tokens)
        return network.score_candidates(network.encode_scenes(*images), words, index)

    def cell_by_cell(*images):
        words = network.encode_instruction(tokens)
        return network.score_candidates(network.encode_pixels(*images), words, index)

    assert isinstance(network.encode_scenes(*images), Kinds)
    network.forward = scored
    quick, gradients = outputs_and_gradients(network, *images)
    network.forward = cell_by_cell
    plain, expected = outputs_and_gradients(network, *images)
    torch.testing.assert_close(quick, plain)
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected[name], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("room", [1 << 22, 0])
def test_candidates_are_scored_like_pairs(scenes, monkeypatch, room):
    monkeypatch.setattr(cells_module, "ROOM", room)
    pixels, tokens, shapes = scenes
    classifier = make_instruction_classifier(shapes, "film", seed=0).module
    index = torch.randint(len(tokens), (len(pixels), 5), generator=torch.Generator().manual_seed(0))
    words = classifier.encode_instruction(tokens)
    found = classifier.encode_scenes(pixels)
    quick = classifier.score_candidates(found, words, index)
    rows = torch.tensor([3, 1])
    torch.testing.assert_close(
        classifier.score_candidates(found[rows], words, index[rows]), quick[rows]
    )
    expected = classifier.score_all(classifier.encode_pixels(pixels), words).gather(1, index)
    torch.testing.assert_close(quick, expected)
    plainly(monkeypatch)
    dense = classifier.encode_scenes(pixels)
    assert isinstance(dense, Tensor)
    torch.testing.assert_close(classifier.score_candidates(dense, words, index), expected)


def test_groups_say_what_lies_where():
    source = torch.Generator().manual_seed(0)
    index, place = torch.randint(5, (7, 12), generator=source), torch.rand(12, 2, generator=source)
    groups = group_cells(index, place)
    assert groups.number.sum(1).tolist() == [12] * 7
    for row in range(7):
        kinds = index[row].unique().tolist()
        there = groups.number[row] > 0
        assert sorted(groups.cell[row][there].tolist()) == kinds
        for kind, number, mean in zip(*(part[row] for part in vars(groups).values()), strict=True):
            if number:
                assert number == (index[row] == kind).sum()
                torch.testing.assert_close(mean, place[index[row] == kind].mean(0))
    twice = groups.repeated(2)
    assert torch.equal(twice[::2].cell, groups.cell) and torch.equal(twice[1::2].mean, groups.mean)
    assert len(group_cells(index[:0], place).cell) == 0


@pytest.mark.parametrize("size", [(48, 48), (44, 50)])
def test_cells_hold_what_the_feature_map_holds(size):
    encoder = PatchEncoder(3, features=16, patch=8)
    image = torch.zeros(4, 3, *size, dtype=torch.uint8)
    image[:, :, 8:19, 10:30] = torch.arange(4, dtype=torch.uint8).view(4, 1, 1, 1) * 50
    cells = encoder.cells(image)
    assert cells is not None and len(cells.features) < cells.index.numel() // 2
    features = cells.features[cells.index].view(4, 6, -1, 16).permute(0, 3, 1, 2)
    torch.testing.assert_close(features, encoder(image))


def test_where_looking_up_would_not_pay():
    encoder = PatchEncoder(3, features=16, patch=8)
    noise = torch.randint(256, (4, 3, 48, 48), dtype=torch.uint8)
    assert encoder.cells(noise) is None  # no two patches are alike
    assert encoder.cells(torch.zeros(4, 3, 48, 48)) is None  # floats
    assert PatchEncoder(3, features=16, patch=6).cells(torch.zeros_like(noise)) is None
    torch.vmap(lambda image: encoder(image) if encoder.cells(image) is None else None)(
        torch.zeros(2, 4, 3, 48, 48, dtype=torch.uint8)
    )


def test_pairs_by_hand():
    pairs = pair_up(torch.tensor([[0, 2], [2, 2]]), torch.tensor([1, 0]), 3, 2)
    assert list(zip(pairs.cell.tolist(), pairs.instruction.tolist(), strict=True)) == [
        (2, 0),
        (0, 1),
        (2, 1),
    ]
    assert pairs.index.tolist() == [[1, 2], [0, 0]]
