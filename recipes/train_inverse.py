"""Train the inverse module: which action lies between two frames (paper, 1st-phase)."""

from _learning import train
from _shared import INVERSE, RANDOM_STEPS, open_stage, tell
from _worlds import build
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import Collected
from ifo_grounding.networks import make_inverse
from ifo_grounding.objectives import InverseLoss


def train_inverse(options: DictConfig) -> dict:
    stage = open_stage(options, "train_inverse", ["inverse"], needs=["collect_transitions"])
    if stage.result is not None:
        return stage.result
    transitions = Collected.load(stage.run.need(RANDOM_STEPS, "collect_transitions"))
    loss = InverseLoss(build(make_inverse, options))
    return train(options, stage, loss, transitions.buffer, "inverse", INVERSE)


@recipe_main
def main(options: DictConfig) -> None:
    tell(train_inverse(options))


if __name__ == "__main__":
    main()
