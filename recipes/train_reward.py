"""Train the reward module: which actions are right (paper, 2nd-phase)."""

from _learning import train
from _shared import REWARD, load_demonstrations, load_labels, open_stage, starting_policy, tell
from _worlds import build, context_of
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import labelled_buffer
from ifo_grounding.networks import make_reward_model
from ifo_grounding.objectives import RewardLoss


def train_reward(options: DictConfig) -> dict:
    needs = ["label", *(["imitate"] if options.reward.init_from_policy else [])]
    stage = open_stage(options, "train_reward", ["reward"], needs)
    if stage.result is not None:
        return stage.result
    buffer = labelled_buffer(load_demonstrations(stage.run), load_labels(stage.run).actions)
    policy = starting_policy(stage.run, options, "reward")
    context = context_of(options, "imitate") if policy is not None else 0
    loss = RewardLoss(build(make_reward_model, options, init_from=policy, context=context))
    return train(options, stage, loss, buffer, "reward", REWARD)


@recipe_main
def main(options: DictConfig) -> None:
    tell(train_reward(options))


if __name__ == "__main__":
    main()
