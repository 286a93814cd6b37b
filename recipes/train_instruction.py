"""Train the instruction module: which instructions suit a scene (paper, 2nd-phase)."""

import math

import torch
from _shared import (
    CLASSIFIER,
    load_demonstrations,
    open_stage,
    starting_policy,
    train,
)
from _worlds import build, context_of, open_world
from omegaconf import DictConfig
from torch import Tensor

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import first_frame_buffer
from ifo_grounding.keys import PIXELS
from ifo_grounding.networks import make_instruction_classifier
from ifo_grounding.objectives import InstructionLoss

STATES_AT_ONCE = 256


def train_instruction(options: DictConfig) -> dict:
    needs = [
        "record_demonstrations",
        *(["imitate"] if options.instruction.init_from_policy else []),
    ]
    stage = open_stage(options, "train_instruction", ["instruction"], needs)
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    policy = starting_policy(stage.run, options, "instruction")
    context = context_of(options, "imitate") if policy is not None else 0
    loss = InstructionLoss(
        build(make_instruction_classifier, options, init_from=policy, context=context),
        demos.pool(),
        negatives=options.instruction.negatives,
        removal_rate=options.instruction.removal_rate,
        warmup=options.instruction.removal_warmup,
        contrast=options.instruction.contrast,
        unlabelled=options.instruction.unlabelled,
        near=options.instruction.near,
        states=fresh_states(options, len(demos)),
        strict=options.instruction.strict,
    )
    calibrate = loss.calibrate if options.instruction.removal_rate == "estimated" else None
    buffer = first_frame_buffer(demos)
    return train(options, stage, loss, buffer, "instruction", CLASSIFIER, finish=calibrate)


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
    print(train_instruction(options))


if __name__ == "__main__":
    main()
