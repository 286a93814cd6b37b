"""The policy and the critic inside TorchRL."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from ifo_grounding.errors import UserError
from ifo_grounding.networks import Shapes, make_policy, make_value
from networks.conftest import inputs


@pytest.fixture
def pair(shapes, preset):
    policy = make_policy(shapes, preset, seed=0)
    return policy, make_value(shapes, preset, init_from=policy, seed=0)


def rollout(shapes: Shapes, policy, batch=(2, 5)) -> TensorDict:
    data = policy(inputs(shapes, [*batch]).select("pixels", "instruction"))
    after = inputs(shapes, [*batch], seed=1).select("pixels")
    after["instruction"] = data["instruction"]
    after["reward"] = torch.rand(*batch, 1)
    after["done"] = torch.zeros(*batch, 1, dtype=torch.bool)
    after["done"][:, -1] = True
    after["terminated"] = after["done"].clone()
    data["next"] = after
    return data.detach()


def test_sampling_is_the_default_and_determinism_an_option(shapes):
    data = inputs(shapes, [1]).exclude("action").expand(300)
    policy = make_policy(shapes, seed=0)
    sampled = policy(data.clone())
    assert len(sampled["action"].unique()) > 1 and policy.spec["action"].n == 6
    greedy = make_policy(shapes, seed=0, deterministic=True)(data.clone())
    assert torch.equal(greedy["action"], greedy["logits"].argmax(-1))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        asked = policy(data.clone())
    assert torch.equal(asked["action"], greedy["action"])


@pytest.mark.parametrize("options", [{"deactivate_vmap": True}, {"shifted": True}], ids=str)
def test_gae_and_ppo(pair, shapes, options):
    policy, value = pair
    data = rollout(shapes, policy)
    GAE(gamma=0.99, lmbda=0.95, value_network=value, **options)(data)
    assert data["advantage"].shape == (2, 5, 1)
    loss = ClipPPOLoss(policy, value)(data)
    sum(loss[key] for key in loss.keys() if key.startswith("loss")).backward()  # noqa: SIM118
    for network in pair:
        assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())
    # nothing was trained between collection and loss, so the ratio of probabilities is 1
    torch.testing.assert_close(loss["kl_approx"], torch.zeros(()), atol=1e-5, rtol=0)


def test_vmap_is_refused_with_the_option_that_avoids_it(pair, shapes):
    policy, value = pair
    with pytest.raises(UserError, match="give TorchRL's value estimators deactivate_vmap=True"):
        GAE(gamma=0.99, lmbda=0.95, value_network=value)(rollout(shapes, policy))
