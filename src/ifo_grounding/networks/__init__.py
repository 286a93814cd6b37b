"""The networks, each a TensorDictModule built for the sizes of a world.

All ``make_*`` functions take a ``spec_source`` (an env, a dataset or :class:`Shapes`), a
``preset`` (``"strong"`` or ``"paper"``), names of entries (``in_keys``, ``out_key``), a ``device``,
a ``seed`` that alone decides the initial weights, and values of :class:`NetworkConfig` to replace;
where they take ``init_from``, a policy of the same preset and sizes, whose weights are copied (a
warm start) and whose ``context`` they have. What they read are images, uint8 [*B, C, H, W],
instructions, int64 [*B, L], and actions, integer [*B]. They raise
:class:`~ifo_grounding.errors.UserError` for an unknown preset or option, for sizes that cannot be
read, and for a policy that does not fit. What they return is in eval mode, in which to collect and
to evaluate; the supervised losses switch to train mode while they compute.
"""

from ifo_grounding.networks.base import read_codes
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.makers import (
    make_goal_classifier,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_reward_model,
    make_value,
)
from ifo_grounding.networks.saving import from_pretrained, load, save, save_pretrained
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.trunk import attention_maps

__all__ = [
    "NetworkConfig",
    "Shapes",
    "attention_maps",
    "from_pretrained",
    "load",
    "make_goal_classifier",
    "make_instruction_classifier",
    "make_inverse",
    "make_policy",
    "make_reward_model",
    "make_value",
    "read_codes",
    "save",
    "save_pretrained",
]
