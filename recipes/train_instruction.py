"""Train the instruction classifier: which instructions suit a scene (paper, 2nd-phase)."""

import math

import torch
from _shared import (
    CLASSIFIER,
    POLICIES,
    build,
    coded_simulator,
    fit_options,
    keep,
    load_demonstrations,
    load_network,
    open_stage,
    read_fast,
    tell,
)
from torch import Tensor

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import Demonstrations, first_frame_buffer
from ifo_grounding.keys import PIXELS
from ifo_grounding.networks import make_instruction_classifier
from ifo_grounding.objectives import InstructionLoss
from ifo_grounding.progress import progress_bar
from ifo_grounding.training import Run, Trial, trial_seed

STATES_AT_ONCE = 256
CLEARLY = 0.9


def train_instruction(options: Options) -> dict:
    stage, section = open_stage(options, "train_instruction"), options.instruction
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    states, seen = fresh_states(options, len(demos)), first_frame_buffer(demos)
    read_fast(seen, options)
    trials = [
        Trial(number, loss, seen, section, stage.trial(number), **fit_options(options, stage))
        for number, loss in enumerate(losses(options, stage.run, demos, states))
    ]
    best = clearly_best(trials, section.trial_steps)
    return keep(options, stage, best, CLASSIFIER, calibrate=section.removal_rate is None)


def losses(
    options: Options, run: Run, demos: Demonstrations, states: Tensor | None
) -> list[InstructionLoss]:
    """Return the loss of each trial: the last one begins without the policy's roles of words."""
    section, pool = options.instruction, demos.pool()
    policy = load_network(run, POLICIES["phase1"], options)
    likely = [(True, trial_seed(options.seed, number)) for number in range(section.trials - 1)]
    return [
        InstructionLoss(
            build(make_instruction_classifier, options, init_from=policy, roles=roles, seed=seed),
            pool,
            negatives=section.negatives,
            removal_rate=section.removal_rate,
            warmup=section.removal_warmup,
            contrast=section.contrast,
            unlabelled=section.unlabelled,
            near=section.near,
            states=states,
            swap_words=section.swap_words,
        )
        for roles, seed in [*likely, (False, options.seed)]
    ]


def clearly_best(trials: list[Trial], steps: int) -> Trial:
    """Return the best trial; the last one only if it is better than the others by a tenth."""
    *likely, last = trials
    if not likely:
        return last
    tried = {trial: trial.learn(steps) for trial in progress_bar(likely, desc="trials")}
    best = min(tried, key=lambda trial: tried[trial])
    return last if last.learn(steps) < CLEARLY * tried[best] else best


def fresh_states(options: Options, demonstrations: int) -> Tensor | None:
    """Return first frames of the simulator, where there are fewer demonstrations than asked for."""
    wanted = options.instruction.fresh_states
    if demonstrations >= wanted:
        return None
    simulator = coded_simulator(options, min(wanted, STATES_AT_ONCE))
    frames = [simulator.reset()[PIXELS] for _ in range(math.ceil(wanted / STATES_AT_ONCE))]
    return torch.cat(frames)[:wanted]


@recipe_main
def main(options: Options) -> None:
    tell(train_instruction(options))


if __name__ == "__main__":
    main()
