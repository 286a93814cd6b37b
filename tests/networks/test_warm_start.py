"""Networks whose initial weights are a policy's."""

import pytest
import torch
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks import (
    make_goal_classifier,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_reward_model,
    make_value,
    word_scoring,
)
from ifo_grounding.networks.trunk import instructed_network
from ifo_grounding.networks.warm_start import inherited
from networks.test_cells import every_cell_for_itself

SCORERS = [make_instruction_classifier, make_goal_classifier]
EVERY = [make_value, make_reward_model, *SCORERS]


@pytest.mark.parametrize("make", [make_value, make_reward_model])
def test_a_trunk_is_copied_and_goes_its_own_way(shapes, preset, make):
    policy = make_policy(shapes, preset, seed=0)
    network = make(shapes, preset, init_from=policy, seed=1)
    source, target = instructed_network(policy).trunk, network.module.trunk
    assert all(map(torch.equal, source.state_dict().values(), target.state_dict().values()))
    assert all(torch.equal(now, then) for now, then in inherited(network))
    with torch.no_grad():
        next(target.parameters()).add_(1)
    assert not torch.equal(next(source.parameters()), next(target.parameters()))


@pytest.mark.parametrize("make", EVERY)
def test_what_does_not_fit_is_refused(shapes, make):
    for options in ({"preset": "paper"}, {"features": 32}):
        with pytest.raises(UserError, match=r"init_from does not fit.*same preset, sizes"):
            make(shapes, init_from=make_policy(shapes, **options))
    for other in (make_inverse(shapes), nn.Linear(1, 1)):
        with pytest.raises(UserError, match="must be a policy"):
            make(shapes, init_from=other)


@pytest.mark.parametrize("make", SCORERS)
def test_a_classifier_of_paper_copies_sentences_gates_and_the_last_image(shapes, make):
    policy = make_policy(shapes, "paper", seed=0)
    classifier = make(shapes, "paper", init_from=policy, seed=1)
    tokens = torch.randint(1, shapes.vocabulary_size, (4, shapes.instruction_length))
    trunk, own = instructed_network(policy).trunk, classifier.module.trunk
    assert torch.equal(classifier.encode_instruction(tokens), trunk.instruction(tokens))
    assert torch.equal(own.fusion.h.weight, trunk.fusion.h.weight)
    first, other, now = torch.randint(256, (3, 5, *shapes.image_shape), dtype=torch.uint8)
    features = classifier.encode_scenes(*(first, now)[-classifier.images :])
    assert torch.equal(features, classifier.encode_scenes(*(other, now)[-classifier.images :]))
    torch.testing.assert_close(features, trunk.image(now))


@pytest.mark.parametrize("make", SCORERS)
def test_a_classifier_of_strong_copies_what_words_mean(shapes, make, monkeypatch):
    monkeypatch.setattr(word_scoring, "group_cells", every_cell_for_itself)
    policy = make_policy(shapes, seed=0)
    classifier = make(shapes, init_from=policy, seed=1)
    tokens = torch.randint(1, shapes.vocabulary_size, (4, shapes.instruction_length))
    trunk = instructed_network(policy).trunk
    start, now = torch.randint(256, (2, 5, *shapes.image_shape), dtype=torch.uint8)
    features = classifier.encode_scenes(*(start, now)[-classifier.images :]).features
    words_said = classifier.images * shapes.vocabulary_size
    heads = trunk.attention.out_features + trunk.value.out_features
    silent = features[:, words_said : words_said + heads]
    cells = trunk.appearance(now)
    expected = torch.cat([trunk.attention(cells.silhouette), trunk.value(cells.silhouette)], -1)
    torch.testing.assert_close(silent.transpose(1, 2), expected[cells.where])
    (_, modifier), words = trunk.words.listen(tokens), classifier.encode_instruction(tokens)
    torch.testing.assert_close(words[:, -modifier.shape[1] :], modifier)
    # Which words count for which map is its own to learn.
    fresh = make(shapes, seed=1).encode_instruction(tokens)
    own = words[:, : -modifier.shape[1]]
    torch.testing.assert_close(own, fresh[:, : own.shape[1]])
