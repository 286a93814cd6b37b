import pytest

from ifo_grounding.errors import UserError
from ifo_grounding.world import BOX_COLOURS, COLOURS, N_KINDS, SHAPES, kind, kind_name
from reference import BOXES, KINDS


def test_the_things_are_those_of_the_paper():
    assert SHAPES == ("circle", "rectangle", "diamond", "triangle")
    assert COLOURS == ("red", "yellow", "blue")
    assert BOX_COLOURS == ("orange", "green", "purple", "pink", "brown", "gray", "cyan")
    assert list(BOX_COLOURS) == BOXES[1:]


def test_kinds_are_numbered_from_one_and_named():
    numbers = [kind(colour, shape) for colour in COLOURS for shape in SHAPES]
    assert numbers == list(range(1, N_KINDS + 1)) == list(range(1, 13))
    assert [kind_name(number) for number in numbers] == KINDS[1:]


def test_an_unknown_thing_has_no_number():
    with pytest.raises(UserError, match="'violet': choose one of 'red', 'yellow', 'blue'"):
        kind("violet", "circle")
    with pytest.raises(UserError, match="unknown shape 'star'"):
        kind("red", "star")
