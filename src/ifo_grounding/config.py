"""Every option of every recipe: a tree of dataclasses, which Hydra checks command lines against.

Below each field stands what it means; ``--help`` and the docs' page of options print that. YAML in
``recipes/conf`` only chooses values: of presets, budgets and worlds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from ifo_grounding.baselines.config import METHODS, BaselineConfig
from ifo_grounding.episodes import MODES
from ifo_grounding.errors import UserError, check_choice, check_numbers, check_range, whole
from ifo_grounding.files import check_folder
from ifo_grounding.machine import check_device
from ifo_grounding.networks.config import NetworksConfig
from ifo_grounding.objectives.instruction import UNLABELLED
from ifo_grounding.tasks.grammar import SPLITS
from ifo_grounding.training.run import LOGGERS
from ifo_grounding.training.self_examination import SelfExaminationConfig
from ifo_grounding.training.supervised import FitConfig
from ifo_grounding.transforms.choosing import CHOICES

STAGES = (
    "record_demonstrations",
    "collect_transitions",
    "train_inverse",
    "label",
    "imitate",
    "train_instruction",
    "train_reward",
    "train_goal",
    "self_examine",
)
"""Stages of a run, in order."""
PASSING = (
    *("run", "base", "until", "results", "variant", "to", "hub", "controls.run", "references"),
    *("device", "threads", "logger", "progress", "checkpoint_seconds", "method", "ray"),
)
"""Options of one command, which a run does not keep."""
FREE = (*PASSING, "evaluate", "baseline")
"""Options, or sections, that decide nothing of what a run learns: they may change as it goes on."""


@dataclass
class DemonstrationsConfig:
    """What is imitated."""

    n: int = 3000
    """How many demonstrations are recorded, or read of those in ``recorded``."""

    def __post_init__(self) -> None:
        check_range(self, "n", least=1)


@dataclass
class TransitionsConfig:
    """Random steps of the simulator, from which the inverse model learns."""

    n: int = 60_000
    """How many steps."""
    num_envs: int = 256
    """Worlds side by side."""
    stop_probability: float = 0.05
    """Probability of the stop in a random step."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_range(self, "n", "num_envs", least=1)
        check_range(self, "stop_probability", least=0, most=1)


@dataclass
class ImitateConfig(FitConfig):
    """Imitation of the labelled demonstrations: phase 1."""

    held_out: float = 0.0
    """Share of the demonstrations that is held out; their likelihood decides when to stop."""
    trials: int = 1
    """Initial weights that are tried; those that imitate best go on."""
    trial_steps: int = 300
    """Steps of each trial."""
    trial_halvings: int = 0
    """How often the better half of the trials goes on for as many steps before the best is chosen
    (successive halving, Jamieson and Talwalkar 2016)."""
    context: int = 0
    """How many neighbouring cells away the policy of ``strong`` sees."""
    words_from: float = 0.0
    """Share of the steps before which words are neither swapped nor penalised (``strong``)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "trials", "trial_steps", least=1)
        check_range(self, "trial_halvings", "context", least=0)
        check_range(self, "words_from", least=0, most=1)
        check_range(self, "held_out", least=0, most=0.999)


@dataclass
class InstructionConfig(FitConfig):
    """The instruction classifier, and how instructions are chosen by it."""

    threshold: float = 0.5
    """Least probability of being suitable with which an instruction is chosen."""
    candidates: int = 64
    """Instructions of the pool that are scored for each state."""
    choose: str = "random"
    """Among those above the threshold: ``random``, or the ``best``."""
    negatives: int = 8
    """Other instructions that each demonstration is contrasted with."""
    near: float = 0.0
    """Share of the negatives that differ from the demonstration's instruction in few words."""
    contrast: float = 0.0
    """Weight of telling the own instruction among the negatives (InfoNCE)."""
    unlabelled: str = "removal"
    """What is done about false negatives: ``removal``, or taken for a ``mixture``."""
    removal_rate: float | None = None
    """Share of the negatives that is taken for suitable; null estimates it."""
    removal_warmup: float = 0.6
    """Share of the steps before false negatives are removed."""
    fresh_states: int = 0
    """With fewer demonstrations than this, as many states of the simulator are negatives too."""
    swap_words: bool = False
    """Whether words are swapped in training (``strong``), for combinations that no demonstration
    names."""
    trials: int = 1
    """Initial weights that are tried; the last trial begins without the policy's roles of words."""
    trial_steps: int = 300
    """Steps of each trial."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("choose", self.choose, CHOICES)
        check_choice("unlabelled", self.unlabelled, UNLABELLED)
        check_range(self, "candidates", "negatives", "trials", "trial_steps", least=1)
        check_range(self, "contrast", "fresh_states", least=0)
        check_range(self, "removal_warmup", least=0, most=1)
        check_range(self, "threshold", "near", "removal_rate", least=0, most=0.999)


@dataclass
class RewardConfig(FitConfig):
    """The reward model of actions (the paper's)."""

    warm_start: bool = True
    """Begin with the weights of the phase-1 policy."""


@dataclass
class GoalConfig(RewardConfig):
    """The goal classifier (an extension)."""


@dataclass
class SelfExamineConfig(SelfExaminationConfig):
    """Self-examination: phase 2."""

    reward: str = "goal"
    """What is paid: ``action``, the paper's reward of every action, or ``goal``, at the stop."""
    num_envs: int = 256
    """Worlds side by side."""
    collectors: int | None = None
    """Workers of a Ray cluster that step an equal share of these worlds each, on one processor;
    null steps them in this process."""
    pairs: int | None = None
    """Starts, each a scene with a chosen instruction, that are stored and cycled through (5,000 or
    10,000 in the paper); null chooses instructions for fresh states all the time."""
    imitation_weight: float = 0.0
    """Weight of the auxiliary imitation loss."""
    reward_steps: int = 0
    """Gradient steps of the reward model in each iteration, with the policy's actions as
    negatives."""
    reward_lr: float = 1e-4
    """Learning rate of these steps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("reward", self.reward, ("action", "goal"))
        check_range(self, "num_envs", "pairs", "collectors", least=1)
        if self.collectors and self.num_envs % self.collectors:
            raise UserError(f"num_envs={self.num_envs} are no {self.collectors} equal shares")
        if self.collectors and self.pairs:
            raise UserError(
                "stored pairs are cycled through in one process: set collectors=null or pairs=null"
            )
        check_range(self, "imitation_weight", "reward_steps", least=0)
        check_range(self, "reward_lr", above=0)


@dataclass
class EvaluateConfig:
    """What is measured of a run; nothing of it is learned from."""

    episodes: int = 2000
    """Scenes in which each policy is played, one episode each."""
    states: int = 4000
    """States for which instructions are chosen and checked against the truth; 0 leaves it out."""
    mode: str = "both"
    """How the policy acts: ``greedy``, ``sampled`` or ``both``."""
    stream: str = "evaluation"
    """Scenes of ``evaluation``, to report, or of ``validation``, to choose by."""
    split: str = "all"
    """Instructions of these scenes: ``all``, ``train`` or ``zero-shot``."""
    seed: int = 0
    """Of the scenes."""
    audit_episodes: int = 1000
    """Episodes in which learned rewards are compared with true success."""
    max_steps: int | None = None
    """Most actions of an episode; null for the world's own limit, 10,000 at most."""

    def __post_init__(self) -> None:
        check_choice("mode", self.mode, (*MODES, "both"))
        check_choice("stream", self.stream, ("validation", "evaluation"))
        check_choice("split", self.split, SPLITS)
        check_range(self, "episodes", "audit_episodes", "max_steps", least=1)
        check_range(self, "states", "seed", least=0)


@dataclass
class ControlsConfig:
    """What phase 2 is compared with: imitation that goes on for as long."""

    run: bool = False
    """Whether ``demo`` trains the control, too."""
    lr: float = 1e-3
    """Its learning rate."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_range(self, "lr", above=0)


@dataclass
class Options:
    """All options; each recipe reads those that concern it."""

    task: str = MISSING
    """``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``; with ``world=babyai`` a
    level; of other worlds, a name."""
    preset: str = MISSING
    """Networks and how they learn: ``strong`` (the best that we know) or ``paper``."""
    budget: str = MISSING
    """How much data and how many steps: ``tiny``, ``few`` or ``many`` by the number of
    demonstrations, ``full`` (the paper's 80,000), or ``demo``, the main job."""
    seed: int = 0
    """Of all randomness."""
    device: str = "cpu"
    """``cpu`` or ``cuda``."""
    threads: int = 1
    """Threads of torch. More can pay for large batches on idle cores, and change results by
    rounding."""
    run: str = "${task}-${preset}-${budget}-seed${seed}"
    """Name of a folder under ``$IFO_GROUNDING_HOME/runs``, or a path."""
    base: str | None = None
    """Another run, whose options and stages up to phase 2 a new run takes over."""
    recorded: str | None = None
    """Folder of demonstrations to learn from, in place of recording any."""
    until: str | None = None
    """Last stage to do, such as ``imitate`` for phase 1 alone; null does all."""
    results: str | None = None
    """Folder for the small file of what was measured."""
    variant: str | None = None
    """What is special about the run, for the name of that file."""
    ray: bool = False
    """Whether a Ray cluster runs the command, and the jobs of ``--multirun`` side by side."""
    references: bool = False
    """Whether ``demo`` also imitates the demonstrator's true actions, to compare with."""
    method: str = "ours"
    """Of ``run baselines``: ``bc``, ``bco``, ``bco-alpha``, ``gail``, ``gail+bc``, ``gaifo``,
    ``agile``, ``agile-chosen``, ``lc-rl``, ``ours``, ``random`` or ``expert``."""
    to: str = "shared"
    """Folder to which ``share`` writes the networks."""
    hub: str | None = None
    """``user/prefix``: ``share`` also sends them to the Hugging Face Hub."""
    logger: str = "csv"
    """``csv``, ``tensorboard``, ``wandb`` or ``none``."""
    progress: bool = True
    """Whether to show progress bars."""
    checkpoint_seconds: float = 15.0
    """Least time between two checkpoints."""
    world: Any = MISSING
    """The world: ``_target_`` names its class, the others are its arguments."""
    networks: NetworksConfig = field(default_factory=NetworksConfig)
    demonstrations: DemonstrationsConfig = field(default_factory=DemonstrationsConfig)
    transitions: TransitionsConfig = field(default_factory=TransitionsConfig)
    inverse: FitConfig = field(default_factory=FitConfig)
    imitate: ImitateConfig = field(default_factory=ImitateConfig)
    instruction: InstructionConfig = field(default_factory=InstructionConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    goal: GoalConfig = field(default_factory=GoalConfig)
    self_examine: SelfExamineConfig = field(default_factory=SelfExamineConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    controls: ControlsConfig = field(default_factory=ControlsConfig)
    baseline: BaselineConfig = field(default_factory=BaselineConfig)

    def __post_init__(self) -> None:
        check_choice("logger", self.logger, LOGGERS)
        check_choice("until", self.until, (None, *STAGES))
        check_choice("method", self.method, METHODS)
        whole("threads", self.threads)
        check_range(self, "threads", least=1, most=1024)
        check_range(self, "checkpoint_seconds", least=0, most=86_400)
        if not str(self.run).strip() or Path(self.run).expanduser().resolve() == Path("/"):
            raise UserError("run needs a name, or the path of a folder")
        if set("/\\\0") & set(self.variant or ""):
            raise UserError(f"variant is part of a file's name, without slashes: {self.variant!r}")
        check_device(self.device)
        if self.results:
            check_folder("results", Path(self.results))
        if self.recorded:
            self.recorded = str(Path(self.recorded))  # without a slash at the end, the same one
