"""What a method may use of demonstrations: a type for each access of the paper's Table 1."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase, Transform, TransformedEnv

from ifo_grounding import keys
from ifo_grounding.data import Demonstrations, Truth, labelled_buffer
from ifo_grounding.data.buffers import frame_buffer
from ifo_grounding.envs.base import begin
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import generator

ENDED = (keys.NEXT, "terminated")


def transitions_of(demos: Demonstrations, last: bool = False) -> TensorDictReplayBuffer:
    """Put transitions without actions into a replay buffer.

    A sample holds ``pixels`` and ``("next", "pixels")``, uint8 [B, C, H, W], ``instruction``
    int64 [B, L], and ``("next", "terminated")`` bool [B, 1]: the stops of demonstrations that show
    theirs.

    Args:
        last: whether only those stops.
    """
    episode, frame = demos.locate()
    ended = demos.closed[episode] & (frame == (demos.starts + demos.lengths - 2)[episode])
    if last:
        episode, frame, ended = episode[ended], frame[ended], ended[ended]
    stored = {keys.PIXELS: frame, keys.NEXT_PIXELS: frame + 1, keys.INSTRUCTION: episode}
    stored[ENDED] = ended.unsqueeze(-1)
    return frame_buffer(demos, stored, [keys.PIXELS, keys.NEXT_PIXELS])


def check_access(method: object, seen: object, allowed: type) -> None:
    """Refuse a source that gives less than a method needs, or more than it may use."""
    if type(seen) is not allowed:
        raise UserError(
            f"{type(method).__name__} uses {allowed.__name__}, no more and no less, got "
            f"{type(seen).__name__}"
        )


@dataclass(frozen=True)
class ActionDemonstrations:
    """Frames, instruction and the demonstrator's true actions: for GAIL and behavioural cloning.

    >>> from ifo_grounding.data import record_demonstrations
    >>> seen = ActionDemonstrations(*record_demonstrations("move", 3, keep_truth=True))
    >>> seen.transitions()[:]["action"].shape == seen.truth.actions.shape
    True
    """

    demos: Demonstrations
    truth: Truth

    def transitions(self) -> TensorDictReplayBuffer:
        """Return transitions with true actions, as :func:`ifo_grounding.data.labelled_buffer`."""
        return labelled_buffer(self.demos, self.truth.actions)


class SteppableDemonstrations:
    """Frames, instruction, and a simulator that begins where a demonstration began: for AGILE.

    Args:
        demos: demonstrations.
        env: shows ``pixels`` and ``instruction``; scene number i of it is the first state of
            demonstration i, as of :meth:`ifo_grounding.worlds.Grid.steppable`.

    Raises:
        UserError: where a first frame or an instruction is another one.

    >>> from ifo_grounding.data import record_demonstrations
    >>> from ifo_grounding.worlds import Grid
    >>> seen = SteppableDemonstrations(
    ...     record_demonstrations("move", 6, seed=0), Grid("move").steppable(2, seed=0)
    ... )
    >>> torch.equal(seen.reset([3, 4])["pixels"][0], seen.demos[3]["pixels"][0])
    True
    """

    def __init__(self, demos: Demonstrations, env: EnvBase) -> None:
        self.demos, self.env = demos, env
        for index in torch.arange(len(demos)).split(env.batch_size.numel()):
            shown = begin(env, index)[: len(index)]
            same = shown[keys.PIXELS].cpu() == demos.frames(demos.starts[index])
            if not same.all() or not torch.equal(
                shown[keys.INSTRUCTION].cpu(), demos.instructions[index].long()
            ):
                raise UserError(
                    f"the simulator does not begin as demonstrations {int(index[0])} and on do: "
                    "make it with their task, seed and options, as Grid.steppable does"
                )

    def reset(self, index: list[int] | Tensor) -> TensorDictBase:
        """Begin an episode in each row with the first state of a demonstration, by its number."""
        index = torch.as_tensor(index, device=self.env.device)
        if index.shape != self.env.batch_size or ((index < 0) | (index >= len(self.demos))).any():
            raise UserError(
                f"give the number of one of {len(self.demos)} demonstrations for each of "
                f"{self.env.batch_size.numel()} rows, got {index.tolist()!r:.60}"
            )
        return begin(self.env, index)

    def starts(self, seed: int = 0) -> TransformedEnv:
        """Return the simulator with every episode begun in a demonstration drawn at random."""
        return TransformedEnv(self.env, DemonstrationStarts(len(self.demos), seed))


@dataclass(frozen=True)
class SteppableActionDemonstrations:
    """True actions, and a simulator that begins where a demonstration began: for LC-RL."""

    steps: SteppableDemonstrations
    truth: Truth

    @property
    def demos(self) -> Demonstrations:
        """What was shown."""
        return self.steps.demos


class DemonstrationStarts(Transform):
    """Begins each episode with a scene drawn at random among the first ``count``."""

    fixes_scenes = True
    """The simulator keeps its seed, of which the demonstrations' scenes are."""

    def __init__(self, count: int, seed: int = 0) -> None:
        super().__init__()
        self.count = count
        self.set_seed(seed)

    def set_seed(self, seed: int) -> None:
        """Restart the draws from a seed."""
        self.generator = generator(seed, "demonstration-starts")

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        parent = self.parent
        assert parent is not None
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=parent.batch_size, device=parent.device)
        drawn = torch.randint(self.count, (*parent.batch_size, 1), generator=self.generator)
        return tensordict.set(keys.SCENE, drawn.to(parent.device or "cpu"))
