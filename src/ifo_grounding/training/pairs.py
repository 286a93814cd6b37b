"""The paper's fixed set of starts: pairs of a scene and a suitable instruction."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.keys import INSTRUCTION, PIXELS, SCENE
from ifo_grounding.progress import progress_bar
from ifo_grounding.seeding import generator
from ifo_grounding.transforms.base import check_pool
from ifo_grounding.transforms.choosing import PoolScorer
from ifo_grounding.transforms.sampler import NothingSuitableError
from ifo_grounding.transforms.starts import FRAME_HASH, frame_hash

PATIENCE, LEAST_SERVED = 100, 0.002
"""Resets from which on the search is given up where a smaller share of states has a pair."""


def select_pairs(
    env: EnvBase,
    classifier: TensorDictModuleBase,
    pool: Tensor,
    n: int,
    *,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
) -> TensorDict:
    """Store ``n`` scenes of a simulator, each with a suitable instruction (5K or 10K in the paper).

    Only first frames are scored. :class:`ifo_grounding.transforms.StartingPairs` begins episodes
    with the pairs, in an environment made with the same arguments.

    Args:
        env: simulator without instructions, with ``scene_numbers`` of its running episodes.
        classifier: TensorDictModule from (pixels, instruction) to the logit of suitability.
        pool: token ids of the instructions, int64 [N, L]; duplicates count once.
        options: of :meth:`ifo_grounding.transforms.PoolScorer.choose`: ``threshold``,
            ``candidates``, ``choose``.

    Returns:
        TensorDict [n] on the CPU: ``scene`` int64 [n, 1], ``instruction`` int64 [n, L] and
        ``frame_hash`` int64 [n, 1].

    Raises:
        UserError: on a simulator that does not number its scenes, or an impossible option.
        NothingSuitableError: where, after 100 resets, less than one state in 500 has a pair.

    >>> from tensordict.nn import TensorDictModule
    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> classifier = TensorDictModule(
    ...     lambda pixels, instruction: torch.full((len(pixels), 1), 9.0),
    ...     ["pixels", "instruction"], ["suitability"],
    ... )
    >>> env = PickAndPlaceEnv("move", num_envs=4, seed=0, instructed=False)
    >>> pairs = select_pairs(env, classifier, torch.ones(1, 16).long(), 6)
    >>> pairs["scene"].squeeze(-1).tolist()
    [0, 1, 2, 3, 4, 5]
    """
    n = at_least_one("the number of pairs", n)
    if not isinstance(getattr(env, "scene_numbers", None), Tensor):
        raise UserError("select_pairs needs an environment with scene_numbers: PickAndPlaceEnv")
    if INSTRUCTION in env.full_observation_spec.keys(True, True):
        raise UserError("select_pairs chooses the instructions: use instructed=False")
    scorer = PoolScorer(classifier, check_pool(pool).unique(dim=0))
    source = generator(seed, "select-pairs")
    found: list[TensorDict] = []
    count = seen = resets = 0
    best_score = 0.0
    with progress_bar(total=n, desc="pairs", shown=progress) as bar:
        while count < n:
            pixels = env.reset()[PIXELS].flatten(0, env.batch_dims - 1)
            choices = scorer.choose(pixels, generator=source, **options)
            rows = (choices.chosen >= 0).nonzero().squeeze(-1)[: n - count]
            seen, count, resets = seen + len(pixels), count + len(rows), resets + 1
            best_score = max(best_score, float(choices.score.max()))
            if resets >= PATIENCE and count < min(n, LEAST_SERVED * seen):
                raise NothingSuitableError(
                    f"only {count:,} of {seen:,} states got an instruction that scored above the "
                    f"threshold (best score seen: {best_score:.2f}), too few to find {n:,} pairs: "
                    "lower threshold, raise candidates, or train the classifier, or the policy "
                    "that it was initialised from, longer"
                )
            pairs = {
                SCENE: env.scene_numbers.flatten()[rows].unsqueeze(-1),
                INSTRUCTION: scorer.pool.to(rows.device)[choices.chosen[rows]],
                FRAME_HASH: frame_hash(pixels[rows]).unsqueeze(-1),
            }
            found.append(TensorDict(pairs, [len(rows)]).cpu())
            bar.update(len(rows))
    return torch.cat(found)
