import pytest
import torch
from torch import nn
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence

from ifo_grounding.errors import UserError
from ifo_grounding.networks.sentences import GRUInstructionEncoder
from ifo_grounding.tasks import TASKS, VOCABULARY, grammar
from pretended_gpu import pretended_gpu


def sentences(rows: int, length: int = 16, vocabulary: int = 40, seed: int = 0) -> torch.Tensor:
    source = torch.Generator().manual_seed(seed)
    tokens = torch.randint(1, vocabulary, (rows, length), generator=source)
    lengths = torch.randint(1, length + 1, (rows, 1), generator=source)
    return tokens * (torch.arange(length) < lengths)


@pytest.fixture(params=["last", "mean"])
def pooling(request):
    return request.param


@pytest.fixture
def encoder(pooling):
    torch.manual_seed(0)
    return GRUInstructionEncoder(40, embedding=8, hidden=16, pooling=pooling)


def reference_gru(encoder: GRUInstructionEncoder) -> nn.GRU:
    gru = nn.GRU(8, 16, batch_first=True, bidirectional=True)
    with torch.no_grad():
        for way, suffix in enumerate(("l0", "l0_reverse")):
            getattr(gru, f"weight_ih_{suffix}").copy_(encoder.input_weight[way].T)
            getattr(gru, f"weight_hh_{suffix}").copy_(encoder.state_weight[way].T)
            getattr(gru, f"bias_ih_{suffix}").copy_(encoder.input_bias[way, 0])
            getattr(gru, f"bias_hh_{suffix}").copy_(encoder.state_bias[way, 0])
    return gru


def test_it_is_the_bidirectional_gru_of_pytorch_over_packed_sentences(encoder, pooling):
    tokens = sentences(50)
    packed = pack_padded_sequence(
        encoder.embedding(tokens), (tokens != 0).sum(1), batch_first=True, enforce_sorted=False
    )
    states, last = reference_gru(encoder)(packed)
    padded, lengths = pad_packed_sequence(states, batch_first=True)
    means = padded.sum(1) / lengths.unsqueeze(1)
    expected = {"last": torch.cat([*last], -1), "mean": means}[pooling]
    torch.testing.assert_close(encoder(tokens), expected)


def test_a_gpu_reads_sentences_at_once_and_to_the_same_end(pooling):
    torch.manual_seed(0)
    encoder = GRUInstructionEncoder(40, embedding=8, hidden=16, rate=0.3, pooling=pooling)
    tokens = sentences(50)
    tokens[7] = 0
    expected = encoder(tokens)
    asked = torch.autograd.grad(expected.square().sum(), list(encoder.parameters()))
    with pretended_gpu():
        encoder, tokens = encoder.to("cuda"), tokens.to("cuda")
        found = encoder(tokens)
        given = torch.autograd.grad(found.square().sum(), list(encoder.parameters()))
        assert found.is_cuda
        assert encoder(tokens[:0]).shape == (0, encoder.size)
        found, given = found.cpu(), [each.cpu() for each in given]
    torch.testing.assert_close(found, expected)
    for ours, theirs in zip(given, asked, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-3)


def test_ids_outside_the_vocabulary_are_refused(encoder):
    for bad in (-1, 40):
        with pytest.raises(UserError, match=r"hold token .*: allowed are 0..39"):
            encoder(torch.tensor([[1, bad, 2]]))


@pytest.mark.parametrize("task", TASKS)
def test_sentences_that_begin_or_end_alike_are_read_once_with_the_same_result(task, pooling):
    torch.manual_seed(0)
    sizes = {"embedding": 8, "hidden": 16, "rate": 0.1}
    encoder = GRUInstructionEncoder(len(VOCABULARY), **sizes, pooling=pooling).double()
    known = grammar(task).tokens
    tokens = torch.cat([known[torch.randint(len(known), (300,))], known[:1] * 0])
    target = torch.randn(len(tokens), encoder.size, dtype=torch.float64)

    def encoded(encode):
        encoder.zero_grad()
        features = encode(tokens.long())
        (features * target).sum().backward()
        return [features.detach(), *(parameter.grad.clone() for parameter in encoder.parameters())]

    once = encoded(encoder)
    for part, every in zip(once, encoded(encoder._encode_all), strict=True):
        torch.testing.assert_close(part, every)
    assert all(map(torch.equal, once, encoded(encoder)))  # repeats exactly


def test_ids_of_padding_between_words_are_words_of_their_own(encoder):
    rows = torch.cartesian_prod(*[torch.arange(3)] * 5)  # any of five may be padding
    torch.testing.assert_close(encoder(rows), encoder._encode_all(rows))
