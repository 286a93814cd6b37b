"""Intervals against numbers worked out by hand or by another method."""

import json
import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from ifo_grounding import stats
from ifo_grounding.errors import UserError


def test_wilson_by_hand_and_of_nothing():
    # 8 of 10, z = 1.96: centre (0.8 + 0.19207) / 1.38415, half 1.96 / 1.38415 * sqrt(0.025604).
    rate = stats.wilson(8, 10)
    assert rate.rate == 0.8
    assert rate.low == pytest.approx(0.4901625, abs=1e-6)
    assert rate.high == pytest.approx(0.9433178, abs=1e-6)
    assert stats.wilson(0, 20).low == 0.0 and stats.wilson(20, 20).high == 1.0
    rate = stats.wilson(0, 0)
    assert math.isnan(rate.rate) and (rate.low, rate.high) == (0.0, 1.0)
    assert str(rate) == "undefined (n=0)"
    assert json.loads(json.dumps(rate.as_dict(), allow_nan=False))["rate"] is None


def test_what_are_no_counts_no_table_no_probabilities_and_no_scores_is_refused():
    for successes, count in ((-1, 3), (4, 3), (3.7, 5), (math.nan, 5)):
        with pytest.raises(UserError, match=r"successes must be 0\.\.count"):
            stats.wilson(successes, count)
    for table in ([], [[[1]]], [0.5, 1.0]):
        with pytest.raises(UserError, match="outcomes must be"):
            stats.rate_over_seeds(table)
    for wrong in ([0.5], [0, 1]), ([1.2], [1]):
        with pytest.raises(UserError, match="reliability needs probabilities"):
            stats.reliability(*wrong)
    with pytest.raises(UserError, match="finite"):
        stats.auc([1.0, math.nan], [1, 0])
    with pytest.raises(UserError, match="3 scores need as many"):
        stats.auc([1, 2, 0], [1, 1, 0], groups=[0, 0])


def test_rate_reads_as_a_person_writes_it():
    assert str(stats.wilson(1946, 2000)) == "97.3% [96.5, 97.9] (n=2000)"
    # A rare failure is not rounded away.
    assert str(stats.wilson(9999, 10_000)) == "99.99% [99.94, 100.00] (n=10000)"
    assert str(stats.wilson(99_999, 100_000)).startswith("99.999% [")
    assert str(stats.wilson(10, 10)).startswith("100.0% [")
    # Nor is what is not known of one that never came.
    assert str(stats.wilson(20_000, 20_000)) == "100.00% [99.98, 100.00] (n=20000)"
    assert str(stats.wilson(0, 100_000)) == "0.000% [0.000, 0.004] (n=100000)"


def test_a_rate_over_seeds_counts_their_spread():
    # One seed fails always, one succeeds always: one half, with an error of one half, 1 and 12.7.
    outcomes = np.stack([np.zeros(500), np.ones(500)])
    rate = stats.rate_over_seeds(outcomes)
    assert (rate.rate, rate.low, rate.high) == (0.5, 0.0, 1.0)
    assert (rate.successes, rate.count) == (500, 1000)
    # Seeds of 50%, 60% and 70% on scenes of their own, which have nothing in common: the error is
    # 0.1 / sqrt(3), the quantile of t with two degrees of freedom 4.303.
    outcomes = np.zeros((3, 3000))
    for seed, successes in enumerate((500, 600, 700)):
        outcomes[seed, 1000 * seed : 1000 * seed + successes] = 1
    rate = stats.rate_over_seeds(outcomes[:, :2700])
    by_seed = np.array([500, 600, 700]) / 2700
    half = 4.302653 * by_seed.std(ddof=1) / math.sqrt(3)
    assert rate.high - rate.rate == pytest.approx(half) == pytest.approx(rate.rate - rate.low)


def test_a_rate_of_one_seed_is_that_of_its_scenes():
    rate = stats.rate_over_seeds(np.arange(10) < 8)
    assert rate == stats.wilson(8, 10)


def test_seeds_that_agree_on_every_scene_carry_no_more_than_one():
    scenes = np.arange(400) % 2 == 0
    rate = stats.rate_over_seeds(np.repeat(scenes[None], 10, axis=0))
    assert rate.high - 0.5 == pytest.approx(2.262157 * math.sqrt(0.25 / 399))  # of nine: 0.057
    ones = np.ones((3, 100))
    assert stats.rate_over_seeds(ones).low == stats.wilson(100, 100).low < 1.0


@pytest.mark.parametrize("seeds", [2, 3, 5])
@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_intervals_over_seeds_cover_the_truth_as_often_as_said(seeds, spread):
    """Seeds differ, and so do scenes, which are easy or hard for all of them."""
    rng = np.random.default_rng(seeds)

    def solved(level, shape=(seeds, 400)):
        eased = rng.normal(level, 1, (1, shape[1])) + rng.normal(0, spread, (shape[0], 1))
        return rng.random(shape) < 1 / (1 + np.exp(-eased))

    before, after = (solved(level, (4000, 4000)).mean() for level in (0.7, 1.5))
    rates = [stats.rate_over_seeds(solved(0.7)) for _ in range(200)]
    gains = [stats.paired_difference(solved(0.7), solved(1.5)) for _ in range(200)]
    covered = np.mean([each.low <= before <= each.high for each in rates])
    gained = np.mean([each.low <= 100 * (after - before) <= each.high for each in gains])
    assert min(covered, gained) >= 0.9


def test_paired_difference_by_hand():
    before = np.array([1] * 80 + [0] * 20)
    after = np.array([1] * 78 + [0] * 2 + [1] * 12 + [0] * 8)
    difference = stats.paired_difference(before, after)
    assert difference.points == pytest.approx(10.0)
    assert (difference.better, difference.worse, difference.count) == (12, 2, 100)
    # Variance of one scene's change: 14/100 - 0.1^2 = 0.13; half 1.96 * sqrt(0.13 / 100) = 7.07.
    assert difference.low == pytest.approx(10 - 7.07, abs=1.0)
    assert difference.high == pytest.approx(10 + 7.07, abs=1.0)
    # McNemar: 2 * (C(14,0) + C(14,1) + C(14,2)) / 2^14 = 2 * 106 / 16384.
    assert difference.p_value == pytest.approx(212 / 16384)
    with pytest.raises(UserError, match="same scenes"):
        stats.paired_difference(before, after[1:])


def test_scenes_that_hardly_change_do_not_narrow_the_interval():
    before = np.ones(5000, bool)
    after = before.copy()
    none = stats.paired_difference(before, after)
    assert none.points == 0.0 and none.p_value == 1.0
    # None of 5000 changed: 1 - 0.025^(1/5000) either way.
    assert none.high == pytest.approx(100 * (1 - 0.025 ** (1 / 5000))) == -none.low
    after[0] = False
    lost = stats.paired_difference(before, after)
    upper = scipy_stats.binomtest(1, 5000).proportion_ci().high  # Clopper and Pearson
    assert lost.low == pytest.approx(-100 * upper)
    assert lost.low < none.low and 0 < lost.high < none.high
    seeds = stats.paired_difference(np.stack([before, before]), np.stack([after, before]))
    # A change of 0.01 points with as large an error, and one degree of freedom: 12.706 of them.
    assert seeds.low == pytest.approx(-0.01 - 0.127062, abs=1e-5)


def test_paired_difference_over_seeds_needs_agreement_of_seeds():
    before = np.zeros((2, 200))
    after = np.stack([np.ones(200), np.zeros(200)])  # one seed gains all, the other nothing
    difference = stats.paired_difference(before, after)
    assert (difference.points, difference.low, difference.high) == (50.0, -100.0, 100.0)
    assert difference.p_value > 0.05
    sure = stats.paired_difference(before, np.ones((2, 200)))
    assert sure.p_value < 0.001
    assert (
        0 < stats.paired_difference([[0], [0], [1]], [[1], [0], [1]]).p_value <= 1
    )  # of one scene


NOISE = [(2, 0.0, 0.05), (5, 0.0, 0.05), (5, 0.3, 0.0)]


@pytest.mark.parametrize(("seeds", "luck", "noise"), NOISE)
def test_noise_of_seeds_and_luck_of_scenes_pass_for_gains_no_more_often_than_said(
    seeds, luck, noise
):
    """Training moves the success of a seed, or of a scene for all of them, up as often as down."""
    rng = np.random.default_rng(seeds)
    found = alone = 0
    for _ in range(150):
        moved = rng.choice([-luck, luck], 200) + rng.normal(0, noise, (seeds, 1))
        before, after = rng.random((seeds, 200)) < 0.6, rng.random((seeds, 200)) < 0.6 + moved
        found += stats.paired_difference(before, after).p_value < 0.05
        alone += (
            luck > 0 and scipy_stats.ttest_1samp((after * 1.0 - before).mean(1), 0).pvalue < 0.05
        )
    assert found <= 14  # 5% would be 7.5; a binomial with 0.05 exceeds 14 in 1 of 100
    assert alone > 14 or not luck  # as a test over seeds alone finds


@pytest.mark.parametrize("spread", [0.0, 0.02])
def test_a_gain_over_seeds_that_share_no_luck_of_scenes_is_found_as_by_a_t_test(spread):
    rng = np.random.default_rng(1)
    found, expected = [], []
    for _ in range(40):
        before = rng.random((5, 1000)) < 0.9
        after = rng.random((5, 1000)) < 0.91 + rng.normal(0, spread, (5, 1))
        found.append(stats.paired_difference(before, after).p_value)
        change = (after * 1.0 - before).mean(1)
        expected.append(scipy_stats.ttest_1samp(change, 0).pvalue)
    assert np.median(found) == pytest.approx(np.median(expected), rel=0.25)


@pytest.mark.parametrize("seeds", [2, 3])
def test_seeds_that_gain_as_much_by_chance_are_no_proof(seeds):
    before, after = np.zeros((2, seeds, 100))
    after[range(seeds), range(seeds)] = 1  # each gains one scene, each another one
    assert stats.paired_difference(before, after).p_value > 0.2
    rng = np.random.default_rng(seeds)
    noise = (rng.random((200, seeds, 200)) < 0.01) * rng.choice([-1, 1], (200, seeds, 200))
    found = [stats.paired_difference(change < 0, change > 0).p_value for change in noise]
    assert np.mean(np.array(found) < 0.05) <= 0.08
    assert min(found) > 1e-4


def test_holm_by_hand():
    # Sorted 0.005, 0.01, 0.03, 0.04 times 4, 3, 2, 1: 0.02, 0.03, 0.06, 0.04 -> running maximum.
    assert stats.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert stats.holm([0.9, 0.8]) == [1.0, 1.0]
    assert stats.holm([]) == []
    with pytest.raises(UserError, match="p_values"):
        stats.holm([0.1, 1.2])


def area(high, low, groups=None):
    """Return the area of scores that should be high against those that should be low."""
    return stats.auc([*high, *low], [True] * len(high) + [False] * len(low), groups)


def test_auc_counts_pairs():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 6, 40), rng.integers(0, 5, 30)
    pairs = (x[:, None] > y).mean() + 0.5 * (x[:, None] == y).mean()
    assert area(x, y).value == pytest.approx(pairs)
    assert area([3, 4], [1, 2]).value == 1.0
    assert math.isnan(area([], [1.0]).value)


@pytest.mark.parametrize(("positives", "shift"), [(1, 2), (2, 1), (20, 2), (40, 3)])
def test_auc_intervals_cover_the_truth_where_one_kind_is_rare(positives, shift):
    rng = np.random.default_rng(0)
    truth = scipy_stats.norm.cdf(shift / math.sqrt(2))
    draws = [area(rng.normal(shift, 1, positives), rng.normal(0, 1, 300)) for _ in range(200)]
    assert np.mean([draw.low <= truth <= draw.high for draw in draws]) > 0.92


def test_auc_is_not_sure_of_what_one_success_shows():
    alone = area([9.0], np.arange(9))
    assert alone.value == alone.high == 1.0 and 0.2 < alone.low < 0.8
    many = area(np.arange(500) + 500, np.arange(500))
    assert 0.99 < many.low < 1.0
    assert area([1.0, 1.0], [1.0, 1.0]).low < 0.2


def test_auc_of_groups_knows_that_copies_add_nothing():
    rng = np.random.default_rng(0)
    x, y = rng.normal(1, 1, 50), rng.normal(0, 1, 50)
    once = area(x, y)
    copied = area(np.repeat(x, 4), np.repeat(y, 4), np.repeat(np.arange(100), 4))
    naive = area(np.repeat(x, 4), np.repeat(y, 4))
    found = [copied.value, copied.low, copied.high]
    assert found == pytest.approx([once.value, once.low, once.high])
    assert naive.high - naive.low < 0.6 * (once.high - once.low)


def test_reliability_of_a_calibrated_and_of_an_overconfident_forecast():
    source = np.random.default_rng(0)
    said = source.uniform(size=200_000)
    calibrated = stats.reliability(said, source.uniform(size=200_000) < said)
    assert len(calibrated) == 10
    assert all(rate.low - 0.01 < share < rate.high + 0.01 for share, rate in calibrated)
    [(share, rate)] = stats.reliability(np.full(1000, 0.95), source.uniform(size=1000) < 0.5)
    assert share == pytest.approx(0.95) and rate.high < 0.6 and rate.count == 1000
    assert stats.reliability([1.0], [True])[0][1].successes == 1
