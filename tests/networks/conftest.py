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


def tiled(rows, height=6, width=6, kinds=9, channels=3):
    """Images of tiles of noise, some alike in what a neighbour sees of them."""
    draw = torch.Generator().manual_seed(0)
    tiles = torch.randint(256, (kinds, channels, 8, 8), generator=draw, dtype=torch.uint8)
    tiles[1::2, :, :, 5:] = tiles[0, :, :, 5:]
    tiles[2::3, :, 5:] = tiles[0, :, 5:]
    which = torch.randint(kinds, (rows, height, width), generator=draw)
    which[torch.rand(which.shape, generator=draw) < 0.6] = 0
    cells = tiles[which].permute(0, 3, 1, 4, 2, 5)
    return cells.reshape(rows, channels, 8 * height, 8 * width)
