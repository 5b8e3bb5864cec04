from typing import Any

from shiftsim._version import __version__ as __version__
from shiftsim.api import Run as Run
from shiftsim.api import load_planner as load_planner
from shiftsim.api import open_run as open_run
from shiftsim.api import open_store as open_store
from shiftsim.api import run as run
from shiftsim.api import simulate as simulate
from shiftsim.errors import ShiftsimError as ShiftsimError
from shiftsim.metrics import compute_metrics as score
from shiftsim.planners.contract import check_planner as check_planner
from shiftsim.runs.rollouts.elsewhere import score_rollout as score_rollout
from shiftsim.sim.log import SimulationLog as SimulationLog
from shiftsim.sim.noise import NoiseModel as NoiseModel
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
    "NoiseModel",
    "Observation",
    "Planner",
    "Run",
    "Scenario",
    "SceneInfo",
    "ShiftsimError",
    "SimulationLog",
    "Tracks",
    "Trajectory",
    "check_planner",
    "load_planner",
    "open_run",
    "open_store",
    "run",
    "score",
    "score_rollout",
    "show",
    "simulate",
]

def deprecated_name(module: str, name: str) -> Any: ...
