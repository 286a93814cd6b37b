"""The suitable rate, measured on classifiers whose quality is known."""

import json
import math

import pytest
import torch
from tensordict.nn import TensorDictModule

from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import suitable_rate
from ifo_grounding.tasks import REASONS, SceneOptions, draw_scenes, grammar, verdict
from ifo_grounding.world import render


def as_classifier(function):
    """Wrap a function of (pixels, instruction) that returns logits [B]."""
    return TensorDictModule(
        lambda pixels, instruction: function(pixels, instruction).float().unsqueeze(-1),
        ["pixels", "instruction"],
        ["suitability"],
    )


def oracle(task, states, flip=0.0):
    """A classifier that recognises the fresh states by their pictures and asks the truth."""
    options = SceneOptions(task, instructed=False, stream="evaluation")
    state = draw_scenes(options, 0, torch.arange(states)).state
    numbers = {picture.numpy().tobytes(): row for row, picture in enumerate(render(state, 8))}
    lies = torch.Generator().manual_seed(1)

    def answer(pixels, instruction):
        rows = torch.tensor([numbers[picture.numpy().tobytes()] for picture in pixels])
        right = verdict(state[rows], grammar(task).parse_tokens(instruction)) == 0
        wrong = torch.rand(len(rows), generator=lies) < flip
        return torch.where(right != wrong, 6.0, -6.0)

    return as_classifier(answer)


def always(logit):
    """A classifier that says the same of everything."""
    return as_classifier(lambda pixels, instruction: torch.full((len(pixels),), logit))


YES = always(9.0)


def base_rate(result):
    """Share of suitable pairs among random ones."""
    bins = [rate for _, rate in result.reliability]
    return sum(rate.successes for rate in bins) / sum(rate.count for rate in bins)


@pytest.mark.parametrize("task", ["move", "pick-udlr"])
def test_the_oracle_is_perfect(task):
    pool = grammar(task).tokens
    result = suitable_rate(oracle(task, 100), task, pool, states=100, batch_size=40)
    assert result.rate.rate == 1.0
    assert (result.precision.rate, result.recall.rate, result.auc.value) == (1.0, 1.0, 1.0)
    assert sum(result.errors.values()) == 0
    assert result.served.count == 100 and result.rate.count == result.served.successes
    assert json.loads(json.dumps(result.as_dict(), allow_nan=False))["rate"]["rate"] == 1.0


def test_errors_are_counted_by_kind():
    pool = ["go to the cell above the red circle"]
    result = suitable_rate(YES, "move-udlr", pool, states=2000, pairs_per_state=0)
    options = SceneOptions("move-udlr", instructed=False, stream="evaluation")
    state = draw_scenes(options, 0, torch.arange(2000)).state
    goal = grammar("move-udlr").parse(pool)[torch.zeros(2000, dtype=torch.int64)]
    counts = verdict(state, goal).bincount(minlength=len(REASONS)).tolist()
    assert result.rate.successes == counts[0] > 0
    assert result.errors == dict(zip(REASONS[1:], counts[1:], strict=True))
    for reason in ("missing", "ambiguous", "out of bounds", "occupied", "already true"):
        assert result.errors[reason] > 0, reason
    assert result.precision.count == 0 and math.isnan(result.auc.value)
    assert result.reliability == []


def test_precision_and_recall_of_a_noisy_classifier():
    # One in ten answers is wrong; b is the share of suitable pairs.
    pool = grammar("move").tokens
    result = suitable_rate(oracle("move", 1000, flip=0.1), "move", pool, states=1000)
    b = base_rate(result)
    assert result.recall.low < 0.9 < result.recall.high
    expected = 0.9 * b / (0.9 * b + 0.1 * (1 - b))
    assert result.precision.low < expected < result.precision.high
    assert result.auc.low < 0.9 < result.auc.high


def test_choosing_at_random_gives_the_base_rate():
    pool = grammar("move").tokens
    result = suitable_rate(YES, "move", pool, states=2000)
    assert result.served.rate == 1.0
    assert result.rate.low - 0.02 < base_rate(result) < result.rate.high + 0.02
    # Twelve goals equally often: log2(12) = 3.585 bits.
    assert result.most_entropy == pytest.approx(math.log2(12))
    assert result.entropy == pytest.approx(math.log2(12), abs=0.02)


def test_nothing_above_the_threshold():
    result = suitable_rate(always(-9.0), "move", grammar("move").tokens, states=100)
    assert result.served.successes == 0 and result.rate.count == 0
    assert str(result) == "undefined (n=0)"
    assert result.recall.rate == 0.0 and result.entropy == 0.0


def test_choices_to_look_at_are_those_that_count():
    pool = grammar("move").tokens
    result = suitable_rate(YES, "move", pool, states=64, batch_size=40, pairs_per_state=0)
    assert int((result.verdict == 0).sum()) == result.rate.successes
    goals = grammar("move").goals[result.chosen]
    assert torch.equal(verdict(result.state, goals), result.verdict)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"states": 0}, "states must be at least 1"),
        ({"pool": []}, "pool is empty"),
        ({"pool": ["put the red circle in the orange box"]}, "no sentence of move"),
        ({"choose": "worst"}, "unknown choose"),
    ],
)
def test_mistakes_get_one_clear_line(options, message):
    arguments = {"task": "move", "pool": ["move to the red circle"], "states": 10, **options}
    with pytest.raises(UserError, match=message):
        suitable_rate(YES, **arguments)


@pytest.mark.parametrize(("task", "share"), [("move", 1.0), ("pick", 0.62), ("pick-out", 0.56)])
def test_not_every_state_has_a_suitable_instruction(task, share):
    pool = grammar(task).tokens[:: len(grammar(task).phrasings)]
    result = suitable_rate(always(-9.0), task, pool, states=600, pairs_per_state=0)
    assert result.servable.count == 500
    assert result.servable.low - 0.01 < share < result.servable.high + 0.01


def test_the_reliability_of_pairs_is_that_of_what_was_said():
    result = suitable_rate(always(2.0), "move", ["move to the red circle"], states=300)
    [(said, rate)] = result.reliability
    assert said == pytest.approx(1 / (1 + math.exp(-2)))
    assert rate.count == 1200
    assert result.as_dict()["reliability"] == [[said, rate.as_dict()]]
