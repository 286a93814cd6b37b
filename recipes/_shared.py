"""What recipes share: the run of their options, its files, and how to tell what was found."""

from __future__ import annotations

import atexit
import contextlib
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from torch import Tensor
from torchrl import torchrl_logger

from ifo_grounding import networks
from ifo_grounding.baselines.config import METHODS
from ifo_grounding.config import FREE, STAGES, Options
from ifo_grounding.data import Demonstrations, FrameDecoder, LabelReport, show_codes
from ifo_grounding.errors import UserError, check_choice, did_you_mean
from ifo_grounding.files import read_json, write_json, write_record
from ifo_grounding.machine import keep_freed_memory, machine_of, release_freed_memory
from ifo_grounding.options import plain
from ifo_grounding.progress import tell_progress
from ifo_grounding.training import FitConfig, Run, Stage, Trial, fit
from ifo_grounding.worlds import World

torchrl_logger.setLevel("WARNING")

TRANSITIONS, DEMONSTRATIONS, TRUTH, LABELS = "transitions", "demonstrations", "truth", "labels"
INVERSE = "inverse.safetensors"
POLICIES = {"phase1": "policy-phase1.safetensors", "phase2": "policy-phase2.safetensors"}
CONTINUED = "policy-continued.safetensors"
REFERENCE = "reference-true-actions.safetensors"
CLASSIFIER = "instruction.safetensors"
REWARD = "reward.safetensors"
GOAL = "goal.safetensors"
VALUE = "value.safetensors"
PAIRS = "pairs"
MADE_BY = {
    **{INVERSE: ["train_inverse"], REWARD: ["train_reward"], GOAL: ["train_goal"]},
    **{CLASSIFIER: ["train_instruction"], POLICIES["phase1"]: ["imitate"]},
    **{POLICIES["phase2"]: ["self_examine"], VALUE: ["self_examine"]},
    **{REFERENCE: ["baselines", "imitate_truth"], CONTINUED: ["controls", "continue_imitation"]},
}
"""The recipe that trains each network, and its stage where that has another name."""
CHECKSUMS = "networks.json"  # of the networks that the run has trained, by file
OF_PHASE_2 = (
    *("self_examine", "continue_imitation", "evaluate*", "baseline_*"),
    *(POLICIES["phase2"], CONTINUED, VALUE, PAIRS),
)
"""Patterns of stages and files that a run makes anew where it takes over another's phase 1."""
CHOSEN_ANEW = (
    *("self_examine", "controls"),
    *("instruction.threshold", "instruction.candidates", "instruction.choose"),
)
"""Options that may differ from those of the run whose phase 1 is taken over."""
UP_TO = {
    **{"train_inverse": "collect_transitions", "label": "train_inverse", "imitate": "label"},
    **dict.fromkeys(("train_instruction", "train_reward", "train_goal"), "imitate"),
    **dict.fromkeys(("continue_imitation", "evaluate", "share"), "imitate"),
    **{"self_examine": "train_goal", "imitate_truth": "record_demonstrations"},
}
"""The last stage that has to be done before another one."""
_OPEN: set[Path] = set()
_LOCKS = contextlib.ExitStack()
"""Of the runs that this process works on."""
atexit.register(_LOCKS.close)


def open_run(options: Options, stage: str = "") -> Run:
    """Return the run of these options, which it is made with from now on.

    A new one takes over what its ``base`` has made, but for phase 2. One that a command makes
    nothing of is removed as the command ends. What ``stage``, done next, needs has to be there.

    Raises:
        UserError: where it was made with other options.
    """
    keep_freed_memory()
    torch.set_flush_denormal(True)  # late in training, tiny gradients would slow the CPU down
    run = Run(options.run, options.logger)
    is_new = run.options() is None
    if not (options.base and is_new):
        refuse_missing(run, options, stage)
    if run.folder not in _OPEN:
        world_of(options)  # what is wrong with it is said before anything begins
        _LOCKS.enter_context(run.lock())  # until this process ends
        _OPEN.add(run.folder)
        if is_new:
            _LOCKS.callback(run.drop_if_empty)
    if options.base:
        base = Run(options.base)
        if is_new and base.options() is not None:
            base.begin(plain(options), [*FREE, *CHOSEN_ANEW])
        run.take_over(base, without=OF_PHASE_2)
    run.begin(plain(options), {*FREE} - {"base"} if options.base else FREE)  # taken over at first
    return run


def refuse_missing(run: Run, options: Options, stage: str) -> None:
    """Refuse a stage before those that it needs are done, with the one command that does them."""
    last = UP_TO.get(stage)
    unused = "train_goal" if options.self_examine.reward == "action" else "train_reward"
    before = [name for name in STAGES[: STAGES.index(last) + 1] if name != unused] if last else []
    if missing := [name for name in before if not run.record(name)]:
        given = [text for text in sys.argv[1:] if "=" in text and not text.startswith("until=")]
        beside = (path.name for path in run.folder.parent.glob("*"))
        said = f"there is no run {run.name}{did_you_mean(run.folder.name, beside)}"
        if run.folder.exists():
            said = f"{stage} needs {', '.join(missing)} of the run {run.name} first"
        makes = f"{shlex.join(given or [f'run={run.name}'])} until={missing[-1]}"
        raise UserError(f"{said}: ifo-grounding demo {makes}")


def open_stage(options: Options, name: str, of: Any = None) -> Stage:
    """Return a stage of the run, done only if ``of`` these values, and say whether it is done."""
    release_freed_memory()  # of the stage before
    stage = open_run(options, name).stage(name)
    if of is not None and stage.result and stage.result.get("of") != of:
        stage.result = None
    torch.set_num_threads(options.threads)
    if options.progress:
        tell_progress(name if stage.result is None else None)
    print(f"{name}: {'running' if stage.result is None else 'done before'}", flush=True)
    return stage


def world_of(options: Options) -> World:
    """Return the world, with the words of the run's demonstrations where it has none of its own."""
    spec = dict(options.world)
    rewarded = spec.pop("rewarded", None)
    try:
        world: World = instantiate(spec, _convert_="all")
    except Exception as error:  # of an own class, whatever it raises
        cause = error.__cause__ or error
        if isinstance(cause, UserError):
            raise UserError(f"world: {cause}") from None
        raise UserError(f"world._target_={spec.get('_target_')} cannot be made: {cause}") from None
    if not isinstance(world, World):
        raise UserError(f"world._target_={spec['_target_']} is no ifo_grounding.worlds.World")
    if rewarded is not None:
        check_choice("world.rewarded", rewarded, (True, False))
        world.rewarded = rewarded
    recorded = Run(options.run) / DEMONSTRATIONS
    if world.vocabulary is None and recorded.exists():
        world.vocabulary = Demonstrations.load(recorded).vocabulary
    return world


def simulator_of(options: Options, num_envs: int = 1) -> Any:
    """Return all that a learner may step."""
    return world_of(options).simulator(num_envs, seed=options.seed, device=options.device)


def coded_simulator(options: Options, num_envs: int = 1) -> Any:
    """Return the same, in codes instead of pixels where the world has them."""
    return world_of(options).coded(num_envs, seed=options.seed, device=options.device)


def build(make: Any, options: Options, **kwargs: Any) -> Any:
    """Build a network for the simulator's images, words and actions."""
    chosen = {"seed": options.seed, "device": options.device, **options.networks.changed()}
    network = make(coded_simulator(options), options.preset, **{**chosen, **kwargs})
    world = world_of(options)
    if network.network_config.shapes.fit(world.vocabulary):
        network.vocabulary = world.vocabulary
    return reading_codes(network, options)


def reading_codes(network: Any, options: Options) -> Any:
    """Let a network read codes of the simulator's, where it has them, and return it."""
    if (tiles := world_of(options).tiles) is not None:
        networks.read_codes(network, tiles)
    return network


def learn(
    options: Options,
    stage: Stage,
    loss: Any,
    buffer: Any,
    config: FitConfig,
    file: str,
    **kwargs: Any,
) -> dict[str, Any]:
    """Fit a network to a buffer, save it, and finish the stage."""
    read_fast(buffer, options)
    how = {"checkpoint": stage.checkpoint, "log": stage.log(), **fit_options(options, stage)}
    history = fit(loss, buffer, config, **how, **kwargs)
    save_network(stage.run, file, loss.network)
    return finish(options, stage, history[-1], history)


def keep(
    options: Options, stage: Stage, best: Trial, file: str, calibrate: bool = False, **found: Any
) -> dict[str, Any]:
    """Train the best of several trials to the end, save its network, and finish the stage.

    What else was found goes into the stage's record.
    """
    history = best.finish(stage.log())
    if calibrate:
        best.loss.calibrate()
    save_network(stage.run, file, best.loss.network)
    return finish(options, stage, {**history[-1], "trial": best.number, **found}, history)


def fit_options(options: Options, stage: Stage) -> dict[str, Any]:
    """Return how :func:`fit` is called for a stage."""
    given = {name: getattr(options, name) for name in ("seed", "checkpoint_seconds", "progress")}
    return {**given, "name": stage.name, "cudagraph": True}


def finish(options: Options, stage: Stage, result: dict[str, Any], history: Any = None) -> dict:
    """Record that a stage is done, and on which machine."""
    tell_progress(None)
    return stage.finish(result, history, machine=machine_of(options.device))


def read_fast(buffer: Any, options: Options) -> None:
    """Let a buffer give codes of the simulator's, where it has them, and keep frames on a GPU."""
    if (tiles := world_of(options).tiles) is not None:
        show_codes(buffer, tiles)
    parts = [part for part in buffer.transform.modules() if isinstance(part, FrameDecoder)]
    gpu = torch.device(options.device).type != "cpu"
    if gpu and all(part.table is not None for part in parts):  # else frames are pixels
        buffer.transform.to(options.device)


def checksums(run: Run) -> dict[str, str]:
    """Return the checksums of the networks that a run has trained."""
    return read_json(run / CHECKSUMS, dict) if (run / CHECKSUMS).exists() else {}


def save_network(run: Run, name: str, network: Any) -> None:
    """Save a network that a recipe has trained, and note its checksum."""
    write_json(run / CHECKSUMS, {**checksums(run), name: networks.save(network, run / name)})


def load_network(run: Run, name: str, options: Options, made_by: Sequence[str] = ()) -> Any:
    """Load a network that an earlier recipe trained; another run's is refused."""
    path, checksum = run.need(name, *made_by or MADE_BY[name]), checksums(run).get(name)
    network = networks.load(path, device=options.device, checksum=checksum)
    return reading_codes(network, options)


def load_there(run: Run, files: Mapping[str, str], options: Options) -> dict[str, Any]:
    """Load the networks that a run has of these files, by their names."""
    return {name: load_network(run, f, options) for name, f in files.items() if (run / f).exists()}


def starting_policy(run: Run, options: Options, warm_start: bool) -> Any:
    """Return the phase-1 policy where a network begins with its weights, else None."""
    return load_network(run, POLICIES["phase1"], options) if warm_start else None


def load_demonstrations(run: Run) -> Demonstrations:
    """Load the recorded demonstrations."""
    return Demonstrations.load(run.need(DEMONSTRATIONS, "record_demonstrations"))


def load_labels(run: Run) -> Tensor:
    """Load the actions that the inverse model gave the demonstrations, int64 [transitions]."""
    return LabelReport.load(run.need(LABELS, "label")).actions


def chosen_by(options: Options) -> dict[str, Any]:
    """Return how instructions are chosen."""
    return {n: getattr(options.instruction, n) for n in ("threshold", "candidates", "choose")}


def result_file(options: Options) -> Path:
    """Return where the small file of what was measured goes."""
    parts = [options.task, options.demonstrations.n, options.preset, options.variant]
    name = "-".join(str(part) for part in parts if part)
    return Path(str(options.results)) / f"{name}-seed{options.seed}.json"


def command(name: str) -> str:
    """Return the command of this process."""
    return f"ifo-grounding {name} {shlex.join(w for w in sys.argv[1:] if '=' in w)}".strip()


def write_result(
    options: Options, results: dict[str, Any], name: str, record: str = "result.json"
) -> dict[str, Any]:
    """Write one small file that says what was measured, by which command, where and how long.

    Raises:
        UserError: where the folder of results holds such a file of another run.
    """
    from ifo_grounding.report import provenance  # reports are slow to import

    run = open_run(options)
    others = {f"{stage}_{method}" for method in METHODS for stage in ("baseline", "evaluate")}
    others -= {f"baseline_{options.method}", f"evaluate_{options.method}"}
    records = {name: record for name, record in run.records().items() if name not in others}
    content = {
        "command": command(name),
        "options": plain(options),
        "stages": {name: record["seconds"] for name, record in records.items()},
        "seconds": round(sum(record["seconds"] for record in records.values()), 1),
        "machines": {name: record.get("machine") for name, record in records.items()},
        "threads": {name: record.get("threads") for name, record in records.items()},
        "provenance": provenance(),
        "results": results,
    }
    write_record(run / record, content)
    if options.results:
        file = result_file(options)
        kept = read_json(file, dict, ["options"])["options"] if file.exists() else plain(options)
        there = kept.get("run") if isinstance(kept, dict) else None
        if there != options.run:
            raise UserError(
                f"{file} is of the run {there}, not {options.run}: tell them apart with variant=, "
                "or name another folder of results"
            )
        write_json(file, content)
    return content


def tell(result: dict[str, Any]) -> None:
    """Print what a stage found, one line each."""
    from ifo_grounding.report import text_table

    print(text_table([{"found": n.replace("_", " "), "value": v} for n, v in result.items()]))
