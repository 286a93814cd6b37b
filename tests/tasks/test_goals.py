import pytest
import torch

from ifo_grounding.tasks import REASONS, TASKS, Goal, fulfilled, plan, verdict
from ifo_grounding.tasks.goals import MAX_STEPS
from reference import BOXES, KINDS, SIDES, Plain, worlds


def goal(task: str, **fields: str) -> Goal:
    tables = {"object": KINDS, "reference": KINDS, "source": BOXES, "target": BOXES, "side": SIDES}
    numbers = {name: table.index(fields.get(name, table[0])) for name, table in tables.items()}
    columns = {name: torch.tensor([number]) for name, number in numbers.items()}
    return Goal(task=torch.tensor([TASKS.index(task)]), **columns, batch_size=[1])


def scene(objects, boxes=(), arm=(0, 0), held=None):
    return worlds([Plain(6, arm, held, frozenset(objects.items()), frozenset(dict(boxes).items()))])


def reason(state, wish: Goal, max_steps: int = MAX_STEPS) -> str:
    return REASONS[int(verdict(state, wish, max_steps))]


RED, BLUE, YELLOW = "red circle", "blue diamond", "yellow triangle"
MOVE = {"task": "move", "object": RED}
SIDE = {"task": "move-udlr", "object": RED}
PICK = {"task": "pick", "object": RED, "target": "green"}
OUT = {"task": "pick-out", "object": RED, "source": "pink", "target": "green"}
BESIDE = {"task": "pick-udlr", "object": RED, "reference": BLUE}
GREEN = {(4, 4): "green"}
BOTH = {(2, 2): "pink", (4, 4): "green"}


@pytest.mark.parametrize(
    ("wish", "objects", "boxes", "expected"),
    [
        (MOVE, {(2, 2): RED}, {}, "suitable"),
        (MOVE, {(2, 2): BLUE}, {}, "missing"),
        (MOVE, {(2, 2): RED, (3, 3): RED}, {}, "ambiguous"),
        (MOVE, {(0, 0): RED}, {}, "already true"),
        (SIDE | {"side": "left"}, {(2, 2): RED}, {}, "suitable"),
        (SIDE | {"side": "above"}, {(0, 2): RED}, {}, "out of bounds"),
        (SIDE | {"side": "below"}, {(2, 2): RED, (3, 2): BLUE}, {}, "occupied"),
        (SIDE | {"side": "left"}, {(0, 1): RED}, {}, "already true"),
        (PICK, {(2, 2): RED}, GREEN, "suitable"),
        (PICK, {(4, 4): RED}, GREEN, "already true"),
        (PICK, {(2, 2): RED, (4, 4): BLUE}, GREEN, "occupied"),
        (OUT, {(2, 2): RED}, BOTH, "suitable"),
        (OUT, {(2, 2): RED}, BOTH | {(3, 3): "green"}, "ambiguous"),
        (OUT, {(2, 3): RED}, BOTH, "missing"),
        # The box says which of two red circles is meant.
        (OUT, {(2, 2): RED, (1, 1): RED}, BOTH, "suitable"),
        (OUT | {"source": "green"}, {(4, 4): RED}, GREEN, "already true"),
        (BESIDE | {"side": "above"}, {(2, 2): RED, (4, 4): BLUE}, {}, "suitable"),
        (BESIDE | {"side": "above"}, {(2, 2): RED, (4, 4): BLUE, (3, 4): YELLOW}, {}, "occupied"),
        # Nothing is beside itself.
        (BESIDE | {"reference": RED, "side": "below"}, {(2, 2): RED}, {}, "missing"),
    ],
)
def test_verdicts_by_hand(wish, objects, boxes, expected):
    assert reason(scene(objects, boxes), goal(**wish)) == expected


def test_what_takes_too_long_is_unachievable():
    state = scene({(2, 1): RED}, GREEN)
    # Three moves, a pick, five moves, a place and the stop.
    assert int(plan(state, goal(**PICK)).steps) == 11
    assert reason(state, goal(**PICK), max_steps=11) == "suitable"
    assert reason(state, goal(**PICK), max_steps=10) == "unachievable"
    assert reason(state, goal(**MOVE), max_steps=4) == "suitable"
    assert reason(state, goal(**MOVE), max_steps=3) == "unachievable"


def test_a_full_hand_makes_every_goal_unachievable():
    begin = scene({(2, 2): RED}, held=BLUE)
    assert reason(begin, goal(**MOVE)) == "unachievable"
    there = scene({(2, 2): RED}, arm=(2, 2), held=BLUE)
    assert not bool(fulfilled(there, plan(begin, goal(**MOVE))))


BEGIN = {(2, 2): RED, (1, 1): BLUE}


@pytest.mark.parametrize(
    ("arm", "objects", "held", "expected"),
    [
        ((4, 4), {(4, 4): RED, (1, 1): BLUE}, None, True),
        ((0, 3), {(4, 4): RED, (1, 1): BLUE}, None, True),  # where the arm is does not matter
        ((4, 4), {(2, 2): RED, (1, 1): BLUE}, None, False),
        ((4, 4), {(4, 4): RED, (1, 2): BLUE}, None, False),  # another object was moved
        ((4, 4), {(4, 4): RED}, BLUE, False),  # or is in the hand
        ((4, 4), {(1, 1): BLUE}, RED, False),  # not put down
        ((4, 4), {(4, 4): BLUE, (2, 2): RED}, None, False),
    ],
)
def test_success_of_pick_by_hand(arm, objects, held, expected):
    final = scene(objects, GREEN, arm, held)
    assert bool(fulfilled(final, plan(scene(BEGIN, GREEN), goal(**PICK)))) is expected


def test_referents_are_those_of_the_initial_state():
    """Moving the reference along does not help: it has to stay where it began."""
    wanted = plan(scene(BEGIN), goal(**BESIDE, side="right"))
    right = scene({(1, 2): RED, (1, 1): BLUE})
    both = scene({(2, 2): RED, (2, 1): BLUE})
    assert bool(fulfilled(right, wanted))
    assert not bool(fulfilled(both, wanted))


def test_other_objects_of_the_same_kind_are_alike():
    """The world does not tell two red circles apart, so neither does success."""
    wanted = plan(scene({(2, 2): RED, (1, 1): RED}, BOTH), goal(**OUT))
    assert bool(fulfilled(scene({(4, 4): RED, (1, 1): RED}, BOTH), wanted))
    assert not bool(fulfilled(scene({(2, 2): RED, (4, 4): RED}, BOTH), wanted))
