"""What is shown of an episode is what decided it."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.evaluation import record_episodes, trace_episode
from ifo_grounding.networks import make_policy, make_reward_model
from ifo_grounding.tasks import VOCABULARY
from ifo_grounding.transforms import LearnedReward


@pytest.fixture(scope="module")
def env():
    return PickAndPlaceEnv("pick", num_envs=1)


@pytest.mark.parametrize(("preset", "maps"), [("strong", 16), ("paper", 1)])
def test_steps_are_as_the_policy_took_them(env, preset, maps):
    policy = make_policy(env, preset, seed=0)
    (episode,) = record_episodes(policy, "pick", [2], max_steps=7)
    trace = trace_episode(policy, episode)
    steps = len(episode.actions)
    assert trace.probabilities.shape == (steps, 6)
    np.testing.assert_allclose(trace.probabilities.sum(-1), 1, rtol=1e-5)
    assert (trace.probabilities.argmax(-1) == episode.actions).all()
    assert trace.maps.shape[:2] == (steps, maps)
    np.testing.assert_allclose(trace.maps.sum((-2, -1)), 1, rtol=1e-4)
    assert trace.rewards == {}


def test_reward_models_say_what_the_learned_reward_pays(env):
    policy, model = make_policy(env, seed=0), make_reward_model(env, seed=1)
    changed = TensorDictModule(
        lambda first, last: (first != last).flatten(1).float().mean(1, keepdim=True),
        ["initial_pixels", "pixels"],
        ["goal_score"],
    )
    (episode,) = record_episodes(policy, "pick", [2], max_steps=7)
    trace = trace_episode(policy, episode, {"action": model, "goal": changed})
    frames, steps = torch.from_numpy(episode.frames), len(episode.actions)
    played = TensorDict(
        {
            keys.PIXELS: frames[:-1],
            keys.INSTRUCTION: VOCABULARY.encode([episode.sentence]).expand(steps, -1),
            keys.ACTION: torch.from_numpy(episode.actions),
        },
        batch_size=[steps],
    )
    paid = LearnedReward(model)(played)[keys.NEXT, keys.LEARNED_REWARD]
    np.testing.assert_allclose(trace.rewards["action"], paid.flatten(), rtol=1e-4)
    differs = (frames[:-1] != frames[:1]).flatten(1).float().mean(1)
    np.testing.assert_allclose(trace.rewards["goal"], differs.sigmoid(), rtol=1e-4)
