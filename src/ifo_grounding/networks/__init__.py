"""The networks: encoders, layers, and six TensorDictModules built from specs."""

from ifo_grounding.networks.appearance import ColourAndForm
from ifo_grounding.networks.building import Blueprint
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder, PatchEncoder
from ifo_grounding.networks.goal import make_goal_classifier
from ifo_grounding.networks.grounding import GroundedTrunk, WordMaps
from ifo_grounding.networks.instruction import make_instruction_classifier
from ifo_grounding.networks.inverse import make_inverse
from ifo_grounding.networks.layers import GatedAttention, ResidualBlock, pool_cells
from ifo_grounding.networks.persistence import load, save
from ifo_grounding.networks.policy import (
    attention_maps,
    make_policy,
    make_value,
)
from ifo_grounding.networks.reward import make_reward_model
from ifo_grounding.networks.scoring import GatedScorer, PairScorer
from ifo_grounding.networks.sentences import GRUInstructionEncoder
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.sharing import from_pretrained, save_pretrained
from ifo_grounding.networks.trunk import GatedTrunk
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
