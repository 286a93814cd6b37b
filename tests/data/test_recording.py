"""Recorded demonstrations show an expert at work, and the truth is kept apart."""

import pytest
import torch

from ifo_grounding.data import Demonstrations, Truth, record_demonstrations, recording
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import derive
from ifo_grounding.tasks import TASKS, SceneOptions, draw_scenes, fulfilled, grammar, plan, verdict
from ifo_grounding.world import Layout, render, step


def scenes_of(task: str, n: int, seed: int = 0, **options):
    """The scenes that a recording begins with."""
    key = derive(seed, "demonstrations")
    return draw_scenes(SceneOptions(task, **options), key, torch.arange(n))


@pytest.mark.parametrize("task", TASKS)
def test_frames_show_the_actions_that_fulfil_the_instruction(task):
    demos, truth = record_demonstrations(task, 12, seed=3, keep_truth=True)
    scenes = scenes_of(task, 12, seed=3)
    goals = grammar(task).parse_tokens(demos.instructions)
    assert not verdict(scenes.state, goals).any()
    actions = truth.actions.long().split((demos.lengths - 1).tolist())
    for number in range(12):
        state = scenes.state[number : number + 1]
        pixels = demos[number]["pixels"]
        assert len(pixels) == len(actions[number]) + 1 == scenes.wanted.steps[number] + 1
        for time, action in enumerate(actions[number]):
            assert torch.equal(render(state)[0], pixels[time])
            state = step(state, action.view(1))
        assert torch.equal(render(state)[0], pixels[-1])
        assert torch.equal(pixels[-2], pixels[-1])
        assert (actions[number] == 5).tolist() == [False] * (len(actions[number]) - 1) + [True]
        one = slice(number, number + 1)
        assert fulfilled(state, plan(scenes.state[one], goals[one])).all()


def test_batches_are_joined_in_order(monkeypatch):
    whole, truth = record_demonstrations("move", 50, keep_truth=True)
    monkeypatch.setattr(recording, "BATCH", 16)
    parts = record_demonstrations("move", 50)
    assert torch.equal(parts.first_frames(), whole.first_frames())
    assert torch.equal(parts.instructions, whole.instructions)
    assert torch.equal(parts.lengths, scenes_of("move", 50).wanted.steps + 1)
    assert len(truth.actions) == whole.transitions


def test_streams_and_environments_of_the_same_seed_differ():
    shown = draw_scenes(SceneOptions("move"), 0, torch.arange(50))
    recorded = [
        record_demonstrations("move", 50, stream=stream).first_frames()
        for stream in ("training", "validation", "evaluation")
    ]
    firsts = torch.cat([render(shown.state), *recorded]).flatten(1)
    assert len(firsts.unique(dim=0)) == 200


@pytest.mark.parametrize(("tile_size", "size"), [(16, 6), (32, 4), (8, 10)])
def test_other_sizes(tile_size, size):
    demos = record_demonstrations("move", 20, tile_size=tile_size, layout=Layout(size=size))
    scenes = scenes_of("move", 20, layout=Layout(size=size))
    assert torch.equal(demos.first_frames(), render(scenes.state, tile_size))


def test_truth_has_a_folder_of_its_own(tmp_path):
    demos, truth = record_demonstrations("pick-out", 12, keep_truth=True)
    assert truth.actions.dtype == torch.uint8
    truth.save(tmp_path / "truth")
    demos.save(tmp_path / "demos")
    loaded = Truth.load(tmp_path / "truth")
    assert torch.equal(loaded.actions, truth.actions)
    assert not [path for path in (tmp_path / "demos").iterdir() if "action" in path.name]
    with pytest.raises(UserError, match="holds 'ifo-grounding truth', not 'ifo-grounding demon"):
        Demonstrations.load(tmp_path / "truth")
    with pytest.raises(UserError, match="not 'ifo-grounding truth'"):
        Truth.load(tmp_path / "demos")


def test_threads_are_left_as_they_were():
    torch.set_num_threads(2)
    try:
        record_demonstrations("move", 3)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)


def test_bad_input_is_refused():
    with pytest.raises(UserError, match="number of demonstrations must be at least 1, got 0"):
        record_demonstrations("move", 0)
    with pytest.raises(UserError, match="unknown task 'fly': choose one of 'move'"):
        record_demonstrations("fly", 3)
