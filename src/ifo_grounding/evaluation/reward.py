"""Whether the learned rewards pay for what is right."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.data import Demonstrations, Truth, labelled_buffer
from ifo_grounding.episodes import Policy
from ifo_grounding.errors import UserError, at_least_one, check_below
from ifo_grounding.evaluation.labels import actions_of
from ifo_grounding.evaluation.scenes import Player, play_scenes
from ifo_grounding.modules import beside, evaluating
from ifo_grounding.stats import Described, Estimate, Rate, auc, wilson
from ifo_grounding.transforms import GoalReward, LearnedReward

AT_ONCE = 1024
"""Pairs that are scored together."""


@dataclass(frozen=True)
class RewardAudit(Described):
    """How well the reward of actions tells the expert's action from the others."""

    auc: Estimate
    """Probability that an expert's action scores above another action."""
    first: Rate
    """Share of transitions where the expert's action scores highest."""


def reward_audit(
    reward_model: TensorDictModuleBase, demos: Demonstrations, truth: Tensor | Truth
) -> RewardAudit:
    """Score every action in transitions of held-out demonstrations, and compare with the expert's.

    Where several shortest paths exist the other one counts as wrong here, so that even a perfect
    model stays somewhat below 1. Intervals take transitions of one demonstration as one group.

    Args:
        reward_model: TensorDictModule from (pixels, instruction, action) to a logit
            ``action_score``.
        demos: demonstrations that the model was not trained on.
        truth: their true actions, integer [transitions], or the
            :class:`~ifo_grounding.data.Truth`.

    Raises:
        UserError: where truth does not have one action per transition, or one that the model does
            not know.
    """
    n_actions = getattr(getattr(reward_model, "shapes", None), "n_actions", keys.N_ACTIONS)
    actions = actions_of(truth)
    if len(actions) != demos.transitions or not len(actions):
        raise UserError(
            f"truth has {len(actions)} actions and the demonstrations {demos.transitions} "
            "transitions: give the truth of these very demonstrations"
        )
    check_below("for this model, truth holds action", actions, n_actions)
    episode, _ = demos.locate()
    scores = _score_actions(reward_model, labelled_buffer(demos, actions), n_actions)
    taken = torch.nn.functional.one_hot(actions, n_actions).bool()
    # Ties do not count as first: a model that finds everything right knows nothing.
    others = scores.masked_fill(taken, -torch.inf).max(1).values
    return RewardAudit(
        auc=auc(scores, taken, episode.unsqueeze(1).expand_as(scores)),
        first=wilson(int((scores[taken] > others).sum()), len(actions)),
    )


def _score_actions(model: TensorDictModuleBase, buffer: ReplayBuffer, n_actions: int) -> Tensor:
    """Logits of every action in every transition, float32 [N, A]."""
    scores = []
    with evaluating(model):
        for rows in torch.arange(len(buffer)).split(max(1, AT_ONCE // n_actions)):
            seen = beside(buffer[rows], model).select(keys.PIXELS, keys.INSTRUCTION)
            batch = seen.repeat_interleave(n_actions, dim=0)
            batch[keys.ACTION] = torch.arange(n_actions, device=batch.device).repeat(len(rows))
            logit = model(batch)[keys.ACTION_SCORE]
            scores.append(logit.float().reshape(len(rows), n_actions).cpu())
    return torch.cat(scores)


@dataclass(frozen=True)
class ReturnAudit(Described):
    """Whether episodes with a higher learned return are those that succeed."""

    auc: Estimate
    """Probability that a success has a higher learned return than a failure."""
    success: Rate
    """Share of true successes in these rollouts."""
    returns: Tensor
    """Learned return of each episode, float32 [N]."""
    outcomes: Tensor
    """True success of each episode, bool [N]."""


def return_audit(
    policy: Policy,
    reward: LearnedReward | GoalReward,
    env_or_task: EnvBase | str,
    *,
    mode: str = "sampled",
    episodes: int = 1000,
    average: bool = False,
    **options: Any,
) -> ReturnAudit:
    """Compare the learned return of rollouts with their true success.

    The rollouts are made for this, on instructed scenes; no learner sees their true reward.

    Args:
        reward: the transform that pays.
        env_or_task: name of a task, or an instructed batched environment with a true reward.
        mode: ``sampled``, so that some episodes succeed and some fail, or ``greedy``.
        average: whether to divide by the length: a sum of probabilities pays for long episodes.
        options: of :func:`success_rate`, such as ``seed``, ``stream`` and ``max_steps``.
    """
    if not hasattr(reward, "pay"):
        raise UserError(
            "reward is a transform that pays: give LearnedReward(reward_model) or "
            "GoalReward(goal_classifier, ...), not the network"
        )

    def play_batch(player: Player, env: EnvBase, start: TensorDictBase) -> Iterable[Tensor]:
        first = start.reshape(-1)[keys.PIXELS].clone()
        total = torch.zeros(len(first), device=first.device)
        arrived = torch.zeros_like(total, dtype=torch.bool)

        def add(rows: Tensor, transition: TensorDictBase) -> None:
            transition[keys.INITIAL_PIXELS] = first[rows]
            paid = reward.pay(transition, transition[keys.NEXT]).reshape(-1)
            total[rows] += paid.where(~arrived[rows], 0.0)
            if reward.arrival is not None:  # where self-examination would end the episode
                arrived[rows] |= paid > 0

        outcomes = player(env, start, on_step=add)
        return total / outcomes.lengths if average else total, outcomes.success

    numbers = range(at_least_one("episodes", episodes))
    (returns, success), _ = play_scenes(
        policy, env_or_task, numbers, play_batch, mode=mode, purpose="return", **options
    )
    rate = wilson(int(success.sum()), len(success))
    return ReturnAudit(auc(returns, success), success=rate, returns=returns, outcomes=success)
