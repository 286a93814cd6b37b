"""LearnedReward and what both rewards share: hand-computed pay on environments and batches."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, ToTensorImage

from ifo_grounding.errors import UserError
from ifo_grounding.transforms import LearnedReward
from transforms.counter_world import POOL, expert, make, reward_model

RIGHT, WRONG = (torch.tensor(logit).sigmoid().item() for logit in (2.0, -1.0))


def test_every_step_is_paid_the_probability_of_its_action():
    rollout = make(LearnedReward(reward_model())).rollout(30, break_when_any_done=False)
    paid = rollout["next", "learned_reward"]
    assert paid.shape == (6, 30, 1) and paid.dtype == torch.float32
    right = expert(rollout.clone())["action"] == rollout["action"]
    assert right.any() and not right.all()
    assert torch.allclose(paid[..., 0], torch.where(right, RIGHT, WRONG))
    assert rollout.get("learned_reward", None) is None


def test_the_true_reward_is_left_alone():
    def rollout(*rewards):
        torch.manual_seed(0)
        return make(*rewards).rollout(20, break_when_any_done=False)

    plain, paid = rollout(), rollout(LearnedReward(reward_model()))
    assert torch.equal(plain["next", "reward"], paid["next", "reward"])
    assert torch.equal(plain["action"], paid["action"])


@pytest.mark.parametrize("one_hot", [torch.eye(3).long(), torch.eye(3).bool()])
def test_one_hot_actions_are_understood(one_hot):
    pixels = torch.full((3, 3, 8, 8), 40, dtype=torch.uint8)
    batch = TensorDict({"pixels": pixels, "instruction": POOL[[2, 2, 2]]}, [3])
    paid = LearnedReward(reward_model())(batch.set("action", one_hot))["next", "learned_reward"]
    assert paid.flatten().tolist() == pytest.approx([WRONG, WRONG, RIGHT])


def test_large_batches_are_scored_in_parts():
    sizes = []
    model = TensorDictModule(
        lambda action: sizes.append(len(action)) or action.float().unsqueeze(-1), ["action"], ["x"]
    )
    batch = TensorDict({"action": torch.arange(10_000)}, [10_000])
    paid = LearnedReward(model)(batch)["next", "learned_reward"]
    assert torch.equal(paid[:, 0], torch.arange(10_000.0).sigmoid())
    assert sizes == [4096, 4096, 1808]


def test_keys_that_do_not_fit_are_refused():
    with pytest.raises(UserError, match="pays 'reward' already, which stays where it is"):
        make(LearnedReward(reward_model(), out_keys=["reward"])).rollout(1)
    with pytest.raises(UserError, match="in_keys name an entry for each of"):
        LearnedReward(reward_model(), in_keys=["pixels"])
    with pytest.raises(UserError, match="out_keys name the reward, one key"):
        LearnedReward(reward_model(), out_keys=["a", "b"])
    with pytest.raises(
        UserError, match=r"needs the entry 'pixels': the tensordict has \['action'\]"
    ):
        LearnedReward(reward_model())(TensorDict({"action": torch.zeros(2).long()}, [2]))


@pytest.mark.parametrize("wrap", [lambda part: part, Compose])
def test_images_that_a_later_transform_changes_are_refused(wrap):
    def stepped(**options):
        later = ToTensorImage(in_keys=["pixels"], shape_tolerant=True, **options)
        return make(wrap(LearnedReward(reward_model()))).append_transform(wrap(later)).rollout(2)

    with pytest.raises(UserError, match=r"after LearnedReward changes \['pixels'\]"):
        stepped()
    assert stepped(out_keys=["shown"])["shown"].dtype == torch.float32


def test_no_steps_are_paid_nothing():
    steps = make(LearnedReward(reward_model())).rollout(3)[:, :0]
    assert LearnedReward(reward_model())(steps)["next", "learned_reward"].shape == (6, 0, 1)
