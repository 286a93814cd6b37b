"""The transforms under TorchRL's own collectors, advantages and losses, and our own networks."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import ParallelEnv
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ReinforceLoss

from ifo_grounding.transforms import GoalReward, LearnedReward
from transforms.counter_world import STOP, goal_classifier, make, reward_model, shown


class Features(nn.Module):
    """One-hot of the number shown and of the target."""

    def __init__(self, outputs):
        super().__init__()
        self.linear = nn.Sequential(nn.Linear(20, 64), nn.ReLU(), nn.Linear(64, outputs))

    def forward(self, pixels, instruction):
        number, target = shown(pixels), instruction[..., 0] - 1
        hot = [nn.functional.one_hot(value.clamp(0, 9), 10) for value in (number, target)]
        return self.linear(torch.cat(hot, -1).float())


def actor_and_critic():
    keys = ["pixels", "instruction"]
    actor = ProbabilisticActor(
        TensorDictModule(Features(3), keys, ["logits"]),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    return actor, TensorDictModule(Features(1), keys, ["state_value"])


@pytest.mark.parametrize("loss_class", [ClipPPOLoss, ReinforceLoss])
def test_losses_read_the_learned_reward_only(loss_class):
    torch.manual_seed(0)
    actor, critic = actor_and_critic()
    loss = loss_class(actor, critic)
    loss.set_keys(reward="learned_reward")
    loss.make_value_estimator(gamma=0.9, lmbda=0.9)
    with torch.no_grad():
        env = make(GoalReward(goal_classifier(), STOP), batch=(32,))
        rollout = env.rollout(20, actor, break_when_any_done=False)
    changed = rollout.clone()
    changed["next", "reward"] += 100.0
    repaid = rollout.clone()
    repaid["next", "learned_reward"] += 100.0
    before, same, other = (
        loss(batch.clone())["loss_objective" if loss_class is ClipPPOLoss else "loss_actor"]
        for batch in (rollout, changed, repaid)
    )
    assert before == same != other


def worker():
    return make(LearnedReward(reward_model()), batch=(4,))


@pytest.mark.filterwarnings("ignore")
def test_new_weights_reach_workers():
    # With buffers, torchrl 0.14.1 no longer waits after load_state_dict (pytorch/rl #4341).
    env = ParallelEnv(2, worker, mp_start_method="fork", use_buffers=False)
    try:
        fresh = worker()
        with torch.no_grad():
            fresh.transform[1].model.module.right.fill_(20.0)
        up = lambda td: td.set("action", torch.zeros(td.shape, dtype=torch.int64))  # noqa: E731
        old = env.rollout(1, up)["next", "learned_reward"]
        env.load_state_dict(fresh.state_dict())
        new = env.rollout(1, up)["next", "learned_reward"]
    finally:
        env.close()
    assert torch.allclose(old, torch.tensor(2.0).sigmoid())
    assert torch.allclose(new, torch.tensor(1.0))
