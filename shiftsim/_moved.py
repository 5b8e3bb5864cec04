"""Import paths of earlier versions, for one version more.

`MODULES`, and `MOVED` of some packages, are the whole story: what was printed in README or docs
and has moved since.
"""

import warnings
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MODULES = {
    "shiftsim.data.deepplan_route": "shiftsim.data.readers.routes",
    "shiftsim.data.deepplan_states": "shiftsim.data.readers.samples",
    "shiftsim.data.deepplan_windows": "shiftsim.data.readers.windows",
    "shiftsim.data.opendrive_map": "shiftsim.data.maps.opendrive.map",
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


def moved_name(name: str, module: str) -> Any:
    """A name that has moved from a package into a module of it."""
    _warn(f"{module.rpartition('.')[0]}.{name}", f"{module}.{name}")
    return getattr(import_module(module), name)


def find_spec(name: str) -> ModuleSpec | None:
    """What imports a module under its earlier path."""
    return ModuleSpec(name, _Loader()) if name in MODULES else None


class _Loader(Loader):
    def exec_module(self, module: ModuleType) -> None:
        _warn(module.__name__, MODULES[module.__name__])
        found = vars(import_module(MODULES[module.__name__]))
        vars(module).update({k: v for k, v in found.items() if not k.startswith("__")})
        vars(module)["__path__"] = []  # what lies below is found here, too


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old} is now {new}", DeprecationWarning, stacklevel=3)
