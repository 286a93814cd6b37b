"""The networks, each a TensorDictModule built for the sizes of a world.

All ``make_*`` functions take an ``spec_source`` (an env, a dataset or :class:`Shapes`), a
``preset`` (``"strong"`` or ``"paper"``), names of entries (``in_keys``, ``out_key``), a ``device``,
a ``seed`` that alone decides the initial weights, and values of :class:`NetworkConfig` to replace;
where they take ``init_from``, a policy of the same preset and sizes. They raise
:class:`~ifo_grounding.errors.UserError` for an unknown preset or option, for sizes that cannot be
read, and for a policy that does not fit. What they return is in eval mode, in which to collect and
to evaluate; the supervised losses switch to train mode while they compute.
"""

from ifo_grounding.networks.appearance import ColourAndForm
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder, PatchEncoder
from ifo_grounding.networks.grounding import GroundedTrunk, WordMaps
from ifo_grounding.networks.layers import GatedAttention, ResidualBlock, pool_cells
from ifo_grounding.networks.makers import (
    Blueprint,
    make_goal_classifier,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_reward_model,
    make_value,
)
from ifo_grounding.networks.saving import from_pretrained, load, save, save_pretrained
from ifo_grounding.networks.scoring import GatedScorer, PairScorer
from ifo_grounding.networks.sentences import GRUInstructionEncoder
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.trunk import GatedTrunk, attention_maps
from ifo_grounding.networks.word_scoring import WordScorer

__all__ = [
    "Blueprint",
    "ColourAndForm",
    "ConvEncoder",
    "GRUInstructionEncoder",
    "GatedAttention",
    "GatedScorer",
    "GatedTrunk",
    "GroundedTrunk",
    "NetworkConfig",
    "PairScorer",
    "PatchEncoder",
    "ResidualBlock",
    "Shapes",
    "WordMaps",
    "WordScorer",
    "attention_maps",
    "from_pretrained",
    "load",
    "make_goal_classifier",
    "make_instruction_classifier",
    "make_inverse",
    "make_policy",
    "make_reward_model",
    "make_value",
    "pool_cells",
    "save",
    "save_pretrained",
]
