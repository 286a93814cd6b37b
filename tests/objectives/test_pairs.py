import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.objectives import NegativeInstructions, pairs
from objectives.conftest import POOL, batch, make_loss


def chi_squared(counts: torch.Tensor) -> float:
    expected = counts.float().mean()
    return float(((counts - expected) ** 2 / expected).sum())


def test_negatives_are_uniform_among_all_others():
    negatives = NegativeInstructions(POOL, 0.0)
    drawn = negatives.draw(POOL[4].expand(1000, -1), 20)
    assert drawn.shape == (1000, 20, 4)
    counts = torch.bincount(drawn[..., 0].flatten(), minlength=13)[1:]
    assert counts[4] == 0
    others = counts[counts > 0]
    assert len(others) == 11
    assert chi_squared(others) < 35.6  # 10 degrees of freedom, p = 1e-4
    # Those of an instruction outside the pool are uniform among all.
    drawn = negatives.draw(torch.full((1000, 4), 13), 20)
    counts = torch.bincount(drawn[..., 0].flatten(), minlength=13)[1:]
    assert chi_squared(counts) < 37.4  # 11 degrees of freedom, p = 1e-4


def test_repeated_rows_of_a_pool_are_never_drawn_against_themselves():
    pool = POOL[[0, 0, 0, 1]]
    negatives = NegativeInstructions(pool, 0.0)
    assert negatives.draw(pool, 50)[:3, :, 0].unique().tolist() == [2]


@pytest.mark.parametrize(("rate", "count", "dropped"), [(0.0, 10, 0), (0.3, 10, 3), (0.3, 3, 0)])
def test_the_top_share_is_dropped(rate, count, dropped):
    scores = torch.randn(count)
    kept = NegativeInstructions(POOL, rate).keep(scores)
    assert int((~kept).sum()) == dropped
    if dropped:
        assert scores[~kept].min() > scores[kept].max()


def test_near_negatives_differ_in_few_words(monkeypatch):
    words = torch.cartesian_prod(*[torch.arange(1, 4)] * 4)  # 81 sentences of four words
    monkeypatch.setattr(pairs, "NEAREST", 8)
    negatives = NegativeInstructions(words, 0.0, near=0.5)
    drawn = negatives.draw(words, 10)
    differing = (drawn != words.unsqueeze(1)).sum(-1)
    assert drawn.shape == (81, 10, 4)
    assert differing.min() == 1  # never the own one
    assert (differing[:, 5:] == 1).all()  # 4 places, 2 other words each
    assert differing[:, :5].float().mean() > 2
    assert negatives.uniform(10) == 5


@pytest.mark.parametrize(
    ("pool", "options", "message"),
    [
        (POOL[[3, 3]], {}, "fewer than two different"),
        (POOL[0], {}, "token ids"),
        (POOL.float(), {}, "token ids"),
        (POOL, {"removal_rate": 1.0}, "removal_rate"),
        (POOL, {"negatives": 0}, "negatives"),
        (POOL, {"contrast": -1.0}, "contrast"),
        (POOL, {"near": 1.0}, "near"),
        (POOL, {"unlabelled": "ignored"}, "treatment of unlabelled"),
        (POOL, {"states": torch.zeros(3, 24, 24)}, r"states must be images \[S, C, H, W\]"),
        (POOL, {"states": torch.zeros(0, 3, 24, 24)}, "states must be images"),
        (POOL, {"fresh": 0}, "fresh must be at least 1, got 0"),
        (None, {}, r"such as demos.pool\(\), got NoneType"),
    ],
)
def test_impossible_negatives_are_refused(pool, options, message):
    with pytest.raises(UserError, match=message):
        make_loss("instruction", pool=pool, **options)


def test_random_actions_are_uniform_among_the_others():
    loss = make_loss("reward", "paper")
    seen = []
    loss.network.all_actions = lambda pixels, _: torch.arange(6.0).expand(1000, 10, 6)
    loss._losses = lambda right, wrong, *_: seen.append(wrong)
    loss(batch((10,)).expand(1000, 10).set("action", torch.full((1000, 10), 4)))
    counts = torch.bincount(seen[0].flatten().long(), minlength=6)
    assert counts[4] == 0
    assert chi_squared(counts[counts > 0]) < 23.6  # 4 degrees of freedom, p = 1e-4


def test_scenes_that_repeat_are_scored_as_any_others(preset):
    network = make_loss("instruction", preset).eval().network
    data = batch()[torch.arange(12) % 3]
    others = POOL[torch.arange(24) % 4].view(12, 2, -1)
    own, other = pairs.pair_scores(network, data, others, "suitability")
    for row in range(12):
        said = torch.cat([data["instruction"][row : row + 1], others[row]])
        alone = data[row].expand(3).clone().set("instruction", said)
        expected = network(alone)["suitability"].flatten()
        torch.testing.assert_close(
            torch.cat([own[row : row + 1], other[row]]), expected, rtol=1e-4, atol=1e-4
        )
