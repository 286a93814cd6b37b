"""The paper's tables and figures, and BabyAI: every run that they need, and what is missing yet.

python recipes/reproduce.py table=2 presets=[strong] seeds=[0]
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from tqdm import tqdm

from ifo_grounding.baselines.config import METHODS, PLANNED, READS, UNLEARNED
from ifo_grounding.cli import recipe_main
from ifo_grounding.cluster import Call, run_on_cluster
from ifo_grounding.errors import UserError, check_choice, check_range
from ifo_grounding.files import home
from ifo_grounding.networks.config import PRESETS
from ifo_grounding.tasks import TASKS
from ifo_grounding.training import Run
from ifo_grounding.training.checkpoint import leaves, written

WANTED = {
    ("table", 1): (),  # a piece for each method
    ("table", 2): ("phase-1", "pairs-5000", "pairs-10000"),
    ("table", 3): ("phase-1",),
    ("table", 4): ("zero-shot", "zero-shot-pairs-5000"),
    ("figure", 5): ("phase-1",),
    ("figure", 6): ("phase-1", "pairs-5000"),
}
"""Pieces that each table and figure of the paper is made from; the first has phase 1."""
FIRST = {"zero-shot-pairs-5000": "zero-shot", "pairs-5000": "phase-1", "pairs-10000": "phase-1"}
"""The piece that another begins with."""
BEHIND_PHASE_1 = ("self_examine.", "baseline.")
"""How options begin that change nothing of phase 1."""


@dataclass
class ReproduceOptions:
    """What is made, and how many pieces side by side."""

    table: int | None = None
    """Of the paper: 1, with a success for each method, 2, 3 or 4."""
    figure: int | None = None
    """Of the paper: 5 or 6."""
    levels: list[str] = field(default_factory=list)
    """Of BabyAI, such as ``[GoToObj,GoToLocal,PickupLoc]``."""
    tasks: list[str] = field(default_factory=lambda: list(TASKS))
    """Of which tasks."""
    presets: list[str] = field(default_factory=list)
    """With which presets: by default ``strong`` and ``paper``, of Table 1 ``strong``."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """With which seeds."""
    demonstrations: list[int] = field(default_factory=list)
    """Of each piece: by default 80,000, of Table 1 200, 2,000 and 20,000, of BabyAI 1,000 and
    5,000."""
    methods: list[str] = field(default_factory=lambda: list(METHODS))
    """Of Table 1: which methods."""
    frames: int = 600_000
    """Of Table 1: steps of the simulator that adversarial methods learn from; of another number
    only these are made."""
    jobs: int = 2
    """Chains of pieces side by side, each on one thread."""
    ray: bool = False
    """Whether they run on a Ray cluster instead, as many side by side as it has processors."""
    device: str = "cpu"
    """Where they are made."""
    tune: bool = False
    """With ``table=1``: run the trials of ``tuning`` on validation scenes instead of the table."""
    list: bool = False
    """Only say what is done and what is not."""
    results: str = "results"
    """Folder of the small result files."""
    progress: bool = True
    """Whether to show a progress bar."""
    all: dict[str, Any] = field(default_factory=dict)
    """Options of all pieces of tables 2 to 4 and of figures."""
    preset: dict[str, Any] = field(default_factory=dict)
    """Further ones by preset."""
    preset_of_task: dict[str, Any] = field(default_factory=dict)
    """Further ones by preset and task."""
    phase: dict[str, Any] = field(default_factory=dict)
    """Further ones by piece."""
    method: dict[str, Any] = field(default_factory=dict)
    """Options of the methods of Table 1."""
    tuned: dict[str, Any] = field(default_factory=dict)
    """Further ones of all trials."""
    tuning: dict[str, Any] = field(default_factory=dict)
    """Search space of each method of Table 1: options with their values, a trial for each
    combination."""
    level: dict[str, Any] = field(default_factory=dict)
    """Options of levels of BabyAI."""

    def __post_init__(self) -> None:
        for kind in ("table", "figure"):
            if (number := getattr(self, kind)) is not None:
                check_choice(kind, number, [of for which, of in WANTED if which == kind])
        for kind, of in (("task", TASKS), ("preset", PRESETS), ("method", METHODS)):
            for name in getattr(self, f"{kind}s"):
                check_choice(kind, name, of)
        check_range(self, "jobs", least=1)


ConfigStore.instance().store(name="reproduce_options", node=ReproduceOptions)


@dataclass(frozen=True)
class Piece:
    """One call of a recipe that leaves one small file of results."""

    call: Call
    file: Path
    base: str | None = None
    """The run that it begins with."""

    def make(self) -> int:
        """Make it in a process of its own, on one thread."""
        self.call.log.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "ifo_grounding", "run", self.call.recipe]
        with self.call.log.open("w") as log:
            return subprocess.run(
                [*command, *self.call.options],
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                stdout=log,
                stderr=subprocess.STDOUT,
                check=False,
            ).returncode


def pieces(options: ReproduceOptions) -> list[list[Piece]]:
    """Return the pieces of what is asked for: chains, each from one phase 1."""
    asked = [(k, getattr(options, k)) for k in ("table", "figure") if getattr(options, k)]
    if not asked and not options.levels:
        raise UserError("name a table=1, 2, 3 or 4, a figure=5 or 6, or levels=[GoToObj]")
    needed = {phase for key in asked for phase in WANTED[key]}
    phases = [phase for phase in options.phase if phase in needed]

    def runs(presets: Sequence[str], *numbers: int) -> Iterator[tuple[int, int, str, str]]:
        demonstrations, presets = options.demonstrations or numbers, options.presets or presets
        return product(options.seeds, demonstrations, presets, options.tasks)

    chains = []
    if phases:
        chains = [
            [of_phase(options, *run, phase) for phase in phases] for run in runs([*PRESETS], 80_000)
        ]
    if options.table == 1:
        chains += [list(of_methods(options, *run)) for run in runs(["strong"], 200, 2000, 20_000)]
        if not any(chains):
            raise UserError(
                f"methods=[{','.join(options.methods)}] has none for these tasks and frames: lc-rl "
                f"plans {' and '.join(PLANNED)}, frames={options.frames} is of adversarial methods"
            )
    levels = product(options.seeds, options.demonstrations or [1000, 5000], options.levels)
    return chains + [[of_level(options, *level)] for level in levels]


def of_phase(
    options: ReproduceOptions, seed: int, n: int, preset: str, task: str, phase: str
) -> Piece:
    """Return the piece of one phase."""
    name = f"tables-{task}-{n}-{preset}-{{}}-seed{seed}"
    base = name.format(FIRST[phase]) if phase in FIRST else None
    return piece(
        options,
        name.format(phase),
        f"tables/{task}-{n}-{preset}-{phase}-seed{seed}.json",
        {"task": task, "preset": preset, "seed": seed, "demonstrations.n": n},
        {"variant": phase},
        *of_tables(options, preset, task),
        options.phase[phase],
        base=base,
    )


def of_tables(options: ReproduceOptions, preset: str, task: str) -> list[Mapping[str, Any]]:
    """Return the options of all pieces of a preset and task."""
    of_task = options.preset_of_task.get(preset, {}).get(task, {})
    return [options.all, options.preset[preset], of_task]


def of_methods(
    options: ReproduceOptions, seed: int, n: int, preset: str, task: str
) -> Iterator[Piece]:
    """Yield a piece for each method of Table 1, of one run, or for each trial, of a run each.

    Trials begin with the phase 1 of the first one that chose values of the same options, unless
    these are of phase 1.
    """
    more = "" if options.frames == ReproduceOptions.frames else f"{options.frames / 1e6:g}M"
    name = "-".join(filter(None, (task, str(n), preset, more)))
    as_tables = of_tables(options, preset, task) if preset == "paper" else []  # no budget is for it
    of_run = {"task": task, "preset": preset, "seed": seed, "demonstrations.n": n, **options.method}
    of_run |= {"baseline.frames": options.frames}
    begun: dict[tuple[str, ...], str] = {}
    for method in options.tuning if options.tune else METHODS:
        if method not in options.methods or (method == "lc-rl" and task not in PLANNED):
            continue
        if more and "frames" not in READS.get(method, ()):
            continue  # the same, whatever the number
        if not options.tune:
            if method in UNLEARNED and seed != options.seeds[0]:
                continue  # the same in the same scenes
            run, file = f"baselines-{name}-seed{seed}", f"baselines/{name}-{method}-seed{seed}.json"
            of_method = {"method": method, "variant": more or None}
            yield piece(options, run, file, *as_tables, of_run, of_method, recipe="baselines")
            continue
        space = options.tuning[method]
        for number, values in enumerate(product(*space.values())):
            run = f"tuning-{name}-{method}-{number}-seed{seed}"
            file = f"tuning/{name}-trial{number}-{method}-seed{seed}.json"
            variant = "-".join(filter(None, (more, f"trial{number}")))
            trial = {"method": method, "variant": variant, **dict(zip(space, values, strict=True))}
            base = begun.get(tuple(space))
            chosen = (*as_tables, of_run, options.tuned, trial)
            yield piece(options, run, file, *chosen, base=base, recipe="baselines")
            if all(option.startswith(BEHIND_PHASE_1) for option in space):
                begun.setdefault(tuple(space), run)


def of_level(options: ReproduceOptions, seed: int, n: int, level: str) -> Piece:
    """Return the piece of one level of BabyAI."""
    of_run = {"world": "babyai", "task": level, "seed": seed, "demonstrations.n": n}
    name = f"{level}-{n}-{options.level['preset']}-seed{seed}"
    return piece(options, f"levels-{name}", f"babyai/{name}.json", of_run, options.level)


def piece(
    options: ReproduceOptions,
    run: str,
    file: str,
    *chosen: Mapping[str, Any],
    base: str | None = None,
    recipe: str = "two_phase",
) -> Piece:
    """Return the piece of some options, later ones first where they differ."""
    path = Path(options.results) / file
    given = {"run": run, "results": str(path.parent), "device": options.device}
    if base:
        given["base"] = base
    for section in chosen:
        given |= leaves(section)
    words = tuple(f"{name}={written(value)}" for name, value in given.items())
    log = home() / "runs" / f"{run}.log"
    return Piece(Call(recipe, words, run, log, gpus=int(given["device"] != "cpu")), path, base)


def to_make(chain: list[Piece]) -> list[Piece]:
    """Return what is missing of a chain: pieces without a file, and runs that they begin with.

    Files of results are kept with the code, runs are not: on another machine a piece may be done
    whose run is not there.
    """
    missing = [piece for piece in chain if not piece.file.exists()]
    bases = {piece.base for piece in missing if Run(piece.call.run).options() is None}
    gone = {base for base in bases if base and not any(Run(base).folder.glob("result*.json"))}
    return [piece for piece in chain if piece in missing or piece.call.run in gone]


def reproduce(options: ReproduceOptions) -> list[Piece]:
    """Make what is missing, chains side by side; return what could not be made."""
    chains = pieces(options)
    if options.list:
        for piece in (piece for chain in chains for piece in chain):
            print("done   " if piece.file.exists() else "not run", piece.file)
        return []
    missing = [to_make(chain) for chain in chains]
    if not any(missing):
        print(f"all is done in {options.results}: results=FOLDER makes it anew elsewhere")
    if options.ray:
        made = {piece.call: piece for chain in missing for piece in chain}
        calls = [[piece.call for piece in chain] for chain in missing]
        return [made[call] for call in run_on_cluster(calls, options.progress)]
    with (
        tqdm(total=sum(map(len, missing)), unit="piece", disable=not options.progress) as bar,
        ThreadPoolExecutor(options.jobs) as pool,
    ):

        def failed(chain: list[Piece]) -> Piece | None:
            for piece in chain:
                bar.set_postfix_str(piece.file.stem)
                if piece.make():
                    return piece
                bar.update()
            return None

        return [piece for piece in pool.map(failed, missing) if piece]


@recipe_main
def main(options: ReproduceOptions) -> None:
    if failed := reproduce(options):
        listed = ", ".join(str(piece.call.log) for piece in failed)
        raise UserError(f"pieces that ended with an error left the rest of their chains: {listed}")


if __name__ == "__main__":
    main()
