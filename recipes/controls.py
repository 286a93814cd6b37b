"""What phase 2 has to beat: its compute spent on imitation, and cloning what the judge accepts."""

from typing import Any

import torch
from _shared import (
    CONTROLS,
    POLICIES,
    load_network,
    open_stage,
    train,
)
from imitate import labelled_demonstrations
from omegaconf import DictConfig, OmegaConf
from self_examine import practice
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ifo_grounding.cli import recipe_main
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import HeldOut, Stage, accepted_steps


def continue_imitation(options: DictConfig) -> dict:
    """Imitate the demonstrations for as long again as phase 2 takes."""
    needs = ["imitate"]
    stage = open_stage(
        options, "continue_imitation", ["imitate", "self_examine", "controls"], needs
    )
    if stage.result is None:
        imitate_on(options, stage, CONTROLS[0], None)
    return stage.result or {}


def clone_accepted(options: DictConfig) -> dict:
    """Imitate the demonstrations and the rollouts of phase 1 that the judge accepts."""
    needs = ["imitate", "train_instruction", "train_goal"]
    sections = ["imitate", "self_examine", "instruction", "controls"]
    stage = open_stage(options, "clone_accepted", sections, needs)
    if stage.result is None:
        section, run = options.self_examine, stage.run
        env, _, _ = practice(run, options)
        rollouts = accepted_steps(
            env,
            load_network(run, POLICIES[0], "imitate", options),
            iterations=section.iterations,
            steps=section.steps,
            seed=options.seed,
            threshold=options.controls.accept,
        )
        imitate_on(options, stage, CONTROLS[1], rollouts)
    return stage.result or {}


def imitate_on(
    options: DictConfig, stage: Stage, file: str, rollouts: TensorDict | None
) -> dict[str, Any]:
    """Train the phase-1 policy on, with as many gradient samples as phase 2, and save it."""
    run = stage.run
    policy = load_network(run, POLICIES[0], "imitate", options)
    loss = ImitationLoss(policy)
    buffer, aside = labelled_demonstrations(run, options.imitate.held_out)
    validation = HeldOut(loss, aside) if aside is not None else None
    if validation is not None:
        validation.look()  # phase 1 itself is the one to beat
    if rollouts is not None:
        buffer = Both(buffer, rollouts)
    settings = {"imitate": {"steps": matched_steps(options), "lr": options.controls.lr}}
    accepted = {} if rollouts is None else {"accepted": float(len(rollouts))}
    longer = OmegaConf.merge(options, settings)
    return train(longer, stage, loss, buffer, "imitate", file, held_out=validation, **accepted)


def matched_steps(options: DictConfig) -> int:
    """Return how many batches of imitation are as many gradient samples as phase 2 takes.

    Every step that phase 2 collects passes policy and critic in each epoch, and the policy once
    more when it is played, which costs a third of a gradient.
    """
    section = options.self_examine
    collected = section.iterations * section.num_envs * section.steps
    return round(collected * (2 * section.epochs + 1 / 3) / options.imitate.batch_size)


class Both:
    """Samples half of each batch from demonstrations and half from rollouts."""

    def __init__(self, demonstrations: Any, rollouts: TensorDict) -> None:
        self.demonstrations = demonstrations
        self.rollouts = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rollouts)))
        self.rollouts.extend(rollouts)

    def sample(self, batch_size: int) -> TensorDict:
        """Return transitions, [batch_size]."""
        entries = ("pixels", "instruction", "action")
        halves = (batch_size // 2, batch_size - batch_size // 2)
        parts = (self.demonstrations.sample(halves[0]), self.rollouts.sample(halves[1]))
        return torch.cat([part.select(*entries) for part in parts])


@recipe_main
def main(options: DictConfig) -> None:
    print(continue_imitation(options))
    print(clone_accepted(options))


if __name__ == "__main__":
    main()
