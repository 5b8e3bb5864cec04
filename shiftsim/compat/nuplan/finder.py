"""Makes `import nuplan…` find the shims, and says clearly what they do not have."""

import importlib.util
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from shiftsim.errors import MissingExtraError

_SHIMS = ("geometry", "transforms", "boxes", "objects", "ego", "map_types", "planning")
_TABLE = """
nuplan.common.actor_state: agent agent_state agent_temporal_state car_footprint dynamic_car_state
    ego_state oriented_box scene_object state_representation static_object tracked_objects
    tracked_objects_types vehicle_parameters waypoint
nuplan.common.geometry: compute convert transform
nuplan.common.maps: abstract_map abstract_map_objects maps_datatypes
nuplan.common.utils: interpolatable_state split_state
nuplan.planning.simulation.controller.motion_model: kinematic_bicycle
nuplan.planning.simulation.history: simulation_history_buffer
nuplan.planning.simulation.observation: observation_type
nuplan.planning.simulation.planner: abstract_planner planner_report
nuplan.planning.simulation.simulation_time_controller: simulation_iteration
nuplan.planning.simulation.trajectory: abstract_trajectory interpolated_trajectory
    predicted_trajectory trajectory_sampling
"""
MODULES = [
    f"{package}.{name}"
    for package, names in re.findall(r"^(\S+): (.*(?:\n .*)*)", _TABLE, re.MULTILINE)
    for name in names.split()
]
_PACKAGES = {name[:end] for name in MODULES for end, sign in enumerate(name) if sign == "."}

_HINT = "install nuplan-devkit itself, which is then used instead, or leave that import out"


class ShimFinder(MetaPathFinder, Loader):
    """Finds the modules of `MODULES`. Nothing else of that name exists once it is installed.

    Every module has all names of the shims: modules of the devkit import from each other, and
    planners import from either. Every module says that it is a package: then `from module import
    name` with a name that there is not comes here, and ends with one clear error instead of
    Python's own.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """A spec for a shim, or None for modules of others.

        Raises:
            MissingExtraError: There is no shim for this part of the devkit.
        """
        if name.partition(".")[0] != "nuplan":
            return None
        if name in MODULES or name in _PACKAGES:
            return ModuleSpec(name, self, is_package=True)
        raise MissingExtraError(_missing(name), hint=_HINT)

    def create_module(self, spec: ModuleSpec) -> None:
        """The ordinary kind of module."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the names into a module."""
        if module.__name__ in MODULES:
            for shim in _SHIMS:
                names = vars(import_module(f"shiftsim.compat.nuplan.shims.{shim}"))
                vars(module).update((name, names[name]) for name in names if name[0] != "_")

        def missing(name: str) -> Any:
            raise AttributeError(f"{_missing(f'{module.__name__}.{name}')}; {_HINT}")

        vars(module)["__getattr__"] = missing


def install() -> bool:
    """Make `import nuplan…` work in this process; call it before importing a planner's module.

    Returns whether the shims are used: false where nuPlan's devkit is there.
    """
    if any(isinstance(finder, ShimFinder) for finder in sys.meta_path):
        return True
    try:
        if (
            importlib.util.find_spec("nuplan.planning.simulation.planner.abstract_planner")
            is not None
        ):
            return False
    except ModuleNotFoundError:
        pass
    # a folder named nuplan, of data for instance, counts as an empty package: drop it
    for name in [name for name in sys.modules if name.partition(".")[0] == "nuplan"]:
        del sys.modules[name]
    sys.meta_path.insert(0, ShimFinder())
    return True


def _missing(name: str) -> str:
    return f"{name!r} is not among shiftsim's shims for nuPlan's devkit"
