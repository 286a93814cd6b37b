"""What is computed once for cells that look alike is what a plain pass over all cells computes."""

import pytest
import torch
from torch import Tensor

from ifo_grounding.data import record_demonstrations
from ifo_grounding.networks import (
    Shapes,
    cells,
    make_goal_classifier,
    make_instruction_classifier,
    word_scoring,
)
from ifo_grounding.networks.cells import distinct_pairs


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


def assert_same(found, expected):
    torch.testing.assert_close(found[0], expected[0])
    for name, gradient in found[1].items():
        torch.testing.assert_close(gradient, expected[1][name], atol=1e-5, rtol=1e-4)


def every_cell_for_itself(index, known):
    return index, known.new_ones(index.shape), known


@pytest.mark.parametrize("make", [make_instruction_classifier, make_goal_classifier])
def test_scenes_are_read_by_kinds_of_cells_as_cell_by_cell(make, scenes, monkeypatch):
    pixels, tokens, shapes = scenes
    network = make(shapes, seed=0).module
    images = (pixels, pixels.flip(0))[: network.images]
    index = torch.randint(len(tokens), (len(pixels), 5), generator=torch.Generator().manual_seed(0))

    def scored(*images):
        words = network.encode_instruction(tokens)
        return network.score_candidates(network.encode_scenes(*images), words, index)

    network.forward = scored
    assert network.encode_scenes(*images).features.shape[-1] < 36
    found = outputs_and_gradients(network, *images)
    monkeypatch.setattr(word_scoring, "group_cells", every_cell_for_itself)
    assert network.encode_scenes(*images).features.shape[-1] == 36
    assert_same(found, outputs_and_gradients(network, *images))


@pytest.mark.parametrize("room", [1 << 22, 0])  # pairs are marked in a table, or sorted
def test_pairs_by_hand(monkeypatch, room):
    monkeypatch.setattr(cells, "ROOM", room)
    first, second, index = distinct_pairs(
        torch.tensor([[0, 2], [2, 2]]), torch.tensor([[1], [0]]), 3, 2
    )
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(2, 0), (0, 1), (2, 1)]
    assert index.tolist() == [[1, 2], [0, 0]]
