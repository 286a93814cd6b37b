import hashlib

import pytest
import torch

from ifo_grounding import tasks
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import STREAMS
from ifo_grounding.tasks import scenes as module
from ifo_grounding.tasks.grammar import holdout_kinds, in_split
from ifo_grounding.tasks.scenes import FEWEST, draw_scenes
from ifo_grounding.world import Layout, render


def first(n: int, seed: int = 0, **options) -> tasks.Scene:
    return draw_scenes(tasks.SceneOptions(**options), seed, torch.arange(n))


def same(one: tasks.Scene, other: tasks.Scene) -> bool:
    return bool((one == other).all())


def appearances(scenes: tasks.Scene) -> set[bytes]:
    return {picture.tobytes() for picture in render(scenes.state).numpy()}


@pytest.mark.parametrize("task", tasks.TASKS)
def test_every_instruction_is_suitable(task):
    scenes = first(800, task=task)
    goals = tasks.grammar(task).parse_tokens(scenes.instruction)
    assert not tasks.verdict(scenes.state, goals).any()
    assert (tasks.plan(scenes.state, goals) == scenes.wanted).all()


def test_a_number_names_one_scene_in_any_order():
    options, block = tasks.SceneOptions("pick-out"), FEWEST
    numbers = torch.tensor([3, 2 * block + 5, 0, block, 3, block - 1])
    scenes = draw_scenes(options, 0, numbers)
    alone = torch.cat([draw_scenes(options, 0, number[None]) for number in numbers.flip(0)]).flip(0)
    assert same(scenes, alone)
    assert same(scenes[0], scenes[4])
    assert not same(scenes[0], scenes[2])
    assert len(draw_scenes(options, 0, numbers[:0])) == 0
    assert same(tasks.Scene.of(module.leaves(scenes)), scenes)


@pytest.mark.parametrize(
    "options", [{"task": "pick"}, {"instructed": False}, {"split": "zero-shot"}]
)
def test_a_scene_does_not_depend_on_those_beside_it(monkeypatch, options):
    together = first(300, **options)
    monkeypatch.setattr(module, "FEWEST", 1)
    assert same(together, draw_scenes(tasks.SceneOptions(**options), 0, torch.arange(300)))


@pytest.mark.gpu
@pytest.mark.parametrize("task", tasks.TASKS)
def test_a_gpu_draws_the_same_bits(task):
    numbers = torch.arange(5000)
    here = draw_scenes(tasks.SceneOptions(task), 3, numbers)
    assert same(here, draw_scenes(tasks.SceneOptions(task), 3, numbers.cuda()).cpu())


def test_scenes_stay_what_they_are():
    """Results name the scenes that they are about: a change here makes all of them of others."""
    digest = hashlib.sha256()
    for task in tasks.TASKS:
        for leaf in module.leaves(first(2048, task=task, stream="evaluation")):
            digest.update(leaf.numpy().tobytes())
    assert digest.hexdigest()[:16] == "bcfda6b365e62b81"


def test_streams_are_disjoint():
    assert STREAMS == ("training", "validation", "evaluation")
    seen: set[bytes] = set()
    for stream in STREAMS:
        now = appearances(first(1000, task="pick", stream=stream))
        assert len(now) == 1000
        assert not now & seen
        seen |= now


@pytest.mark.parametrize("task", tasks.TASKS)
def test_instructed_scenes_are_the_others_conditioned_by_rejection_only(task):
    """The first draw of a number is its free scene; it is instructed where its goal suits."""
    free, asked = (first(2000, task=task, instructed=told).state.objects for told in (False, True))
    share = (free == asked).all(-1).float().mean()
    assert 0.15 < share < 0.8


@pytest.mark.parametrize("task", tasks.TASKS)
@pytest.mark.parametrize("split", ["train", "zero-shot"])
def test_scenes_of_a_split_have_its_instructions(task, split):
    tokens = first(200, task=task, split=split).instruction
    assert in_split(tasks.grammar(task).parse_tokens(tokens), split, "pairs-3").all()


def test_held_out_pairs_are_seen_in_training_scenes_unless_hidden():
    pairs = torch.tensor(holdout_kinds("pairs-3"), dtype=torch.uint8)
    shown = first(1000, task="pick", split="train")
    hidden = first(1000, task="pick", split="train", holdout_visible=False)
    assert all((shown.state.objects == pair).any() for pair in pairs)
    assert not torch.isin(hidden.state.objects, pairs).any()
    novel = first(200, task="pick", split="zero-shot", holdout_visible=False)
    assert torch.isin(novel.state.objects, pairs).any(-1).all()


def test_wordings_are_equally_likely():
    sentences = tasks.VOCABULARY.decode(first(4000, task="pick").instruction)
    verbs = [sum(f" {verb} " in f" {s} " for s in sentences) for verb in ("put", "place", "drop")]
    assert sum(verbs) == 4000
    assert all(abs(count - 4000 / 3) < 5 * (4000 * 2 / 9) ** 0.5 for count in verbs)
    assert abs(sum(s.startswith("pick up") for s in sentences) - 2000) < 5 * 1000**0.5


def test_no_goal_needs_more_steps_than_an_episode_has():
    assert first(500, task="pick", max_steps=9).wanted.steps.max() <= 9


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"task": "fly"}, "unknown task 'fly'"),
        ({"split": "x"}, "unknown split 'x'"),
        ({"stream": "x"}, "unknown stream 'x'"),
        ({"holdout": "x"}, "unknown holdout 'x'"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
        ({"holdout_visible": "no"}, "unknown holdout_visible 'no'"),
        ({"layout": {"size": 8}}, "a layout is a Layout"),
        ({"task": "pick", "layout": Layout(boxes=(0, 0))}, "only 0 of .* admit a suitable goal"),
    ],
)
def test_bad_requests_are_refused(monkeypatch, options, said):
    monkeypatch.setattr(module, "PATIENCE", 3)
    with pytest.raises(UserError, match=said):
        first(1, **options)
