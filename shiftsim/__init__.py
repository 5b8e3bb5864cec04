"""Closed-loop evaluation of driving planners with nuPlan's semantics."""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from shiftsim.errors import ShiftsimError as ShiftsimError
    from shiftsim.log import SimulationLog as SimulationLog
    from shiftsim.metrics import compute_metrics as score
    from shiftsim.noise import NoiseModel as NoiseModel
    from shiftsim.planner import Observation as Observation
    from shiftsim.planner import Planner as Planner
    from shiftsim.planner import SceneInfo as SceneInfo
    from shiftsim.planners.contract import check_planner as check_planner
    from shiftsim.results import Run as Run
    from shiftsim.results import open_run as open_run
    from shiftsim.runner import open_named_store as open_store
    from shiftsim.runner import run as run
    from shiftsim.scenario import Scenario as Scenario
    from shiftsim.simulation import simulate as simulate
    from shiftsim.state import Command as Command
    from shiftsim.state import EgoState as EgoState
    from shiftsim.state import Tracks as Tracks
    from shiftsim.state import Trajectory as Trajectory
    from shiftsim.viewer.page import show as show

# public name -> where it is; imported when it is first used, so that `import shiftsim` is instant
_PUBLIC = {
    "Command": "shiftsim.state:Command",
    "EgoState": "shiftsim.state:EgoState",
    "NoiseModel": "shiftsim.noise:NoiseModel",
    "Observation": "shiftsim.planner:Observation",
    "Planner": "shiftsim.planner:Planner",
    "Run": "shiftsim.results:Run",
    "Scenario": "shiftsim.scenario:Scenario",
    "SceneInfo": "shiftsim.planner:SceneInfo",
    "ShiftsimError": "shiftsim.errors:ShiftsimError",
    "SimulationLog": "shiftsim.log:SimulationLog",
    "Tracks": "shiftsim.state:Tracks",
    "Trajectory": "shiftsim.state:Trajectory",
    "check_planner": "shiftsim.planners.contract:check_planner",
    "open_run": "shiftsim.results:open_run",
    "open_store": "shiftsim.runner:open_named_store",
    "run": "shiftsim.runner:run",
    "score": "shiftsim.metrics:compute_metrics",
    "show": "shiftsim.viewer.page:show",
    "simulate": "shiftsim.simulation:simulate",
}

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
    "open_run",
    "open_store",
    "run",
    "score",
    "show",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'shiftsim' has no attribute {name!r}")
    from importlib import import_module

    module, _, attribute = _PUBLIC[name].partition(":")
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
