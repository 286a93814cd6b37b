"""Success of a policy in training, on validation scenes: for the log, never for the learner."""

from __future__ import annotations

from collections.abc import Callable

from _shared import world
from omegaconf import DictConfig
from torch import nn

from ifo_grounding.evaluation import success_rate


def audit_callback(policy: nn.Module, options: DictConfig) -> Callable[[int], dict[str, float]]:
    """Return a callback that measures greedy and sampled success on validation scenes."""

    def audit(step: int) -> dict[str, float]:
        result = success_rate(
            policy,
            options.task,
            mode="both",
            episodes=options.evaluate.audit_episodes,
            seed=options.evaluate.seed,
            stream="validation",
            **world(options),
        )
        assert result.sampled is not None
        return {
            "success": result.rate.rate,
            "success_low": result.rate.low,
            "success_high": result.rate.high,
            "success_sampled": result.sampled.rate.rate,
            "success_stopped": result.stopped.rate,
        }

    return audit
