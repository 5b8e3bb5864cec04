"""Closed-loop evaluation of driving planners with nuPlan's semantics."""

import sys

from shiftsim._version import __version__ as __version__

TYPE_CHECKING = False  # type checkers take this name for true; nothing is imported for it
if TYPE_CHECKING:
    from typing import Any

    from shiftsim.api import Run as Run
    from shiftsim.api import load_planner as load_planner
    from shiftsim.api import open_run as open_run
    from shiftsim.api import open_store as open_store
    from shiftsim.api import run as run
    from shiftsim.api import simulate as simulate
    from shiftsim.errors import ShiftsimError as ShiftsimError
    from shiftsim.metrics import compute_metrics as score  # noqa: F401
    from shiftsim.planners.contract import check_planner as check_planner
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

# public name -> where it is; imported when it is first used, so that `import shiftsim` is instant
_PUBLIC = {
    "Command": "shiftsim.world.state:Command",
    "EgoState": "shiftsim.world.state:EgoState",
    "NoiseModel": "shiftsim.sim.noise:NoiseModel",
    "Observation": "shiftsim.sim.planner:Observation",
    "Planner": "shiftsim.sim.planner:Planner",
    "Run": "shiftsim.api:Run",
    "Scenario": "shiftsim.world.scenario:Scenario",
    "SceneInfo": "shiftsim.sim.planner:SceneInfo",
    "ShiftsimError": "shiftsim.errors:ShiftsimError",
    "SimulationLog": "shiftsim.sim.log:SimulationLog",
    "Tracks": "shiftsim.world.state:Tracks",
    "Trajectory": "shiftsim.world.state:Trajectory",
    "check_planner": "shiftsim.planners.contract:check_planner",
    "load_planner": "shiftsim.api:load_planner",
    "open_run": "shiftsim.api:open_run",
    "open_store": "shiftsim.api:open_store",
    "run": "shiftsim.api:run",
    "score": "shiftsim.metrics:compute_metrics",
    "show": "shiftsim.view.page:show",
    "simulate": "shiftsim.api:simulate",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> "Any":
    if name not in _PUBLIC:
        raise AttributeError(f"module 'shiftsim' has no attribute {name!r}")
    from importlib import import_module

    module, _, attribute = _PUBLIC[name].partition(":")
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


class _Moved:
    """Asked last, for modules that nobody else knows: import paths of earlier versions."""

    @staticmethod
    def find_spec(name: str, path: "Any" = None, target: "Any" = None) -> "Any":
        if not name.startswith("shiftsim."):
            return None
        from shiftsim._moved import find_spec

        return find_spec(name)


sys.meta_path.append(_Moved)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
