"""What an environment says of itself in plain attributes, whatever it is wrapped in."""

from __future__ import annotations

from typing import Any

from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from ifo_grounding.errors import UserError

STOP_ACTION = "stop_action"


def attribute(source: Any, name: str) -> Any:
    """Return a plain attribute; a vector env that answers per worker must agree with itself."""
    try:
        value = getattr(source, name, None)
        answers = list(value) if isinstance(value, (list, tuple)) else [value]
    except Exception:  # a closed or remote env may fail in many ways; its specs then speak
        return None
    if name == "image_shape":
        return tuple(answers) if len(answers) == 3 else None
    answer = answers[0] if answers else None
    same = all(other == answer for other in answers)
    return answer if same and isinstance(answer, int) else None


def says_stop(env: EnvBase) -> bool:
    """Whether an environment says which action is its stop, be it that it has none."""
    if isinstance(env, BatchedEnvBase) and env.is_closed:
        env.start()  # it could not answer
    try:
        return hasattr(env, STOP_ACTION)
    except Exception:  # of a remote one
        return False


def stop_of(env: EnvBase | None, user: str) -> int:
    """Return which action ends an episode by the policy's will, as the environment says.

    Raises:
        UserError: where it does not, or there is none; ``user`` is who asks.
    """
    stop = attribute(env, STOP_ACTION)
    if stop is not None:
        return stop
    asked = "a batch does not say" if env is None else "the environment does not say"
    raise UserError(
        f"{asked} which action is the stop: give {user} its stop_action=..., or make the "
        "environment with from_gymnasium(..., stop=...)"
    )
