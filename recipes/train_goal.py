"""Train the goal judge: whether an instruction is fulfilled (an extension of the paper)."""

from _learning import train
from _shared import GOAL, load_demonstrations, open_stage, starting_policy, tell
from _worlds import build, context_of
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import goal_buffer
from ifo_grounding.networks import make_goal_classifier
from ifo_grounding.objectives import GoalLoss


def train_goal(options: DictConfig) -> dict:
    needs = ["record_demonstrations", *(["imitate"] if options.goal.init_from_policy else [])]
    # Runs without near negatives go on as they were before there were any.
    without = () if options.goal.near else ("goal.near",)
    stage = open_stage(options, "train_goal", ["goal"], needs, without=without)
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    policy = starting_policy(stage.run, options, "goal")
    context = context_of(options, "goal")
    loss = GoalLoss(
        build(make_goal_classifier, options, init_from=policy, context=context),
        demos.pool(),
        negatives=options.goal.negatives,
        removal_rate=options.goal.removal_rate,
        near=options.goal.near,
    )
    return train(options, stage, loss, goal_buffer(demos), "goal", GOAL)


@recipe_main
def main(options: DictConfig) -> None:
    tell(train_goal(options))


if __name__ == "__main__":
    main()
