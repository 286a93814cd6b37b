"""Train the instruction module: which instructions suit a scene (paper, 2nd-phase)."""

import math

import torch
from _learning import Beginning, beginning_seed
from _shared import (
    CLASSIFIER,
    OF_CHOICE,
    load_demonstrations,
    open_stage,
    starting_policy,
    tell,
)
from _worlds import build, context_of, open_world
from omegaconf import DictConfig
from torch import Tensor

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import Demonstrations, first_frame_buffer
from ifo_grounding.keys import PIXELS
from ifo_grounding.networks import make_instruction_classifier
from ifo_grounding.objectives import InstructionLoss
from ifo_grounding.training import Run

STATES_AT_ONCE = 256
CLEARLY = 0.9


def train_instruction(options: DictConfig) -> dict:
    needs = [
        "record_demonstrations",
        *(["imitate"] if options.instruction.init_from_policy else []),
    ]
    stage = open_stage(options, "train_instruction", ["instruction"], needs, without=OF_CHOICE)
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    states = fresh_states(options, len(demos))
    seen = first_frame_buffer(demos)
    beginnings = [
        Beginning(options, stage, "instruction", loss, seen, number)
        for number, loss in enumerate(losses(options, stage.run, demos, states))
    ]
    best = clearly_best(beginnings)
    estimated = options.instruction.removal_rate == "estimated"
    return best.train(CLASSIFIER, finish=best.loss.calibrate if estimated else None)


def losses(
    options: DictConfig, run: Run, demos: Demonstrations, states: Tensor | None
) -> list[InstructionLoss]:
    """Return a loss for each way to begin: the last one without the policy's roles of words."""
    section = options.instruction
    policy = starting_policy(run, options, "instruction")
    context = context_of(options, "imitate") if policy is not None else 0
    pool = demos.pool()
    likely = [(True, beginning_seed(options, number)) for number in range(section.trials - 1)]
    return [
        InstructionLoss(
            build(
                make_instruction_classifier,
                options,
                init_from=policy,
                roles=roles,
                context=context,
                seed=seed,
            ),
            pool,
            negatives=section.negatives,
            removal_rate=section.removal_rate,
            warmup=section.removal_warmup,
            contrast=section.contrast,
            unlabelled=section.unlabelled,
            near=section.near,
            states=states,
            strict=section.strict,
        )
        for roles, seed in [*likely, (False, options.seed)]
    ]


def clearly_best(beginnings: list[Beginning]) -> Beginning:
    """Try beginnings out, and return the best; the last one only if it is better by a tenth."""
    *likely, last = beginnings
    if not likely:
        return last
    tried = [(beginning.try_out(), beginning) for beginning in likely]
    least, best = min(tried, key=lambda pair: pair[0])
    return last if last.try_out() < CLEARLY * least else best


def fresh_states(options: DictConfig, demonstrations: int) -> Tensor | None:
    """Return first frames of the simulator, where there are fewer demonstrations than asked for."""
    wanted = options.instruction.fresh_states
    if demonstrations >= wanted:
        return None
    simulator = open_world(options).simulator(min(wanted, STATES_AT_ONCE))
    frames = [simulator.reset()[PIXELS] for _ in range(math.ceil(wanted / STATES_AT_ONCE))]
    return torch.cat(frames)[:wanted]


@recipe_main
def main(options: DictConfig) -> None:
    tell(train_instruction(options))


if __name__ == "__main__":
    main()
