"""A Gymnasium environment: one scenario per episode, driven by whoever acts.

Importing this module makes `shiftsim/Driving-v0` known to Gymnasium.
"""

from shiftsim.errors import MissingExtraError

try:
    from gymnasium.envs.registration import register, registry
except ModuleNotFoundError as error:
    what = "the environment needs gymnasium"
    raise MissingExtraError(what, hint='pip install "shiftsim[gym]"') from error

from shiftsim.env.raster import raster_observation as raster_observation
from shiftsim.env.vector import vector_observation as vector_observation

ID = "shiftsim/Driving-v0"

if ID not in registry:
    register(
        ID,
        entry_point="shiftsim.env.driving:DrivingEnv",
        vector_entry_point="shiftsim.env.driving:DrivingVectorEnv",
    )
