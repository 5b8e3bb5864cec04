"""Import paths of earlier versions, for one version more.

`MODULES` and `NAMES` are the whole story: what was printed in README or docs and has moved since.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MODULES = {
    "shiftsim.data.deepplan_route": "shiftsim.data.deepplan.route",
    "shiftsim.data.deepplan_states": "shiftsim.data.deepplan.states",
    "shiftsim.data.deepplan_windows": "shiftsim.data.deepplan.windows",
    "shiftsim.data.opendrive_map": "shiftsim.data.opendrive.map",
    "shiftsim.log": "shiftsim.sim.log",
    "shiftsim.map": "shiftsim.world.map",
    "shiftsim.noise": "shiftsim.sim.noise",
    "shiftsim.planner": "shiftsim.sim.planner",
    "shiftsim.scenario": "shiftsim.world.scenario",
    "shiftsim.state": "shiftsim.world.state",
    "shiftsim.traffic": "shiftsim.sim.traffic",
    "shiftsim.traffic.constant_velocity": "shiftsim.sim.traffic.constant_velocity",
    "shiftsim.traffic.idm": "shiftsim.sim.traffic.idm.model",
    "shiftsim.traffic.mixed": "shiftsim.sim.traffic.mixed",
}
NAMES = {
    "shiftsim.data.opendrive": {"read_opendrive": "shiftsim.data.opendrive.reading"},
    "shiftsim.data.store": {
        "StoreWriter": "shiftsim.data.store.writing",
        "open_store": "shiftsim.data.store.reading",
    },
    "shiftsim.planners": {"load_planner": "shiftsim.planners.registry"},
}


def moved_names(package: str) -> Callable[[str], Any]:
    """The `__getattr__` of a package that names have moved out of."""

    def find(name: str) -> Any:
        if name not in NAMES[package]:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        _warn(f"{package}.{name}", f"{NAMES[package][name]}.{name}")
        return getattr(import_module(NAMES[package][name]), name)

    return find


class _Finder(MetaPathFinder, Loader):
    """Asked last, for modules that nobody else knows."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MODULES else None

    def exec_module(self, module: ModuleType) -> None:
        _warn(module.__name__, MODULES[module.__name__])
        found = vars(import_module(MODULES[module.__name__]))
        vars(module).update({k: v for k, v in found.items() if not k.startswith("__")})
        vars(module)["__path__"] = []  # what lies below is found here, too


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old} is now {new}", DeprecationWarning, stacklevel=3)


def install() -> None:
    """Let earlier import paths work in this process."""
    sys.meta_path.append(_Finder())
