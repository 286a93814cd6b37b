import pytest
import torch

from ifo_grounding.networks.layers import GatedAttention, ResidualBlock
from ifo_grounding.networks.sentences import GRUInstructionEncoder
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


def test_initial_gates_differ_from_one_sentence_to_another():
    torch.manual_seed(0)
    encoder = GRUInstructionEncoder(len(VOCABULARY), embedding=8, hidden=64, pooling="last")
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


def test_a_residual_block_by_hand():
    block = ResidualBlock(1)
    with torch.no_grad():
        block.mix.weight.fill_(2)
        block.mix.bias.fill_(-1)
        block.look.weight.fill_(1)
        block.look.bias.fill_(0.25)
    # mixed: 1, -1; ReLU: 1, 0; each cell sees both: 1
    found = block(torch.tensor([[[[1.0, 0.0]]]]))
    torch.testing.assert_close(found, torch.tensor([[[[1 + 1.25, 0 + 1.25]]]]))
