"""Networks as folders that others can use: weights, words, and a card that says what they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ifo_grounding.errors import UserError, extra
from ifo_grounding.files import atomic_write, read_json, write_json
from ifo_grounding.networks.building import Blueprint
from ifo_grounding.networks.persistence import load, save
from ifo_grounding.tasks.vocabulary import Vocabulary

WEIGHTS = "network.safetensors"
WORDS = "vocabulary.json"
CARD = "README.md"
ROLES = {
    "policy": "chooses an action for an image and an instruction",
    "value": "estimates the learned return of an image and an instruction",
    "inverse": "names the action that led from one image to the next",
    "instruction": "says whether an instruction suits an image",
    "reward": "says whether an action is right for an image and an instruction",
    "goal": "says whether an instruction is fulfilled, by the first and the present image",
}


def save_pretrained(
    module: nn.Module,
    folder: str | Path,
    *,
    vocabulary: Vocabulary | None = None,
    facts: Mapping[str, object] | None = None,
    hub_id: str | None = None,
) -> Path:
    """Write a network as a folder with a model card, and send it to the Hugging Face Hub if asked.

    Args:
        module: what a ``make_*`` function built.
        folder: where to; it appears when everything is written.
        vocabulary: the words of its token ids; :func:`from_pretrained` gives them back.
        facts: what the card says, such as ``{"Task": "move", "Success": "99.7% [99.5, 99.8]"}``.
        hub_id: ``user/name`` on the Hub; needs the extra ``hub`` and an account that is logged in.

    Returns:
        The folder.

    Raises:
        UserError: for a module that no ``make_*`` function built, or a missing extra.

    >>> import tempfile
    >>> from ifo_grounding.networks import Shapes, make_policy
    >>> words = Vocabulary(["go", "up"], length=4)
    >>> shapes = Shapes((3, 16, 16), vocabulary_size=len(words), instruction_length=4)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = save_pretrained(make_policy(shapes), f"{folder}/mine", vocabulary=words)
    ...     from_pretrained(made).vocabulary.words
    ('go', 'up')
    """
    folder = Path(folder)
    with atomic_write(folder) as temporary:
        temporary.mkdir()
        save(module, temporary / WEIGHTS)
        plan: Blueprint = module.network_config  # type: ignore[assignment]
        if vocabulary is not None:
            words = {"words": list(vocabulary.words), "length": vocabulary.length}
            write_json(temporary / WORDS, words)
        (temporary / CARD).write_text(_card(plan, facts or {}), encoding="utf-8")
    if hub_id is not None:
        hub = _hub()
        hub.create_repo(hub_id, exist_ok=True)
        hub.upload_folder(repo_id=hub_id, folder_path=str(folder))
    return folder


def from_pretrained(
    source: str | Path, device: torch.device | str | None = None, kind: str | None = None
) -> Any:
    """Load a network that :func:`save_pretrained` wrote.

    Args:
        source: its folder, or ``user/name`` on the Hugging Face Hub (extra ``hub``).
        device: where to build it.
        kind: the kind that is expected, such as ``"policy"``; None allows any.

    Returns:
        The network, in eval mode, with the words of its token ids as ``vocabulary``, or None.

    Raises:
        UserError: where there is no such folder, or it holds no network of that kind.
    """
    folder = Path(source)
    if not folder.is_dir():
        if str(source).count("/") != 1 or str(source).startswith((".", "/", "~")):
            raise UserError(f"{source} is no folder; on the Hub a network is called user/name")
        folder = Path(_hub().snapshot_download(str(source), allow_patterns=[WEIGHTS, WORDS, CARD]))
    module = load(folder / WEIGHTS, device=device, kind=kind)
    words = read_json(folder / WORDS) if (folder / WORDS).exists() else None
    module.vocabulary = Vocabulary(words["words"], words["length"]) if words else None
    return module


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
library_name: ifo-grounding
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


def _hub() -> Any:
    with extra("hub", "the Hugging Face Hub needs an extra"):
        import huggingface_hub
    return huggingface_hub
