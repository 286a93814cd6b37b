from __future__ import annotations

from collections import Counter

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.tasks import (
    MAX_STEPS,
    REASONS,
    TASKS,
    Goal,
    SceneOptions,
    SceneStream,
    achieved,
    grammar,
    plan,
    verdict,
)
from ifo_grounding.tasks.expert import act
from ifo_grounding.tasks.goals import check_task
from ifo_grounding.world import Layout, random_layout, step
from reference import (
    BOXES,
    KINDS,
    SIDES,
    Plain,
    draw_goal,
    holds,
    plain,
    wishes,
    worlds,
)

LAYOUTS = (
    Layout(),
    Layout(size=4, objects=(5, 10), boxes=(2, 5)),
    Layout(size=3, objects=(1, 4), boxes=(0, 2), inside=0.8),
    Layout(size=10, objects=(10, 20), boxes=(3, 7)),
)


def goal(task: str, **fields: str) -> Goal:
    tables = {"object": KINDS, "reference": KINDS, "source": BOXES, "target": BOXES, "side": SIDES}
    numbers = {name: table.index(fields.get(name, table[0])) for name, table in tables.items()}
    columns = {name: torch.tensor([number]) for name, number in numbers.items()}
    return Goal(task=torch.tensor([TASKS.index(task)]), **columns, batch_size=[1])


def scene(arm=(0, 0), objects=None, boxes=None, held=None, size=6):
    objects, boxes = objects or {}, boxes or {}
    return worlds([Plain(size, arm, held, frozenset(objects.items()), frozenset(boxes.items()))])


def reason(state, wish: Goal, max_steps: int = MAX_STEPS) -> str:
    return REASONS[int(verdict(state, wish, max_steps))]


RED, BLUE, YELLOW = "red circle", "blue diamond", "yellow triangle"
PICK = {"object": RED, "target": "green"}
OUT = {"object": RED, "source": "pink", "target": "green"}


@pytest.mark.parametrize(
    ("task", "wish", "things", "expected"),
    [
        ("move", {"object": RED}, {"objects": {(2, 2): RED}}, "suitable"),
        ("move", {"object": RED}, {"objects": {(2, 2): BLUE}}, "missing"),
        ("move", {"object": RED}, {"objects": {(2, 2): RED, (3, 3): RED}}, "ambiguous"),
        ("move", {"object": RED}, {"objects": {(0, 0): RED}}, "already true"),
        ("move-udlr", {"object": RED, "side": "left"}, {"objects": {(2, 2): RED}}, "suitable"),
        (
            "move-udlr",
            {"object": RED, "side": "above"},
            {"objects": {(0, 2): RED}},
            "out of bounds",
        ),
        (
            "move-udlr",
            {"object": RED, "side": "below"},
            {"objects": {(2, 2): RED, (3, 2): BLUE}},
            "occupied",
        ),
        ("move-udlr", {"object": RED, "side": "left"}, {"objects": {(0, 1): RED}}, "already true"),
        ("pick", PICK, {"objects": {(2, 2): RED}, "boxes": {(4, 4): "green"}}, "suitable"),
        ("pick", PICK, {"objects": {(4, 4): RED}, "boxes": {(4, 4): "green"}}, "already true"),
        (
            "pick",
            PICK,
            {"objects": {(2, 2): RED, (4, 4): BLUE}, "boxes": {(4, 4): "green"}},
            "occupied",
        ),
        (
            "pick-out",
            OUT,
            {"objects": {(2, 2): RED}, "boxes": {(2, 2): "pink", (4, 4): "green"}},
            "suitable",
        ),
        (
            "pick-out",
            OUT,
            {"objects": {(2, 2): RED}, "boxes": {(2, 2): "pink", (4, 4): "green", (3, 3): "green"}},
            "ambiguous",
        ),
        (
            "pick-out",
            OUT,
            {"objects": {(2, 3): RED}, "boxes": {(2, 2): "pink", (4, 4): "green"}},
            "missing",
        ),
        (  # the box says which of two red circles is meant
            "pick-out",
            OUT,
            {"objects": {(2, 2): RED, (1, 1): RED}, "boxes": {(2, 2): "pink", (4, 4): "green"}},
            "suitable",
        ),
        (
            "pick-udlr",
            {"object": RED, "reference": BLUE, "side": "above"},
            {"objects": {(2, 2): RED, (4, 4): BLUE}},
            "suitable",
        ),
        (
            "pick-udlr",
            {"object": RED, "reference": BLUE, "side": "above"},
            {"objects": {(2, 2): RED, (4, 4): BLUE, (3, 4): YELLOW}},
            "occupied",
        ),
        (  # nothing is beside itself
            "pick-udlr",
            {"object": RED, "reference": RED, "side": "below"},
            {"objects": {(2, 2): RED, (3, 4): BLUE}},
            "missing",
        ),
        (
            "pick-out",
            {"object": RED, "source": "green", "target": "green"},
            {"objects": {(4, 4): RED}, "boxes": {(4, 4): "green"}},
            "already true",
        ),
    ],
)
def test_verdicts_by_hand(task, wish, things, expected):
    assert reason(scene(**things), goal(task, **wish)) == expected


def test_what_takes_too_long_is_unachievable():
    state = scene(objects={(2, 1): RED}, boxes={(4, 4): "green"})
    # Three moves, a pick, five moves, a place and the stop.
    assert int(plan(state, goal("pick", **PICK)).steps) == 11
    assert reason(state, goal("pick", **PICK), max_steps=11) == "suitable"
    assert reason(state, goal("pick", **PICK), max_steps=10) == "unachievable"
    assert reason(state, goal("move", object=RED), max_steps=4) == "suitable"
    assert reason(state, goal("move", object=RED), max_steps=3) == "unachievable"


def test_a_full_hand_makes_every_goal_unachievable():
    state = scene(objects={(2, 1): RED}, held=BLUE)
    assert reason(state, goal("move", object=RED)) == "unachievable"


BEGIN = scene(arm=(0, 0), objects={(2, 2): RED, (1, 1): BLUE}, boxes={(4, 4): "green"})


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
    final = scene(arm=arm, objects=objects, boxes={(4, 4): "green"}, held=held)
    assert bool(achieved(BEGIN, final, goal("pick", **PICK))) is expected


def test_success_needs_an_empty_hand_even_if_it_was_full_before():
    begin = scene(arm=(0, 0), objects={(2, 2): RED}, held=BLUE)
    there = scene(arm=(2, 2), objects={(2, 2): RED}, held=BLUE)
    assert not bool(achieved(begin, there, goal("move", object=RED)))


def test_referents_are_those_of_the_initial_state():
    """Moving the reference along does not help: it has to stay where it began."""
    wish = goal("pick-udlr", object=RED, reference=BLUE, side="right")
    right = scene(objects={(1, 2): RED, (1, 1): BLUE})
    both = scene(objects={(2, 2): RED, (2, 1): BLUE})
    assert bool(achieved(BEGIN, right, wish))
    assert not bool(achieved(BEGIN, both, wish))


@pytest.mark.parametrize("task", TASKS)
def test_success_agrees_with_the_plain_rules(task):
    """Finals: walks that the expert starts and chance ends, so that many come close."""
    counts: Counter[bool] = Counter()
    for number, layout in enumerate(LAYOUTS):
        stream = SceneStream(SceneOptions(task, layout=layout), seed=number)
        initial = stream.scenes(torch.arange(150))
        draw = torch.Generator().manual_seed(number)
        unsuitable = random_layout(150, layout, generator=draw)
        state = torch.cat([initial.state, unsuitable])
        said = grammar(task).parse_tokens(initial.instruction)
        wish = torch.cat([said, draw_goal(task, unsuitable, number, present=0.8)])
        wanted, start = plan(state, wish), state
        patience = torch.randint(40, (300,), generator=draw)
        slips = torch.rand(300, generator=draw) < 0.5
        for time in range(45):
            chance = torch.randint(6, (300,), generator=draw)
            expert = act(state, wanted, draw)
            state = step(state, torch.where((time > patience) & slips, chance, expert))
            if time % 11 == 10:
                found = achieved(start, state, wish).tolist()
                expected = [
                    holds(*worlds_and_wish)
                    for worlds_and_wish in zip(
                        plain(start), plain(state), wishes(wish), strict=True
                    )
                ]
                assert found == expected
                counts.update(found)
    assert min(counts[True], counts[False]) > 250


def test_other_objects_of_the_same_kind_are_alike():
    """The world does not tell two red circles apart, so neither does success."""
    wish = goal("pick-out", **OUT)
    boxes = {(2, 2): "pink", (4, 4): "green"}
    begin = scene(objects={(2, 2): RED, (1, 1): RED}, boxes=boxes)
    assert bool(achieved(begin, scene(objects={(4, 4): RED, (1, 1): RED}, boxes=boxes), wish))
    assert not bool(achieved(begin, scene(objects={(2, 2): RED, (4, 4): RED}, boxes=boxes), wish))


def test_tasks_have_numbers():
    assert TASKS == ("move", "move-udlr", "pick", "pick-out", "pick-udlr")
    assert [check_task(task) for task in TASKS] == [0, 1, 2, 3, 4]
    with pytest.raises(UserError, match="unknown task 'fly': choose one of 'move'"):
        check_task("fly")
