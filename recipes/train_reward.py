"""Train the reward model: which actions are right (paper, 2nd-phase)."""

from _shared import (
    REWARD,
    build,
    learn,
    load_demonstrations,
    load_labels,
    open_stage,
    starting_policy,
    tell,
)

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import labelled_buffer
from ifo_grounding.networks import make_reward_model
from ifo_grounding.objectives import RewardLoss


def train_reward(options: Options) -> dict:
    stage, section = open_stage(options, "train_reward"), options.reward
    if stage.result is not None:
        return stage.result
    buffer = labelled_buffer(load_demonstrations(stage.run), load_labels(stage.run))
    policy = starting_policy(stage.run, options, section.warm_start)
    network = build(make_reward_model, options, init_from=policy)
    return learn(options, stage, RewardLoss(network), buffer, section, REWARD)


@recipe_main
def main(options: Options) -> None:
    tell(train_reward(options))


if __name__ == "__main__":
    main()
