"""What the words of a policy that reads word by word say about things."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ifo_grounding.errors import UserError
from ifo_grounding.evaluation.episodes import device_of
from ifo_grounding.modules import evaluating
from ifo_grounding.networks import GroundedTrunk
from ifo_grounding.networks.warm_start import trunk_of
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import COLOURS, N_KINDS, SHAPES, WorldState, kind_name, render


@dataclass(frozen=True)
class WordEvidence:
    """Evidence of words about objects, each word's mean over objects taken off."""

    words: tuple[str, ...]
    """W words."""
    objects: tuple[str, ...]
    """The twelve kinds of objects."""
    colour: Tensor
    """What each word says of each object's colours, float32 [12, W]."""
    form: Tensor
    """What each word says of each object's form, float32 [12, W]."""


def word_evidence(
    policy: nn.Module, words: Sequence[str] = (*COLOURS, *SHAPES), tile_size: int = 8
) -> WordEvidence:
    """Ask a policy of the preset ``strong`` what its words say about each kind of object.

    Args:
        policy: built by ``make_policy(..., "strong")``, with the vocabulary of this world.
        words: of the vocabulary.
        tile_size: pixels along one side of a cell.

    Raises:
        UserError: where the policy does not read word by word.

    >>> from ifo_grounding.networks import Shapes, make_policy
    >>> sizes = Shapes((3, 48, 48), len(VOCABULARY), tile_size=8)
    >>> said = word_evidence(make_policy(sizes, "strong", seed=0))
    >>> said.words[0], said.objects[0], said.colour.shape
    ('red', 'red circle', torch.Size([12, 7]))
    """
    trunk = trunk_of(policy)
    if not isinstance(trunk, GroundedTrunk):
        raise UserError("this policy does not read word by word: build it with preset 'strong'")
    device = device_of(policy)
    state = WorldState.empty(1, device=device)
    state.objects[0, :N_KINDS] = torch.arange(1, N_KINDS + 1, dtype=torch.uint8, device=device)
    state.arm[0] = N_KINDS
    tokens = VOCABULARY.encode(list(words))[:, 0].to(device)
    with evaluating(policy):
        looks = trunk.appearance(render(state, tile_size))
        seen = looks.where[0, :N_KINDS]
        said = [evidence[seen][:, tokens] for evidence in trunk.words.evidence(looks)]
    colour, form = ((evidence - evidence.mean(0)).cpu() for evidence in said)
    objects = tuple(kind_name(number) for number in range(1, N_KINDS + 1))
    return WordEvidence(tuple(words), objects, colour, form)
