"""Every dependency says which version is the oldest that works, so that it can be tried."""

import re

from environments import requirements


def test_every_dependency_of_every_extra_has_a_lower_bound():
    bounded = re.compile(r"[\w.-]+(\[\w+\])?>=\d[\d.]*(,<\d[\d.]*)?(;.*)?")
    assert len(requirements()) > 20
    assert not [each for each in requirements() if not bounded.fullmatch(each)]
