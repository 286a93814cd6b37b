import pytest
import torch
from tensordict import TensorDict

from ifo_grounding.networks import Shapes
from ifo_grounding.networks.saving import MAKERS

OUTPUTS = {
    "inverse": ("logits", "A"),
    "policy": ("logits", "A"),
    "value": ("state_value", 1),
    "instruction": ("suitability", 1),
    "reward": ("action_score", 1),
    "goal": ("goal_score", 1),
}


@pytest.fixture(params=list(MAKERS))
def kind(request):
    return request.param


@pytest.fixture(params=["strong", "paper"])
def preset(request):
    return request.param


@pytest.fixture
def shapes():
    return Shapes((3, 48, 48), 40, tile_size=8)


def inputs(shapes: Shapes, batch: list[int], seed: int = 0) -> TensorDict:
    source = torch.Generator().manual_seed(seed)

    def frames():
        return torch.randint(
            256, (*batch, *shapes.image_shape), dtype=torch.uint8, generator=source
        )

    words = (*batch, shapes.instruction_length)
    return TensorDict(
        {
            "pixels": frames(),
            "initial_pixels": frames(),
            "next": {"pixels": frames()},
            "instruction": torch.randint(shapes.vocabulary_size, words, generator=source),
            "action": torch.randint(shapes.n_actions, batch, generator=source),
        },
        batch,
    )


def nested_keys(module) -> dict:
    """Return names of all inputs and outputs under ``agent``, as options of the same maker."""
    keys = {"in_keys": [("agent", *([k] if isinstance(k, str) else k)) for k in module.in_keys]}
    if "action" in module.out_keys:
        return {**keys, "action_key": ("agent", "choice"), "logits_key": ("agent", "scores")}
    return {**keys, "out_key": ("agent", "said")}
