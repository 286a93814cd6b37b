"""What is shown of an episode is what decided it."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import record_episodes, trace_episode
from ifo_grounding.networks import make_goal_classifier, make_policy, make_reward_model
from ifo_grounding.report import trace_animation
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


def test_judges_say_what_the_learned_reward_pays(env):
    policy = make_policy(env, seed=0)
    judges = {"action": make_reward_model(env, seed=1), "goal": make_goal_classifier(env, seed=2)}
    (episode,) = record_episodes(policy, "pick", [2], max_steps=7)
    trace = trace_episode(policy, episode, judges)
    frames = torch.from_numpy(episode.frames)
    steps = len(episode.actions)
    played = TensorDict(
        {
            keys.PIXELS: frames[:-1],
            keys.INITIAL_PIXELS: frames[:1].expand_as(frames[:-1]),
            keys.INSTRUCTION: VOCABULARY.encode([episode.sentence]).expand(steps, -1),
            keys.ACTION: torch.from_numpy(episode.actions),
            keys.NEXT: {keys.PIXELS: frames[1:]},
        },
        batch_size=[steps],
    )
    paid = LearnedReward(judges["action"])(played.clone())[keys.NEXT, keys.LEARNED_REWARD]
    np.testing.assert_allclose(trace.rewards["action"], paid.flatten(), rtol=1e-4)
    # A stop changes nothing, so the goal's reward for one is what the judge says of the frame.
    stopped = played.clone()
    stopped[keys.ACTION] = torch.full((steps,), keys.STOP)
    stopped[keys.NEXT, keys.PIXELS] = stopped[keys.PIXELS]
    goal = LearnedReward(judges["goal"], "goal", stop_action=keys.STOP)
    paid = goal(stopped)[keys.NEXT, keys.LEARNED_REWARD]
    np.testing.assert_allclose(trace.rewards["goal"], paid.flatten(), rtol=1e-4)


def test_every_step_is_a_picture(env):
    policy = make_policy(env, "strong", seed=0)
    (episode,) = record_episodes(policy, "pick", [2], max_steps=7)
    trace = trace_episode(policy, episode)
    for shown in (2, 30):
        moving = Image.open(io.BytesIO(trace_animation(trace, steps=shown)))
        assert moving.n_frames == min(shown, len(episode.actions))
    with pytest.raises(UserError, match="6 actions and 3 names"):
        trace_animation(trace, actions="LRS")
