"""Worlds of Gymnasium that show an image and say an instruction, as a TorchRL environment."""

from __future__ import annotations

import functools
import secrets
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.envs.base import NumberedEnv
from ifo_grounding.envs.reading import ENDED, Reading
from ifo_grounding.envs.simulator import check_actions
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.seeding import STREAMS, derive
from ifo_grounding.tasks.vocabulary import Vocabulary, check_vocabulary

Make = Callable[[], gymnasium.Env]


def from_gymnasium(
    world: str | Make,
    *,
    vocabulary: Vocabulary,
    num_envs: int = 1,
    image: str | None = "image",
    instruction: str = "mission",
    instructed: bool = True,
    stop: int | str | None = None,
    skip_unknown: bool = False,
    processes: bool = False,
    seed: int | None = None,
    stream: str = "training",
    device: torch.device | str | None = None,
    **make_options: Any,
) -> GymnasiumEnv:
    """Put a Gymnasium world behind the keys of this library.

    The world has to show an image of bytes, or a stack of them, or numbers of its tiles, int16
    [h, w], where it has an attribute ``tiles``, uint8 [K, C, T, T]. It has to take actions of a
    ``Discrete`` space, numbered from 0 here; its instruction is a sentence in the observation or in
    ``info``, which stays throughout an episode. Episodes end as the world says,
    and its reward is the true one: for evaluation alone, which counts an episode as a success where
    its last step pays more than 0, and withheld where ``instructed=False``.

    Args:
        world: id for :func:`gymnasium.make`, or a function that makes the world (then give it all
            it needs, wrappers included).
        vocabulary: that of the demonstrations.
        image: name of the image in the observation; None where the observation is the image.
        instruction: name of the sentence in the observation, or else in ``info``.
        instructed: whether episodes show their instruction and pay their reward. Without, an
            episode that the world ends counts as truncated: what the world was asked for is no
            business of a learner.
        stop: how a policy says that it is done: the number of the action that ends an episode; or,
            where none does, of one that does nothing, such as MiniGrid's ``done`` (6), or ``"add"``
            for one more action that never reaches the world. It terminates the episode, and is the
            environment's ``stop_action``; close the demonstrations with
            :meth:`~ifo_grounding.data.Demonstrations.close_episodes` to match. None: no action
            ends an episode as far as a learner is told.
        skip_unknown: whether unknown words are left out of instructions, or refused.
        processes: whether every world runs in a process of its own, for which a script needs its
            ``if __name__ == "__main__":``.
        seed: of the stream of scenes; random by default.
        stream: ``training``, ``validation`` or ``evaluation``: disjoint scenes.
        make_options: for :func:`gymnasium.make`.

    Returns:
        An environment of batch size [num_envs] with ``pixels``, uint8 [N, C, H, W] or codes, and
        ``instruction``, int64 [N, L]. ``reset`` takes ``"scene"`` as
        :class:`~ifo_grounding.envs.PickAndPlaceEnv` does: the same number is the same scene, as
        far as the world obeys its seed.

    Raises:
        UserError: where image, instruction or actions are not as said; where an instruction has an
            unknown word.

    >>> from ifo_grounding.tasks import VOCABULARY
    >>> env = from_gymnasium(
    ...     "ifo_grounding/Move-v0", vocabulary=VOCABULARY, num_envs=2, image="pixels",
    ...     instruction="instruction_text", seed=0,
    ... )
    >>> env.reset()["pixels"].shape
    torch.Size([2, 3, 48, 48])
    """
    check_choice("stream", stream, STREAMS)
    flags = {"instructed": instructed, "skip_unknown": skip_unknown, "processes": processes}
    for name, flag in flags.items():
        check_choice(name, flag, (True, False))
    check_vocabulary(vocabulary)
    if isinstance(world, str):
        world = functools.partial(gymnasium.make, world, **make_options)
    elif make_options:
        raise UserError(
            f"options {sorted(make_options)} are for a world made from its id: give them to it in "
            "your function"
        )
    if not callable(world):
        raise UserError(
            "a world is an id or a function that makes it, such as its class, got "
            f"{type(world).__name__}"
        )
    reading = (vocabulary, image, instruction, instructed, stop, skip_unknown)
    makes = [functools.partial(_open, world, *reading)] * at_least_one("num_envs", num_envs)
    vector = AsyncVectorEnv if processes else SyncVectorEnv
    worlds: Any = vector(makes, autoreset_mode=AutoresetMode.DISABLED)
    if not processes and len({id(each.unwrapped) for each in worlds.envs}) < num_envs:
        raise UserError(
            "the function that makes the world returned the same one twice: let it make a new one, "
            "such as lambda: MyWorld()"
        )
    return GymnasiumEnv(worlds, vocabulary, instructed, seed, stream, device)


def _open(make: Make, *reading: Any) -> Reading:
    env = make()
    try:
        return Reading(env, *reading)
    except BaseException:
        if isinstance(env, gymnasium.Env):
            env.close()
        raise


def world_seed(seed: int, stream: str, number: int) -> int:
    """Return what a world is seeded with for the scene of a number."""
    return derive(seed, stream, number) % 2**31


class GymnasiumEnv(NumberedEnv):
    """What :func:`from_gymnasium` returns: a vector of worlds as :class:`Reading` reads them."""

    own_sentence = (
        "the world sets it. For a sentence of your own, make the environment with "
        "instructed=False and set 'instruction' after its reset: nothing is paid there"
    )

    def __init__(
        self,
        worlds: VectorEnv,
        vocabulary: Vocabulary,
        instructed: bool,
        seed: int | None,
        stream: str,
        device: torch.device | str | None,
    ) -> None:
        super().__init__(worlds.num_envs, vocabulary, instructed, device)
        self._worlds, self.stream = worlds, stream
        self.scene_numbers = torch.full((self.num_envs,), -1)
        """Number of the scene that each row began with, int64 [num_envs]."""
        self._set_seed(seed)
        self.n_actions = int(worlds.single_action_space.n)  # type: ignore[attr-defined]
        self.stop_action = worlds.get_attr("stop")[0]  # type: ignore[attr-defined]
        """The action by which a policy ends an episode, or None."""
        shown: Any = worlds.single_observation_space[keys.PIXELS]  # type: ignore[index]
        self.tiles: Tensor | None = None
        """What the numbers in ``pixels`` stand for, where they are numbers."""
        dtype = torch.uint8
        if len(shown.shape) == 2:
            (tiles, *_), dtype = worlds.get_attr("tiles"), torch.int16  # type: ignore[attr-defined]
            self.tiles = tiles.to(self.device)
            _, channels, _, size = tiles.shape
            self.image_shape = (channels, *(size * side for side in shown.shape))
        high = int(shown.high.max())
        self._declare(self._bounded(high, *shown.shape, dtype=dtype), self.n_actions)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask, numbers = self._asked(tensordict)
        if int(self.scene_numbers.min()) < 0:  # all begin at the first time
            mask = torch.ones_like(mask)
        if len(rows := mask.cpu().nonzero().squeeze(-1)):
            if numbers is not None:
                numbers = numbers.cpu()[rows]
            else:
                numbers = torch.arange(self._next_number, self._next_number + len(rows))
                self._next_number += len(rows)
            # A new tensor: others may hold the old one.
            self.scene_numbers = self.scene_numbers.index_copy(0, rows, numbers)
            numbered = self.scene_numbers.tolist()
            seeds: Any = [world_seed(self._seed, self.stream, number) for number in numbered]
            given = {"reset_mask": mask.cpu().numpy()}
            self._seen, _ = self._worlds.reset(seed=seeds, options=given)
        shown = self._observed()
        if (wish := self._wish(tensordict)) is not None:
            self._check_instruction(wish[mask], shown[keys.INSTRUCTION][mask])
        return shown

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get(keys.ACTION).cpu()
        check_actions(actions, self.num_envs, self.n_actions)
        self._seen, reward, *_ = self._worlds.step(actions.numpy())
        terminated, truncated, stopped = self._seen[ENDED].astype(bool).T
        done = terminated | truncated | stopped
        terminated = terminated | stopped
        if not self.instructed:
            reward, terminated, truncated = np.zeros_like(reward), stopped, done & ~stopped
        flags = {"done": done, "terminated": terminated, "truncated": truncated}
        shown = self._observed(reward=reward.astype(np.float32), **flags)
        if self.instructed:
            self._check_instruction(tensordict.get(keys.INSTRUCTION, None), shown[keys.INSTRUCTION])
        return shown

    def _observed(self, **columns: np.ndarray) -> TensorDict:
        """Return what is seen, with columns [num_envs] beside it."""
        seen = {name: self._seen[name] for name in self.observation_spec.keys()}  # noqa: SIM118
        seen.update({name: column[:, None] for name, column in columns.items()})
        tensors = {name: torch.from_numpy(array) for name, array in seen.items()}
        return TensorDict(tensors, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = secrets.randbits(31) if seed is None else seed
        self._next_number = 0

    def close(self, **options: Any) -> None:
        """Close the worlds."""
        self._worlds.close()
        super().close(**options)
