import pytest
import torch
from torch import nn

from ifo_grounding.networks import (
    CellCount,
    CellLinear,
    GatedAttention,
    GRUInstructionEncoder,
    ResidualBlock,
    ResidualFiLM,
    SpatialReadout,
    pool_cells,
)
from ifo_grounding.tasks import VOCABULARY, grammar


def test_gated_attention_is_the_papers_equation():
    gate = GatedAttention(2, 3)
    with torch.no_grad():
        gate.h.weight.copy_(torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))
        gate.h.bias.copy_(torch.tensor([0.0, 0.0, 1.0]))
    image = torch.arange(12.0).reshape(1, 3, 2, 2)
    gated = gate(image, torch.tensor([[0.0, 2.0]]))
    expected = image * torch.tensor([0.5, 0.8807970779778823, 0.7310585786300049]).view(1, 3, 1, 1)
    torch.testing.assert_close(gated, expected)


def test_gates_differ_from_one_sentence_to_another_to_begin_with():
    torch.manual_seed(0)
    encoder = GRUInstructionEncoder(len(VOCABULARY), embedding=8, hidden=64)
    gate = GatedAttention(encoder.size, 32)
    gates = gate(torch.ones(1, 32, 1, 1), encoder(grammar("move").tokens.flatten(0, -2)))
    assert gates.std(0).mean() > 0.1


def test_a_rate_changes_what_a_sentence_part_learns_not_what_it_computes():
    tokens = grammar("move").tokens.flatten(0, -2)
    steps, outputs = [], []
    for rate in (1.0, 0.1):
        torch.manual_seed(0)
        encoder = GRUInstructionEncoder(len(VOCABULARY), embedding=8, hidden=64, rate=rate)
        gate = GatedAttention(encoder.size, 32, rate)
        optimizer = torch.optim.Adam([*encoder.parameters(), *gate.parameters()], lr=1e-4)
        before = gate(torch.ones(1, 32, 1, 1), encoder(tokens))
        before[0].sum().backward()
        optimizer.step()
        after = gate(torch.ones(1, 32, 1, 1), encoder(tokens))
        outputs.append(before)
        steps.append(float((before - after).abs().mean()))
    torch.testing.assert_close(*outputs)
    assert steps[1] / steps[0] == pytest.approx(0.1, rel=0.2)


def test_film_block_by_hand():
    block = ResidualFiLM(1, 1, kernel=3)
    with torch.no_grad():
        block.mix.weight.fill_(2)
        block.mix.bias.fill_(1)
        block.film.weight.copy_(torch.tensor([[0.5], [-3.0]]))
        block.film.bias.zero_()
        block.look.weight.fill_(1)
        block.look.bias.fill_(0.25)
    image = torch.tensor([[[[1.0, 0.0]]]])
    # mixed: 3, 1; scaled by 1.5, shifted by -3: 1.5, -1.5; ReLU: 1.5, 0; each sees both: 1.5
    torch.testing.assert_close(
        block(image, torch.ones(1, 1)), torch.tensor([[[[1 + 1.75, 0 + 1.75]]]])
    )


def test_an_instruction_of_zeros_leaves_the_plain_block():
    torch.manual_seed(0)
    film, plain = ResidualFiLM(4, 8, kernel=3), ResidualBlock(8)
    nn.init.zeros_(film.film.bias)
    plain.load_state_dict({k: v for k, v in film.state_dict().items() if "film" not in k})
    image = torch.randn(2, 8, 6, 6)
    torch.testing.assert_close(film(image, torch.zeros(2, 4)), plain(image))


def test_pooling_keeps_maxima_and_means():
    image = torch.tensor([[[[1.0, 2.0], [3.0, 6.0]], [[-1.0, -1.0], [-1.0, -5.0]]]])
    assert pool_cells(image).tolist() == [[6.0, -1.0, 3.0, -2.0]]


def test_a_linear_layer_of_cells_is_a_1x1_convolution():
    torch.manual_seed(0)
    layer = CellLinear(5, 7)
    image = torch.randn(2, 5, 3, 4)
    expected = nn.functional.conv2d(image, layer.weight[..., None, None], layer.bias)
    torch.testing.assert_close(layer(image), expected)


@pytest.mark.parametrize(("kernel", "reach"), [(1, 1), (3, 9)])
def test_a_block_sees_as_far_as_its_kernel(kernel, reach):
    torch.manual_seed(0)
    block = ResidualFiLM(4, 8, kernel=kernel)
    image = torch.randn(1, 8, 6, 6)
    changed = image.clone()
    changed[..., 2, 3] += 1
    words = torch.randn(1, 4)
    different = (block(image, words) - block(changed, words)).abs().amax(1) > 1e-6
    assert int(different.sum()) == reach


def test_a_readout_tells_where_a_head_looks_and_what_it_sees():
    readout = SpatialReadout(2, heads=1, values=1, grid=(3, 5))
    with torch.no_grad():
        readout.attention.weight.copy_(torch.tensor([[100.0, 0.0]]))
        readout.attention.bias.zero_()
        readout.value.weight.copy_(torch.tensor([[0.0, 1.0]]))
        readout.value.bias.fill_(0.5)
    image = torch.zeros(1, 2, 3, 5)
    image[0, 0, 2, 1] = 1
    image[0, 1] = torch.arange(15.0).reshape(3, 5)
    # the head looks at row 2 of 0..2 and column 1 of 0..4, whose second channel holds 11
    torch.testing.assert_close(readout(image), torch.tensor([[1.0, -0.5, 11.5]]))
    assert readout.maps(image).argmax() == 11
    torch.testing.assert_close(readout.maps(image).sum((-2, -1)), torch.ones(1, 1))


def test_a_readout_of_one_row_of_cells_is_finite():
    readout = SpatialReadout(2, heads=3, values=4, grid=(1, 4))
    assert readout(torch.randn(2, 2, 1, 4)).isfinite().all()
    assert readout.size == 3 * 6


def test_counts_tell_one_cell_from_two():
    count = CellCount(1, detectors=1)
    with torch.no_grad():
        count.detect.weight.fill_(20.0)
        count.detect.bias.fill_(-10.0)
    image = torch.zeros(3, 1, 6, 6)
    image[1, 0, 2, 2] = 1
    image[2, 0, 2, 2:4] = 1
    found = count(image)
    torch.testing.assert_close(found[:, 0], torch.tensor([0.0, 1.0, 2.0]), atol=5e-3, rtol=0)
    torch.testing.assert_close(found[:, 1], torch.tanh(found[:, 0]))
