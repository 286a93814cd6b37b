"""Networks on disk: a file of weights, or a folder for others with words and a model card."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from ifo_grounding.errors import UserError, optional
from ifo_grounding.files import atomic_write, read_json, write_json
from ifo_grounding.machine import check_device
from ifo_grounding.networks import makers
from ifo_grounding.networks.makers import Blueprint
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.tasks.vocabulary import Vocabulary

FORMAT = "ifo-grounding network 2"
MAKERS: dict[str, Callable[..., Any]] = {
    "inverse": makers.make_inverse,
    "policy": makers.make_policy,
    "value": makers.make_value,
    "instruction": makers.make_instruction_classifier,
    "reward": makers.make_reward_model,
    "goal": makers.make_goal_classifier,
}
WEIGHTS = "network.safetensors"
WORDS = "vocabulary.json"
CARD = "README.md"
FILES = [WEIGHTS, WORDS, CARD]
LIBRARY = "library_name: ifo-grounding"
ROLES = {
    "policy": "chooses an action for an image and an instruction",
    "value": "estimates the learned return of an image and an instruction",
    "inverse": "names the action that led from one image to the next",
    "instruction": "says whether an instruction suits an image",
    "reward": "says whether an action is right for an image and an instruction",
    "goal": "says whether an instruction is fulfilled, by the first and the present image",
}


def save(module: nn.Module, path: str | Path) -> None:
    """Write a network built by a ``make_*`` function to ``path``, atomically.

    What was copied from ``init_from`` is not kept: training on after loading lets weights decay to
    zero, not to what they were there.

    Raises:
        UserError: for a module that no ``make_*`` function built.

    >>> import tempfile
    >>> policy = makers.make_policy(Shapes(image_shape=(3, 16, 16), vocabulary_size=9), seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save(policy, f"{folder}/policy.safetensors")
    ...     again = load(f"{folder}/policy.safetensors")
    >>> all(map(torch.equal, policy.state_dict().values(), again.state_dict().values()))
    True
    """
    plan = json.dumps(asdict(_blueprint(module)), sort_keys=True)
    weights = {
        name: value.detach().cpu().contiguous() for name, value in module.state_dict().items()
    }
    with atomic_write(path) as temporary:
        save_file(weights, temporary, {"format": FORMAT, "network": plan})


def load(
    path: str | Path, device: torch.device | str | None = None, kind: str | None = None
) -> Any:
    """Read a network that :func:`save` wrote and build it again on ``device``.

    Args:
        path: the file.
        device: where to build it.
        kind: the kind that is expected (``"policy"``, ``"inverse"``, ...); None allows any.

    Raises:
        UserError: where the file is missing, damaged, of another origin or another kind.
    """
    check_device(device or "cpu")
    plan, weights = _read(Path(path))
    found = str(plan.get("kind"))
    if kind not in (None, found):
        raise UserError(f"{path} holds a network of kind {found!r}, not {kind!r}")
    try:
        options = {name: _key(value) for name, value in plan["options"].items()}
        options["in_keys"] = [_key(value) for value in plan["options"]["in_keys"]]
        shapes = Shapes(**plan["shapes"])
        module = MAKERS[found](shapes, device=device, seed=0, **options, **plan["config"])
        module.load_state_dict(weights)
    except torch.OutOfMemoryError:
        raise  # says nothing against the file
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise UserError(
            f"{path} does not fit this version of ifo-grounding ({_first_line(error)}): train the "
            "network again"
        ) from None
    return module


def save_pretrained(
    module: nn.Module,
    folder: str | Path,
    *,
    vocabulary: Vocabulary | None = None,
    facts: Mapping[str, object] | None = None,
    hub_id: str | None = None,
    **hub: Any,
) -> Path:
    """Write a network as a folder with a model card, and send it to the Hugging Face Hub if asked.

    Args:
        module: what a ``make_*`` function built.
        folder: where to. In a folder that exists, ``network.safetensors``, ``vocabulary.json`` and
            the card are replaced one by one, the weights last. Everything else stays, and so does
            a ``README.md`` that is no card of this library.
        vocabulary: the words of its token ids, by default the ``vocabulary`` of ``module``.
        facts: what the card says, such as ``{"Task": "move", "Success": "99.7% [99.5, 99.8]"}``.
        hub_id: ``user/name`` on the Hub; needs the extra ``hub`` and an account that is logged in.
        hub: ``private``, ``token``, and options of ``huggingface_hub.HfApi.upload_folder`` such as
            ``commit_message``, ``revision`` or ``create_pr``.

    Returns the folder.

    Raises:
        UserError: for a module that no ``make_*`` function built, words that do not fit it, a
            ``folder`` that is none, a missing extra, or where the Hub refuses.
    """
    folder, plan = Path(folder), _blueprint(module)
    if vocabulary is None:
        vocabulary = getattr(module, "vocabulary", None)
    if vocabulary is not None:
        _check_fit(vocabulary, plan.shapes, "the vocabulary")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder} is no folder and cannot be made one ({error.strerror}): choose another"
        ) from None
    (folder / WORDS).unlink(missing_ok=True)  # of the network that was here before
    if vocabulary is not None:
        words = {"words": list(vocabulary.words), "length": vocabulary.length}
        write_json(folder / WORDS, words)
    card = folder / CARD
    if not card.exists() or LIBRARY in card.read_text(encoding="utf-8", errors="replace"):
        with atomic_write(card) as temporary:
            temporary.write_text(_card(plan, facts or {}), encoding="utf-8")
    save(module, folder / WEIGHTS)
    if hub_id is not None:
        _upload(folder, hub_id, **hub)
    return folder


def from_pretrained(
    source: str | Path,
    device: torch.device | str | None = None,
    kind: str | None = None,
    **hub: Any,
) -> Any:
    """Load a network that :func:`save_pretrained` wrote, with its words as ``vocabulary``, or None.

    Args:
        source: its folder, or ``user/name`` on the Hugging Face Hub (extra ``hub``).
        device: where to build it.
        kind: the kind that is expected, such as ``"policy"``; None allows any.
        hub: for ``huggingface_hub.snapshot_download``, such as ``revision``, ``cache_dir``,
            ``token`` or ``local_files_only``.

    Raises:
        UserError: where there is no such folder, here or on the Hub, or it holds no network of
            that kind, or its words are damaged or another network's.
    """
    folder = Path(source)
    if not folder.is_dir():
        if folder.exists() or str(source).count("/") != 1 or str(source)[0] in "./~":
            raise UserError(
                f"{source} is no folder that save_pretrained wrote; on the Hub a network is called "
                "user/name"
            )
        folder = _downloaded(str(source), hub)
    module = load(folder / WEIGHTS, device=device, kind=kind)
    words = folder / WORDS
    module.vocabulary = _vocabulary(words, module.network_config.shapes) if words.exists() else None
    return module


def _blueprint(module: nn.Module) -> Blueprint:
    """Return what a network was built by, or refuse what no ``make_*`` function built."""
    plan = getattr(module, "network_config", None)
    if not isinstance(plan, Blueprint):
        raise UserError(
            f"cannot save {type(module).__name__}: only what a make_* function of "
            "ifo_grounding.networks built can be saved"
        )
    return plan


def _read(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the blueprint of a file, as JSON has it, and the weights."""
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


def _key(value: Any) -> Any:
    """Turn a nested key, of which JSON made a list, into a tuple again."""
    return tuple(value) if isinstance(value, list) else value


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error) or 'no reason given').splitlines()[0]}"


def _hub() -> Any:
    return optional("huggingface_hub", extra="hub")


def _upload(folder: Path, hub_id: str, private: bool | None = None, **options: Any) -> None:
    """Send the files of a network in one commit; those of another that was there go with it."""
    api = _hub().HfApi(token=options.pop("token", None))
    try:
        repo = api.create_repo(hub_id, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=repo.repo_id,
            folder_path=folder,
            allow_patterns=FILES,
            delete_patterns=[WORDS],
            **options,
        )
    except TypeError:  # an option that there is not
        raise
    except Exception as error:  # the client's and those of its transport, which share no base
        raise UserError(
            f"{hub_id} could not be sent to the Hugging Face Hub ({_first_line(error)}): mend the "
            "name or the connection, or log in with `hf auth login`"
        ) from None


def _downloaded(hub_id: str, options: dict[str, Any]) -> Path:
    hub = _hub()
    try:
        return Path(hub.snapshot_download(hub_id, allow_patterns=FILES, **options))
    except (OSError, ValueError) as error:  # what all errors of the Hub are
        raise UserError(
            f"{hub_id} is neither a folder nor a repository of the Hugging Face Hub that can be "
            f"reached ({_first_line(error)}): mend the name, or the connection"
        ) from None


def _vocabulary(path: Path, shapes: Shapes) -> Vocabulary:
    """Read the words of a network, or refuse what is damaged or another network's."""
    found = read_json(path)
    try:
        vocabulary = Vocabulary(found["words"], found["length"])
    except (TypeError, KeyError, AttributeError, UserError) as error:
        raise UserError(
            f"{path} holds no words ({_first_line(error)}): restore it, or save the network again "
            "with its vocabulary"
        ) from None
    _check_fit(vocabulary, shapes, str(path))
    return vocabulary


def _check_fit(vocabulary: Vocabulary, shapes: Shapes, name: str) -> None:
    given = len(vocabulary), vocabulary.length
    taken = shapes.vocabulary_size, shapes.instruction_length
    if given[0] > taken[0] or given[1] != taken[1]:
        raise UserError(
            f"{name} has {given[0]} token ids and {given[1]} per instruction, but the network was "
            f"built for {taken[0]} and {taken[1]}: pass the vocabulary that it was built for"
        )


def _card(plan: Blueprint, facts: Mapping[str, object]) -> str:
    shapes = plan.shapes
    rows = {
        "Network": plan.kind,
        "Preset": plan.config.preset,
        "Images": "x".join(map(str, shapes.image_shape)),
        "Token ids": f"{shapes.vocabulary_size}, {shapes.instruction_length} per instruction",
        "Actions": shapes.n_actions,
        **facts,
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items() if value is not None)
    return f"""---
{LIBRARY}
license: mit
tags: [torchrl, imitation-from-observation, language-grounding, reinforcement-learning]
---

# A network of ifo-grounding

It {ROLES[plan.kind]}.

It was trained by the method of *Learning from Observation-Only Demonstration for Task-Oriented
Language Grounding via Self-Examination* or an extension of it.

| | |
| --- | --- |
{table}

```python
from ifo_grounding.networks import from_pretrained

network = from_pretrained("path/to/this/folder")
```
"""
