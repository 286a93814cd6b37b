"""Whether the learned rewards pay for what is right."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.data import Demonstrations, Truth
from ifo_grounding.episodes import Policy, play
from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.evaluation.labels import actions_of
from ifo_grounding.evaluation.scenes import device_of, most_steps, scene_batches, seeded
from ifo_grounding.modules import evaluating
from ifo_grounding.seeding import derive, generator
from ifo_grounding.stats import Estimate, Rate, auc, correlation, wilson
from ifo_grounding.transforms import GoalReward, LearnedReward


@dataclass(frozen=True)
class RewardAudit:
    """How well the reward of actions tells the expert's action from the others."""

    auc: Estimate
    """Probability that an expert's action scores above another action."""
    per_action: dict[str, Estimate]
    """The same for one action: where the expert took it against where it did not."""
    first: Rate
    """Share of transitions where the expert's action scores highest."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "auc": self.auc.as_dict(),
            "per_action": {name: area.as_dict() for name, area in self.per_action.items()},
            "first": self.first.as_dict(),
        }

    def __str__(self) -> str:
        """Return the area with its interval."""
        return str(self.auc)


def reward_audit(
    reward_model: TensorDictModuleBase,
    demos: Demonstrations,
    truth: Tensor | Truth,
    *,
    transitions: int = 5000,
    seed: int = 0,
    batch_size: int = 1024,
    names: Sequence[str] | None = None,
) -> RewardAudit:
    """Score every action in transitions of held-out demonstrations, and compare with the expert's.

    Where several shortest paths exist the other one counts as wrong here, so that even a perfect
    judge stays somewhat below 1. Intervals take transitions of one demonstration as one group.

    Args:
        reward_model: TensorDictModule from (pixels, instruction, action) to a logit
            ``action_score``.
        demos: demonstrations that the model was not trained on.
        truth: their true actions, integer [transitions], or the
            :class:`~ifo_grounding.data.Truth`.
        transitions: how many to draw, without repetition.
        seed: of the draw.
        batch_size: pairs scored together.
        names: of the actions; by default the grid's, or numbers where the model judges more or
            fewer.

    Raises:
        UserError: where truth does not have one action per transition, or there is not one name for
            each action that the model judges, or nothing to draw.
    """
    transitions = at_least_one("transitions", transitions)
    batch_size = at_least_one("batch_size", batch_size)
    names = _names_for(reward_model, names)
    actions = actions_of(truth)
    if len(actions) and int(actions.max()) >= len(names):
        raise UserError(
            f"truth has the action {int(actions.max())}, of {len(names)} with a name: give names= "
            "of all actions"
        )
    if len(actions) != demos.transitions or not len(actions):
        raise UserError(
            f"truth has {len(actions)} actions and the demonstrations {demos.transitions} "
            "transitions: give the truth of these very demonstrations"
        )
    order = torch.randperm(len(actions), generator=generator(seed, "reward-audit"))
    drawn = order[:transitions].sort().values
    episode, frame = demos.locate(drawn)
    scores = _score_actions(reward_model, demos, episode, frame, len(names), batch_size)
    taken = torch.nn.functional.one_hot(actions[drawn], len(names)).bool()
    group = episode.unsqueeze(1).expand_as(scores)
    # Ties do not count as first: a judge that finds everything right knows nothing.
    others = scores.masked_fill(taken, -torch.inf).max(1).values
    return RewardAudit(
        auc=_area(scores, taken, group),
        per_action={
            name: _area(scores[:, a], taken[:, a], episode) for a, name in enumerate(names)
        },
        first=wilson(int((scores[taken] > others).sum()), len(drawn)),
    )


def _names_for(model: TensorDictModuleBase, names: Sequence[str] | None) -> Sequence[str]:
    """Return a name for each action that a judge knows, as far as it says how many that are."""
    known = getattr(getattr(model, "shapes", None), "n_actions", len(names or keys.ACTIONS))
    if names is None:
        return keys.action_names(known)
    if len(names) != known:
        raise UserError(f"the model judges {known} actions, not {len(names)}: name each of them")
    return names


def _area(scores: Tensor, taken: Tensor, group: Tensor) -> Estimate:
    return auc(
        scores[taken].numpy(),
        scores[~taken].numpy(),
        positive_groups=group[taken].numpy(),
        negative_groups=group[~taken].numpy(),
    )


def _score_actions(
    reward_model: TensorDictModuleBase,
    demos: Demonstrations,
    episode: Tensor,
    frame: Tensor,
    n_actions: int,
    batch_size: int,
) -> Tensor:
    """Logits of every action in every transition, float32 [N, A]."""
    device, scores = device_of(reward_model), []
    every = torch.arange(n_actions)
    instructions = demos.instructions
    with evaluating(reward_model):
        for part in torch.arange(len(frame)).split(max(1, batch_size // n_actions)):
            pixels, words = demos.frames(frame[part]), instructions[episode[part]]
            batch = TensorDict(
                {
                    keys.PIXELS: pixels.repeat_interleave(n_actions, 0),
                    keys.INSTRUCTION: words.repeat_interleave(n_actions, 0),
                    keys.ACTION: every.repeat(len(part)),
                },
                batch_size=[n_actions * len(part)],
            ).to(device)
            logit = reward_model(batch)[keys.ACTION_SCORE]
            scores.append(logit.float().reshape(len(part), n_actions).cpu())
    return torch.cat(scores)


@dataclass(frozen=True)
class ReturnAudit:
    """Whether episodes with a higher learned return are those that succeed."""

    correlation: Estimate
    """Point-biserial correlation of learned return and true success."""
    auc: Estimate
    """Probability that a success has a higher learned return than a failure."""
    success: Rate
    """Share of true successes in these rollouts."""
    returns: Tensor
    """Learned return of each episode, float32 [N]."""
    outcomes: Tensor
    """True success of each episode, bool [N]."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, without every episode."""
        names = ("correlation", "auc", "success")
        return {name: getattr(self, name).as_dict() for name in names}

    def __str__(self) -> str:
        """Return the correlation with its interval."""
        return str(self.correlation)


def return_correlation(
    policy: Policy,
    reward: TensorDictModuleBase | LearnedReward | GoalReward,
    env_or_task: EnvBase | str,
    *,
    episodes: int = 1000,
    seed: int = 0,
    stream: str = "evaluation",
    mode: str = "sampled",
    discount: float = 1.0,
    average: bool = False,
    batch_size: int = 1000,
    device: torch.device | str | None = None,
    max_steps: int | None = None,
    **env_options: Any,
) -> ReturnAudit:
    """Compare the learned return of rollouts with their true success.

    The rollouts are made for this, on instructed scenes; no learner sees their true reward.

    Args:
        policy: whose episodes; sampled by default, so that some succeed and some fail.
        reward: a :class:`~ifo_grounding.transforms.LearnedReward`, a
            :class:`~ifo_grounding.transforms.GoalReward`, or a module from (pixels, instruction,
            action) to a logit, taken as ``LearnedReward(reward)``.
        env_or_task: name of a task, or an instructed batched environment with a true reward.
        episodes: number of scenes.
        seed: of scenes and actions.
        stream: ``training``, ``validation`` or ``evaluation``.
        mode: ``greedy`` or ``sampled``.
        discount: of the return.
        average: whether to divide by the length: a sum of probabilities pays for long episodes.
        batch_size: episodes side by side.
        device: where to run; the policy's by default.
        max_steps: most actions per episode, one that has not ended by then is a failure; by default
            40 for a task's name, and 1,000 in an environment, whose own limit may be lower.
        env_options: further arguments of :class:`~ifo_grounding.envs.PickAndPlaceEnv`.
    """
    pay = reward if isinstance(reward, LearnedReward | GoalReward) else LearnedReward(reward)
    where = torch.device(device) if device is not None else device_of(policy)
    limit = most_steps(env_or_task, max_steps)
    batches = scene_batches(
        env_or_task,
        range(episodes),
        seed=seed,
        stream=stream,
        batch_size=batch_size,
        device=where,
        max_steps=limit,
        **env_options,
    )
    paid, won = [], []
    for number, (env, start, count) in enumerate(batches):
        total = torch.zeros(env.batch_size.numel(), device=start.device or env.device)
        with evaluating(policy), seeded(derive(seed, "return", mode, number), where):
            outcomes = play(
                policy,
                env,
                start,
                mode=mode,
                max_steps=limit,
                on_step=_purse(pay, start.reshape(-1)[keys.PIXELS].clone(), total, discount),
            )
        if average:
            total = total / outcomes.lengths
        paid.append(total[:count].cpu())
        won.append(outcomes.success[:count].cpu())
    returns, success = torch.cat(paid), torch.cat(won)
    return ReturnAudit(
        correlation=correlation(returns.numpy(), success.numpy()),
        auc=auc(returns[success].numpy(), returns[~success].numpy()),
        success=wilson(int(success.sum()), len(success)),
        returns=returns,
        outcomes=success,
    )


def _purse(
    pay: LearnedReward | GoalReward, first: Tensor, total: Tensor, discount: float
) -> Callable[[Tensor, TensorDictBase], None]:
    """Return what adds each step's learned reward to ``total``."""
    step = 0
    arrived = torch.zeros_like(total, dtype=torch.bool)

    def collect(rows: Tensor, transition: TensorDictBase) -> None:
        nonlocal step
        transition[keys.INITIAL_PIXELS] = first[rows]
        reward, reached = (part.reshape(-1) for part in pay.pay(transition, transition[keys.NEXT]))
        total[rows] += discount**step * reward.where(~arrived[rows], 0.0)
        if pay.arrival is not None:  # where practice would end the episode
            arrived[rows] |= reached
        step += 1

    return collect
