"""LC-RL (Fu et al. 2019): a reward from frames and instruction by maximum-entropy inverse RL.

For tasks whose states are the arm's cells, ``move`` and ``move-udlr``, where dynamic programming is
exact. It reads true actions, steps from demonstrations' states, and walks through the scenes in
which it is measured.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.baselines.access import SteppableActionDemonstrations, check_access
from ifo_grounding.envs.base import begin
from ifo_grounding.episodes import play
from ifo_grounding.errors import UserError
from ifo_grounding.modules import evaluating
from ifo_grounding.networks import make_instruction_classifier
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.updates import make_optimizer, means, update
from ifo_grounding.world.dynamics import DOWN, LEFT, RIGHT, UP, neighbour

MOVES = (UP, RIGHT, DOWN, LEFT)
CHOICES = (*MOVES, keys.STOP)
"""What is planned with: the arm never picks."""


def neighbours(size: int) -> Tensor:
    """Return the cell that each move leads to from each of ``size`` x ``size``, int64 [cells, 4].

    >>> neighbours(2).tolist()
    [[0, 1, 2, 0], [1, 1, 3, 0], [0, 3, 2, 2], [1, 3, 3, 2]]
    """
    return neighbour(torch.arange(size * size).unsqueeze(1), torch.tensor(MOVES), size)[0]


def soft_values(reward: Tensor, moves: Tensor, horizon: int) -> Tensor:
    """Return the log-probability of each choice in each cell, [*B, cells, 5], last the stop.

    The stop is paid the reward of its cell, a move nothing; the episode ends after ``horizon``
    moves at the latest. Entropy is that relative to chance, which else would make long walks worth
    more than any goal. Differentiable, so that the likelihood of demonstrations trains the reward
    (Ziebart et al. 2008).

    Args:
        reward: of stopping, [*B, cells].
        moves: of :func:`neighbours`.

    >>> reward = torch.tensor([0.0, 9.0, 0.0, 0.0])
    >>> soft_values(reward, neighbours(2), horizon=3).argmax(-1).tolist()
    [1, 4, 0, 0]
    """
    value = reward
    for _ in range(horizon):
        choices = torch.cat([value[..., moves], reward.unsqueeze(-1)], -1)
        value = choices.logsumexp(-1) - math.log(len(CHOICES))
    return choices.log_softmax(-1)


def walk(env: EnvBase, scenes: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Visit every cell from the first states of scenes, by steps of the simulator alone.

    Args:
        scenes: numbers, int64 [R], as many as the env has rows or fewer.

    Returns:
        What is seen from each cell, uint8 [R, cells, C, H, W], and the instruction.
    """
    state = begin(env, scenes)
    instruction = state[keys.INSTRUCTION].clone()

    def go(action: int) -> Tensor:
        nonlocal state
        state = env.step(state.set(keys.ACTION, torch.full(env.batch_size, action)))[keys.NEXT]
        return state[keys.PIXELS]

    for action in [UP] * (size - 1) + [LEFT] * (size - 1):
        seen = go(action)
    frames = seen.new_empty(len(seen), size * size, *seen.shape[1:])
    for row, cells in enumerate(torch.arange(size * size).view(size, size)):
        along, path = (RIGHT, cells) if row % 2 == 0 else (LEFT, cells.flip(0))
        for place, cell in enumerate(path):
            if row or place:  # the walk begins in the first cell
                seen = go(along if place else DOWN)
            frames[:, cell] = seen
    return frames[: len(scenes)], instruction[: len(scenes)]


class LCRL:
    """Learns a reward of cells from demonstrations, and plans with it.

    Args:
        seen: true actions, and a simulator that begins where demonstrations began.
        size: cells along one side of the world.
        preset: of the reward network.
        horizon: most moves of a plan; by default as many as two sides of the world.
        options: for the network.

    Raises:
        UserError: where ``seen`` is anything else, or a demonstration does more than move.
    """

    access: type[Any] = SteppableActionDemonstrations

    def __init__(
        self,
        seen: Any,
        size: int = 6,
        preset: str = "strong",
        *,
        lr: float = 1e-3,
        horizon: int | None = None,
        **options: Any,
    ) -> None:
        check_access(self, seen, self.access)
        self.seen, self.size, self.horizon = seen, size, horizon or 2 * size
        self.moves = neighbours(size)
        self.network: TensorDictModule = make_instruction_classifier(seen.demos, preset, **options)
        self.optimizer = make_optimizer(self.network.parameters(), lr)
        actions = seen.truth.actions.long()
        if not torch.isin(actions, torch.tensor(CHOICES)).all():
            raise UserError("LC-RL plans moves and a stop, and a demonstrator here did more")
        self.choice = actions.where(actions != keys.STOP, len(CHOICES) - 1)

    @cached_property
    def cells(self) -> Tensor:
        """Where the arm is in each transition, found by the frame alone: int64 [transitions].

        Raises:
            UserError: where a demonstration changes its scene.
        """
        demos, found = self.seen.demos, []
        episode, frame = demos.locate()
        for index in torch.arange(len(demos)).split(self.seen.steps.env.batch_size.numel()):
            frames, _ = walk(self.seen.steps.env, index, self.size)
            of_these = (episode >= index[0]) & (episode <= index[-1])
            shown = demos.frames(frame[of_these])
            same = (frames[episode[of_these] - index[0]] == shown.unsqueeze(1)).flatten(2).all(-1)
            if not same.any(1).all():
                raise UserError(
                    "a demonstration changes its scene: LC-RL knows the arm's cell alone"
                )
            found.append(same.int().argmax(1))
        return torch.cat(found)

    def rewards(self, frames: Tensor, instruction: Tensor) -> Tensor:
        """Return the reward of stopping in each cell, [rows, cells]."""
        rows, cells = frames.shape[:2]
        words = instruction.unsqueeze(1).expand(rows, cells, -1).flatten(0, 1)
        batch = TensorDict(
            {keys.PIXELS: frames.flatten(0, 1), keys.INSTRUCTION: words}, [rows * cells]
        )
        scored = self.network(batch).get(self.network.out_keys[0])
        return scored.float().reshape(rows, cells)

    def learn(self, steps: int, batch_size: int = 32, seed: int = 0) -> Metrics:
        """Raise the likelihood of demonstrated choices; return mean metrics."""
        demos, cells, updates = self.seen.demos, self.cells, []
        torch.manual_seed(seed)
        episode, _ = demos.locate()
        self.network.train()
        for _ in range(steps):
            index = torch.randperm(len(demos))[:batch_size].sort().values
            frames, instruction = walk(self.seen.steps.env, index, self.size)
            chosen = soft_values(self.rewards(frames, instruction), self.moves, self.horizon)
            of_these = torch.isin(episode, index)
            row = torch.searchsorted(index, episode[of_these])
            told = chosen[row, cells[of_these], self.choice[of_these]]
            losses = TensorDict({"loss_likelihood": -told.mean()})
            updates.append(update(losses, self.optimizer))
        self.network.eval()
        return means(updates)

    def success(self, env: EnvBase, episodes: int) -> Tensor:
        """Plan in scenes 0 to ``episodes`` of an instructed world: success, bool [episodes]."""
        found, rows = [], env.batch_size.numel()
        for first in range(0, episodes, rows):
            scenes = torch.arange(first, first + rows).clamp(max=episodes - 1)
            frames, instruction = walk(env, scenes, self.size)
            with evaluating(self.network):
                parts = [
                    soft_values(self.rewards(*part), self.moves, self.horizon).argmax(-1)
                    for part in zip(frames.split(64), instruction.split(64), strict=True)
                ]
            found.append(follow(env, scenes, frames, torch.cat(parts), 2 * self.horizon))
        return torch.cat(found)[:episodes]


def follow(env: EnvBase, scenes: Tensor, frames: Tensor, plan: Tensor, max_steps: int) -> Tensor:
    """Follow plans, [R, cells], in scenes, int64 [R], whose cells look like frames: bool [R]."""
    running = torch.arange(len(scenes))

    def act(state: TensorDictBase) -> TensorDictBase:
        here = (frames[running] == state[keys.PIXELS].unsqueeze(1)).flatten(2).all(-1)
        choice = plan[running, here.int().argmax(1)]
        return state.set(keys.ACTION, torch.tensor(CHOICES)[choice])

    def run(rows: Tensor, transition: TensorDictBase) -> None:
        nonlocal running
        running = rows[~transition[keys.NEXT, "done"].reshape(-1)]

    return play(act, env, begin(env, scenes), max_steps=max_steps, on_step=run).success
