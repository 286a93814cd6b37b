"""Whether things that are called likely happen as often as was said."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.stats.rates import wilson
from ifo_grounding.stats.results import Rate


def reliability(
    probabilities: ArrayLike, happened: ArrayLike, bins: int = 10
) -> list[tuple[float, Rate]]:
    """Compare probabilities with what happened, in bins of equal width (DeGroot, Fienberg 1983).

    Args:
        probabilities: what was predicted, in [0, 1], [N].
        happened: what came true, bool [N].
        bins: number of bins.

    Returns:
        For each bin that is not empty the mean probability and the share of what came true, with
        Wilson's interval. The closer the two, the better calibrated.

    Raises:
        UserError: where the inputs do not fit together, or are no probabilities.

    >>> [(said, rate.rate) for said, rate in reliability([0.25, 0.25, 0.75], [0, 1, 1], bins=2)]
    [(0.25, 0.5), (0.75, 1.0)]
    """
    said = np.asarray(probabilities, dtype=np.float64).ravel()
    true = np.asarray(happened, dtype=bool).ravel()
    if len(said) != len(true):
        raise UserError(f"{len(said)} probabilities do not fit {len(true)} outcomes")
    bins = at_least_one("bins", bins)
    if not ((said >= 0) & (said <= 1)).all():
        raise UserError("probabilities must lie in [0, 1]")
    places = np.minimum((said * bins).astype(int), bins - 1)
    return [
        (float(said[here].mean()), wilson(int(true[here].sum()), int(here.sum())))
        for here in (places == place for place in range(bins))
        if here.any()
    ]
