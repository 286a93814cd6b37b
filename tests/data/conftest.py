"""What the tests of the ways to store demonstrations share."""

import pytest

from ifo_grounding.data import record_demonstrations


@pytest.fixture
def demos():
    return record_demonstrations("move", 12, seed=0)
