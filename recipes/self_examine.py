"""Self-examination: chosen instructions, a learned reward, policy gradient (paper, Algorithm 1)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from _shared import (
    CLASSIFIER,
    GOAL,
    PAIRS,
    POLICIES,
    REWARD,
    VALUE,
    build,
    checksums,
    chosen_by,
    coded_simulator,
    finish,
    load_demonstrations,
    load_labels,
    load_network,
    open_stage,
    read_fast,
    save_network,
    tell,
    world_of,
)
from evaluate import audit_callback
from imitate import labelled_demonstrations
from tensordict import TensorDict
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, EnvBase, TransformedEnv

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options, SelfExamineConfig
from ifo_grounding.data import labelled_buffer
from ifo_grounding.data.folder import load_folder, save_folder
from ifo_grounding.keys import INSTRUCTION, SCENE
from ifo_grounding.networks import make_value
from ifo_grounding.objectives import ImitationLoss, RewardLoss
from ifo_grounding.training import (
    AdversarialUpdates,
    AuxiliaryImitation,
    HeldOutAccuracy,
    Run,
    select_pairs,
    self_examine,
)
from ifo_grounding.transforms import GoalReward, InstructionSampler, LearnedReward, StartingPairs
from ifo_grounding.transforms.starts import FRAME_HASH

KIND = "ifo-grounding pairs"
"""What the folder of pairs says that it holds."""


def examine(options: Options) -> dict:
    stage, section = open_stage(options, "self_examine"), options.self_examine
    if stage.result is not None:
        return stage.result
    run = stage.run
    # What is trained: the policy of phase 1, and a critic that begins with its weights.
    policy = load_network(run, POLICIES["phase1"], options)
    value = build(make_value, options, init_from=policy)
    # Where: states of the simulator with chosen instructions, paid by what was learned.
    reward = learned_reward(run, options)
    env = paid_simulator(reward, run, options)
    # What demonstrations add: an imitation loss beside the reward, and accuracy on those held out.
    seen, aside = labelled_demonstrations(run, options.imitate.held_out)
    read_fast(seen, options)
    weight = section.imitation_weight
    imitation = AuxiliaryImitation(ImitationLoss(policy), seen, weight) if weight else None
    # What is measured on the way, for the log alone, where the world pays success.
    rewarded = world_of(options).rewarded
    audit = audit_callback(policy, reward, run, options) if rewarded else None
    history = self_examine(
        env,
        policy,
        value,
        section,
        seed=options.seed,
        imitation=imitation,
        held_out=held_out_accuracy(policy, aside, run, options),
        adversarial=adversarial_updates(reward, run, options),
        checkpoint=stage.checkpoint,
        checkpoint_seconds=options.checkpoint_seconds,
        log=stage.log(),
        callback=audit,
        progress=options.progress,
        workers=remote_simulators(run, options),
        cudagraph=True,
    )
    save_network(run, VALUE, value)
    save_network(run, POLICIES["phase2"], policy)
    return finish(options, stage, history[-1], history)


def paid_simulator(reward: LearnedReward | GoalReward, run: Run, options: Options) -> EnvBase:
    """Return the simulator with chosen instructions and a learned reward."""
    simulator = coded_simulator(options, options.self_examine.num_envs)
    return TransformedEnv(simulator, Compose(chosen_starts(run, options), reward))


def remote_simulators(run: Run, options: Options) -> list[Callable[[], EnvBase]]:
    """Return what makes the simulator of each worker on Ray, which has networks of its own."""
    section, here = options.self_examine, replace(options, device="cpu")
    if section.collectors is None:
        return []
    world, rows = world_of(here), section.num_envs // section.collectors
    starts, reward = chosen_starts(run, here), learned_reward(run, here)

    def make() -> EnvBase:
        return TransformedEnv(world.coded(rows, seed=here.seed), Compose(starts, reward))

    return [make] * section.collectors


def learned_reward(run: Run, options: Options) -> LearnedReward | GoalReward:
    """Return the paper's reward of actions, or the reward of reached goals."""
    if options.self_examine.reward == "action":
        return LearnedReward(load_network(run, REWARD, options))
    classifier = load_network(run, GOAL, options)
    return GoalReward(classifier, stop_action=world_of(options).stop_action)


def chosen_starts(run: Run, options: Options) -> InstructionSampler | StartingPairs:
    """Return fresh states with chosen instructions, or the paper's fixed number of pairs.

    Pairs are kept in the run, for where the search is long: some tasks suit one state in seventy.
    """
    classifier = load_network(run, CLASSIFIER, options)
    pool, section = load_demonstrations(run).pool(), options.self_examine
    if section.pairs is None:
        return InstructionSampler(classifier, pool, **chosen_by(options))
    made_by = {"classifier": checksums(run).get(CLASSIFIER)}
    if (run / PAIRS).exists():
        parts, found = load_folder(run / PAIRS, KIND, (SCENE, INSTRUCTION, FRAME_HASH))
        if found == made_by:
            return StartingPairs(TensorDict(parts, [section.pairs]).clone())
    with torch.no_grad():
        pairs = select_pairs(
            coded_simulator(options, section.num_envs),
            classifier,
            pool,
            section.pairs,
            seed=options.seed,
            progress=options.progress,
            **chosen_by(options),
        )
    save_folder(run / PAIRS, KIND, dict(pairs.items()), made_by)
    return StartingPairs(pairs)


def trains_reward(section: SelfExamineConfig) -> bool:
    """Whether the reward model is trained on."""
    return section.reward == "action" and section.reward_steps > 0


def adversarial_updates(reward: Any, run: Run, options: Options) -> AdversarialUpdates | None:
    """Return what trains the reward model on, with the policy's actions as negatives."""
    section = options.self_examine
    if not trains_reward(section):
        return None
    demos = labelled_buffer(load_demonstrations(run), load_labels(run))
    loss = RewardLoss(reward.model)
    return AdversarialUpdates(loss, demos, section.reward_steps, section.reward_lr)


def held_out_accuracy(
    policy: Any, aside: ReplayBuffer | None, run: Run, options: Options
) -> HeldOutAccuracy | None:
    """Return what measures the policy on demonstrations held out.

    Where none are, but their accuracy has to choose the checkpoint, since the reward model is
    trained on, they are the first of those that are imitated.
    """
    section = options.self_examine
    if aside is None and section.select_every and trains_reward(section):
        demos = load_demonstrations(run)[: section.select_episodes]
        aside = labelled_buffer(demos, load_labels(run)[: demos.transitions])
    return HeldOutAccuracy(policy, aside) if aside is not None else None


@recipe_main
def main(options: Options) -> None:
    tell(examine(options))


if __name__ == "__main__":
    main()
