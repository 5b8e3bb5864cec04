from typing import Any

from shiftsim._version import __version__ as __version__
from shiftsim.api import bench as bench
from shiftsim.api import demo as demo
from shiftsim.api import demo_store as demo_store
from shiftsim.api import load_planner as load_planner
from shiftsim.api import merge as merge
from shiftsim.api import open_run as open_run
from shiftsim.api import open_store as open_store
from shiftsim.api import run as run
from shiftsim.api import score_files as score_files
from shiftsim.api import simulate as simulate
from shiftsim.api.finished import Run as Run
from shiftsim.api.stores import convert_dataset as convert_dataset
from shiftsim.api.stores import convert_dsc3d as convert_dsc3d
from shiftsim.api.stores import convert_nuplan as convert_nuplan
from shiftsim.api.stores import convert_tracks as convert_tracks
from shiftsim.api.stores import make_towns as make_towns
from shiftsim.env.policy import policy_planner as policy_planner
from shiftsim.errors import ShiftsimError as ShiftsimError
from shiftsim.metrics import compute_metrics as score
from shiftsim.planners.contract import check_planner as check_planner
from shiftsim.runs.rollouts.branches import branch as branch
from shiftsim.runs.rollouts.elsewhere import score_rollout as score_rollout
from shiftsim.sim.log import SimulationLog as SimulationLog
from shiftsim.sim.noise import NoiseModel as NoiseModel
from shiftsim.sim.perception import Localization as Localization
from shiftsim.sim.perception import Perception as Perception
from shiftsim.sim.planner import Observation as Observation
from shiftsim.sim.planner import Planner as Planner
from shiftsim.sim.planner import SceneInfo as SceneInfo
from shiftsim.view.page import show as show
from shiftsim.world.scenario import Scenario as Scenario
from shiftsim.world.state import Command as Command
from shiftsim.world.state import EgoState as EgoState
from shiftsim.world.state import Tracks as Tracks
from shiftsim.world.state import Trajectory as Trajectory

__all__ = [
    "Command",
    "EgoState",
    "Localization",
    "NoiseModel",
    "Observation",
    "Perception",
    "Planner",
    "Run",
    "Scenario",
    "SceneInfo",
    "ShiftsimError",
    "SimulationLog",
    "Tracks",
    "Trajectory",
    "bench",
    "branch",
    "check_planner",
    "convert_dataset",
    "convert_dsc3d",
    "convert_nuplan",
    "convert_tracks",
    "demo",
    "demo_store",
    "load_planner",
    "make_towns",
    "merge",
    "open_run",
    "open_store",
    "policy_planner",
    "run",
    "score",
    "score_files",
    "score_rollout",
    "show",
    "simulate",
]

def deprecated_name(module: str, name: str) -> Any: ...
