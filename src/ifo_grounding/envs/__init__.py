"""The world as environments of TorchRL and Gymnasium, and other worlds of Gymnasium."""

from ifo_grounding.envs.pick_and_place import PickAndPlaceEnv
from ifo_grounding.envs.wrapping import GymnasiumEnv, from_gymnasium

__all__ = ["GymnasiumEnv", "PickAndPlaceEnv", "from_gymnasium"]
