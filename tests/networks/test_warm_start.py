"""Networks whose initial weights are a policy's."""

import pytest
import torch
from torch import nn

from ifo_grounding import networks
from ifo_grounding.errors import UserError
from ifo_grounding.networks.trunk import instructed_network
from ifo_grounding.networks.warm_start import inherited

SCORERS = [networks.make_instruction_classifier, networks.make_goal_classifier]
EVERY = [networks.make_value, networks.make_reward_model, *SCORERS]


@pytest.mark.parametrize("make", EVERY)
def test_a_network_inherits_and_goes_its_own_way(shapes, preset, make):
    policy = networks.make_policy(shapes, preset, seed=0)
    network, trunk = (
        make(shapes, preset, init_from=policy, seed=1),
        instructed_network(policy).trunk,
    )
    if make not in SCORERS:
        own = network.module.trunk.state_dict().values()
        assert all(map(torch.equal, own, trunk.state_dict().values()))
    before = [weight.clone() for weight in policy.parameters()]
    with torch.no_grad():
        for now, then in inherited(network):
            assert torch.equal(now, then)
            now.add_(1)
    assert len(inherited(network)) >= 7
    assert all(map(torch.equal, policy.parameters(), before))


@pytest.mark.parametrize("make", EVERY)
def test_a_network_sees_as_far_as_the_policy_that_it_begins_with(shapes, make):
    policy = networks.make_policy(shapes, context=2, seed=0)
    assert make(shapes, init_from=policy).network_config.config.context == 2
    assert make(shapes).network_config.config.context == 0
    if make not in SCORERS:  # which always see one cell around
        with pytest.raises(UserError, match="init_from does not fit"):
            make(shapes, context=1, init_from=policy)


@pytest.mark.parametrize("make", EVERY)
def test_what_does_not_fit_is_refused(shapes, make):
    for options in ({"preset": "paper"}, {"features": 32}):
        with pytest.raises(UserError, match=r"init_from does not fit.*same preset, sizes"):
            make(shapes, init_from=networks.make_policy(shapes, **options))
    for other in (networks.make_inverse(shapes), nn.Linear(1, 1)):
        with pytest.raises(UserError, match="must be a policy"):
            make(shapes, init_from=other)


def test_a_classifier_of_strong_copies_what_words_mean(shapes):
    policy = networks.make_policy(shapes, seed=0)
    classifier = networks.make_instruction_classifier(shapes, init_from=policy, seed=1)
    tokens = torch.randint(1, shapes.vocabulary_size, (4, shapes.instruction_length))
    (_, modifier), words = (
        instructed_network(policy).trunk.words.listen(tokens),
        classifier.encode_instruction(tokens),
    )
    torch.testing.assert_close(words[:, -modifier.shape[1] :], modifier)


@pytest.mark.parametrize("make", SCORERS)
def test_a_classifier_of_paper_copies_sentences_gates_and_the_last_image(shapes, make):
    policy = networks.make_policy(shapes, "paper", seed=0)
    classifier = make(shapes, "paper", init_from=policy, seed=1)
    tokens = torch.randint(1, shapes.vocabulary_size, (4, shapes.instruction_length))
    trunk, own = instructed_network(policy).trunk, classifier.module.trunk
    assert torch.equal(classifier.encode_instruction(tokens), trunk.instruction(tokens))
    assert torch.equal(own.fusion.h.weight, trunk.fusion.h.weight)
    first, other, now = torch.randint(256, (3, 5, *shapes.image_shape), dtype=torch.uint8)
    features = classifier.encode_scenes(*(first, now)[-classifier.images :])
    assert torch.equal(features, classifier.encode_scenes(*(other, now)[-classifier.images :]))
    torch.testing.assert_close(features, trunk.image(now))
