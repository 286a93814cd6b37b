"""The paper's tables and figures, ablations, BabyAI: every run they need, and what is missing yet.

python recipes/reproduce.py table=2 presets=[strong] seeds=[0]
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from _changes import changes, flat, today
from _shared import RUNNING, plain, result_file
from omegaconf import DictConfig
from tqdm import tqdm

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import babyai
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import home, read_json
from ifo_grounding.tasks import TASKS
from ifo_grounding.training import Run

PLACES = ("run", "base", "results")
"""Options that say where a piece lies, and nothing of what it is."""
GOAL = "goal-pairs-5000"
"""Phase 2 paid for the goal, of the preset whose own phase 2 is paid for actions."""
PHASES = ("phase-1", "pairs-5000", "pairs-10000", GOAL)
ZERO_SHOT = ("zero-shot", "zero-shot-pairs-5000")
UNSEEN = "zero-shot-unseen"
WANTED = {
    ("table", 2): PHASES,
    ("table", 3): PHASES[:1],
    ("table", 4): (*ZERO_SHOT, UNSEEN),
    ("figure", 5): PHASES[:1],
    ("figure", 6): (*PHASES[:2], GOAL),
}
"""Pieces that each table and figure of the paper is made from; the first has phase 1."""


def first_of(phase: str) -> str:
    """Return the phase whose run a phase begins with; itself, where it has a phase 1 of its own."""
    return next(of[0] for of in (PHASES, ZERO_SHOT, (UNSEEN,)) if phase in of)


@dataclass(frozen=True)
class Piece:
    """One call of the recipe `study` that leaves one small file of results."""

    run: str
    arguments: tuple[str, ...]
    file: Path
    base: str | None = None
    """The run that it begins with."""

    @property
    def done(self) -> bool:
        """Whether its file is there and was made by the same call, or by one that says the same.

        What only one of both says counts as said by the other where its option has that value, or
        where there was no such option and it does nothing.
        """
        if not self.file.exists():
            return False
        made = read_json(self.file)
        other = saying(made) ^ {*self.arguments}
        said = {each.partition("=")[0] for each in other} - {*RUNNING, *PLACES}
        then, now = (flat(each) if said else {} for each in (made["options"], self.today))
        return said <= now.keys() and all(
            then[name] == now[name] if name in then else not now[name] for name in said
        )

    @property
    def today(self) -> dict[str, Any]:
        """The options that its call has today."""
        return today(self.arguments)

    def changed(self) -> list[str]:
        """Return what is said otherwise today than the options of its file, if there is one.

        What presets and budgets say is not part of its command, and a file that was made before
        they changed still counts as done: its numbers are those of the options that it holds.
        """
        if not self.file.exists():
            return []
        return changes(read_json(self.file)["options"], self.arguments)

    def of_another_phase_1(self) -> bool:
        """Return whether its run began with a phase 1 that its base has made anew since."""
        if self.base is None:
            return False
        made = [Run(name).record("imitate").get("settings") for name in (self.run, self.base)]
        return None not in made and made[0] != made[1]

    def make(self) -> int:
        """Make it in a process of its own, at one thread; what it prints goes to a file."""
        if self.of_another_phase_1():
            shutil.rmtree(self.folder)  # begun as it is, it would imitate by itself once more
        self.log.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, str(Path(__file__).with_name("study.py")), *self.arguments]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        with self.log.open("w") as log:
            return subprocess.run(
                command, env=environment, stdout=log, stderr=subprocess.STDOUT, check=False
            ).returncode

    @property
    def log(self) -> Path:
        """Where its output goes."""
        return self.folder.with_name(f"{self.run}.log")

    @property
    def folder(self) -> Path:
        """Where its run lies."""
        return home() / "runs" / self.run


def saying(made: dict[str, Any]) -> set[str]:
    """Return the arguments of the call of ``ifo-grounding run study`` that a file is of."""
    return {*shlex.split(made["command"])[3:]}


def pieces(options: DictConfig) -> list[list[Piece]]:
    """Return the pieces of what is asked for: chains, each from one phase 1."""
    asked = {kind for kind in ("table", "figure", "ablation", "level") if options[kind] is not None}
    if not asked:
        raise UserError(
            "name a table=2, 3 or 4, a figure=5 or 6, of the paper, ablation=all or level=all"
        )
    for task in options.tasks:
        check_choice("task", task, TASKS)
    if options.phases is not None and not asked & {"table", "figure"}:
        raise UserError("phases are of a table or a figure: name one, or leave phases out")
    if options.jobs < 1:
        raise UserError(f"jobs must be at least 1, got {options.jobs}")
    found = table_chains(options) if asked & {"table", "figure"} else []
    found += ablation_chains(options) if "ablation" in asked else []
    found += level_chains(options) if "level" in asked else []
    if options.device == "cpu":
        return found
    there = (f"device={options.device}",)
    return [[replace(piece, arguments=piece.arguments + there) for piece in of] for of in found]


def table_chains(options: DictConfig) -> list[list[Piece]]:
    """Return the pieces of the table and the figure of the paper that are asked for."""
    phases = wanted_phases(options)
    for preset in options.presets:
        check_choice("preset", preset, options.options_of.preset)
    return [
        list(chain(options, task, preset, seed, phases))
        for seed, preset, task in product(options.seeds, options.presets, options.tasks)
    ]


def ablation_chains(options: DictConfig) -> list[list[Piece]]:
    """Return the pieces of the ablation asked for, and of the whole that it is compared with."""
    sections = options.options_of.ablation
    first, *others = sections.variant
    asked = options.ablation
    check_choice("ablation", asked, ["all", *others])
    names = [first, *others] if asked == "all" else [first, asked]
    known = [task for task in options.tasks if task in sections.task]
    if not known:
        raise UserError(f"ablations are of the tasks {', '.join(sections.task)} alone")
    return [
        [ablated(options, task, name, seed) for name in names]
        for seed, task in product(options.seeds, known)
    ]


def ablated(options: DictConfig, task: str, name: str, seed: int) -> Piece:
    """Return the piece of one variant."""
    sections = options.options_of.ablation
    variant = plain(sections.variant[name])
    of = variant.pop("of", None)
    runs = {part: f"ablations-{task}-{part}-seed{seed}" for part in (name, of)}
    given = {
        "task": task,
        "seed": seed,
        "run": runs[name],
        "variant": name,
        "results": options.ablations,
        **({"base": runs[of]} if of else {}),
        **flat(sections.all),
        **flat(sections.task[task]),
        **flat(variant),
    }
    parts = (task, given["demonstrations.n"], given["preset"], name, seed)
    file = result_file(options.ablations, *parts)
    arguments = tuple(f"{key}={value}" for key, value in given.items())
    return Piece(runs[name], arguments, file, given.get("base"))


def level_chains(options: DictConfig) -> list[list[Piece]]:
    """Return the pieces of the levels of BabyAI that are asked for, each by itself."""
    section = options.options_of.level
    names = section.names if options.level == "all" else [options.level]
    for name in names:
        babyai(name)  # refuses what is no level
    return [
        [leveled(options, name, n, seed)]
        for seed, n, name in product(options.seeds, section.demonstrations, names)
    ]


def leveled(options: DictConfig, level: str, n: int, seed: int) -> Piece:
    """Return the piece of one level and number of demonstrations."""
    section = options.options_of.level.all
    name = f"{level}-{n}-{section.preset}-seed{seed}"
    given = {
        "world": "babyai",
        "level": level,
        "seed": seed,
        "demonstrations.n": n,
        "run": f"levels-{name}",
        "results": options.levels,
        **flat(section),
    }
    file = result_file(options.levels, level, n, section.preset, None, seed)
    return Piece(f"levels-{name}", tuple(f"{key}={value}" for key, value in given.items()), file)


def wanted_phases(options: DictConfig) -> list[str]:
    """Return the phases that the tables and figures asked for need, in order.

    Where ``phases`` names some of them, these alone, with what they begin with.
    """
    asked = [(kind, options[kind]) for kind in ("table", "figure") if options[kind] is not None]
    for kind, number in asked:
        check_choice(kind, number, [of for which, of in WANTED if which == kind])
    needed = {phase for key in asked for phase in WANTED[key]}
    if options.phases is not None:
        for phase in options.phases:
            check_choice("phase", phase, sorted(needed))
        needed = {*options.phases, *map(first_of, options.phases)}
    return [phase for phase in (*PHASES, *ZERO_SHOT, UNSEEN) if phase in needed]


def chain(
    options: DictConfig, task: str, preset: str, seed: int, phases: list[str]
) -> Iterator[Piece]:
    """Yield the pieces of one task, preset and seed, each phase 1 before what builds on it."""
    sections = options.options_of
    for phase in phases:
        if phase == GOAL and preset != "paper":
            continue  # paid for the goal as it is
        first = first_of(phase)
        names = {part: f"tables-{task}-{preset}-{part}-seed{seed}" for part in (phase, first)}
        given = {
            "task": task,
            "preset": preset,
            "seed": seed,
            "demonstrations.n": options.demonstrations,
            "run": names[phase],
            "variant": phase,
            "results": options.results,
            **({} if phase == first else {"base": names[first]}),
            **flat(sections.all),
            **flat(sections.preset[preset]),
            **flat(sections.preset_of_task.get(preset, {}).get(task, {})),
            **flat(sections.phase[phase]),
        }
        arguments = tuple(f"{name}={value}" for name, value in given.items())
        of = (task, options.demonstrations, preset, phase, seed)
        yield Piece(names[phase], arguments, result_file(options.results, *of), given.get("base"))


def to_make(chain: list[Piece]) -> list[Piece]:
    """Return what is missing of a chain: pieces that are not done, and runs that they begin with.

    Files of results are kept with the code, runs are not: on another machine a piece may be done
    whose run is not there, or was interrupted while it was made again.
    """
    bases = {piece.base for piece in chain if not (piece.done or Run(piece.run).begun)}
    return [
        piece
        for piece in chain
        if not piece.done or (piece.run in bases and not Run(piece.run).is_current("evaluate"))
    ]


def reproduce(options: DictConfig) -> list[Piece]:
    """Make what is missing, chains side by side; return what could not be made."""
    chains = pieces(options)
    if options.list:
        for piece in (piece for chain in chains for piece in chain):
            there = "other  " if piece.file.exists() else "not run"
            print("done   " if piece.done else there, piece.file)
            if changed := piece.changed():
                print("        made with", ", ".join(changed))
        return []
    failed: list[Piece] = []
    missing = [to_make(chain) for chain in chains]
    with (
        tqdm(total=sum(map(len, missing)), unit="piece", disable=not options.progress) as bar,
        ThreadPoolExecutor(options.jobs) as pool,
    ):

        def run(chain: list[Piece]) -> None:
            for piece in chain:
                bar.set_postfix_str(piece.file.stem)
                if piece.make():
                    failed.append(piece)
                    return
                bar.update()

        list(pool.map(run, missing))
    return failed


@recipe_main
def main(options: DictConfig) -> None:
    if failed := reproduce(options):
        listed = ", ".join(str(piece.log) for piece in failed)
        raise UserError(f"pieces that ended with an error left the rest of their chains: {listed}")


if __name__ == "__main__":
    main()
