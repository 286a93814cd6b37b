"""The learner's own experience: transitions of random actions, for the inverse model."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Categorical, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.data.buffers import encoded_buffer
from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.data.decoding import FrameDecoder
from ifo_grounding.data.folder import damaged, load_folder, save_folder
from ifo_grounding.errors import UserError, at_least_one, share, whole
from ifo_grounding.progress import progress_bar
from ifo_grounding.seeding import derive
from ifo_grounding.seeding import generator as seeded

KIND = "ifo-grounding transitions"
BATCH_FRAMES = 2048


class RandomActions(TensorDictModuleBase):
    """A policy that draws actions as :func:`collect_transitions` says, by its own generator.

    Those other than the stop are equally likely.

    Raises:
        UserError: where the actions are not categorical, or the stop is not one of them.

    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> env = PickAndPlaceEnv("move", num_envs=3, seed=0)
    >>> RandomActions(env)(env.reset())["action"].shape
    torch.Size([3])
    """

    def __init__(
        self,
        env: EnvBase,
        stop_probability: float | None = None,
        stop_action: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        spec = env.action_spec
        if not isinstance(spec, Categorical) or spec.shape != env.batch_size:
            raise UserError(f"random transitions need one categorical action, got {spec}")
        self.in_keys: list[Any] = []
        self.out_keys = [env.action_key]
        self.shape, self.n_actions, self.device = spec.shape, int(spec.space.n), env.device
        named = attribute(env, "stop_action") if stop_action is None else stop_action
        self.stop_action = None if named is None else whole("stop_action", named)
        if self.stop_action is not None and not 0 <= self.stop_action < self.n_actions:
            raise UserError(f"stop_action must be 0..{self.n_actions - 1}, got {stop_action}")
        self.probabilities = torch.full((self.n_actions,), 1 / self.n_actions)
        if stop_probability is not None:
            stop_probability = share("stop_probability", stop_probability)
            if self.n_actions < 2:
                raise UserError("stop_probability is for several actions, and this world has one")
            if self.stop_action is None:
                raise UserError(
                    "stop_probability is for worlds with a stop, and this one names none: give "
                    "stop_action="
                )
            self.probabilities.fill_((1 - stop_probability) / (self.n_actions - 1))
            self.probabilities[self.stop_action] = stop_probability
        self.generator = seeded(seed, "random actions")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write an action into each row."""
        n = self.shape.numel()
        drawn = self.probabilities.multinomial(n, replacement=True, generator=self.generator)
        return tensordict.set(self.out_keys[0], drawn.view(self.shape).to(self.device))


@dataclass(frozen=True)
class TransitionReport:
    """How many steps of each action were taken, and how many of them are in the buffer."""

    taken: Tensor
    """Steps taken with each action, int64 [A]."""
    kept: Tensor
    """Of these, steps in the buffer, int64 [A]."""


class Collected(NamedTuple):
    """Random transitions in a replay buffer, and their counts."""

    buffer: TensorDictReplayBuffer
    """Samples hold ``pixels``, ``action`` and ``("next", "pixels")``."""
    report: TransitionReport
    """Counts per action."""

    def save(self, folder: str | Path) -> None:
        """Write a folder of ``.npy`` files and ``meta.json``."""
        stored = self.buffer.storage.get(slice(0, len(self.buffer)))
        codec = next(part for part in self.buffer.transform if isinstance(part, FrameDecoder)).codec
        arrays = {
            "pixels": stored[keys.PIXELS],
            "next_pixels": stored[keys.NEXT_PIXELS],
            "action": stored[keys.ACTION],
            "taken": self.report.taken,
            "kept": self.report.kept,
        }
        if codec.tiles is not None:
            arrays["tiles"] = codec.tiles
        save_folder(folder, KIND, arrays, {"image_shape": list(codec.image_shape)})

    @classmethod
    def load(cls, folder: str | Path, **options: Any) -> Collected:
        """Read what :meth:`save` wrote, or raise :class:`UserError`; options are the buffer's."""
        names = ("pixels", "next_pixels", "action", "taken", "kept")
        arrays, facts = load_folder(folder, KIND, names, ("tiles",))
        codes, after, action, taken, kept = (arrays[name] for name in names)
        with damaged(folder):
            codec = FrameCodec(facts["image_shape"], arrays.get("tiles"))
            return cls(_buffer(codec, codes, action, after, options), TransitionReport(taken, kept))


def _buffer(
    codec: FrameCodec, codes: Tensor, action: Tensor, after: Tensor, options: dict[str, Any]
) -> TensorDictReplayBuffer:
    entries = {keys.PIXELS: codes, keys.ACTION: action, keys.NEXT: {keys.PIXELS: after}}
    return encoded_buffer(TensorDict(entries, [len(action)]), [FrameDecoder(codec)], options)


def collect_transitions(
    env: EnvBase,
    n: int,
    *,
    stop_probability: float | None = None,
    stop_action: int | None = None,
    drop_unchanged: bool = True,
    policy: TensorDictModuleBase | None = None,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
) -> Collected:
    """Take ``n`` random steps and keep what they showed (paper, "Inverse model").

    An unchanged frame may be a stop, a bump into a wall or a void pick or place: no model can tell.
    With ``drop_unchanged`` such transitions are left out, other than stops; the model then calls an
    unchanged frame a stop, which is right for demonstrators that waste no step. Uniform actions
    stop after six steps on average, so that places are rare: a lower ``stop_probability`` helps.

    Args:
        env: environment with uint8 ``pixels`` and a categorical action; it is left open.
        n: steps to take, at least; all environments of the batch step together. The buffer holds
            fewer where unchanged ones are dropped.
        stop_probability: probability of the stop; by default all actions are equally likely.
        stop_action: by default that of the environment; none where that is None.
        drop_unchanged: whether to leave out unchanged transitions other than stops.
        policy: acts in place of chance, where it is given what it reads.
        seed: of the actions; scenes are drawn by the environment.
        options: for ``TensorDictReplayBuffer``, such as ``batch_size``, ``sampler``, ``generator``;
            a ``transform`` comes after frames are decoded.

    Raises:
        UserError: where nobody says which action is the stop, and unchanged frames are to be left
            out; where no step showed anything; where a ``storage`` is given.

    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> buffer, report = collect_transitions(PickAndPlaceEnv("pick", num_envs=8, seed=0), 64)
    >>> int(report.taken.sum()), len(buffer) == int(report.kept.sum())
    (64, True)
    """
    n = at_least_one("n", n)
    if drop_unchanged and stop_action is None and attribute(env, "stop_action", ...) is ...:
        raise UserError(
            "the environment does not say which action is its stop, whose unchanged frames are "
            "kept: give stop_action=, set its stop_action (None where no action is), or say "
            "drop_unchanged=False"
        )
    chance = RandomActions(env, stop_probability, stop_action, seed)
    if policy is not None:
        torch.manual_seed(derive(seed, "policy"))
    taken = torch.zeros(chance.n_actions, dtype=torch.int64)
    actions: list[Tensor] = []

    def pieces() -> Iterator[Tensor]:
        """Yield frames and next frames in turns, uint8 [2 K, C, H, W], of the K kept steps."""
        for batch in _collect(env, policy or chance, n, progress):
            action = batch[keys.ACTION].cpu()
            pair = torch.stack([batch[keys.PIXELS], batch[keys.NEXT_PIXELS]], 1).cpu()
            taken.add_(action.bincount(minlength=len(taken)))
            if drop_unchanged:
                keep = (pair[:, 0] != pair[:, 1]).flatten(1).any(1)
                if chance.stop_action is not None:
                    keep |= action == chance.stop_action
                action, pair = action[keep], pair[keep]
            actions.append(action)
            yield pair.flatten(0, 1)

    codec, codes = FrameCodec.compress(pieces())
    if not len(codes):
        raise UserError(f"none of {n} steps changed anything or stopped: take more steps")
    kept = torch.cat(actions)
    buffer = _buffer(codec, codes[0::2], kept, codes[1::2], options)
    return Collected(buffer, TransitionReport(taken, kept.bincount(minlength=len(taken))))


def _compare_workers(env: EnvBase, first: Tensor) -> None:
    """Warn where workers begin with the same images, [W, *B, C, H, W]: they have one seed."""
    base = getattr(env, "base_env", env)
    if isinstance(base, BatchedEnvBase) and len(first.flatten(1).unique(dim=0)) < len(first):
        warnings.warn(
            "several workers begin with the same image: unless the world always does, give each "
            "a seed of its own, or call set_seed of the environment of all",
            stacklevel=4,
        )


def _collect(
    env: EnvBase, policy: TensorDictModuleBase, n: int, progress: bool
) -> Iterator[TensorDictBase]:
    """Yield flat batches of steps, ``n`` in all."""
    width = max(1, env.batch_size.numel())
    frames = width * max(1, min(BATCH_FRAMES, n) // width)
    collector = Collector(
        env,
        policy,
        frames_per_batch=frames,
        # Without an end of its own: at the end it would close the environment.
        total_frames=-1,
        split_trajs=False,
        compact_obs=False,
        auto_register_policy_transforms=False,
    )
    remaining = n
    try:
        with progress_bar(total=n, desc="collect", shown=progress) as bar:
            for number, batch in enumerate(collector):
                if not number:
                    _compare_workers(env, batch[keys.PIXELS][..., 0, :, :, :])
                read = batch.select(keys.PIXELS, keys.ACTION, keys.NEXT_PIXELS)
                yield read.reshape(-1)[:remaining]
                bar.update(min(frames, remaining))
                remaining -= min(frames, remaining)
                if not remaining:
                    return
    finally:
        collector.shutdown(close_env=False)
