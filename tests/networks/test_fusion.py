import torch
from torch import nn

from ifo_grounding.networks import GatedAttention, ResidualBlock, ResidualFiLM, pool_cells


def test_gated_attention_is_the_papers_equation():
    gate = GatedAttention(2, 3)
    with torch.no_grad():
        gate.h.weight.copy_(torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))
        gate.h.bias.copy_(torch.tensor([0.0, 0.0, 1.0]))
    image = torch.arange(12.0).reshape(1, 3, 2, 2)
    gated = gate(image, torch.tensor([[0.0, 2.0]]))
    expected = image * torch.tensor([0.5, 0.8807970779778823, 0.7310585786300049]).view(1, 3, 1, 1)
    torch.testing.assert_close(gated, expected)


def test_film_block_by_hand():
    block = ResidualFiLM(1, 1)
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
    film, plain = ResidualFiLM(4, 8), ResidualBlock(8)
    nn.init.zeros_(film.film.bias)
    plain.load_state_dict({k: v for k, v in film.state_dict().items() if "film" not in k})
    image = torch.randn(2, 8, 6, 6)
    torch.testing.assert_close(film(image, torch.zeros(2, 4)), plain(image))


def test_pooling_keeps_maxima_and_means():
    image = torch.tensor([[[[1.0, 2.0], [3.0, 6.0]], [[-1.0, -1.0], [-1.0, -5.0]]]])
    assert pool_cells(image).tolist() == [[6.0, -1.0, 3.0, -2.0]]
