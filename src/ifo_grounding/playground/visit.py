"""What one browser sees: a scene and what was done there, a lesson, and a recording."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ifo_grounding.data import Demonstrations
from ifo_grounding.data.recorded import load_recorded
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import home
from ifo_grounding.playground import drawing
from ifo_grounding.playground.agent import Agent, Played, Suited
from ifo_grounding.playground.looking import Recorded, look
from ifo_grounding.playground.teaching import Lesson, Training
from ifo_grounding.world import BOX_COLOURS, N_KINDS, WorldState, kind_name

LOOK, ARM, CLEAR = "nothing", "the arm", "take away"
OBJECTS = [kind_name(number) for number in range(1, N_KINDS + 1)]
BOXES = [f"{colour} box" for colour in BOX_COLOURS]
TOOLS = (LOOK, CLEAR, ARM, *OBJECTS, *BOXES)
"""What a click on a cell does."""
ROWS = 500
"""Demonstrations of a recording that are listed at most."""
MOST = 2**31 - 1


@dataclass(frozen=True)
class Source:
    """Where agents come from."""

    load: Callable[[str], Agent]
    """Returns the agent of a name: ``ifo-grounding/move``, or a run's."""
    names: tuple[str, ...]
    """The names that are offered; the first one is shown at the beginning."""
    local: bool = True
    """Whether the page is for this machine alone, so that it may read any folder."""


@dataclass
class Study:
    """What a person shows and trains; it outlives the tab."""

    lesson: Lesson | None = None
    teach: Sequence[str] = ()
    """Options of the command that trains in the lesson's world."""
    training: Training | None = None


@dataclass
class Visit:
    """One tab."""

    source: Source
    study: Study = field(default_factory=Study)
    wrong: str = ""
    """What was wrong with the last thing that was asked for, empty where nothing was."""
    name: str = ""
    """Of the agent that is watched."""
    scene: int = 0
    """Number of the scene."""
    seed: int = 0
    """Of the scenes."""
    sentence: str | None = None
    """What the person said; None for the scene's own instruction."""
    state: WorldState | None = None
    """How the person arranged the scene, [1]."""
    at: int = 0
    """Step that is seen."""
    tool: str = LOOK
    """What a click on a cell does, one of :data:`TOOLS`."""
    looks: bool = False
    """Whether it is shown where the policy looks."""
    recording: Demonstrations | None = None
    """Demonstrations that are looked at."""
    rows: list[Recorded] = field(default_factory=list)
    """The same, those first that look wrong."""
    row: int | None = None
    """Place in ``rows`` of the one that is seen."""
    saved: tuple[Path, Path] | None = None
    """Folder and file of what was saved last."""
    turn: Any = field(default_factory=threading.RLock)
    """Held while something is done: what a person asks for at once is done one after another."""

    def __post_init__(self) -> None:
        self.choose(self.source.names[0])

    # Watch and talk.

    @property
    def names(self) -> list[str]:
        """The networks that may be watched: those offered, and what this person trained."""
        training = self.study.training
        own = [training.run.name] if training is not None and training.done == 1 else []
        return [*self.source.names, *own]

    def choose(self, name: str) -> None:
        """Take the networks of a name, and go to its first scene."""
        check_choice("networks", name, self.names)
        agent = self.source.load(name)
        study, lesson = self.study, self.study.lesson
        if lesson is None or (not lesson.episodes and study.teach != agent.teach):
            study.lesson, study.teach = Lesson(agent.taught), agent.teach
        self.name, self.agent = name, agent
        self.go(0, 0)

    def go(self, scene: float | None, seed: float | None) -> None:
        """Go to a scene by its number and seed, with its own instruction."""
        for what, number in (("scene", scene), ("seed", seed)):
            if number is None or not 0 <= number <= MOST:
                raise UserError(f"{what} is a number from 0 to {MOST:,}, got {number}")
        assert scene is not None and seed is not None
        self._play(int(scene), int(seed), None, None)

    def tell(self, sentence: str) -> None:
        """Let the agent do what a sentence says, in this scene."""
        self._play(self.scene, self.seed, sentence, self.state)

    def click(self, cell: int) -> None:
        """Put what the tool says into a cell, or take away what is there."""
        if self.tool == LOOK or not self.agent.arranges:
            return
        state = self._first.states[0].clone()
        if self.tool == ARM:
            state.arm[0] = cell
        elif self.tool == CLEAR:
            state.objects[0, cell] = state.boxes[0, cell] = 0
        elif self.tool in OBJECTS:
            state.objects[0, cell] = 1 + OBJECTS.index(self.tool)
        else:
            state.boxes[0, cell] = 1 + BOXES.index(self.tool)
        self._play(self.scene, self.seed, self.said, state)

    def hold(self, tool: str) -> None:
        """Choose what a click on a cell does."""
        check_choice("tool", tool, TOOLS)
        self.tool = tool

    def _play(self, scene: int, seed: int, sentence: str | None, state: WorldState | None) -> None:
        self.played = self.agent.play(scene, seed, sentence, state)
        self.scene, self.seed, self.sentence, self.state = scene, seed, sentence, state
        self.at = 0

    @property
    def _first(self) -> Played:
        return next(iter(self.played.values()))

    @property
    def said(self) -> str:
        """The instruction of what is seen."""
        return self._first.trace.episode.sentence

    @property
    def frame(self) -> torch.Tensor:
        """First frame of the scene, uint8 [C, H, W]."""
        return torch.from_numpy(self._first.trace.episode.frames[0])

    @property
    def steps(self) -> int:
        """Steps of the longest of the episodes."""
        return max(len(one.trace.episode.actions) for one in self.played.values())

    def step(self, by: int) -> None:
        """Go some steps on, or back."""
        self.at = min(max(self.at + by, 0), self.steps)

    def suited(self, sentence: str) -> Suited:
        """Say whether a sentence suits the scene."""
        state = self._first.states[0] if self.agent.arranges else None
        return self.agent.suits(sentence, self.frame, self.scene, self.seed, state)

    def boards(self) -> str:
        """Draw what is seen."""
        arranges = self.agent.arranges and self.tool != LOOK
        actions = self.agent.world.actions
        return drawing.boards(self.played, self.at, actions, looks=self.looks, arranges=arranges)

    # Teach.

    @property
    def lesson(self) -> Lesson:
        """What this person shows."""
        assert self.study.lesson is not None
        return self.study.lesson

    def archive(self, form: str) -> None:
        """Write what was shown into a folder, and all of it into one file."""
        folder = self.lesson.save(form)
        file = Path(tempfile.mkdtemp()) / folder.name
        self.saved = folder, Path(shutil.make_archive(str(file), "zip", folder))

    def train(self) -> None:
        """Train both phases from what was shown, in the background."""
        if self.study.training is not None and not self.study.training.ended:
            raise UserError("a training is under way: wait for its end")
        self.study.training = Training(self.lesson, self.study.teach)

    def show(self) -> None:
        """Watch what was trained."""
        training = self.study.training
        if training is None or training.done < 1:
            raise UserError("there is nothing trained yet")
        self.choose(str(training.run.name))

    # Look.

    def open(self, folder: str) -> None:
        """Look at recorded demonstrations."""
        path = Path(folder).expanduser()
        if not self.source.local and not path.resolve().is_relative_to(home().resolve()):
            raise UserError(f"this page is shared: it reads folders in {home()} alone")
        if not folder.strip() or not path.is_dir():
            raise UserError(f"{folder!r} is no folder of demonstrations")
        demos = load_recorded(path)
        inverse, actions = self.agent.inverse, self.agent.world.actions
        if inverse is not None and tuple(inverse.network_config.shapes.image_shape) != (
            demos.image_shape
        ):
            inverse = None
        self.recording, self.row = demos, None
        self.rows = look(demos, inverse, drawing.action_words(actions))

    def listed(self) -> str:
        """Draw the list of a recording, those first that look wrong."""
        rows = [
            (
                place,
                (
                    one.number,
                    one.sentence,
                    len(one.labels) or "",
                    f"{min(one.confidence):.0%}" if one.confidence else "",
                    "; ".join(one.doubts),
                ),
            )
            for place, one in enumerate(self.rows[:ROWS])
        ]
        head = ("number", "sentence", "steps", "least sure", "looks wrong")
        return drawing.table(rows, head, self.row)

    def film(self) -> str:
        """Draw the demonstration that was chosen, with its labels."""
        if self.recording is None or self.row is None:
            return ""
        one = self.rows[self.row]
        frames = self.recording[one.number]["pixels"].movedim(1, -1).numpy()
        notes = [f"{n} {sure:.0%}" for n, sure in zip(one.labels, one.confidence, strict=True)]
        return drawing.strip(list(frames), notes)
