"""Imitate the labelled demonstrations: phase 1, which is BCO (paper, 1st-phase)."""

from _shared import POLICIES, build, load_demonstrations, load_labels, open_stage, train
from omegaconf import DictConfig
from torchrl.data import ReplayBuffer

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import labelled_buffer
from ifo_grounding.networks import make_policy
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import HeldOut
from ifo_grounding.training.run import Run


def imitate(options: DictConfig) -> dict:
    stage = open_stage(options, "imitate", ["imitate"], needs=["label"])
    if stage.result is not None:
        return stage.result
    loss = ImitationLoss(build(make_policy, options))
    seen, held_out = labelled_demonstrations(stage.run, options.imitate.held_out)
    validation = HeldOut(loss, held_out) if held_out is not None else None
    return train(options, stage, loss, seen, "imitate", POLICIES[0], held_out=validation)


def labelled_demonstrations(run: Run, share: float) -> tuple[ReplayBuffer, ReplayBuffer | None]:
    """Return the labelled transitions to learn from, and those of the share held out."""
    demos, actions = load_demonstrations(run), load_labels(run).actions
    seen = demos[: len(demos) - round(share * len(demos))]
    aside = demos[len(seen) :]
    split = seen.transitions
    held_out = labelled_buffer(aside, actions[split:]) if len(aside) else None
    return labelled_buffer(seen, actions[:split]), held_out


@recipe_main
def main(options: DictConfig) -> None:
    print(imitate(options))


if __name__ == "__main__":
    main()
