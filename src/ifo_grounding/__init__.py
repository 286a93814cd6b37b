"""Learning to follow instructions from observation-only demonstrations, in TorchRL.

Importing the package registers its Gymnasium environments, ``ifo_grounding/Move-v0`` and the like.
"""

from __future__ import annotations

from importlib import metadata

from gymnasium.envs.registration import register, registry

try:
    __version__ = metadata.version("ifo-grounding")
except metadata.PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0+unknown"

_IDS = {
    "Move": "move",
    "MoveUDLR": "move-udlr",
    "Pick": "pick",
    "PickOut": "pick-out",
    "PickUDLR": "pick-udlr",
}
for _name, _task in _IDS.items():
    if f"ifo_grounding/{_name}-v0" not in registry:
        register(
            f"ifo_grounding/{_name}-v0",
            entry_point="ifo_grounding.envs.gymnasium_envs:PickAndPlaceGymEnv",
            vector_entry_point="ifo_grounding.envs.gymnasium_envs:PickAndPlaceVectorEnv",
            kwargs={"task": _task},
        )
