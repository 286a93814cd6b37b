"""What every part does with modules that it is handed: device, eval mode, outputs, words."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ifo_grounding.errors import UserError
from ifo_grounding.keys import ACTION_SCORE, GOAL_SCORE, SUITABILITY

TURNS = threading.RLock()
"""While it is held, modules may be in another mode than their own, and policies act greedily."""


@contextlib.contextmanager
def in_mode(training: bool, module: object) -> Iterator[None]:
    """Run a block with a module in train or eval mode; what this switched gets its mode back."""
    parts = module.modules() if isinstance(module, nn.Module) else ()
    with TURNS:
        switched = [part for part in parts if part.training is not training]
        try:
            for part in switched:
                part.training = training
            yield
        finally:
            for part in switched:
                part.training = not training


@contextlib.contextmanager
def evaluating(module: object) -> Iterator[None]:
    """Run a block without gradients and in eval mode; every submodule gets its own mode back.

    >>> network = nn.Sequential(nn.Dropout(), nn.Linear(1, 1).eval())
    >>> with evaluating(network):
    ...     print([part.training for part in network])
    [False, False]
    >>> [part.training for part in network]
    [True, False]
    """
    with in_mode(False, module), torch.no_grad():
        yield


@contextlib.contextmanager
def exploring(kind: ExplorationType) -> Iterator[None]:
    """Let policies act greedily, or by chance, while the block lasts.

    TorchRL keeps one such choice for all threads, which therefore take turns.
    """
    with TURNS, set_exploration_type(kind):
        yield


def device_of(module: object) -> torch.device | None:
    """Return the device of a module's first parameter or buffer, None where there is none.

    >>> device_of(nn.Linear(1, 1)), device_of(nn.ReLU())
    (device(type='cpu'), None)
    """
    if isinstance(module, nn.Module):
        for tensor in itertools.chain(module.parameters(), module.buffers()):
            return tensor.device
    return None


def output_key(module: TensorDictModuleBase, *expected: str) -> NestedKey:
    """Key of what a TensorDictModule is expected to write, wherever nested, or of all it writes.

    Raises:
        UserError: where ``module`` is no TensorDictModule, it is unclear which output is meant, or
            it is what another network says of pairs or actions.

    >>> from tensordict.nn import TensorDictModule
    >>> output_key(TensorDictModule(nn.Identity(), ["x"], ["features", "logits"]), "logits")
    'logits'
    """
    named = " or ".join(map(repr, expected))
    if not isinstance(module, TensorDictModuleBase):
        raise UserError(
            f"expected a TensorDictModule that writes {named}, got {type(module).__name__}"
        )
    names = [unravel_key(key) for key in module.out_keys]
    for name in names:
        if name in expected or (isinstance(name, tuple) and name[-1] in expected):
            return name
    if len(names) != 1:
        raise UserError(f"the module writes {names}: one of them must be named {named}")
    if (written := names[0]) in (ACTION_SCORE, GOAL_SCORE, SUITABILITY):
        raise UserError(
            f"the module writes {written!r}: what is needed here is a network that writes {named}"
        )
    return written


def beside(batch: TensorDictBase, module: object) -> TensorDictBase:
    """Return a batch where a module's weights are: buffers sample on the CPU.

    >>> from tensordict import TensorDict
    >>> batch = TensorDict({"pixels": torch.zeros(2)}, [2])
    >>> beside(batch, nn.Linear(1, 1, device="meta")).device
    device(type='meta')
    """
    device = device_of(module)
    return batch if device is None or device.type == "cpu" else batch.to(device)


class WholePairs:
    """A module of whole pairs, to be asked as one that encodes images and instructions apart."""

    def __init__(self, module: TensorDictModuleBase, output: NestedKey) -> None:
        self.module, self.output = module, output

    def encode_scenes(self, *pixels: Tensor) -> TensorDict:
        """Return images, each [N, C, H, W], by their names."""
        return TensorDict(dict(zip(self.module.in_keys, pixels, strict=False)), [len(pixels[0])])

    def encode_instruction(self, tokens: Tensor) -> Tensor:
        """Return token ids [P, L] as they are."""
        return tokens

    def score_candidates(self, scenes: TensorDict, words: Tensor, index: Tensor) -> Tensor:
        """Score some instructions, index [N, K], of each scene: logits [N * K, 1]."""
        rows = torch.arange(len(index), device=index.device).repeat_interleave(index.shape[1])
        pairs = scenes[rows].set(self.module.in_keys[-1], words[index.flatten()])
        return self.module(pairs).get(self.output)


def halves_of(module: TensorDictModuleBase, output: NestedKey) -> Any:
    """Return what scores images, each encoded once, with instructions, each encoded once.

    That is the module itself where it has ``encode_scenes``, ``encode_instruction`` and
    ``score_candidates``; any other is called on whole pairs: images first, the instruction last.
    """
    parts = ("encode_scenes", "encode_instruction", "score_candidates")
    split = all(hasattr(module, part) for part in parts)
    return module if split else WholePairs(module, output)


def has_word_penalty(module: nn.Module) -> bool:
    """Whether a part of a module leaves a ``word_penalty`` when it computes in train mode."""
    return any(hasattr(part, "word_penalty") for part in module.modules())


def take_word_penalty(module: nn.Module) -> Tensor | None:
    """Take the ``word_penalty``, a tensor of one number, that a module's last batch left.

    >>> part = nn.Linear(1, 1)
    >>> part.word_penalty = torch.tensor(2.0)
    >>> take_word_penalty(nn.Sequential(part)), take_word_penalty(part)
    (tensor(2.), None)
    """
    total: Tensor | None = None
    for part in module.modules():
        penalty = getattr(part, "word_penalty", None)
        if isinstance(penalty, Tensor):
            total = penalty if total is None else total + penalty
            part.word_penalty = None  # type: ignore[assignment]
    return total


def set_word_swapping(module: nn.Module, on: bool) -> None:
    """Switch on or off that the parts of a module with ``swaps_words`` do so in train mode.

    >>> part = nn.Linear(1, 1)
    >>> part.swaps_words = True
    >>> set_word_swapping(nn.Sequential(part), False)
    >>> part.swaps_words
    False
    """
    for part in module.modules():
        if hasattr(part, "swaps_words"):
            part.swaps_words = on  # type: ignore[assignment]
