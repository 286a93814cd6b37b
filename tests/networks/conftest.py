import pytest
import torch
from tensordict import TensorDict

from ifo_grounding.networks import (
    Shapes,
    make_goal_classifier,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_reward_model,
    make_value,
)

MAKERS = {
    "inverse": make_inverse,
    "policy": make_policy,
    "value": make_value,
    "instruction": make_instruction_classifier,
    "reward": make_reward_model,
    "goal": make_goal_classifier,
}
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
