"""How episodes end, and what another policy does in the same scenes (paper, Fig. 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.episodes import Outcomes, Policy
from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.evaluation.scenes import Player, play_scenes
from ifo_grounding.stats import Described
from ifo_grounding.tasks.goals import SIDES, Goal, Plan
from ifo_grounding.tasks.grammar import grammar
from ifo_grounding.world import WorldState, neighbour

ENDINGS = ("success", "stuck", "wrong object", "wrong place", "nothing done")
"""How an episode can end. `stuck`: it never stopped. `nothing done`: it stopped without having
moved the object that it was to carry."""
SUCCESS, STUCK, WRONG_OBJECT, WRONG_PLACE, NOTHING_DONE = range(5)


@dataclass(frozen=True)
class Endings(Described):
    """How each of N episodes ended, one per scene; everything on the CPU."""

    counts: dict[str, int]
    """Episodes by how they ended."""
    kind: Tensor
    """Index into :data:`ENDINGS`, int64 [N]."""
    actions: Tensor
    """What was done, int8 [N, max_steps]; -1 after the end."""
    scenes: str
    """Hash of the first frames and instructions of all scenes."""


def episode_endings(policy: Policy, task: str, *, episodes: int = 2000, **options: Any) -> Endings:
    """Play the scenes of :func:`success_rate`, with its options, and say how each episode ended.

    >>> stop = lambda td: td.set("action", torch.full(td.shape, 5))
    >>> episode_endings(stop, "pick", episodes=50).counts["nothing done"]
    50
    """
    numbers = range(at_least_one("episodes", episodes))
    (kind, actions), scenes = play_scenes(policy, task, numbers, _play, **options)
    return Endings(_counts(kind), kind, actions, scenes)


def compare_endings(before: Endings, after: Endings) -> dict[str, Any]:
    """Count what changed from one policy to another, scene by scene.

    Returns:
        ``gained``: scenes that only the second solves, by how the first one's episode ended;
        ``lost``: scenes that only the first solves, by how the second one's ended; ``other path``
        and ``same path``: scenes that both solve.

    Raises:
        UserError: where the two are about different scenes, or episodes of different length.
    """
    if before.scenes != after.scenes or before.actions.shape != after.actions.shape:
        raise UserError(
            "the two are about different scenes: use the same seed, stream and max_steps"
        )
    first, second = before.kind == SUCCESS, after.kind == SUCCESS
    same = (before.actions == after.actions).all(1)
    return {
        "gained": _counts(before.kind[~first & second]),
        "lost": _counts(after.kind[first & ~second]),
        "other path": int((first & second & ~same).sum()),
        "same path": int((first & second & same).sum()),
    }


def _play(player: Player, env: EnvBase, start: TensorDictBase) -> tuple[Tensor, ...]:
    """Return how episodes ended, and what was done."""
    assert isinstance(env, PickAndPlaceEnv)
    first, wanted = env.truth.state.clone(), env.truth.wanted.clone()
    goal = grammar(env.task).parse_tokens(start[keys.INSTRUCTION])
    last = first.clone()
    shape = (env.num_envs, env.options.max_steps)
    actions = torch.full(shape, -1, dtype=torch.int8, device=env.device)
    taken = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)

    def keep(rows: Tensor, transition: TensorDictBase) -> None:
        last[rows] = env.truth.state[rows]
        actions[rows, taken[rows]] = transition[keys.ACTION].to(torch.int8)
        taken[rows] += 1

    outcomes = player(env, start, on_step=keep)
    return _ending(first, last, wanted, goal, outcomes), actions


def _ending(
    first: WorldState, last: WorldState, wanted: Plan, goal: Goal, outcomes: Outcomes
) -> Tensor:
    """Return how episodes ended, index into ENDINGS [B]."""
    gone_to = _gone_to(last, goal)
    carried = _carried(first, last, wanted)
    mistaken = torch.where(goal.carries, carried, gone_to)
    untouched = goal.carries & (last.objects == first.objects).all(-1) & (last.held == 0)
    kind = torch.where(mistaken > 0, WRONG_OBJECT, WRONG_PLACE)
    kind = torch.where(untouched, NOTHING_DONE, kind)
    kind = torch.where(outcomes.stopped, kind, STUCK)
    return torch.where(outcomes.success, SUCCESS, kind)


def _gone_to(last: WorldState, goal: Goal) -> Tensor:
    """Return the kind of the object that the arm stands at, in the way that a goal asks for."""
    opposite = (goal.side + len(SIDES) // 2) % len(SIDES)
    beside, inside = neighbour(last.arm, opposite, last.size)
    cell = torch.where(goal.has_side, beside, last.arm)
    found = last.objects.gather(-1, cell.unsqueeze(-1)).squeeze(-1).long()
    return torch.where(inside | ~goal.has_side, found, 0)


def _carried(first: WorldState, last: WorldState, wanted: Plan) -> Tensor:
    """Return the kind of an object, other than the one to be carried, that was moved; else 0."""
    others = first.objects.scatter(-1, wanted.object_cell.unsqueeze(-1), 0)
    gone = (others > 0) & (last.objects != others)
    return others.gather(-1, gone.byte().argmax(-1, keepdim=True)).squeeze(-1).long() * gone.any(-1)


def _counts(kinds: Tensor) -> dict[str, int]:
    found = kinds.bincount(minlength=len(ENDINGS)).tolist()
    return dict(zip(ENDINGS, found, strict=True))
