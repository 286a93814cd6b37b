"""Rates, differences and areas under the ROC curve, each with its 95% interval."""

from ifo_grounding.stats.association import auc
from ifo_grounding.stats.rates import (
    holm,
    paired_difference,
    rate_over_seeds,
    reliability,
    wilson,
)
from ifo_grounding.stats.results import Described, Difference, Estimate, Rate

__all__ = [
    "Described",
    "Difference",
    "Estimate",
    "Rate",
    "auc",
    "holm",
    "paired_difference",
    "rate_over_seeds",
    "reliability",
    "wilson",
]
