"""What an environment says of itself in plain attributes, whatever it is wrapped in."""

from __future__ import annotations

import operator
from collections.abc import MutableMapping
from typing import Any
from weakref import WeakKeyDictionary

from torchrl.envs import EnvBase, ParallelEnv, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from ifo_grounding.errors import UserError

STOP_ACTION = "stop_action"


def answers(source: Any, name: str) -> list[Any]:
    """Return what an environment says of itself, or what its workers say; empty where nothing."""
    try:
        value = getattr(_answering(source), name, None)
        return list(value) if isinstance(value, (list, tuple)) else [value]
    except Exception:  # a closed or remote env may fail in many ways; its specs then speak
        return []


def attribute(source: Any, name: str) -> Any:
    """Return a plain attribute; a vector env that answers per worker must agree with itself.

    Raises:
        UserError: for a stop that is no action's number, or another one in some workers.
    """
    told = answers(source, name)
    if name == "image_shape":
        if told and all(isinstance(answer, (list, tuple)) for answer in told):
            same = all(each == told[0] for each in told)
            told = list(told[0]) if same else []
        return tuple(told) if len(told) == 3 else None
    answer = told[0] if told else None
    try:
        number = None if answer is None else operator.index(answer)
        said = all(other == answer for other in told)
    except TypeError:
        number, said = None, False
    if name == STOP_ACTION and not said:
        found = told if told[1:] else answer
        raise UserError(
            f"the environment's {STOP_ACTION} is {found!r}: it is the number of an action, the "
            "same in all worlds, or None where no action ends an episode"
        )
    return number if said else None


def _answering(source: Any) -> Any:
    """Return what can be asked without harm.

    A worker in another process ends at a name that it does not know, so a first worker is made here
    and asked instead. Workers of this process cannot answer before they are started.
    """
    base = source
    while isinstance(base, TransformedEnv):
        base = base.base_env
    if isinstance(base, ParallelEnv):
        return first_worker(base)
    if isinstance(base, BatchedEnvBase) and base.is_closed:
        base.start()
    return source


def first_worker(env: BatchedEnvBase) -> EnvBase:
    """Return an environment as that of a batch's first worker, made here."""
    if env not in _FIRST_WORKERS:
        _FIRST_WORKERS[env] = env.create_env_fn[0](**env.create_env_kwargs[0])
    return _FIRST_WORKERS[env]


_FIRST_WORKERS: MutableMapping[EnvBase, EnvBase] = WeakKeyDictionary()


def says_stop(env: EnvBase) -> bool:
    """Whether an environment says which action is its stop, be it that it has none."""
    try:
        return hasattr(_answering(env), STOP_ACTION)
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
