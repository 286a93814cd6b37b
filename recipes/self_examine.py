"""Self-examination: practise chosen instructions under a learned reward (paper, Algorithm 1)."""

from typing import Any

import torch
from _audit import audit_callback
from _learning import self_examination_config
from _shared import (
    CLASSIFIER,
    GOAL,
    POLICIES,
    REWARD,
    load_demonstrations,
    load_labels,
    load_network,
    need_current,
    open_stage,
    practised_pool,
    shows_progress,
    tell,
)
from _worlds import build, context_of, open_world
from imitate import labelled_demonstrations
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding import networks
from ifo_grounding.cli import recipe_main
from ifo_grounding.data import labelled_buffer
from ifo_grounding.objectives import ImitationLoss, RewardLoss
from ifo_grounding.training import Adversary, Guard, Rehearsal, select_pairs, self_examine
from ifo_grounding.training.run import Run
from ifo_grounding.transforms import InstructionSampler, LearnedReward, StartingPairs


def examine(options: DictConfig) -> dict:
    section = options.self_examine
    stage = open_stage(options, "self_examine", ["self_examine", "instruction"], needs(options))
    if stage.result is not None:
        return stage.result
    run = stage.run
    policy = load_network(run, POLICIES[0], "imitate", options)
    context = context_of(options, "imitate")
    value = build(networks.make_value, options, init_from=policy, context=context)
    env, reward, adversary = practice(run, options)
    seen, aside = labelled_demonstrations(run, options.imitate.held_out)
    weight = section.rehearsal
    rehearsed = Rehearsal(ImitationLoss(policy), seen, weight) if weight else None
    history = self_examine(
        env,
        policy,
        value,
        self_examination_config(section),
        seed=options.seed,
        adversary=adversary,
        rehearsal=rehearsed,
        guard=guard_of(policy, aside, run, options),
        checkpoint=stage.checkpoint,
        log=stage.log(),
        callback=audit_callback(policy, reward, run, options),
        progress=shows_progress(options),
        settings=stage.settings,
    )
    stage.replace()
    networks.save(policy, run / POLICIES[1])
    return stage.finish(history[-1], history)


def judge_learns(options: DictConfig) -> bool:
    """Whether the judge of actions is trained on while the policy practises."""
    return options.self_examine.kind != "goal" and options.self_examine.reward_steps > 0


def guard_of(
    policy: TensorDictModuleBase, aside: ReplayBuffer | None, run: Run, options: DictConfig
) -> Guard | None:
    """Return what asks demonstrations whether the policy goes astray.

    They are those held out. Where none are, but agreement has to decide, since the judge learns on,
    they are as many of those learned from as episodes would be looked at.
    """
    section = options.self_examine
    if aside is None and section.select_every and judge_learns(options):
        demos = load_demonstrations(run)[: section.select_episodes]
        aside = labelled_buffer(demos, load_labels(run).actions[: demos.transitions])
    return Guard(policy, aside) if aside is not None else None


def needs(options: DictConfig) -> list[str]:
    """Return the stages that practice builds on."""
    judges = {"action": ["train_reward"], "goal": ["train_goal"]}.get(
        options.self_examine.kind, ["train_reward", "train_goal"]
    )
    return ["imitate", "train_instruction", *judges]


def practice(
    run: Run, options: DictConfig
) -> tuple[TransformedEnv, LearnedReward, Adversary | None]:
    """Return the env to practise in, its reward and, where that is to be trained on, what does.

    Raises:
        UserError: where a judge or the choice of instructions is of another phase 1.
    """
    need_current(run, needs(options))
    reward, adversary = learned_reward(run, options)
    simulator = open_world(options).simulator(options.self_examine.num_envs)
    env = TransformedEnv(simulator, Compose(chosen_starts(run, options), reward))
    return env, reward, adversary


def learned_reward(run: Run, options: DictConfig) -> tuple[LearnedReward, Adversary | None]:
    """Return the reward of the chosen kind and, where it is to be trained on, what does so."""
    section = options.self_examine
    judges: dict[str, Any] = {}
    adversary = None
    if section.kind != "goal":
        judges["action"] = load_network(run, REWARD, "train_reward", options)
    if section.kind != "action":
        judges["goal"] = load_network(run, GOAL, "train_goal", options)
    if judge_learns(options):
        demos = labelled_buffer(load_demonstrations(run), load_labels(run).actions)
        adversary = Adversary(
            RewardLoss(judges["action"]), demos, section.reward_steps, section.reward_lr
        )
    model, *rest = judges.values()
    reward = LearnedReward(
        model,
        section.kind,
        form=section.form,
        goal_model=rest[0] if rest else None,
        stop_action=open_world(options).stop,
    )
    return reward, adversary


def chosen_starts(run: Run, options: DictConfig) -> InstructionSampler | StartingPairs:
    """Return fresh states with chosen instructions, or the paper's fixed number of pairs."""
    classifier = load_network(run, CLASSIFIER, "train_instruction", options)
    pool = practised_pool(run, options)
    section = options.instruction
    chosen = {name: section[name] for name in ("threshold", "candidates", "choose")}
    if options.self_examine.pairs is None:
        return InstructionSampler(classifier, pool, **chosen)
    with torch.no_grad():
        pairs = select_pairs(
            open_world(options).simulator(options.self_examine.num_envs),
            classifier,
            pool,
            options.self_examine.pairs,
            seed=options.seed,
            progress=shows_progress(options),
            **chosen,
        )
    return StartingPairs(pairs)


@recipe_main
def main(options: DictConfig) -> None:
    tell(examine(options))


if __name__ == "__main__":
    main()
