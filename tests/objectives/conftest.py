import pytest
import torch
from tensordict import TensorDict

from ifo_grounding import networks
from ifo_grounding.objectives import (
    GoalLoss,
    ImitationLoss,
    InstructionLoss,
    InverseLoss,
    RewardLoss,
)
from networks.conftest import inputs

SHAPES = networks.Shapes((3, 24, 24), 14, instruction_length=4, tile_size=8)
POOL = torch.arange(1, 13).unsqueeze(1) * torch.tensor([1, 1, 0, 0])
LOSSES = {
    "inverse": (networks.make_inverse, InverseLoss, {}),
    "imitation": (networks.make_policy, ImitationLoss, {}),
    "instruction": (networks.make_instruction_classifier, InstructionLoss, {"pool": POOL}),
    "reward": (networks.make_reward_model, RewardLoss, {}),
    "goal": (networks.make_goal_classifier, GoalLoss, {"pool": POOL}),
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
