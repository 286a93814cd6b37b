"""How often a policy fulfils its instruction (paper, Table 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding.episodes import MODES, Policy
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.evaluation.scenes import play_scenes
from ifo_grounding.stats import Described, Difference, Rate, paired_difference, wilson


@dataclass(frozen=True)
class SuccessResult(Described):
    """Success on fixed scenes, one episode each."""

    rate: Rate
    """Share of scenes whose instruction was fulfilled at the end, with Wilson's interval."""
    stopped: Rate
    """Share of episodes that terminated, by the policy's stop or, in a world that ends by itself,
    by the world; the others ran out of steps."""
    outcomes: Tensor
    """Success of each scene, bool [N], on the CPU."""
    lengths: Tensor
    """Actions in each episode, int64 [N], on the CPU."""
    scenes: str
    """Hash of the first frames and instructions of all scenes."""
    mode: str
    """``greedy`` or ``sampled``."""
    sampled: SuccessResult | None = None
    """The sampled policy's result on the same scenes, where ``both`` were asked for."""


def success_rate(
    policy: Policy,
    env_or_task: EnvBase | str,
    *,
    mode: str = "greedy",
    episodes: int = 2000,
    seed: int = 0,
    stream: str = "evaluation",
    batch_size: int = 1000,
    max_steps: int | None = None,
    **env_options: Any,
) -> SuccessResult:
    """Measure how often a policy fulfils its instruction: one episode per fixed scene.

    An episode is a success where the step that ends it pays a true reward above 0. The same seed
    and stream give the same scenes, whatever the policy, the mode and the batch size;
    :attr:`SuccessResult.scenes` is their hash. The policy runs in eval mode and without gradients,
    and its modes are as before afterwards; so are torch's global generators.

    Args:
        policy: writes an action into a tensordict, a TensorDictModule mostly.
        env_or_task: name of a task; or an instructed batched environment with a true reward,
            which is seeded anew and used as it is. A
            :class:`~ifo_grounding.envs.PickAndPlaceEnv` plays the scenes that its task's name
            would.
        mode: ``greedy`` (the headline), ``sampled``, or ``both``: greedy, with the sampled
            policy's result as its :attr:`SuccessResult.sampled`.
        seed: of the scenes and, where sampled, of the actions.
        stream: ``evaluation`` for results, ``validation`` for choices.
        batch_size: episodes side by side, for a task's name.
        max_steps: most actions per episode, one that has not ended by then is a failure; by default
            40 for a task's name, and 1,000 in an environment, whose own limit may be lower.
        env_options: further arguments of :class:`~ifo_grounding.envs.PickAndPlaceEnv`, such as
            ``tile_size`` and ``split``; its device is the policy's by default.

    Raises:
        UserError: on an unknown name, no episodes, an environment without instructions, or a policy
            that writes no action.

    >>> import torch
    >>> stop = lambda td: td.set("action", torch.full(td.shape, 5))
    >>> result = success_rate(stop, "move", episodes=50)
    >>> print(result.rate, result.lengths.max().item())
    0.0% [0.0, 7.1] (n=50) 1
    """
    check_choice("mode", mode, [*MODES, "both"])
    options: dict[str, Any] = {"seed": seed, "stream": stream, "batch_size": batch_size}
    options |= {"max_steps": max_steps, **env_options}
    if mode == "both":
        greedy, sampled = (
            success_rate(policy, env_or_task, mode=each, episodes=episodes, **options)
            for each in MODES
        )
        return replace(greedy, sampled=sampled)
    numbers = range(at_least_one("episodes", episodes))
    (success, lengths, stopped), scenes = play_scenes(
        policy, env_or_task, numbers, lambda play, *place: play(*place), mode=mode, **options
    )
    return SuccessResult(
        rate=wilson(int(success.sum()), len(success)),
        stopped=wilson(int(stopped.sum()), len(success)),
        outcomes=success,
        lengths=lengths,
        scenes=scenes,
        mode=mode,
    )


def compare_success(before: SuccessResult, after: SuccessResult) -> Difference:
    """Return the paired difference of two results on the same scenes.

    Raises:
        UserError: where the scenes or the modes differ.
    """
    if before.scenes != after.scenes or len(before.outcomes) != len(after.outcomes):
        raise UserError(
            "the two are about different scenes: use the same seed, stream, options and codes"
        )
    if before.mode != after.mode:
        raise UserError(f"cannot compare a {before.mode} with a {after.mode} policy")
    return paired_difference(before.outcomes.numpy(), after.outcomes.numpy())
