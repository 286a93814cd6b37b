"""Demonstrations by a person: frames and a sentence are kept, and never what was pressed."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.config import STAGES
from ifo_grounding.data import Demonstrations, save_lerobot, save_pictures
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import home
from ifo_grounding.tasks import Vocabulary
from ifo_grounding.tasks.vocabulary import words_of
from ifo_grounding.texts import one_line
from ifo_grounding.training import Run
from ifo_grounding.worlds import World

FORMS = ("demonstrations", "png", "gif", "lerobot")
"""Ways in which what was taught is written."""
MOST_STEPS = 200
"""Of one demonstration."""
FEWEST = 4
"""Demonstrations without which training is not begun."""
WORDS = 16
"""Of a sentence at most."""


class Shown(NamedTuple):
    """One demonstration by a person."""

    frames: np.ndarray
    """What a learner sees, uint8 [T + 1, C, H, W]."""
    sentence: str
    """What is shown."""
    pictures: np.ndarray
    """The same for people, uint8 [T + 1, h, w, 3]."""


class Lesson:
    """What one person shows in a simulator.

    A step that changes nothing is not kept, but for the stop: demonstrators waste none.

    Args:
        world: where; its simulator is stepped.
        seed: of its scenes.

    >>> from ifo_grounding.worlds import OpenGrid
    >>> lesson = Lesson(OpenGrid(), seed=0)
    >>> for action in (0, 1, 2, 5):
    ...     ended = lesson.act(action, "go round")
    >>> ended, lesson.episodes[0].sentence
    (True, 'go round')
    """

    def __init__(self, world: World, seed: int = 0) -> None:
        self.world, self.episodes = world, list[Shown]()
        self._env: EnvBase = world.simulator(1, seed=seed)
        self.begin()

    def begin(self) -> None:
        """Go to a fresh scene; what was shown in this one is forgotten."""
        self._state = self._env.reset()
        self._frames = [self._state[keys.PIXELS][0].cpu().numpy().copy()]
        self._pictures = [self.picture()]

    @property
    def steps(self) -> int:
        """Steps shown in this scene so far."""
        return len(self._frames) - 1

    def picture(self) -> np.ndarray:
        """Return the scene as it is, for people, uint8 [H, W, 3]."""
        if isinstance(self._env, PickAndPlaceEnv):
            return self._env.render()[0]
        return self._frames[-1].transpose(1, 2, 0)

    def act(self, action: int, sentence: str) -> bool:
        """Do one step; return whether it ended the demonstration, which is then kept.

        Args:
            action: its number.
            sentence: what is shown.

        Raises:
            UserError: where the sentence is empty or too long, or the demonstration is.
        """
        said = words_of(sentence)
        if not 1 <= len(said) <= WORDS:
            raise UserError(f"say first what you show, in 1 to {WORDS} words, and then show it")
        stops = action == self.world.stop_action
        if self.steps >= MOST_STEPS and not stops:
            raise UserError(f"that is {MOST_STEPS} steps: stop, or begin anew")
        stepped = self._env.step(self._state.set(keys.ACTION, torch.tensor([action])))
        self._state = self._env.step_mdp(stepped)
        frame = stepped[keys.NEXT_PIXELS][0].cpu().numpy().copy()
        ended = bool(stepped[keys.NEXT, "done"])
        if stops or not np.array_equal(frame, self._frames[-1]):
            self._frames.append(self._frames[-1] if stops else frame)
            self._pictures.append(self.picture())
        if ended or stops:
            self.finish(sentence)
        return ended or stops

    def finish(self, sentence: str) -> None:
        """Keep what was shown in this scene, and go to a fresh one."""
        if self.steps:
            kept = " ".join(words_of(sentence))
            self.episodes.append(Shown(np.stack(self._frames), kept, np.stack(self._pictures)))
        self.begin()

    def drop(self, number: int) -> None:
        """Throw a demonstration away."""
        del self.episodes[number]

    def demonstrations(self) -> Demonstrations:
        """Return what was shown.

        Raises:
            UserError: where nothing was.
        """
        if not self.episodes:
            raise UserError("nothing was shown yet")
        named = ((number, each.frames, each.sentence) for number, each in enumerate(self.episodes))
        words = self.world.vocabulary
        said = [each.sentence for each in self.episodes]
        known = words is not None and all(set(words_of(s)) <= set(words.words) for s in said)
        own = words if known else Vocabulary.from_sentences(said)
        return Demonstrations.from_episodes(named, vocabulary=own)

    def save(self, form: str) -> Path:
        """Write what was shown into a new folder, and return it.

        Args:
            form: one of :data:`FORMS`.

        Raises:
            UserError: where nothing was shown, or the form needs an extra that is not installed.
        """
        check_choice("form", form, FORMS)
        demos = self.demonstrations()
        name = re.sub("[^a-z0-9]+", "-", self.episodes[0].sentence).strip("-")[:40] or "taught"
        folder = home() / "taught" / f"{name}-{uuid.uuid4().hex[:8]}"
        if form == "demonstrations":
            demos.save(folder)
        elif form == "lerobot":
            save_lerobot(demos, folder)
        else:
            save_pictures(demos, folder, kind=form)
        return folder


class Training:
    """Both phases from a person's demonstrations, in a process of its own.

    It goes on where the page is closed, and ``command`` typed in a terminal goes on with it.

    Args:
        lesson: what was shown.
        options: of its world, as on the command line.

    Raises:
        UserError: where too little was shown.
    """

    def __init__(self, lesson: Lesson, options: Sequence[str]) -> None:
        if len(lesson.episodes) < FEWEST:
            raise UserError(
                f"{len(lesson.episodes)} demonstrations: show at least {FEWEST}, of two sentences "
                "or more"
            )
        folder = lesson.save("demonstrations")
        self.run = Run(folder.name)
        words = ["demo", *options, f"recorded={folder}", f"run={folder.name}"]
        words += [f"demonstrations.n={len(lesson.episodes)}", "progress=true"]
        self.command = shlex.join(["ifo-grounding", *words])
        self.said = folder.with_suffix(".log")
        with self.said.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "ifo_grounding", *words],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env={**os.environ, "IFO_GROUNDING_TRACEBACK": "0"},
            )

    @property
    def ended(self) -> bool:
        """Whether the process has ended, well or not."""
        return self.process.poll() is not None

    @property
    def done(self) -> float:
        """Share of the stages that are done."""
        if self.process.poll() == 0:
            return 1.0
        return len(self.run.records().keys() & {*STAGES}) / len(STAGES)

    @property
    def now(self) -> str:
        """The last line that it printed; of one that failed, why."""
        lines = self.said.read_text(errors="replace").splitlines()
        return one_line(lines[-1]) if lines else "beginning"
