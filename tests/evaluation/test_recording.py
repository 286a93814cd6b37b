"""Recorded episodes are those that the success rate counts."""

from functools import partial

import numpy as np
import pytest
from torchrl.envs import GymEnv, SerialEnv

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import record_episodes, success_rate
from ifo_grounding.tasks import grammar


def test_frames_actions_and_outcome_belong_together(make_expert):
    expert = make_expert("pick-out")
    numbers = [3, 11, 4]
    episodes = record_episodes(expert, "pick-out", numbers, expose_state=True)
    assert [episode.scene for episode in episodes] == numbers
    steps = expert.steps(12)
    for episode in episodes:
        assert len(episode.actions) == steps[episode.scene]
        assert episode.frames.shape == (len(episode.actions) + 1, 3, 48, 48)
        assert episode.frames.dtype == np.uint8
        # The expert wastes no step, so that frames change until the stop repeats the last one.
        changes = (episode.frames[1:] != episode.frames[:-1]).any((1, 2, 3))
        assert changes[:-1].all() and not changes[-1]
        assert episode.actions[-1] == 5 and episode.stopped and episode.success
        grammar("pick-out").parse(episode.sentence)


def test_outcomes_agree_with_the_success_rate(up, random_policy):
    outcomes = success_rate(up, "move", episodes=100).outcomes
    episodes = record_episodes(up, "move", range(100))
    assert [episode.success for episode in episodes] == outcomes.tolist()
    assert any(outcomes) and not any(episode.stopped for episode in episodes)
    # Sampled actions are the same too, of the same batch.
    lengths = success_rate(random_policy, "move", mode="sampled", episodes=9).lengths
    episodes = record_episodes(random_policy, "move", range(9), mode="sampled")
    assert [len(episode.actions) for episode in episodes] == lengths.tolist()


def test_scenes_of_a_world_without_numbers_are_the_first_ones(random_policy):
    workers = SerialEnv(2, partial(PickAndPlaceEnv, "move", num_envs=3))
    episodes = record_episodes(random_policy, workers, range(6))
    assert [episode.frames.shape[1:] for episode in episodes] == [(3, 48, 48)] * 6
    assert all(episode.sentence for episode in episodes)
    single = GymEnv("ifo_grounding/Move-v0", categorical_action_encoding=True)
    (episode,) = record_episodes(random_policy, single, [0])
    assert episode.frames.shape[1:] == (3, 48, 48) and episode.sentence
    with pytest.raises(UserError, match="cannot be reset to a scene by its number"):
        record_episodes(random_policy, single, [5])


def test_scenes_that_do_not_fit(random_policy):
    assert record_episodes(random_policy, "move", []) == []
    with pytest.raises(UserError, match="has 2 rows for 3 scenes"):
        record_episodes(random_policy, PickAndPlaceEnv("move", num_envs=2), range(3))
