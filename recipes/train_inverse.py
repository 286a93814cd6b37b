"""Train the inverse model: which action lies between two frames (paper, 1st-phase)."""

from _shared import INVERSE, TRANSITIONS, build, learn, open_stage, tell

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import Collected
from ifo_grounding.networks import make_inverse
from ifo_grounding.objectives import InverseLoss


def train_inverse(options: Options) -> dict:
    stage = open_stage(options, "train_inverse")
    if stage.result is not None:
        return stage.result
    transitions = Collected.load(stage.run.need(TRANSITIONS, "collect_transitions"))
    loss = InverseLoss(build(make_inverse, options))
    return learn(options, stage, loss, transitions.buffer, options.inverse, INVERSE)


@recipe_main
def main(options: Options) -> None:
    tell(train_inverse(options))


if __name__ == "__main__":
    main()
