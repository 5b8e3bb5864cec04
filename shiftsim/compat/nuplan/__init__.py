"""Runs planners written for nuPlan: subclasses of its `AbstractPlanner`, unchanged.

Where nuPlan's devkit is installed, planners get its own objects. Where it is not, shims take
the `nuplan.*` module names in this process: `import nuplan…` finds them, and says clearly what they
do not have.

    shiftsim run --planner nuplan:my_package.planner:MyPlanner --planner-arg horizon=8
    shiftsim.run(wrap(MyPlanner(horizon=8)), store="demo")
"""

import functools
import importlib.util
import inspect
import logging
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.planners.registry import planner_factory

if TYPE_CHECKING:
    from shiftsim.compat.nuplan.bridge.planner import NuplanPlanner

_METHODS = ("name", "initialize", "observation_type", "compute_planner_trajectory")
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
_AMONG = "among shiftsim's shims for nuPlan's devkit"
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
        raise MissingExtraError(f"{name!r} is not {_AMONG}", hint=_HINT)

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
            full = f"{module.__name__}.{name}"
            if name[:2] != "__" and self._note(full):
                return type(name, (), {"__module__": _EMPTY})
            raise AttributeError(f"{full!r} is not {_AMONG}; {_HINT}")

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


def wrap(planner: Any, **arguments: Any) -> "NuplanPlanner":
    """A planner for shiftsim from one for nuPlan.

    Args:
        planner: An instance, which is initialized again for every scenario, or a class, of which
            every scenario gets a new instance, as in nuPlan.
        arguments: For the constructor of a class.

    Raises:
        ConfigError: It is no nuPlan planner, or asks for what shiftsim does not have.
    """
    install()
    from shiftsim.compat.nuplan.bridge.planner import NuplanPlanner

    kind = planner if inspect.isclass(planner) else type(planner)
    _check(kind)
    if kind is not planner and arguments:
        what = f"arguments {', '.join(arguments)} were given for an instance of {kind.__name__}"
        raise ConfigError(what, hint=f"wrap({kind.__name__}, …) or wrap({kind.__name__}(…))")
    return NuplanPlanner(planner, arguments)


def from_spec(spec: str) -> Callable[..., "NuplanPlanner"]:
    """What makes the planner `nuplan:package.module:Class`; a ShiftsimError if it is none."""
    if spec.count(":") != 2:
        what = f"planner {spec!r} is not of the form nuplan:package.module:Class"
        raise ConfigError(what, hint="for example nuplan:my_package.my_module:MyPlanner")
    install()
    inner = spec.removeprefix("nuplan:")
    try:
        return factory(planner_factory(inner, "nuplan:", _METHODS[-1]))
    except MissingExtraError as error:
        module = inner.rpartition(":")[0]
        shims = (finder for finder in sys.meta_path if isinstance(finder, ShimFinder))
        found = [name for finder in shims for name in finder.find_missing(module)]
        if len(found) < 2:
            raise
        what = f"{module!r} needs {len(found)} names that are not {_AMONG}: {', '.join(found)}"
        raise MissingExtraError(what, hint=_HINT) from error


def factory(kind: Any) -> Callable[..., "NuplanPlanner"]:
    """What makes wrapped planners of a class, by its arguments; a ConfigError if it is none."""
    if not inspect.isclass(kind):
        what = f"{getattr(kind, '__name__', kind)!r} is not a class"
        raise ConfigError(what, hint="nuplan:package.module:Class")
    _check(kind)

    def make(**arguments: Any) -> "NuplanPlanner":
        return wrap(kind, **arguments)

    functools.update_wrapper(make, kind, updated=())
    # said, for `AbstractPlanner.__new__` hides the constructor from some versions of `inspect`
    parameters = [*inspect.signature(kind.__init__, eval_str=True).parameters.values()][1:]
    if kind.__init__ is object.__init__:
        parameters = []
    vars(make)["__signature__"] = inspect.Signature(parameters)
    return make


def _check(kind: type) -> None:
    missing = [name for name in _METHODS if not callable(getattr(kind, name, None))]
    abstract = sorted(getattr(kind, "__abstractmethods__", ()))
    if missing or abstract:
        raise ConfigError(
            f"{kind.__name__} has no method {(missing or abstract)[0]}()",
            hint="a nuPlan planner is a subclass of AbstractPlanner with "
            + ", ".join(f"{name}()" for name in _METHODS),
        )
    if getattr(kind, "requires_scenario", False):
        raise ConfigError(
            f"{kind.__name__} has requires_scenario = True: it wants nuPlan's scenario object with "
            "the recorded future, which shiftsim does not have",
            hint="what a planner is given: route, goal, map, history, traffic lights; "
            "the oracle of shiftsim is log-future",
        )
