"""Imitate the labelled demonstrations: phase 1, which is BCO (paper, 1st-phase)."""

from _shared import POLICIES, build, load_demonstrations, load_labels, open_stage, train
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import labelled_buffer
from ifo_grounding.networks import make_policy
from ifo_grounding.objectives import ImitationLoss


def imitate(options: DictConfig) -> dict:
    stage = open_stage(options, "imitate", ["imitate"], needs=["label"])
    if stage.result is not None:
        return stage.result
    buffer = labelled_buffer(load_demonstrations(stage.run), load_labels(stage.run).actions)
    loss = ImitationLoss(build(make_policy, options))
    return train(options, stage, loss, buffer, "imitate", POLICIES[0])


@recipe_main
def main(options: DictConfig) -> None:
    print(imitate(options))


if __name__ == "__main__":
    main()
