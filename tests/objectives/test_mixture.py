import pytest
import torch

from ifo_grounding.objectives.mixture import MixtureEstimate, best_bin_estimate
from ifo_grounding.objectives.pairs import MOST_REMOVED, NegativeInstructions

POOL = torch.arange(1, 13).unsqueeze(1).expand(12, 16)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.36, 0.7])
def test_the_share_is_found_from_overlapping_scores(share):
    positive, hidden = torch.randn(4000) + 3, int(4000 * share)
    unlabelled = torch.cat([torch.randn(hidden) + 3, torch.randn(4000 - hidden)])
    assert best_bin_estimate(positive, unlabelled) == pytest.approx(share, abs=0.04)


def test_scores_without_information_say_that_all_may_be_positive():
    assert best_bin_estimate(*torch.randn(2, 4000)) > 0.9


def test_the_oldest_scores_are_forgotten():
    estimate = MixtureEstimate(size=10, ratio=1)
    estimate.add(torch.ones(8), torch.ones(8))
    assert estimate.share() == 1.0
    estimate.add(torch.ones(10), -torch.ones(10))
    assert estimate.share() == 0.0
    assert estimate.count.tolist() == [18, 18]


def scored(share: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores of positives, and of negatives of which a share score as high."""
    other = -torch.ones(32_768)  # as many as are remembered
    other[: round(share * len(other))] = 1
    return torch.ones(4096), other


def test_removal_does_not_feed_itself():
    negatives = NegativeInstructions(POOL, None, warmup=0.5)
    negatives.progress = 0.4
    negatives.watch(*scored(1 / 4))
    negatives.progress = 0.6
    negatives.watch(*scored(1 / 8))  # before anything is dropped it may fall and rise
    negatives.watch(*scored(1 / 16))
    assert negatives.keep(torch.rand(1024)).sum() == 960
    negatives.watch(*scored(1 / 4))  # what is dropped scores higher: that is no evidence
    assert negatives.keep(torch.rand(1024)).sum() == 960
    negatives.watch(*scored(1 / 32))  # once begun it goes on, though there are fewer than 5%
    assert negatives.keep(torch.rand(1024)).sum() == 992
    assert negatives.suitable_share() == 1 / 32
    negatives.watch(*scored(1 / 4))
    assert negatives.keep(torch.rand(1024)).sum() == 960


def test_the_bound_of_removal_travels_with_the_state_and_no_look_moves_it():
    negatives, other = (NegativeInstructions(POOL, None, warmup=0.5) for _ in range(2))
    negatives.watch(*scored(1 / 8))
    assert negatives.eval().keep(torch.rand(1024)).sum() == 896
    assert float(negatives.bound) == 1
    negatives.train().keep(torch.rand(1024))
    other.load_state_dict(negatives.state_dict())
    other.watch(*scored(1 / 4))
    assert other.removal_rate == 1 / 8


def test_an_untrained_classifier_does_not_remove_nearly_all():
    negatives = NegativeInstructions(POOL, None)
    negatives.watch(torch.zeros(100), torch.zeros(100))
    assert negatives.removal_rate == MOST_REMOVED
