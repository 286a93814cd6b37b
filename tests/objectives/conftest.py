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
)
from ifo_grounding.objectives import (
    GoalLoss,
    ImitationLoss,
    InstructionLoss,
    InverseLoss,
    RewardLoss,
)
from networks.conftest import inputs

SHAPES = Shapes((3, 24, 24), 14, instruction_length=4, tile_size=8)
POOL = torch.arange(1, 13).unsqueeze(1) * torch.tensor([1, 1, 0, 0])
LOSSES = {
    "inverse": (make_inverse, InverseLoss, {}),
    "imitation": (make_policy, ImitationLoss, {}),
    "instruction": (make_instruction_classifier, InstructionLoss, {"pool": POOL}),
    "reward": (make_reward_model, RewardLoss, {}),
    "goal": (make_goal_classifier, GoalLoss, {"pool": POOL}),
}


@pytest.fixture(params=["strong", "paper"])
def preset(request):
    return request.param


@pytest.fixture(params=list(LOSSES))
def kind(request):
    return request.param


def make_loss(kind: str, preset: str = "paper", make_options=None, **options):
    make, loss, defaults = LOSSES[kind]
    network = make(SHAPES, preset, **{"seed": 0, "dropout": 0.0, **(make_options or {})})
    return loss(network, **{**defaults, **options})


def batch(size=(12,), seed: int = 0) -> TensorDict:
    data, source = inputs(SHAPES, [*size], seed), torch.Generator().manual_seed(seed)
    data["instruction"] = POOL[torch.randint(len(POOL), size, generator=source)]
    return data.set("final", torch.rand(*size, 1, generator=source) < 0.4)


def seeded(loss, *args, **kwargs):
    """Call a loss with the random numbers of one seed."""
    torch.manual_seed(0)
    return loss(*args, **kwargs)


def total(losses: TensorDict) -> torch.Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))
