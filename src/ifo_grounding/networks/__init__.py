"""The networks: encoders, fusion, and six TensorDictModules built from specs."""

from ifo_grounding.networks.attention import attention_maps
from ifo_grounding.networks.building import Blueprint
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder, PatchEncoder
from ifo_grounding.networks.fusion import (
    CellCount,
    CellLinear,
    GatedAttention,
    ResidualBlock,
    ResidualFiLM,
    SpatialReadout,
    pool_cells,
)
from ifo_grounding.networks.goal import make_goal_judge
from ifo_grounding.networks.grounding import GroundedTrunk, WordMaps
from ifo_grounding.networks.instruction import make_instruction_classifier
from ifo_grounding.networks.inverse import InverseNetwork, make_inverse
from ifo_grounding.networks.looks import ColourAndForm
from ifo_grounding.networks.persistence import load, save
from ifo_grounding.networks.policy import PolicyNetwork, ValueNetwork, make_policy, make_value
from ifo_grounding.networks.reward import RewardNetwork, make_reward_model
from ifo_grounding.networks.scoring import PairScorer, SentenceScorer
from ifo_grounding.networks.sentences import (
    ConvInstructionEncoder,
    GRUInstructionEncoder,
    InstructionEncoder,
)
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.sharing import from_pretrained, save_pretrained
from ifo_grounding.networks.word_scoring import WordScorer

__all__ = [
    "Blueprint",
    "CellCount",
    "CellLinear",
    "ColourAndForm",
    "ConvEncoder",
    "ConvInstructionEncoder",
    "GRUInstructionEncoder",
    "GatedAttention",
    "GroundedTrunk",
    "InstructionEncoder",
    "InverseNetwork",
    "NetworkConfig",
    "PairScorer",
    "PatchEncoder",
    "PolicyNetwork",
    "ResidualBlock",
    "ResidualFiLM",
    "RewardNetwork",
    "SentenceScorer",
    "Shapes",
    "SpatialReadout",
    "ValueNetwork",
    "WordMaps",
    "WordScorer",
    "attention_maps",
    "from_pretrained",
    "load",
    "make_goal_judge",
    "make_instruction_classifier",
    "make_inverse",
    "make_policy",
    "make_reward_model",
    "make_value",
    "pool_cells",
    "save",
    "save_pretrained",
]
