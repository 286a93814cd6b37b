"""The world as environments of TorchRL and Gymnasium."""

from ifo_grounding.envs.pick_and_place import PickAndPlaceEnv

__all__ = ["PickAndPlaceEnv"]
