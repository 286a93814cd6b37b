"""What a policy in training truly does, on validation scenes: for the log alone."""

from __future__ import annotations

import functools
from collections.abc import Callable

from _shared import CLASSIFIER, load_network, practised_pool
from _worlds import open_world
from omegaconf import DictConfig
from torch import nn

from ifo_grounding.data import Demonstrations, Truth
from ifo_grounding.evaluation import (
    return_correlation,
    reward_audit,
    success_rate,
    suitable_rate,
)
from ifo_grounding.training import Run
from ifo_grounding.transforms import LearnedReward

EXPERT_EPISODES = 200


def audit_callback(
    policy: nn.Module, reward: LearnedReward, run: Run, options: DictConfig
) -> Callable[[int], dict[str, float]]:
    """Return a callback that lets the oracle judge the policy, its instructions and its judges."""
    world = open_world(options)
    scenes = {"seed": options.evaluate.seed, "stream": "validation"}
    episodes = options.evaluate.audit_episodes
    place, shown = world.played(episodes, **scenes)
    waiting, _ = world.played(episodes, waits=True, **scenes)
    classifier = load_network(run, CLASSIFIER, "train_instruction", options)
    pool = practised_pool(run, options)

    def audit(step: int) -> dict[str, float]:
        result = success_rate(policy, place, mode="both", **shown)
        assert result.sampled is not None
        played = return_correlation(policy, reward, waiting, **shown)
        return {
            "success": result.rate.rate,
            "success_low": result.rate.low,
            "success_high": result.rate.high,
            "success_sampled": result.sampled.rate.rate,
            "success_stopped": result.stopped.rate,
            "audit_return": float(played.returns.mean()),
            "audit_success": played.success.rate,
            "return_auc": played.auc.value,
            **(instructions() if world.oracle else {}),
            **(actions() if world.oracle else {}),
        }

    # The instruction module does not change while the policy practises.
    @functools.cache
    def instructions() -> dict[str, float]:
        chosen = suitable_rate(
            classifier,
            world.task,
            pool,
            states=episodes,
            pairs_per_state=0,
            **{key: options.instruction[key] for key in ("threshold", "candidates", "choose")},
            **world.arguments(**scenes),
        )
        return {"suitable": chosen.rate.rate}

    @functools.cache
    def shown_by_expert() -> tuple[Demonstrations, Truth]:
        return world.demonstrate(EXPERT_EPISODES, **scenes)

    def actions() -> dict[str, float]:
        if options.self_examine.kind == "goal":
            return {}
        assert reward.action_judge is not None  # as it is by now: it may be trained on
        return {"action_auc": reward_audit(reward.action_judge, *shown_by_expert()).auc.value}

    return audit
