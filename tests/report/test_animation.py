"""Animations and galleries show the frames that they were given."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule

from ifo_grounding import report
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import Episode
from ifo_grounding.evaluation.suitability import suitable_rate
from ifo_grounding.evaluation.tracing import Trace
from ifo_grounding.report.drawing import BORDER, PADDING
from ifo_grounding.report.theme import BAD, GOOD, RUNNING
from ifo_grounding.tasks import grammar


def episode(colours, success, stopped=True):
    frames = np.stack([np.full((3, 48, 48), 0, np.uint8) for _ in colours])
    for frame, colour in zip(frames, colours, strict=True):
        frame[:] = np.array(colour, np.uint8)[:, None, None]
    actions = np.full(len(colours) - 1, 5)
    return Episode(frames, actions, "move to the red circle", success, stopped, 0)


def frames_of(gif):
    image = Image.open(io.BytesIO(gif))
    result, durations = [], []
    for number in range(image.n_frames):
        image.seek(number)
        durations.append(image.info["duration"])
        result.append(np.asarray(image.convert("RGB")).astype(int))
    return result, durations


def near(pixel, colour):
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return np.abs(pixel - wanted).max() < 12


def test_frames_outcomes_and_waiting():
    short = episode([(255, 0, 0), (0, 0, 255)], success=True)
    long = episode([(0, 255, 0)] * 3 + [(255, 255, 0)], success=False)
    frames, durations = frames_of(report.animation([short, long], width=100))
    assert durations == [250, 250, 250, 2500]
    middle = (PADDING + BORDER + 40, PADDING + BORDER + 40)
    cell = 2 * 48 + 2 * BORDER + PADDING + (100 - 96)
    for step, frame in enumerate(frames):
        assert near(frame[middle], "#FF0000" if step == 0 else "#0000FF")
        assert near(frame[middle[0], middle[1] + cell], "#FFFF00" if step == 3 else "#00FF00")
        edge = frame[PADDING + 1, PADDING + 1]
        assert near(edge, RUNNING if step == 0 else GOOD)
        assert near(frame[PADDING + 1, PADDING + 1 + cell], BAD if step == 3 else RUNNING)


def test_animation_refusals():
    with pytest.raises(UserError, match="at least one episode"):
        report.animation([])
    with pytest.raises(UserError, match="one per episode"):
        report.animation([episode([(0, 0, 0)] * 2, True)], titles=["a", "b"])
    with pytest.raises(UserError, match="6 actions and 3 names"):
        report.animation([episode([(0, 0, 0)] * 2, True)], actions="LRS")
    with pytest.raises(UserError, match=r"uint8 \[C, H, W\]"):
        report.animation([Episode(np.zeros((2, 48, 48, 3)), np.array([5]), "a", True, True, 0)])


def test_gallery_marks_the_unsuitable():
    picture = np.zeros((3, 48, 48), np.uint8)
    cases = [report.Captioned(picture, "move", colour=colour) for colour in (GOOD, BAD)]
    sheet = np.asarray(Image.open(io.BytesIO(report.gallery(cases, width=96)))).astype(int)
    assert near(sheet[PADDING + 1, PADDING + 1], GOOD)
    assert near(sheet[PADDING + 1, 2 * PADDING + 2 * BORDER + 96 + 1], BAD)
    with pytest.raises(UserError, match="at least one picture"):
        report.gallery([])


def test_cases_show_suitable_and_unsuitable_choices():
    def score(pixels, instruction):
        return torch.full((len(pixels), 1), 3.0)

    yes = TensorDictModule(score, ["pixels", "instruction"], ["suitability"])
    pool = grammar("move").tokens
    cases = report.instruction_cases(suitable_rate(yes, "move", pool, states=512), pool)
    assert [case.colour for case in cases] == [GOOD] * 8 + [BAD] * 4
    assert all(case.note == "suitable (0.95)" for case in cases[:8])
    assert "missing (0.95)" in {case.note for case in cases}
    assert cases[0].frame.shape == (3, 192, 192)
    none = suitable_rate(yes, "move", pool, states=512, threshold=0.99)
    assert report.instruction_cases(none, pool) == []


def test_a_step_is_a_picture_and_a_dollar_sign_no_formula():
    shown = episode([(9, 9, 9)] * 3, success=True)
    shown = dataclasses.replace(shown, sentence=r"pay $\frac for the red $ circle " * 5)
    trace = Trace(
        episode=shown,
        probabilities=np.full((2, 3), 1 / 3, np.float32),
        maps=np.full((2, 2, 6, 6), 1 / 36, np.float32),
        rewards={"$^": np.full(2, 0.5, np.float32)},
    )
    shown.actions[:] = 1
    frames, _ = frames_of(report.trace_animation(trace, actions=["$_", "go", "$}"]))
    assert len(frames) == 2
    with pytest.raises(UserError, match="3 actions and 6 names"):
        report.trace_animation(trace)
    assert frames_of(report.animation([shown], actions=["$_", "$^"]))
