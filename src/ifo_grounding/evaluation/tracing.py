"""What went on inside a policy and the networks of its rewards during an episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ifo_grounding import keys
from ifo_grounding.evaluation.recording import Episode
from ifo_grounding.modules import device_of, evaluating, output_key
from ifo_grounding.networks import attention_maps
from ifo_grounding.tasks.vocabulary import VOCABULARY, Vocabulary


@dataclass(frozen=True)
class Trace:
    """An episode of T steps with what decided them."""

    episode: Episode
    """What happened."""
    probabilities: np.ndarray
    """Of the A actions at each step, float32 [T, A]."""
    maps: np.ndarray
    """How each of M maps weighs the cells at each step, float32 [T, M, h, w]."""
    rewards: dict[str, np.ndarray]
    """What each learned reward's network says of each step, a probability, float32 [T]."""


@torch.no_grad()
def trace_episode(
    policy: TensorDictModule,
    episode: Episode,
    networks: Mapping[str, TensorDictModule] | None = None,
    *,
    vocabulary: Vocabulary | None = None,
) -> Trace:
    """Ask a policy and the networks of learned rewards about each step of an episode.

    Args:
        episode: from :func:`record_episodes`, its frames as the policy sees them.
        networks: by name: reward models, which score the action that was taken, and goal
            classifiers, which say whether the instruction is fulfilled where the arm was then.
        vocabulary: of the instruction; by default that of the library's own world.

    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> from ifo_grounding.evaluation import record_episodes
    >>> from ifo_grounding.networks import make_policy, make_reward_model
    >>> env = PickAndPlaceEnv("move", num_envs=1)
    >>> policy = make_policy(env, seed=0)
    >>> (episode,) = record_episodes(policy, "move", [0])
    >>> trace = trace_episode(policy, episode, {"action": make_reward_model(env, seed=0)})
    >>> trace.probabilities.shape[1], trace.maps.shape[1:], sorted(trace.rewards)
    (6, (16, 6, 6), ['action'])
    """
    steps, device = len(episode.actions), device_of(policy)
    words = (vocabulary or VOCABULARY).encode([episode.sentence]).to(device)
    frames = torch.from_numpy(episode.frames[:-1]).to(device)
    seen = TensorDict(
        {
            keys.PIXELS: frames,
            keys.INITIAL_PIXELS: frames[:1].expand_as(frames),
            keys.INSTRUCTION: words.expand(steps, -1),
            keys.ACTION: torch.from_numpy(episode.actions).to(device),
        },
        batch_size=[steps],
    )
    with evaluating(policy):
        maps = attention_maps(policy, frames, seen[keys.INSTRUCTION])
        probabilities = policy.get_dist(seen.copy()).probs
    rewards = {}
    for name, network in (networks or {}).items():
        with evaluating(network):
            written = output_key(network, keys.ACTION_SCORE, keys.GOAL_SCORE)
            logit = network(seen.select(*network.in_keys))[written]
        rewards[name] = logit.sigmoid().flatten().cpu().numpy()
    return Trace(episode, probabilities.cpu().numpy(), maps.cpu().numpy(), rewards)
