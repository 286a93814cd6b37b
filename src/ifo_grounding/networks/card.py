"""The model card of a network that is shared."""

from __future__ import annotations

from collections.abc import Mapping

from ifo_grounding.networks.makers import Blueprint
from ifo_grounding.texts import markdown_cell

LIBRARY = "library_name: ifo-grounding"
ROLES = {
    "policy": "chooses an action for an image and an instruction",
    "value": "estimates the learned return of an image and an instruction",
    "inverse": "names the action that led from one image to the next",
    "instruction": "says whether an instruction suits an image",
    "reward": "says whether an action is right for an image and an instruction",
    "goal": "says whether an instruction is fulfilled, by the first and the present image",
}


def card(plan: Blueprint, facts: Mapping[str, object]) -> str:
    """Return the model card of a network, with facts about it."""
    shapes = plan.shapes
    rows = {
        "Network": plan.kind,
        "Preset": plan.config.preset,
        "Images": "x".join(map(str, shapes.image_shape)),
        "Token ids": f"{shapes.vocabulary_size}, {shapes.instruction_length} per instruction",
        "Actions": shapes.n_actions,
        **facts,
    }
    cells = [[markdown_cell(each) for each in row] for row in rows.items() if row[1] is not None]
    table = "\n".join(f"| {name} | {value} |" for name, value in cells)
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
