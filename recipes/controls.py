"""What phase 2 is compared with: imitation that goes on with as many gradient samples."""

import math
from dataclasses import replace

from _shared import CONTINUED, POLICIES, learn, load_network, open_stage, tell
from imitate import labelled_demonstrations
from self_examine import held_out_accuracy, learned_reward, paid_simulator, trains_reward

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import AuxiliaryImitation, BestCheckpoint


def continue_imitation(options: Options) -> dict:
    """Imitate on; the checkpoint to keep is chosen as phase 2 chooses its own, and as often."""
    stage, section = open_stage(options, "continue_imitation"), options.self_examine
    if stage.result is not None:
        return stage.result
    run = stage.run
    policy = load_network(run, POLICIES["phase1"], options)
    seen, aside = labelled_demonstrations(run, options.imitate.held_out)
    steps, batch = matched_steps(options), section.minibatch
    config = replace(options.imitate, steps=steps, batch_size=batch, lr=options.controls.lr)
    best = None
    if section.select_every:
        reward = learned_reward(run, options)
        best = BestCheckpoint(
            paid_simulator(reward, run, options),
            policy,
            seed=options.seed,
            episodes=section.select_episodes,
            max_steps=section.max_steps,
            margin=section.select_margin,
            held_out=held_out_accuracy(policy, aside, run, options),
            by_accuracy=trains_reward(section),
        )
        best.measure()  # phase 1 itself is the one to beat
        looks = math.ceil(section.iterations / section.select_every)
        best.every = math.ceil(config.steps / config.iteration / looks)
    return learn(options, stage, ImitationLoss(policy), seen, config, CONTINUED, held_out=best)


def matched_steps(options: Options) -> int:
    """Return how many of phase 2's minibatches are as many gradient samples as it takes.

    Every step that phase 2 collects passes policy and critic in each epoch, and the policy once
    more when it is played, which costs a third of a gradient. The auxiliary imitation comes on top.
    """
    section = options.self_examine
    collected = section.iterations * section.num_envs * section.steps
    samples = collected * (2 * section.passes + 1 / 3)
    if section.imitation_weight:
        samples += collected / section.minibatch * section.passes * AuxiliaryImitation.batch_size
    return max(1, round(samples / section.minibatch))


@recipe_main
def main(options: Options) -> None:
    tell(continue_imitation(options))


if __name__ == "__main__":
    main()
