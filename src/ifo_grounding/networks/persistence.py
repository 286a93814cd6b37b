"""Networks on disk: weights as safetensors, with all that is needed to build them again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write
from ifo_grounding.machine import check_device
from ifo_grounding.networks.building import Blueprint
from ifo_grounding.networks.goal import make_goal_classifier
from ifo_grounding.networks.instruction import make_instruction_classifier
from ifo_grounding.networks.inverse import make_inverse
from ifo_grounding.networks.policy import make_policy, make_value
from ifo_grounding.networks.reward import make_reward_model
from ifo_grounding.networks.shapes import Shapes

FORMAT = "ifo-grounding network 2"
MAKERS: dict[str, Callable[..., Any]] = {
    "inverse": make_inverse,
    "policy": make_policy,
    "value": make_value,
    "instruction": make_instruction_classifier,
    "reward": make_reward_model,
    "goal": make_goal_classifier,
}


def save(module: nn.Module, path: str | Path) -> None:
    """Write a network built by a ``make_*`` function to ``path``, atomically.

    What was copied from ``init_from`` is not kept: training on after loading lets weights decay to
    zero, not to what they were there.

    Raises:
        UserError: for a module that no ``make_*`` function built.

    >>> import tempfile
    >>> policy = make_policy(Shapes(image_shape=(3, 16, 16), vocabulary_size=9), seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save(policy, f"{folder}/policy.safetensors")
    ...     again = load(f"{folder}/policy.safetensors")
    >>> all(map(torch.equal, policy.state_dict().values(), again.state_dict().values()))
    True
    """
    plan = asdict(Blueprint.of(module))
    metadata = {"format": FORMAT, "network": json.dumps(plan, sort_keys=True)}
    weights = {
        name: value.detach().cpu().contiguous() for name, value in module.state_dict().items()
    }
    with atomic_write(path) as temporary:
        save_file(weights, temporary, metadata)


def load(
    path: str | Path, device: torch.device | str | None = None, kind: str | None = None
) -> Any:
    """Read a network that :func:`save` wrote and build it again on ``device``.

    Args:
        path: the file.
        device: where to build it.
        kind: the kind that is expected (``"policy"``, ``"inverse"``, ...); None allows any.

    Raises:
        UserError: where the file is missing, damaged, of another origin, or of another kind, or
            where there is no such device.
    """
    check_device(device or "cpu")
    content, weights = _read(Path(path))
    found = str(content.get("kind"))
    if kind is not None and kind != found:
        raise UserError(f"{path} holds a network of kind {found!r}, not {kind!r}")
    try:
        options = {name: _option(name, value) for name, value in content["options"].items()}
        shapes = Shapes(
            **{**content["shapes"], "image_shape": tuple(content["shapes"]["image_shape"])}
        )
        module = MAKERS[found](shapes, device=device, seed=0, **options, **content["config"])
        module.load_state_dict(weights)
    except torch.OutOfMemoryError:
        raise  # says nothing against the file
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"{path} does not fit this version of ifo-grounding ({type(error).__name__}: {reason}):"
            " train the network again"
        ) from None
    return module


def _read(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise UserError(
                    f"{path} is no network of this version of ifo-grounding (format "
                    f"{metadata.get('format')!r}, expected {FORMAT!r}): train it again"
                )
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return json.loads(metadata["network"]), weights
    except FileNotFoundError:
        raise UserError(f"{path} does not exist") from None
    except (SafetensorError, OSError, KeyError, json.JSONDecodeError) as error:
        raise UserError(
            f"{path} is damaged or no safetensors file ({error}): restore or retrain it"
        ) from None


def _option(name: str, value: Any) -> Any:
    """Turn what JSON made of an option back: nested keys are tuples."""
    if name == "in_keys":
        return [_option("key", key) for key in value]
    return tuple(value) if isinstance(value, list) else value
