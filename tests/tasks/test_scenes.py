from __future__ import annotations

import hashlib

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.seeding import STREAMS
from ifo_grounding.tasks import (
    HOLDOUTS,
    TASKS,
    VOCABULARY,
    Scene,
    SceneOptions,
    SceneStream,
    grammar,
    streams,
    verdict,
)
from ifo_grounding.tasks import scenes as module
from ifo_grounding.tasks.grammar import holdout_kinds
from ifo_grounding.tasks.scenes import CHUNK
from ifo_grounding.world import COLOURS, SHAPES, Layout, render
from reference import holds, plain, verdict_of, wishes


def first(n: int, seed: int = 0, **options) -> Scene:
    return SceneStream(SceneOptions(**options), seed).scenes(torch.arange(n))


def same(one: Scene, other: Scene) -> bool:
    return bool((one == other).all())


def appearances(scenes: Scene) -> set[bytes]:
    return {picture.tobytes() for picture in render(scenes.state).numpy()}


@pytest.mark.parametrize("task", TASKS)
def test_every_instruction_is_suitable(task):
    scenes = first(800, task=task)
    goals = grammar(task).parse_tokens(scenes.instruction)
    assert not verdict(scenes.state, goals).any()
    rows = list(zip(plain(scenes.state[:400]), wishes(goals[:400]), strict=True))
    assert {verdict_of(world, wish) for world, wish in rows} == {"suitable"}
    assert not any(holds(world, world, wish) for world, wish in rows)


def test_a_number_names_one_scene_in_any_order():
    options = SceneOptions("pick-out")
    numbers = torch.tensor([3, 2 * CHUNK + 5, 0, CHUNK, 3, CHUNK - 1])
    scenes = SceneStream(options, seed=0).scenes(numbers)
    fresh = SceneStream(options, seed=0)
    alone = torch.cat([fresh.scenes(number[None]) for number in numbers.flip(0)]).flip(0)
    assert same(scenes, alone)
    assert same(scenes[0], scenes[4])
    assert not same(scenes[0], scenes[2])


@pytest.mark.parametrize(
    "options", [{"task": "pick"}, {"instructed": False}, {"split": "zero-shot"}]
)
def test_chunks_that_are_drawn_side_by_side_are_those_drawn_alone(monkeypatch, options):
    together = first(3 * CHUNK, **options)
    monkeypatch.setattr(module, "AHEAD", 1)
    monkeypatch.setattr(streams, "BLOCK", CHUNK)
    assert same(together, first(3 * CHUNK, **options))


def test_scenes_are_written_to_rows_of_others():
    stream = SceneStream(SceneOptions("pick-out"), seed=0)
    others = stream.scenes(torch.arange(10)).clone()
    numbers, rows = torch.tensor([7, streams.BLOCK + 3, 100]), torch.tensor([9, 0, 4])
    expected = others.clone()
    expected[rows] = stream.scenes(numbers)
    stream.write(numbers, module.scene_leaves(others), rows)
    assert same(others, expected)


def test_scenes_of_several_blocks_come_in_the_order_of_their_numbers():
    stream = SceneStream(SceneOptions("move"), seed=0)
    block = streams.BLOCK
    numbers = torch.tensor([2 * block, 5, block + 3, 2 * block + 1, 5, 7])
    one_by_one = torch.cat([stream.scenes(number.view(1)) for number in numbers])
    assert same(stream.scenes(numbers), one_by_one)


def test_scenes_stay_what_they_are():
    """Results name the scenes that they are about: a change here makes all of them of others."""
    digest = hashlib.sha256()
    for task in TASKS:
        for leaf in module.scene_leaves(first(2 * CHUNK, task=task, stream="evaluation")):
            digest.update(leaf.numpy().tobytes())
    assert digest.hexdigest()[:16] == "49e349ca8fb375ae"


def test_streams_are_disjoint():
    assert STREAMS == ("training", "validation", "evaluation")
    seen: set[bytes] = set()
    for stream in STREAMS:
        now = appearances(first(1000, task="pick", stream=stream))
        assert len(now) == 1000
        assert not now & seen
        seen |= now


@pytest.mark.parametrize("task", TASKS)
def test_instructed_scenes_are_the_others_conditioned_by_rejection_only(task):
    """Free scenes are drawn first; instructed ones are those whose goal suits, in their order."""
    free, asked = (
        [row.tobytes() for row in first(n, task=task, instructed=told).state.objects.numpy()]
        for n, told in ((CHUNK, False), (100, True))
    )
    places = [free.index(row) for row in asked]
    assert places == sorted(set(places)) and places[-1] > 99


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("holdout", ["pairs-1", "pairs-3"])
def test_splits_mention_what_they_should(task, holdout):
    options = {"task": task, "holdout": holdout}
    train = VOCABULARY.decode(first(500, split="train", **options).instruction)
    novel = VOCABULARY.decode(first(200, split="zero-shot", **options).instruction)
    assert not any(pair in sentence for sentence in train for pair in HOLDOUTS[holdout])
    assert all(any(pair in sentence for pair in HOLDOUTS[holdout]) for sentence in novel)
    assert {*COLOURS, *SHAPES} <= {word for sentence in train for word in sentence.split()}


def test_held_out_pairs_are_seen_in_training_scenes_unless_hidden():
    pairs = torch.tensor(holdout_kinds("pairs-3"), dtype=torch.uint8)
    shown = first(1000, task="pick", split="train")
    hidden = first(1000, task="pick", split="train", holdout_visible=False)
    assert all((shown.state.objects == pair).any() for pair in pairs)
    assert not torch.isin(hidden.state.objects, pairs).any()
    novel = first(200, task="pick", split="zero-shot", holdout_visible=False)
    assert torch.isin(novel.state.objects, pairs).any(-1).all()


def test_wordings_are_equally_likely():
    sentences = VOCABULARY.decode(first(4000, task="pick").instruction)
    verbs = [sum(f" {verb} " in f" {s} " for s in sentences) for verb in ("put", "place", "drop")]
    assert sum(verbs) == 4000
    assert all(abs(count - 4000 / 3) < 5 * (4000 * 2 / 9) ** 0.5 for count in verbs)
    assert abs(sum(s.startswith("pick up") for s in sentences) - 2000) < 5 * 1000**0.5


def test_no_goal_needs_more_steps_than_an_episode_has():
    assert first(500, task="pick", max_steps=9).wanted.steps.max() <= 9


def test_no_numbers_give_no_scenes():
    stream = SceneStream(SceneOptions("move"), seed=0)
    assert len(stream.scenes(torch.zeros(0, dtype=torch.int64))) == 0


def test_bad_requests_are_refused(monkeypatch):
    with pytest.raises(UserError, match="unknown task 'fly'"):
        SceneOptions("fly")
    with pytest.raises(UserError, match="unknown split 'x'"):
        SceneOptions(split="x")
    with pytest.raises(UserError, match="unknown stream 'x'"):
        SceneOptions(stream="x")
    with pytest.raises(UserError, match="unknown holdout 'x'"):
        SceneOptions(holdout="x")
    with pytest.raises(UserError, match="max_steps must be at least 1"):
        SceneOptions(max_steps=0)
    with pytest.raises(UserError, match="start at 0"):
        SceneStream(SceneOptions(), 0).scenes(torch.tensor([-1]))
    monkeypatch.setattr(module, "PATIENCE", 3)
    with pytest.raises(UserError, match="only 0 scenes admit a suitable goal of 'pick'"):
        SceneStream(SceneOptions("pick", layout=Layout(boxes=(0, 0))), 0).scenes(torch.tensor([0]))
    with pytest.raises(UserError, match="a layout is a Layout"):
        SceneOptions("pick", layout={"size": 8})
