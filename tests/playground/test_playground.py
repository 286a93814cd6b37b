"""What stands behind the page: an agent that is told things, a lesson, a look at recordings."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from ifo_grounding.data import Demonstrations, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.networks import from_pretrained, make_policy
from ifo_grounding.options import options_of
from ifo_grounding.playground import (
    Agent,
    Lesson,
    Source,
    Training,
    Visit,
    look,
    taught_in,
    teaching,
)
from ifo_grounding.playground.drawing import picture
from ifo_grounding.tasks import grammar
from ifo_grounding.world import WorldState, kind
from ifo_grounding.worlds import BabyAI, Grid, OpenGrid
from importing import recipes_importable

MOVE = "ifo-grounding/move"
UP, RIGHT, DOWN, LEFT, PICK, STOP = range(6)


@pytest.fixture(scope="module")
def agent():
    others = {name: from_pretrained(MOVE, kind=name) for name in ("instruction", "goal")}
    policies = {"self-examination": from_pretrained(MOVE, kind="policy")}
    return Agent(Grid("move"), policies, grammar("move").tokens, **others)


def test_a_scene_is_played_with_what_decided_it(agent):
    (played,) = agent.play(scene=7, seed=0).values()
    steps = len(played.trace.episode.actions)
    assert len(played.states) == steps + 1 and played.success is True
    assert played.fulfilled > 0.5 and played.values == []
    drawn = agent.world.instructed(1, seed=0, stream="evaluation")
    assert (played.trace.episode.frames[0].shape) == drawn.observation_spec["pixels"].shape[1:]


def test_a_sentence_that_no_template_makes_is_followed_and_not_judged(agent):
    (played,) = agent.play(7, 0, "Red DIAMOND!").values()
    assert played.trace.episode.sentence == "red diamond" and played.success is None
    frame = torch.from_numpy(played.trace.episode.frames[0])
    assert agent.suits("red diamond", frame, 7, 0).truth is None
    assert agent.suits("move to the red circle", frame, 7, 0).truth.endswith("not here")
    with pytest.raises(UserError, match="never heard 'fly', 'moon'"):
        agent.play(7, 0, "fly to the moon")
    with pytest.raises(UserError, match="400 characters: 300"):
        agent.play(7, 0, 400 * "x")


def test_who_came_longest_ago_is_forgotten(monkeypatch):
    page = importlib.import_module("ifo_grounding.playground.page")
    monkeypatch.setattr(page, "MOST_STUDIES", 2)
    studies = {}
    first = page.recalled(studies, "a")
    page.recalled(studies, "b")
    assert page.recalled(studies, "a") is first
    page.recalled(studies, "c")
    assert list(studies) == ["a", "c"]


@pytest.mark.parametrize("channels", [1, 3, 4, 6])
def test_frames_of_any_world_are_drawn(channels):
    assert picture(np.zeros((8, 8, channels), np.uint8)).startswith("data:image/png")


def test_what_is_typed_is_completed_by_what_suits(agent):
    (played,) = agent.play(7, 0).values()
    frame = torch.from_numpy(played.trace.episode.frames[0])
    found = agent.complete("red ci", frame)
    assert found == ["move to the red circle"]
    suits = [agent.suits(each, frame, 7, 0).probability for each in agent.complete("", frame)]
    assert suits == sorted(suits, reverse=True) and len(suits) == 8
    assert agent.complete("purple", frame) == []


def test_a_scene_is_played_as_it_was_arranged(agent):
    state = WorldState.empty(1)
    state.objects[0, 35] = kind("blue", "circle")
    (played,) = agent.play(7, 0, "move to the blue circle", state).values()
    assert played.success and int(played.states[-1].arm) == 35
    frame = torch.from_numpy(played.trace.episode.frames[0])
    state.objects[0, 3] = kind("blue", "circle")
    assert "more than once" in agent.suits("move to the blue circle", frame, 7, 0, state).truth
    state.objects[0, 4] = 99
    with pytest.raises(UserError, match="objects of a world holds 99"):
        agent.play(7, 0, None, state)


def test_a_lesson_keeps_frames_and_the_sentence_alone():
    lesson = Lesson(OpenGrid(), seed=0)
    for action in (*5 * [UP], *9 * [LEFT], STOP):  # against the border nothing changes
        ended = lesson.act(action, "Go home!")
    (shown,) = lesson.episodes
    assert ended and shown.sentence == "go home" and lesson.steps == 0
    changed = (shown.frames[1:] != shown.frames[:-1]).any(axis=(1, 2, 3))
    assert changed.tolist() == [True] * (len(changed) - 1) + [False]
    demos = lesson.demonstrations()
    assert demos.sentences() == ["go home"] and demos.closed.all()
    with pytest.raises(UserError, match="say first what you show"):
        lesson.act(UP, "  ")
    with pytest.raises(UserError, match="show at least 4"):
        Training(lesson, ())
    lesson.drop(0)
    with pytest.raises(UserError, match="nothing was shown"):
        lesson.demonstrations()


def test_recordings_that_look_wrong_come_first():
    demos = record_demonstrations("move", 12, seed=0)
    assert all(one.doubts == [] for one in look(demos))
    frames = [demos[number]["pixels"] for number in range(12)]
    frames[3] = frames[3][:-1]  # cut
    frames[5] = torch.cat([frames[5][:1], frames[5]])  # waits
    frames[8] = torch.cat([frames[8][:1], frames[7]])  # another scene
    rows = look(Demonstrations.from_arrays(frames, demos.sentences()))
    found = {one.number: one.doubts for one in rows[:3]}
    assert found[3] == ["shows no stop"]
    assert found[5] == ["stands still at step 1"]
    assert found[8] == ["jumps at step 1"]
    assert all(one.doubts == [] for one in rows[3:])


def test_visits_are_apart_and_say_what_is_wrong(agent, tmp_path):
    source = Source(lambda name: agent, (MOVE,), local=False)
    first, second = Visit(source), Visit(source)
    first.go(3, 0)
    first.lesson.act(STOP, "stay")
    assert second.scene == 0 and second.lesson.episodes == []
    with pytest.raises(UserError, match="scene is a number from 0"):
        first.go(-1, 0)
    with pytest.raises(UserError, match="unknown networks '/etc'"):
        first.choose("/etc")
    with pytest.raises(UserError, match="this page is shared"):
        first.open(str(tmp_path))
    with pytest.raises(UserError, match="nothing trained yet"):
        first.show()


def test_worlds_of_gymnasium_are_played_and_taught_in():
    world = BabyAI("GoToObj", processes=1)
    demos, _ = world.demonstrate(2, seed=0)
    world.vocabulary = demos.vocabulary
    policies = {"imitation": make_policy(world.simulator(1, seed=0), seed=0)}
    agent = Agent(world, policies, demos.pool())
    visit = Visit(Source(lambda name: agent, ("rooms",)))
    assert visit.played["imitation"].success in (True, False) and not agent.arranges
    visit.tell(demos.sentences()[0])  # it sets its own missions, and judges no other
    assert visit.said == demos.sentences()[0] and visit.played["imitation"].success is None
    assert visit.suited(visit.said) == (None, None) and "<polyline" not in visit.boards()
    visit.lesson.act(world.actions.index("left"), "turn round")
    assert visit.lesson.act(world.stop_action, "turn round")
    assert [len(one.frames) for one in visit.lesson.episodes] == [3]


def test_a_lesson_is_trained_in_the_world_in_which_it_was_shown(agent):
    rooms = {"_target_": "ifo_grounding.worlds.BabyAI", "level": "GoToObj", "processes": None}
    options = options_of(*taught_in(rooms))
    assert options.world == {**rooms, "rewarded": False} and options.task == "taught"
    agents = {"own": agent, "rooms": replace(agent, teach=taught_in(rooms))}
    visit = Visit(Source(agents.get, ("own", "rooms")))
    visit.choose("rooms")
    assert visit.study.teach == taught_in(rooms)  # nothing was shown before
    visit.lesson.act(STOP, "stay")
    visit.choose("own")
    assert visit.study.teach == taught_in(rooms) and len(visit.lesson.episodes) == 1


def test_a_long_demonstration_can_be_stopped_and_not_go_on(monkeypatch):
    monkeypatch.setattr(teaching, "MOST_STEPS", 1)
    lesson = Lesson(OpenGrid(), seed=0)
    for action in (UP, RIGHT, DOWN, LEFT):
        if not lesson.steps:
            lesson.act(action, "go")
    with pytest.raises(UserError, match="that is 1 steps: stop"):
        lesson.act(UP, "go")
    assert lesson.act(STOP, "go")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_what_no_template_names_is_learned_from_twenty_demonstrations(tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))
    corners = {"go to the top left corner": (UP, LEFT, 0), "go down right": (DOWN, RIGHT, 35)}
    lesson = Lesson(OpenGrid(), seed=0)
    for said, (along, across, _) in corners.items():
        for _ in range(10):
            for action in (*5 * [along], *5 * [across], STOP):
                lesson.act(action, said)
    training = Training(lesson, Agent.teach)
    assert training.process.wait() == 0, training.now
    with recipes_importable():
        agent = importlib.import_module("play").load(training.run.name)
    for said, (*_, corner) in corners.items():
        ended = [agent.play(scene, 1, said) for scene in range(60)]
        for phase in agent.policies:
            there = [int(one[phase].states[-1].arm) == corner for one in ended]
            print(said, phase, sum(there))
            assert sum(there) > 45
