"""The world as environments of TorchRL and Gymnasium, and other worlds of Gymnasium."""

from ifo_grounding.envs.from_gymnasium import GymnasiumEnv, from_gymnasium
from ifo_grounding.envs.pick_and_place import PickAndPlaceEnv

__all__ = ["GymnasiumEnv", "PickAndPlaceEnv", "from_gymnasium"]
