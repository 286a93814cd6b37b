"""What phase 2 has to beat: its compute spent on imitation, and cloning what the judge accepts."""

import math
import sys
from collections.abc import Callable
from typing import Any

import torch
from _learning import self_examination_config, train
from _options import as_made
from _shared import CONTROLS, POLICIES, load_network, open_stage, tell
from imitate import labelled_demonstrations
from omegaconf import DictConfig, OmegaConf
from self_examine import guard_of, judge_learns, needs, practice
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase

from ifo_grounding.cli import recipe_main
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import (
    FitConfig,
    NothingAcceptedError,
    Rehearsal,
    Selection,
    Stage,
    accepted_steps,
)

SECTIONS = ["imitate", "self_examine", "instruction", "controls"]


def continue_imitation(options: DictConfig) -> dict:
    """Imitate the demonstrations for as long again as phase 2 takes."""
    stage = open_stage(options, "continue_imitation", SECTIONS, needs(options))
    if stage.result is None:
        imitate_on(options, stage, CONTROLS[0])
    return stage.result or {}


def clone_accepted(options: DictConfig) -> dict:
    """Imitate the demonstrations and the rollouts of phase 1 that the judge accepts."""
    stage = open_stage(options, "clone_accepted", SECTIONS, needs(options))

    def rollouts(env: EnvBase) -> TensorDict:
        section = options.self_examine
        return accepted_steps(
            env,
            load_network(stage.run, POLICIES[0], "imitate", options),
            iterations=section.iterations,
            steps=section.steps,
            seed=options.seed,
            threshold=options.controls.accept,
        )

    if stage.result is None:
        imitate_on(options, stage, CONTROLS[1], rollouts)
    return stage.result or {}


def imitate_on(
    options: DictConfig,
    stage: Stage,
    file: str,
    rollouts: Callable[[EnvBase], TensorDict] | None = None,
) -> dict[str, Any]:
    """Train the phase-1 policy on, with as many gradient samples as phase 2, and save it.

    The weights to keep are chosen as phase 2 chooses its own: by the same measure of the greedy
    policy, as often, on the same episodes.
    """
    section = options.self_examine
    policy = load_network(stage.run, POLICIES[0], "imitate", options)
    env, _, _ = practice(stage.run, options)
    settings: dict[str, Any] = {"steps": matched_steps(options), "lr": options.controls.lr}
    buffer, aside = labelled_demonstrations(stage.run, options.imitate.held_out)
    selection = None
    if section.select_every:
        # Before any rollout, so that it remembers the first starts.
        chosen = self_examination_config(section)
        guard = guard_of(policy, aside, stage.run, options)
        by_agreement = judge_learns(options)
        selection = Selection(
            env, policy, chosen.selection, options.seed, guard, by_agreement=by_agreement
        )
        selection.look()  # phase 1 itself is the one to beat
        looks = math.ceil(section.iterations / section.select_every)
        iteration = options.imitate.get("iteration", FitConfig.iteration)
        settings["validate_every"] = math.ceil(settings["steps"] / iteration / looks)
    found = {}
    if rollouts is not None:
        accepted = rollouts(env)
        buffer = Both(buffer, accepted)
        found["accepted"] = float(len(accepted))
    longer = options.copy()
    OmegaConf.set_struct(longer, False)  # not every budget names all settings
    longer.imitate.update(settings)
    loss = ImitationLoss(policy)
    return train(longer, stage, loss, buffer, "imitate", file, held_out=selection, **found)


def matched_steps(options: DictConfig) -> int:
    """Return how many batches of imitation are as many gradient samples as phase 2 takes.

    Every step that phase 2 collects passes policy and critic in each epoch, and the policy once
    more when it is played, which costs a third of a gradient. What it rehearses comes on top.
    """
    section = options.self_examine
    collected = section.iterations * section.num_envs * section.steps
    epochs = section.epochs if section.algorithm == "ppo" else 1
    samples = collected * (2 * epochs + 1 / 3)
    if section.rehearsal:
        samples += collected / section.minibatch * epochs * Rehearsal.batch_size
    return round(samples / options.imitate.batch_size)


class Both:
    """Samples half of each batch from demonstrations and half from rollouts."""

    def __init__(self, demonstrations: Any, rollouts: TensorDict) -> None:
        self.demonstrations = demonstrations
        self.rollouts = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rollouts)))
        self.rollouts.extend(rollouts)

    def __len__(self) -> int:
        return len(self.demonstrations) + len(self.rollouts)

    def sample(self, batch_size: int) -> TensorDict:
        """Return transitions, [batch_size]."""
        entries = ("pixels", "instruction", "action")
        halves = (batch_size // 2, batch_size - batch_size // 2)
        parts = (self.demonstrations.sample(halves[0]), self.rollouts.sample(halves[1]))
        return torch.cat([part.select(*entries) for part in parts])


def run_controls(options: DictConfig) -> list[dict]:
    """Make both controls, or without ``controls.clone`` the first."""
    results = [continue_imitation(options)]
    if options.controls.clone:
        try:
            results.append(clone_accepted(options))
        except NothingAcceptedError as error:
            print(f"note: nothing is cloned, for {error}", file=sys.stderr)
    return results


@recipe_main
def main(options: DictConfig) -> None:
    for result in run_controls(as_made(options)):
        tell(result)


if __name__ == "__main__":
    main()
