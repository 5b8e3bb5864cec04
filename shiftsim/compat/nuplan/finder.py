"""Makes `import nuplan…` find the shims, and says clearly what they do not have."""

import importlib.util
import logging
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from shiftsim.errors import MissingExtraError

_SHIMS = ("geometry", "transforms", "boxes", "objects", "ego", "map_types", "planning")
_TABLE = """
nuplan.common.actor_state: agent agent_state agent_temporal_state car_footprint dynamic_car_state
    ego_state oriented_box scene_object state_representation static_object tracked_objects
    tracked_objects_types vehicle_parameters waypoint
nuplan.common.geometry: compute convert torch_geometry transform
nuplan.common.maps: abstract_map abstract_map_objects maps_datatypes
nuplan.common.maps.nuplan_map: utils
nuplan.common.utils: interpolatable_state split_state
nuplan.planning.metrics.utils: collision_utils expert_comparisons state_extractors
nuplan.planning.scenario_builder: abstract_scenario
nuplan.planning.simulation.controller.motion_model: kinematic_bicycle
nuplan.planning.simulation.history: simulation_history_buffer
nuplan.planning.simulation.observation: observation_type
nuplan.planning.simulation.observation.idm: utils
nuplan.planning.simulation.occupancy_map: abstract_occupancy_map strtree_occupancy_map
nuplan.planning.simulation.path: interpolated_path path utils
nuplan.planning.simulation.planner: abstract_planner planner_report
nuplan.planning.simulation.planner.ml_planner: transform_utils
nuplan.planning.simulation.planner.utils: breadth_first_search
nuplan.planning.simulation.simulation_time_controller: simulation_iteration
nuplan.planning.simulation.trajectory: abstract_trajectory interpolated_trajectory
    predicted_trajectory trajectory_sampling
nuplan.planning.training.modeling: torch_module_wrapper types
nuplan.planning.training.preprocessing.feature_builders: abstract_feature_builder
nuplan.planning.training.preprocessing.features: abstract_model_feature trajectory_utils
nuplan.planning.training.preprocessing.target_builders: abstract_target_builder
    ego_trajectory_target_builder
"""
MODULES = [
    f"{package}.{name}"
    for package, names in re.findall(r"^(\S+): (.*(?:\n .*)*)", _TABLE, re.MULTILINE)
    for name in names.split()
]
_PACKAGES = {name[:end] for name in MODULES for end, sign in enumerate(name) if sign == "."}

_LOG = logging.getLogger(__name__)
_EMPTY = "shiftsim.compat.nuplan.empty"  # module of classes in place of missing ones
_HINT = "install nuplan-devkit itself, which is then used instead, or leave that import out"


class ShimFinder(MetaPathFinder, Loader):
    """Finds the modules of `MODULES`. Nothing else of that name exists once it is installed.

    Every module has all names of the shims: modules of the devkit import from each other, and
    planners import from either. Every module says that it is a package: then `from module import
    name` with a name that there is not comes here, and ends with one clear error instead of
    Python's own.
    """

    missing: set[str] | None = None  # names asked for in vain, while `find_missing` looks for them

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """A spec for a shim, None for modules of others; an error for parts without a shim."""
        if name.partition(".")[0] != "nuplan":
            return None
        if name in MODULES or name in _PACKAGES or self._note(name):
            return ModuleSpec(name, self, is_package=True)
        raise MissingExtraError(_missing(name), hint=_HINT)

    def find_missing(self, module_name: str) -> list[str]:
        """All names without a shim that the import of a module asks for; it is forgotten again."""
        before, self.missing = set(sys.modules), set[str]()
        try:
            import_module(Path(module_name).stem if module_name[-3:] == ".py" else module_name)
        except Exception:  # an empty class may not do, and then the list ends here
            _LOG.debug("%s with empty classes", module_name, exc_info=True)
        found, self.missing = self.missing, None
        for name in set(sys.modules) - before:
            values = [*vars(sys.modules[name]).values()]
            if name in found or any(getattr(v, "__module__", "") == _EMPTY for v in values):
                del sys.modules[name]
        return sorted(n for n in found if not any(m.startswith(f"{n}.") for m in found))

    def _note(self, name: str) -> bool:
        """Note a missing name, if such names are being looked for."""
        if self.missing is not None:
            self.missing.add(name)
        return self.missing is not None

    def create_module(self, spec: ModuleSpec) -> None:
        """The ordinary kind of module."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the names into a module."""
        if module.__name__ in MODULES:
            shims = (*_SHIMS, "torch_modules") if "torch" in module.__name__ else _SHIMS
            for shim in shims:
                names = vars(import_module(f"shiftsim.compat.nuplan.shims.{shim}"))
                # planners import private functions as well
                vars(module).update((name, names[name]) for name in names if name[:2] != "__")

        def missing(name: str) -> Any:
            if name[:2] != "__" and self._note(f"{module.__name__}.{name}"):
                return type(name, (), {"__module__": _EMPTY})
            raise AttributeError(f"{_missing(f'{module.__name__}.{name}')}; {_HINT}")

        vars(module)["__getattr__"] = missing


def install() -> bool:
    """Make `import nuplan…` work in this process, and return whether the shims are used."""
    if any(isinstance(finder, ShimFinder) for finder in sys.meta_path):
        return True
    with suppress(ModuleNotFoundError):
        if importlib.util.find_spec("nuplan.planning.simulation.planner.abstract_planner"):
            return False
    # a folder named nuplan, of data for instance, counts as an empty package: drop it
    for name in [name for name in sys.modules if name.partition(".")[0] == "nuplan"]:
        del sys.modules[name]
    sys.meta_path.insert(0, ShimFinder())
    return True


def with_all_missing(error: MissingExtraError, module_name: str) -> MissingExtraError:
    """The error of an import that asks for missing names, with all of them."""
    finder = next((one for one in sys.meta_path if isinstance(one, ShimFinder)), None)
    found = finder.find_missing(module_name) if finder is not None else []
    if len(found) < 2:
        return error
    return MissingExtraError(
        f"{module_name!r} needs {len(found)} names that are not among shiftsim's shims for "
        f"nuPlan's devkit: {', '.join(found)}",
        hint=_HINT,
    )


def _missing(name: str) -> str:
    return f"{name!r} is not among shiftsim's shims for nuPlan's devkit"
