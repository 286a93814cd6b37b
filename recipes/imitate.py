"""Imitate the labelled demonstrations: phase 1, which is BCO (paper, 1st-phase)."""

from dataclasses import replace
from typing import Any

from _shared import (
    POLICIES,
    REFERENCE,
    TRUTH,
    build,
    fit_options,
    keep,
    load_demonstrations,
    load_labels,
    open_stage,
    read_fast,
    tell,
)
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.modules import ProbabilisticActor

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import Demonstrations, Truth, labelled_buffer
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_policy
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import EarlyStopping, Run, Stage, Trial, successive_halving, trial_seed
from ifo_grounding.training.parallel import rank, together


def imitate(options: Options) -> dict:
    stage = open_stage(options, "imitate")
    if stage.result is not None:
        return stage.result
    seen, held_out = labelled_demonstrations(stage.run, options.imitate.held_out)
    return imitate_transitions(options, stage, seen, held_out, POLICIES["phase1"])


def imitate_truth(options: Options) -> dict:
    """Imitate as phase 1 does, with the demonstrator's actions in place of labels."""
    stage = open_stage(options, "imitate_truth")
    if stage.result is not None:
        return stage.result
    demos, truth = load_demonstrations(stage.run), true_actions(stage.run)
    seen, held_out = split_transitions(demos, truth.actions, options.imitate.held_out)
    return imitate_transitions(options, stage, seen, held_out, REFERENCE)


def true_actions(run: Run) -> Truth:
    """Load the demonstrator's actions.

    Raises:
        UserError: where they were not recorded.
    """
    if not (run / TRUTH).exists():
        raise UserError(
            f"{run / TRUTH} is missing: demonstrations that were recorded elsewhere hold no true "
            "actions to learn from"
        )
    return Truth.load(run / TRUTH)


def imitate_transitions(
    options: Options,
    stage: Stage,
    seen: ReplayBuffer,
    held_out: ReplayBuffer | None,
    file: str,
    **found: Any,
) -> dict:
    """Imitate transitions with their actions, from the best of a few initial weights.

    What else was found goes into the stage's record.
    """
    section = options.imitate
    read_fast(seen, options)

    def trial(number: int) -> Trial:
        policy = new_policy(options, trial_seed(options.seed, number))
        loss = ImitationLoss(policy, words_from=section.words_from)
        stopping = EarlyStopping(loss, held_out) if held_out is not None else None
        checkpoint = stage.trial(number)
        return Trial(
            number,
            loss,
            seen,
            section,
            checkpoint,
            held_out=stopping,
            **fit_options(options, stage),
        )

    trials = [trial(number) for number in range(section.trials)]
    best = successive_halving(trials, section.trial_steps, section.trial_halvings)
    return keep(options, stage, best, file, **found)


def new_policy(options: Options, seed: int) -> ProbabilisticActor:
    """Build a policy that sees as many neighbouring cells as the options say."""
    return build(make_policy, options, seed=seed, context=options.imitate.context)


def labelled_demonstrations(run: Run, share: float) -> tuple[ReplayBuffer, ReplayBuffer | None]:
    """Return the labelled transitions to learn from, and those of the share held out."""
    return split_transitions(load_demonstrations(run), load_labels(run), share)


def split_transitions(
    demos: Demonstrations, actions: Tensor, share: float
) -> tuple[ReplayBuffer, ReplayBuffer | None]:
    """Return transitions with their actions to learn from, and those of the share held out.

    Raises:
        UserError: where nothing is left to learn from or held out, or actions are of others.
    """
    number = round(share * len(demos))
    if share and not 0 < number < len(demos):
        raise UserError(
            f"imitate.held_out={share} of {len(demos)} demonstrations holds out {number}: some "
            "have to be held out, and some left to learn from"
        )
    if len(actions) != demos.transitions:
        raise UserError(
            f"there are {len(actions)} actions for {demos.transitions} transitions: run the recipe "
            "that labels the demonstrations again"
        )
    seen, aside = demos[: len(demos) - number], demos[len(demos) - number :]
    split = seen.transitions
    held_out = labelled_buffer(aside, actions[split:]) if number else None
    return labelled_buffer(seen, actions[:split]), held_out


@recipe_main
def main(options: Options) -> None:
    with together(options.run, options.device) as (run, device):
        shown = options.progress and not rank()
        tell(imitate(replace(options, run=run, device=device, progress=shown)))


if __name__ == "__main__":
    main()
