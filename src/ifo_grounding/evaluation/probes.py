"""Which part of a policy fails on words in new combinations: seeing, reading or matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation.endings import looks
from ifo_grounding.evaluation.episodes import device_of
from ifo_grounding.modules import evaluating
from ifo_grounding.networks import GroundedTrunk, attention_maps
from ifo_grounding.networks.trunk import GatedTrunk as Trunk
from ifo_grounding.networks.warm_start import trunk_of
from ifo_grounding.tasks.grammar import grammar, holdout_kinds
from ifo_grounding.world import COLOURS, SHAPES

DECAY = 1e-3
"""Of the squared weights of a linear probe, whose features are scaled to a variance of one."""


@dataclass(frozen=True)
class Probe:
    """Something measured on trained and on held-out pairs, each between 0 and 1."""

    trained: float
    held_out: float


@dataclass(frozen=True)
class Probes:
    """What :func:`probe` found."""

    seeing_colour: Probe
    """Accuracy of a linear probe of the features of an object's cell for its colour."""
    seeing_shape: Probe
    """The same for its shape."""
    reading_colour: Probe | None
    """Accuracy of a linear probe of the encoded instruction for the colour that it asks for; None
    where the network encodes no sentence."""
    reading_shape: Probe | None
    """The same for the shape."""
    matching: Probe
    """Weight that one map lays on the cell of the object asked for: the map with most weight there
    on trained pairs."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class _Scenes:
    """First frames and instructions with the truth about them."""

    pixels: Tensor
    """uint8 [N, C, H, W]."""
    instruction: Tensor
    """int64 [N, L]."""
    objects: Tensor
    """Kind in each cell, 1..12, 0 for none, int64 [N, cells]."""
    wanted: Tensor
    """Kind of the object that the instruction is about, int64 [N]."""
    cell: Tensor
    """Its cell, int64 [N]."""


@torch.no_grad()
def probe(
    policy: nn.Module,
    task: str,
    *,
    holdout: str = "pairs-3",
    scenes: int = 2000,
    seed: int = 0,
    stream: str = "validation",
    **env_options: Any,
) -> Probes:
    """Ask what a policy sees, reads and matches, on trained and on held-out pairs.

    Linear probes (Alain and Bengio 2016) are fitted on every other object and
    sentence of a trained pair, and asked about the rest of these and about held-out pairs.

    Args:
        policy: built by ``make_policy``, one feature vector for each cell of the world.
        task: name of the task.
        holdout: named list of the held-out pairs.
        scenes: first frames of each kind.
        seed: of the stream of scenes.
        stream: ``training``, ``validation`` or ``evaluation``.
        env_options: further arguments of :class:`~ifo_grounding.envs.PickAndPlaceEnv`.

    Raises:
        UserError: where the network's cells are not those of the world.

    >>> from ifo_grounding.networks import make_policy
    >>> env = PickAndPlaceEnv("move", num_envs=1)
    >>> found = probe(make_policy(env, "strong", seed=0), "move", scenes=40)
    >>> found.reading_colour is None, 0 <= found.matching.held_out <= 1
    (True, True)
    """
    trunk = trunk_of(policy)
    shown = {"holdout": holdout, "seed": seed, "stream": stream, **env_options}
    trained, held_out = (
        _scenes(task, scenes, device_of(policy), split=split, **shown)
        for split in ("train", "zero-shot")
    )
    named = holdout_kinds(holdout)
    with evaluating(policy):
        colour, shape = _linear(*_objects(trunk, trained), named)
        read: tuple[Probe | None, Probe | None] = (None, None)
        if isinstance(trunk, Trunk):
            read = _linear(*_sentences(trunk, trained, held_out), named)
        matching = _matching(policy, trained, held_out)
    return Probes(colour, shape, *read, matching)


def _scenes(task: str, count: int, device: torch.device, **options: Any) -> _Scenes:
    env = PickAndPlaceEnv(task, num_envs=count, device=device, **options)
    start = env.reset()
    goal = grammar(task).parse_tokens(start[keys.INSTRUCTION])
    return _Scenes(
        start[keys.PIXELS],
        start[keys.INSTRUCTION],
        env.simulator.state.objects.long(),
        goal.object.long(),
        env.simulator.wanted.object_cell,
    )


def _objects(trunk: Trunk | GroundedTrunk, scenes: _Scenes) -> tuple[Tensor, Tensor]:
    """Return features [M, F] and kinds [M] of all objects that lie about."""
    features = trunk.cells(scenes.pixels)
    if features.shape[1] != scenes.objects.shape[1]:
        raise UserError(
            f"this network sees {features.shape[1]} cells where the world has "
            f"{scenes.objects.shape[1]}: probe one whose patches are the world's tiles"
        )
    there = scenes.objects > 0
    return features[there].float(), scenes.objects[there]


def _sentences(trunk: Trunk, *parts: _Scenes) -> tuple[Tensor, Tensor]:
    """Return encodings [M, D] of all instructions, and the kinds [M] that they are about."""
    encoded = [trunk.instruction(part.instruction) for part in parts]
    return torch.cat(encoded).float(), torch.cat([part.wanted for part in parts])


def _linear(features: Tensor, kinds: Tensor, held_out: Sequence[int]) -> tuple[Probe, Probe]:
    """Fit linear probes for colour and shape on every other row of trained pairs; ask the rest."""
    named = torch.isin(kinds, torch.tensor(held_out, device=kinds.device))
    half = torch.arange(len(kinds), device=kinds.device) % 2 == 0
    known, asked = half & ~named, ~half & ~named
    scaled = (features - features[known].mean(0)) / features[known].std(0).clamp_min(1e-6)
    found = []
    for truth, count in zip(looks(kinds), (len(COLOURS), len(SHAPES)), strict=True):
        right = _logistic(scaled[known], truth[known], count)(scaled).argmax(1) == truth
        found.append(Probe(float(right[asked].float().mean()), float(right[named].float().mean())))
    return found[0], found[1]


@torch.enable_grad()
def _logistic(features: Tensor, truth: Tensor, count: int) -> nn.Linear:
    """Fit a logistic regression, its weights held small."""
    layer = nn.utils.skip_init(nn.Linear, features.shape[1], count, device=features.device)
    nn.init.zeros_(layer.weight)  # and no random numbers drawn that would be thrown away
    nn.init.zeros_(layer.bias)
    optimiser = torch.optim.LBFGS(layer.parameters(), max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = F.cross_entropy(layer(features), truth) + DECAY * layer.weight.square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    return layer


def _matching(policy: nn.Module, trained: _Scenes, held_out: _Scenes) -> Probe:
    """Return the weight that the best map lays on the cell of the object asked for."""
    on_target = []
    for part in (trained, held_out):
        maps = attention_maps(policy, part.pixels, part.instruction).flatten(2)
        cell = part.cell.view(-1, 1, 1).expand(-1, maps.shape[1], 1)
        on_target.append(maps.gather(2, cell).squeeze(2).mean(0))
    best = int(on_target[0].argmax())
    return Probe(*(float(weight[best]) for weight in on_target))
