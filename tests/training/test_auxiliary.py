import functools

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ifo_grounding import keys
from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_reward_model
from ifo_grounding.objectives import ImitationLoss, RewardLoss
from ifo_grounding.training import (
    AdversarialUpdates,
    AuxiliaryImitation,
    BestCheckpoint,
    HeldOutAccuracy,
    self_examine,
)
from ifo_grounding.training.updates import means
from training import tiny


def test_metrics_that_some_updates_lack_are_means_of_the_others():
    updates = [{"loss": torch.tensor(1.0)}, {"loss": torch.tensor(2.0), "rare": torch.tensor(4.0)}]
    assert means(updates) == {"loss": 1.5, "rare": 4.0}


def reward_loss(seed=0):
    return RewardLoss(make_reward_model(tiny.simulator(1), features=16, seed=seed))


def test_auxiliary_imitation_keeps_what_the_demonstrations_show():
    """Demonstrations that always take action 3 hold against a reward model that likes action 1."""
    demos, shares = TensorDictReplayBuffer(storage=LazyTensorStorage(12)), {}
    shown = {keys.PIXELS: tiny.simulator(12).reset()[keys.PIXELS], keys.INSTRUCTION: tiny.POOL}
    demos.extend(TensorDict({**shown, keys.ACTION: torch.full((12,), 3)}, [12]))
    for weight in (0.0, 10.0):
        policy, value = tiny.make_networks()
        imitation = AuxiliaryImitation(ImitationLoss(policy), demos, weight, 32) if weight else None
        taught = tiny.config(iterations=3, **tiny.TEACH)
        history = self_examine(tiny.make_env(), policy, value, taught, seed=0, imitation=imitation)
        assert ("loss_imitation" in history[-1]) == bool(weight)
        action = policy(TensorDict(shown, [12]))[keys.ACTION]
        shares[weight] = float((action == 3).float().mean())
    assert shares[0.0] < 0.3 and shares[10.0] > 0.8
    with pytest.raises(UserError, match="weight must be above 0"):
        AuxiliaryImitation(ImitationLoss(policy), demos, 0.0)


@functools.cache
def demonstrated():
    demos, truth = record_demonstrations("move", 20, seed=0, keep_truth=True)
    return labelled_buffer(demos, truth.actions)


def adversarial(seed=0):
    return AdversarialUpdates(reward_loss(seed), demonstrated(), steps=4, lr=3e-3, batch_size=32)


def test_adversarial_updates_tell_actions_apart_and_go_on_from_a_checkpoint(tmp_path):
    """The policy's own from those demonstrated."""
    options = {"seed": 0, "checkpoint": tmp_path / "run.pt", "checkpoint_seconds": 0.0}

    def examine(updates, **options):
        env, chosen = tiny.make_env(updates.loss.network, num_envs=8), tiny.config()
        return self_examine(env, *tiny.make_networks(), chosen, adversarial=updates, **options)

    whole, resumed = adversarial(), adversarial(seed=1)
    first, last = examine(whole, seed=0)
    assert last["reward/loss_reward"] < first["reward/loss_reward"]
    assert last["reward/positive_probability"] > last["reward/negative_probability"]
    with pytest.raises(KeyboardInterrupt):
        examine(adversarial(), log=tiny.kill_at(2), **options)
    examine(resumed, **options)
    assert tiny.same(tiny.weights(resumed.loss), tiny.weights(whole.loss))


def test_with_adversarial_updates_the_most_accurate_policy_is_kept():
    """The learned returns would keep the last policy, which a misleading reward has changed."""
    policy, value = tiny.make_networks()
    tiny.prefer(policy, 2)
    before = tiny.weights(policy)
    misled = tiny.config(select_every=1, **tiny.TEACH)
    updates = AdversarialUpdates(reward_loss(), tiny.labelled(2), 1, 0.0)
    options = {"seed": 0, "adversarial": updates}
    accuracy = HeldOutAccuracy(policy, tiny.labelled(2))
    history = self_examine(tiny.make_env(), policy, value, misled, held_out=accuracy, **options)
    assert [metrics.get("selected") for metrics in history] == [0, 0]
    assert history[-1]["held_out_accuracy"] < 0.5
    assert "selection_return" not in history[-1]
    assert tiny.same(tiny.weights(policy), before)
    with pytest.raises(UserError, match="give held_out="):
        self_examine(tiny.make_env(tiny.likes(1)), policy, value, misled, **options)
    with pytest.raises(UserError, match="give held_out="):
        BestCheckpoint(tiny.make_env(), policy, seed=0, by_accuracy=True)
