"""The halves of the instruction classifier and the goal judge; the reward model's actions."""

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_goal_judge, make_instruction_classifier, make_reward_model
from networks.conftest import inputs


@pytest.fixture(params=[make_instruction_classifier, make_goal_judge])
def scorer(request, shapes, preset):
    return request.param(shapes, preset, seed=0)


def images(scorer, data):
    return [data[key] for key in scorer.in_keys[:-1]]


def test_the_halves_together_are_the_whole(scorer, shapes):
    data = inputs(shapes, [5])
    halves = scorer.score(
        scorer.encode_pixels(*images(scorer, data)), scorer.encode_instruction(data["instruction"])
    )
    out = scorer(data.select(*scorer.in_keys))[scorer.out_keys[0]]
    torch.testing.assert_close(halves, out)


@pytest.mark.parametrize("chunk", [1, 4, 2048])
def test_every_scene_with_every_instruction(scorer, shapes, chunk):
    scenes, pool = inputs(shapes, [4]), inputs(shapes, [3], seed=1)["instruction"]
    features = scorer.encode_pixels(*images(scorer, scenes))
    scores = scorer.score_all(features, scorer.encode_instruction(pool), chunk=chunk)
    expected = torch.cat(
        [
            scorer(scenes.select(*scorer.in_keys[:-1]).set("instruction", words.expand(4, -1)))[
                scorer.out_keys[0]
            ]
            for words in pool
        ],
        -1,
    )
    torch.testing.assert_close(scores, expected)


def test_no_scenes_or_no_instructions_give_no_scores(scorer, shapes):
    data = inputs(shapes, [4])
    features = scorer.encode_pixels(*images(scorer, data))
    words = scorer.encode_instruction(data["instruction"])
    assert scorer.score_all(features[:0], words).shape == (0, 4)
    assert scorer.score_all(features, words[:0]).shape == (4, 0)


def test_features_know_no_instruction_and_need_matching_batches(scorer, shapes):
    data = inputs(shapes, [2, 3])
    features = scorer.encode_pixels(*images(scorer, data))
    assert features.shape[:2] == (2, 3)
    with pytest.raises(UserError, match="same batch dims"):
        scorer.score(features, scorer.encode_instruction(data["instruction"][0]))


def test_the_reward_model_scores_all_actions_as_it_scores_each(shapes, preset):
    model = make_reward_model(shapes, preset, seed=0)
    data = inputs(shapes, [2, 3])
    every = model.all_actions(data["pixels"], data["instruction"])
    assert every.shape == (2, 3, 6)
    for action in range(6):
        chosen = data.clone().set("action", torch.full((2, 3), action))
        torch.testing.assert_close(model(chosen)["action_score"][..., 0], every[..., action])
    with pytest.raises(UserError, match=r"action \[2, 3, 1\]"):
        model(
            pixels=data["pixels"], instruction=data["instruction"], action=data["action"][..., None]
        )


def test_what_is_enough_for_a_word_matters_where_it_is_said(shapes):
    classifier = make_instruction_classifier(shapes, "strong", seed=0)
    data = inputs(shapes, [8])
    word = data["instruction"][0, 0]
    before = classifier(data.clone())["suitability"]
    with torch.no_grad():
        classifier.module.threshold[word] += 2
    changed = (classifier(data.clone())["suitability"] != before).squeeze(-1)
    unsaid = (data["instruction"] != word).all(-1)
    assert changed[0]
    assert unsaid.any() and not changed[unsaid].any()
