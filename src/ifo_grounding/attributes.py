"""What an environment declares of itself in plain attributes, whatever it is wrapped in.

``stop_action`` (number of the action that ends an episode, None where there is none),
``instructed``, ``expose_state``, ``steps_on``, ``vocabulary``, ``vocabulary_size``,
``instruction_length``, ``image_shape``, ``n_actions`` and ``tile_size`` are read where they are
there. Datasets declare sizes in the same way.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any
from weakref import WeakKeyDictionary

from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase


def attribute(source: Any, name: str, default: Any = None) -> Any:
    """Return what an environment or a dataset declares; workers' environments are asked, too.

    >>> from types import SimpleNamespace
    >>> attribute(SimpleNamespace(tile_size=8), "tile_size"), attribute("nothing", "tile_size")
    (8, None)
    """
    value = getattr(innermost(source), name, default)
    # Numbers of NumPy and PyTorch become Python's.
    return value.item() if getattr(value, "shape", None) == () else value


def innermost(env: Any) -> Any:
    """Return the environment that all transforms and all batches of workers are around."""
    env = untransformed(env)
    return innermost(first_worker(env)) if isinstance(env, BatchedEnvBase) else env


def untransformed(env: EnvBase) -> EnvBase:
    """Return the environment that all transforms are around: a batch of workers stays one."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def first_worker(env: BatchedEnvBase) -> EnvBase:
    """Return an environment as that of a batch's first worker, made here: processes stay apart."""
    if env not in _FIRST_WORKERS:
        _FIRST_WORKERS[env] = env.create_env_fn[0](**env.create_env_kwargs[0])
    return _FIRST_WORKERS[env]


_FIRST_WORKERS: MutableMapping[EnvBase, EnvBase] = WeakKeyDictionary()
