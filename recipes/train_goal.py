"""Train the goal classifier: whether an instruction is fulfilled (an extension of the paper)."""

from _shared import GOAL, build, learn, load_demonstrations, open_stage, starting_policy, tell

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import goal_buffer
from ifo_grounding.networks import make_goal_classifier
from ifo_grounding.objectives import GoalLoss


def train_goal(options: Options) -> dict:
    stage, section = open_stage(options, "train_goal"), options.goal
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    policy = starting_policy(stage.run, options, section.warm_start)
    loss = GoalLoss(build(make_goal_classifier, options, init_from=policy), demos.pool())
    return learn(options, stage, loss, goal_buffer(demos), section, GOAL)


@recipe_main
def main(options: Options) -> None:
    tell(train_goal(options))


if __name__ == "__main__":
    main()
