"""The policy and the critic inside TorchRL."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss, ReinforceLoss
from torchrl.objectives.value import GAE

from ifo_grounding.errors import UserError
from ifo_grounding.networks import (
    Shapes,
    make_goal_judge,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_reward_model,
    make_value,
)
from ifo_grounding.networks.transfer import trunk_of
from ifo_grounding.networks.trunk import encode_instruction
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


def test_actions_are_indices_with_their_log_probability(pair, shapes):
    policy, _ = pair
    out = policy(inputs(shapes, [64]).exclude("action"))
    assert out["action"].shape == (64,)
    assert out["action"].dtype == torch.int64
    expected = out["logits"].log_softmax(-1).gather(-1, out["action"].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(out["action_log_prob"], expected)
    assert policy.spec["action"].n == 6


def test_sampling_is_the_default_and_determinism_an_option(shapes):
    data = inputs(shapes, [1]).exclude("action").expand(300)
    sampled = make_policy(shapes, seed=0)(data.clone())
    counts = torch.bincount(sampled["action"], minlength=6)
    expected = 300 * sampled["logits"][0].softmax(-1)
    assert ((counts - expected) ** 2 / expected).sum() < 25.7  # chi-squared, 5 dof, p = 1e-4
    greedy = make_policy(shapes, seed=0, deterministic=True)(data.clone())
    assert torch.equal(greedy["action"], greedy["logits"].argmax(-1))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        asked = make_policy(shapes, seed=0)(data.clone())
    assert torch.equal(asked["action"], greedy["action"])


@pytest.mark.parametrize("options", [{"deactivate_vmap": True}, {"shifted": True}, {}], ids=str)
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


def test_gae_is_the_same_with_and_without_vmap(pair, shapes):
    policy, value = pair
    data = rollout(shapes, policy)
    plain = GAE(gamma=0.99, lmbda=0.95, value_network=value, deactivate_vmap=True)(data.clone())
    mapped = GAE(gamma=0.99, lmbda=0.95, value_network=value)(data.clone())
    torch.testing.assert_close(plain["advantage"], mapped["advantage"], atol=1e-5, rtol=1e-4)


def test_reinforce(pair, shapes):
    policy, value = pair
    loss = ReinforceLoss(policy, value)
    out = loss(rollout(shapes, policy))
    (out["loss_actor"] + out["loss_value"]).backward()
    for network in pair:
        assert all(p.grad is not None for p in network.parameters())


def test_a_critic_starts_from_the_policys_trunk_and_goes_its_own_way(pair):
    policy, value = pair
    source, target = policy.module[0].module.trunk, value.module.trunk
    assert all(map(torch.equal, source.parameters(), target.parameters()))
    with torch.no_grad():
        next(target.parameters()).add_(1)
    assert not torch.equal(next(source.parameters()), next(target.parameters()))


@pytest.mark.parametrize("preset", ["film", "paper"])
def test_a_judge_of_actions_may_start_from_the_policys_trunk_too(shapes, preset):
    policy = make_policy(shapes, preset, seed=0)
    judge = make_reward_model(shapes, preset, init_from=policy, seed=1)
    source, target = trunk_of(policy), judge.module.trunk
    assert all(map(torch.equal, source.parameters(), target.parameters()))
    with pytest.raises(UserError, match="trunk of init_from does not fit"):
        make_reward_model(shapes, preset, init_from=policy, embedding=5)


def test_a_trunk_that_does_not_fit_is_refused(shapes):
    with pytest.raises(UserError, match="trunk of init_from does not fit"):
        make_value(shapes, init_from=make_policy(shapes, features=32))
    for other in (make_inverse(shapes), nn.Linear(1, 1)):
        with pytest.raises(UserError, match="must be a policy"):
            make_value(shapes, init_from=other)


def test_place_matters_to_a_policy(shapes):
    """The head is flattened, not pooled: the same cell elsewhere is something else."""
    policy = make_policy(shapes, seed=0, deterministic=True)
    pixels = torch.zeros(2, 3, 48, 48, dtype=torch.uint8)
    pixels[0, :, :8, :8] = 255
    pixels[1, :, 40:, 40:] = 255
    logits = policy(TensorDict({"pixels": pixels, "instruction": torch.ones(2, 16)}, [2]))["logits"]
    assert (logits[0] - logits[1]).abs().max() > 1e-3


@pytest.mark.parametrize("preset", ["film", "paper"])
def test_an_instruction_module_begins_with_what_the_policy_learned(shapes, preset):
    policy = make_policy(shapes, preset, seed=0)
    classifier = make_instruction_classifier(shapes, preset, init_from=policy, seed=1)
    fresh = make_instruction_classifier(shapes, preset, seed=1)
    tokens = torch.randint(1, shapes.vocabulary_size, (4, shapes.instruction_length))
    trunk = trunk_of(policy)
    assert torch.equal(
        classifier.encode_instruction(tokens), encode_instruction(trunk.instruction, tokens)
    )
    assert not torch.equal(classifier.encode_instruction(tokens), fresh.encode_instruction(tokens))
    fusion = classifier.module.fusion.state_dict()
    assert fusion
    assert all(torch.equal(trunk.fusion.state_dict()[name], w) for name, w in fusion.items())
    with pytest.raises(UserError, match="does not fit"):
        make_instruction_classifier(shapes, preset, init_from=policy, embedding=5)


@pytest.mark.parametrize("make", [make_instruction_classifier, make_goal_judge])
@pytest.mark.parametrize("presets", [("strong", "film"), ("film", "strong")])
def test_a_judge_of_sentences_cannot_begin_with_a_reader_of_words(shapes, make, presets):
    policy = make_policy(shapes, presets[0], seed=0)
    with pytest.raises(UserError, match="word by word"):
        make(shapes, presets[1], init_from=policy)


@pytest.mark.parametrize("make", [make_instruction_classifier, make_goal_judge])
def test_a_judge_of_words_begins_with_the_policys(shapes, make):
    policy = make_policy(shapes, "strong", seed=0)
    judge = make(shapes, "strong", init_from=policy, seed=1)
    tokens = torch.randint(1, shapes.vocabulary_size, (4, shapes.instruction_length))
    trunk = trunk_of(policy)
    start, other, now = torch.randint(256, (3, 5, *shapes.image_shape), dtype=torch.uint8)
    seen = (start, now)[-judge.images :]
    features = judge.encode_pixels(*seen)
    words_said = judge.images * shapes.vocabulary_size
    heads = trunk.attention.out_features + trunk.value.out_features
    silent = features.flatten(2)[:, words_said : words_said + heads]
    looks = trunk.looks(now)
    expected = torch.cat([trunk.attention(looks.silhouette), trunk.value(looks.silhouette)], -1)
    torch.testing.assert_close(silent.transpose(1, 2), expected[looks.where])
    if judge.images == 2:
        again = judge.encode_pixels(other, now)
        last = slice(shapes.vocabulary_size, words_said + heads)
        assert torch.equal(features[:, last], again[:, last])
        first = slice(shapes.vocabulary_size)
        assert not torch.equal(features[:, first], again[:, first])
    (said, manner), words = trunk.words.listen(tokens), judge.encode_instruction(tokens)
    torch.testing.assert_close(words[:, -manner.shape[1] :], manner)
    # Which words count for which map is its own to learn.
    own = words[:, : -manner.shape[1]]
    assert not torch.isclose(own, said.flatten(1)).all()
    torch.testing.assert_close(
        own, make(shapes, "strong", seed=1).encode_instruction(tokens)[:, : own.shape[1]]
    )
    with pytest.raises(UserError, match="does not fit"):
        make(shapes, "strong", init_from=policy, heads=5)


@pytest.mark.parametrize("preset", ["film", "paper"])
def test_a_goal_judge_begins_with_what_the_policy_sees_in_the_present_image(shapes, preset):
    policy = make_policy(shapes, preset, seed=0)
    judge = make_goal_judge(shapes, preset, init_from=policy, seed=1)
    first, other, now = torch.randint(256, (3, 5, *shapes.image_shape), dtype=torch.uint8)
    features = judge.encode_pixels(first, now)
    assert torch.equal(features, judge.encode_pixels(other, now))
    torch.testing.assert_close(features, trunk_of(policy).image(now))
