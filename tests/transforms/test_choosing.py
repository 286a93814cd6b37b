"""PoolScorer, by hand-computed scores."""

import pytest
import torch
from tensordict.nn import TensorDictModule

from ifo_grounding.errors import UserError
from ifo_grounding.seeding import generator
from ifo_grounding.transforms import PoolScorer
from ifo_grounding.transforms.choosing import draw_candidates
from transforms.counter_world import POOL, Suitability, classifier, constant

SURE = torch.tensor(3.0).sigmoid().item()


def pixels(*numbers):
    shade = torch.tensor(numbers, dtype=torch.uint8) * 20
    return shade.view(-1, 1, 1, 1).expand(-1, 3, 8, 8)


def choose(numbers, model=None, pool=POOL, **options):
    return PoolScorer(model or classifier(), pool).choose(pixels(*numbers), **options)


@pytest.mark.parametrize("network", [Suitability(), Suitability().eval().forward])
def test_chooses_only_above_the_threshold(network):
    """Whether or not the network encodes states and instructions separately."""
    model = classifier(network=network)
    chosen, score = choose([0, 5, 8, 9] * 50, model, generator=generator(0))
    targets = chosen.view(50, 4)
    assert (targets[:, 0] >= 1).all() and (targets[:, 1] >= 6).all()
    assert (targets[:, 2] == 9).all() and (targets[:, 3] == -1).all()
    assert targets[:, 0].unique().numel() == 9
    assert score.view(50, 4)[0].tolist() == pytest.approx([SURE, SURE, SURE, 1 - SURE])


def test_random_choice_is_uniform_over_the_suitable_ones():
    chosen = choose([5] * 4000, generator=generator(3)).chosen
    counts = chosen.bincount(minlength=10)
    assert counts[:6].sum() == 0
    assert ((counts[6:] - 1000).abs() < 130).all()  # four standard errors


@pytest.mark.parametrize("candidates", [1, 3, 10])
def test_random_choice_does_not_prefer_the_best(candidates):
    model = classifier(network=lambda pixels, instruction: 2.0 + instruction[:, :1])
    chosen = choose([0] * 3000, model, candidates=candidates, generator=generator(1)).chosen
    assert ((chosen.bincount(minlength=10) - 300).abs() < 80).all()  # five standard errors


def test_best_takes_the_highest_logit_and_nothing_of_no_states():
    model = classifier(network=lambda pixels, instruction: instruction[:, :1] * 1.0)
    choices = choose([0, 1], model, choose="best")
    assert choices.chosen.tolist() == [9, 9]
    assert choices.score.tolist() == pytest.approx([torch.tensor(10.0).sigmoid().item()] * 2)
    none = choose([])
    assert none.chosen.shape == (0,) and none.score.shape == (0,)


def test_threshold_is_on_the_probability():
    model = constant(1.38)  # sigmoid(1.38) = 0.799
    assert choose([0], model, threshold=0.79).chosen[0] >= 0
    assert choose([0], model, threshold=0.8).chosen[0] == -1
    assert choose([0], model, threshold=0.0).chosen[0] >= 0


def test_each_instruction_is_encoded_once_until_a_weight_changes():
    model = classifier()
    network = model.module
    scorer = PoolScorer(model, POOL)
    for _ in range(3):
        scorer.choose(pixels(*range(9)))
    assert network.encoded == 10
    with torch.no_grad():
        network.sharpness.add_(1.0)
    logits = scorer.score(scorer.encode(pixels(0)), torch.tensor([[0, 9]]))
    assert network.encoded == 20
    assert logits.tolist() == [[-4.0, 4.0]]
    # Updates through .data, as collectors send them, count too.
    network.sharpness.data.fill_(2.0)
    assert scorer.score(scorer.encode(pixels(0)), torch.tensor([[0, 9]])).tolist() == [[-2.0, 2.0]]
    assert network.encoded == 30


def test_candidates_are_distinct_and_uniform():
    index = draw_candidates(3000, 20, 6, generator(0))
    assert index.shape == (3000, 6)
    assert (index.sort(1).values.diff(dim=1) > 0).all()
    for place in index.T:
        assert ((place.bincount(minlength=20) - 150).abs() < 60).all()  # five standard errors
    assert draw_candidates(2, 3, 6, None).sort(1).values.tolist() == [[0, 1, 2], [0, 1, 2]]


BOTH = ["pixels", "instruction"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threshold": 1.0}, "threshold must be within 0..1, below 1"),
        ({"threshold": -0.1}, "threshold must be within 0..1"),
        ({"candidates": 0}, "candidates must be at least 1"),
        ({"choose": "worst"}, "unknown choose 'worst'"),
        ({"pool": torch.zeros(0, 4).long()}, "pool is empty"),
        ({"pool": torch.zeros(3, 4)}, "pool must be token ids"),
        ({"pool": torch.zeros(4).long()}, "pool must be token ids"),
        ({"pool": None}, "pool must be token ids"),
        ({"model": Suitability()}, "expected a TensorDictModule"),
        ({"model": TensorDictModule(lambda a: a, BOTH[:1], ["x"])}, "pixels and an instruction"),
        ({"model": TensorDictModule(lambda *a: a, BOTH, ["x", "y"])}, "be named 'suitability'"),
        ({"model": classifier(network=lambda a, b: a.new_zeros(len(a), 2))}, r"1\], got \[4, 2\]"),
        ({"model": constant(torch.nan)}, "not a number"),
    ],
)
def test_what_does_not_fit_is_refused(options, message):
    with pytest.raises(UserError, match=message):
        choose([0], **options)
