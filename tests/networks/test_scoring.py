"""The halves of the classifiers of pairs; the reward model's actions."""

import pytest
import torch

from ifo_grounding import networks
from ifo_grounding.errors import UserError
from networks.conftest import inputs


@pytest.fixture(params=[networks.make_instruction_classifier, networks.make_goal_classifier])
def scorer(request, shapes, preset):
    return request.param(shapes, preset, seed=0)


def images(scorer, data):
    return [data[key] for key in scorer.in_keys[:-1]]


@pytest.mark.parametrize("at_once", [1, 4096])
def test_the_halves_together_are_the_whole(scorer, shapes, at_once, monkeypatch):
    monkeypatch.setattr(networks.scoring, "PAIRS_AT_ONCE", at_once)
    scenes, pool = inputs(shapes, [4]), inputs(shapes, [3], seed=1)["instruction"]
    encoded = scorer.encode_scenes(*images(scorer, scenes))
    every = torch.arange(3).expand(4, -1)
    scores = scorer.score_candidates(encoded, scorer.encode_instruction(pool), every)
    expected = [
        scorer(scenes.select(*scorer.in_keys[:-1]).set("instruction", words.expand(4, -1)))[
            scorer.out_keys[0]
        ]
        for words in pool
    ]
    torch.testing.assert_close(scores, torch.cat(expected, -1))


def test_no_scenes_or_no_candidates_give_no_scores(scorer, shapes):
    data = inputs(shapes, [4])
    scenes = scorer.encode_scenes(*images(scorer, data))
    words = scorer.encode_instruction(data["instruction"])
    none = torch.zeros(4, 0, dtype=torch.int64)
    assert scorer.score_candidates(scenes[:0], words, none[:0]).shape == (0, 0)
    assert scorer.score_candidates(scenes, words, none).shape == (4, 0)


def test_the_reward_model_scores_all_actions_as_it_scores_each(shapes, preset):
    model = networks.make_reward_model(shapes, preset, seed=0)
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
