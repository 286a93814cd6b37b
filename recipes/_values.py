"""Values that no stage could use, refused before the first one begins."""

import math
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from ifo_grounding.errors import UserError, whole

ESTIMATED = "estimated"

AT_LEAST_ONE = (
    "threads",
    "demonstrations.n",
    "transitions.n",
    "transitions.num_envs",
    "imitate.trials",
    "imitate.trial_steps",
    "instruction.negatives",
    "instruction.trials",
    "instruction.trial_steps",
    "goal.negatives",
    "self_examine.num_envs",
    "self_examine.pairs",
    "evaluate.episodes",
    "evaluate.audit_episodes",
)
NOT_NEGATIVE = (
    "imitate.trial_halvings",
    "instruction.contrast",
    "instruction.fresh_states",
    "self_examine.rehearsal",
    "self_examine.reward_steps",
    "evaluate.states",
)
ABOVE_ZERO = ("self_examine.reward_lr", "controls.lr")
SHARES = (
    "transitions.stop_probability",
    "imitate.strict_from",
    "instruction.removal_warmup",
    "controls.accept",
)
PARTS = (
    "imitate.held_out",
    "instruction.near",
    "instruction.removal_rate",
    "goal.near",
    "goal.removal_rate",
)
"""Shares that are never the whole."""


def check_values(options: DictConfig) -> None:
    """Refuse numbers that are too small or too large, and devices that are not there.

    Raises:
        UserError: on one of them, with what is allowed.
    """
    for names, allowed, fits in (
        (AT_LEAST_ONE, "at least 1", lambda number: number >= 1),
        (NOT_NEGATIVE, "0 or more", lambda number: number >= 0),
        (ABOVE_ZERO, "above 0", lambda number: number > 0),
        (SHARES, "within 0..1", lambda number: 0 <= number <= 1),
        (PARTS, "a share, in [0, 1)", lambda number: 0 <= number < 1),
    ):
        for name in names:
            number: Any = OmegaConf.select(options, name)
            if number is None or number == ESTIMATED:
                continue
            if names is AT_LEAST_ONE:
                whole(name, number)
            if isinstance(number, str) or not fits(number) or math.isinf(number):
                raise UserError(f"{name} must be {allowed}, got {number}")
    check_device(options.device)


def count_held_out(share: float, demonstrations: int) -> int:
    """Return how many demonstrations a share of them holds out.

    Raises:
        UserError: where a share above 0 holds out none of them, or all.
    """
    number = round(share * demonstrations)
    if share and not 0 < number < demonstrations:
        raise UserError(
            f"imitate.held_out={share} of {demonstrations} demonstrations holds out {number}: some "
            "have to be held out, and some left to learn from"
        )
    return number


def check_device(name: str) -> None:
    """Raise :class:`UserError` unless networks can be on a device of this name here."""
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"device={name} is none: use cpu, cuda or cuda:0")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"device={name}: torch sees no GPU here; use device=cpu")
