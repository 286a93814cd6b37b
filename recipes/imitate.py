"""Imitate the labelled demonstrations: phase 1, which is BCO (paper, 1st-phase)."""

import math
from collections.abc import Callable

from _learning import Beginning, beginning_seed
from _shared import POLICIES, load_demonstrations, load_labels, open_stage, tell
from _values import count_held_out
from _worlds import build, context_of
from omegaconf import DictConfig
from torch import Tensor
from torchrl.data import ReplayBuffer

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import Demonstrations, labelled_buffer
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_policy
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import Run, Stage


def imitate(options: DictConfig) -> dict:
    stage = open_stage(options, "imitate", ["imitate"], needs=["label"])
    if stage.result is not None:
        return stage.result
    seen, held_out = labelled_demonstrations(stage.run, options.imitate.held_out)
    return imitate_transitions(options, stage, seen, held_out, POLICIES[0])


def imitate_transitions(
    options: DictConfig,
    stage: Stage,
    seen: ReplayBuffer,
    held_out: ReplayBuffer | None,
    file: str,
) -> dict:
    """Imitate transitions with their actions, from the best of a few initial weights."""
    return best_beginning(options, stage, seen, held_out).train(file)


def imitation(options: DictConfig, seed: int) -> ImitationLoss:
    """Return the loss of a policy with the initial weights of a seed."""
    context = context_of(options, "imitate")
    policy = build(make_policy, options, seed=seed, context=context)
    return ImitationLoss(policy, words_from=options.imitate.get("strict_from", 0.0))


def best_beginning(
    options: DictConfig,
    stage: Stage,
    seen: ReplayBuffer,
    held_out: ReplayBuffer | None,
    imitation: Callable[[DictConfig, int], ImitationLoss] = imitation,
) -> Beginning:
    """Try a few initial weights, and return those that imitate best so far.

    Successive halving (Jamieson and Talwalkar 2016): those of the better half learn on for as many
    steps, as often as ``imitate.trial_halvings`` says, before the best are chosen.
    """

    def beginning(number: int) -> Beginning:
        loss = imitation(options, beginning_seed(options, number))
        return Beginning(options, stage, "imitate", loss, seen, number, held_out)

    beginnings = [beginning(number) for number in range(options.imitate.trials)]
    for times in range(1, options.imitate.get("trial_halvings", 0) + 2):
        losses = {each: each.try_out(times) for each in beginnings}
        beginnings = sorted(losses, key=lambda each: losses[each])[: math.ceil(len(losses) / 2)]
    return beginnings[0]


def labelled_demonstrations(run: Run, share: float) -> tuple[ReplayBuffer, ReplayBuffer | None]:
    """Return the labelled transitions to learn from, and those of the share held out."""
    demos = load_demonstrations(run)
    return split_transitions(demos, load_labels(run).actions, share)


def split_transitions(
    demos: Demonstrations, actions: Tensor, share: float
) -> tuple[ReplayBuffer, ReplayBuffer | None]:
    """Return transitions with their actions to learn from, and those of the share held out.

    Raises:
        UserError: where nothing is left to learn from or held out, or actions are of others.
    """
    seen = demos[: len(demos) - count_held_out(share, len(demos))]
    aside = demos[len(seen) :]
    if len(actions) != demos.transitions:
        raise UserError(
            f"there are {len(actions)} actions for {demos.transitions} transitions: run the recipe "
            "that labels the demonstrations again"
        )
    split = seen.transitions
    held_out = labelled_buffer(aside, actions[split:]) if len(aside) else None
    return labelled_buffer(seen, actions[:split]), held_out


@recipe_main
def main(options: DictConfig) -> None:
    tell(imitate(options))


if __name__ == "__main__":
    main()
