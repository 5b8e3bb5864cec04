"""Closed-loop evaluation of driving planners with nuPlan's semantics.

Type checkers read `__init__.pyi`, so that nothing is imported for them.
"""

import sys
from typing import Any

from shiftsim._version import __version__ as __version__

# public name -> where it is; imported when it is first used, so that `import shiftsim` is instant
_PUBLIC = {
    "Command": "shiftsim.world.state:Command",
    "EgoState": "shiftsim.world.state:EgoState",
    "Localization": "shiftsim.sim.perception:Localization",
    "NoiseModel": "shiftsim.sim.noise:NoiseModel",
    "Observation": "shiftsim.sim.planner:Observation",
    "Perception": "shiftsim.sim.perception:Perception",
    "Planner": "shiftsim.sim.planner:Planner",
    "Run": "shiftsim.api.finished:Run",
    "Scenario": "shiftsim.world.scenario:Scenario",
    "SceneInfo": "shiftsim.sim.planner:SceneInfo",
    "ShiftsimError": "shiftsim.errors:ShiftsimError",
    "SimulationLog": "shiftsim.sim.log:SimulationLog",
    "Tracks": "shiftsim.world.state:Tracks",
    "Trajectory": "shiftsim.world.state:Trajectory",
    "bench": "shiftsim.api:bench",
    "branch": "shiftsim.runs.rollouts.branches:branch",
    "check_planner": "shiftsim.planners.contract:check_planner",
    "convert_dataset": "shiftsim.api.stores:convert_dataset",
    "convert_dsc3d": "shiftsim.api.stores:convert_dsc3d",
    "convert_nuplan": "shiftsim.api.stores:convert_nuplan",
    "convert_tracks": "shiftsim.api.stores:convert_tracks",
    "demo": "shiftsim.api:demo",
    "demo_store": "shiftsim.api:demo_store",
    "load_planner": "shiftsim.api:load_planner",
    "make_towns": "shiftsim.api.stores:make_towns",
    "merge": "shiftsim.api:merge",
    "open_run": "shiftsim.api:open_run",
    "open_store": "shiftsim.api:open_store",
    "policy_planner": "shiftsim.env.policy:policy_planner",
    "run": "shiftsim.api:run",
    "score": "shiftsim.metrics:compute_metrics",
    "score_files": "shiftsim.api:score_files",
    "score_rollout": "shiftsim.runs.rollouts.elsewhere:score_rollout",
    "show": "shiftsim.view.page:show",
    "simulate": "shiftsim.api:simulate",
}

__all__ = list(_PUBLIC)

# Names that earlier documentation printed, for one version more: module path -> where it is now,
# with all modules in it, and `module:name` -> the same. Remove them with the next version.
_DEPRECATED = {
    "shiftsim.api:RunSettings": "shiftsim.runs.config:RunConfig",
    "shiftsim.data.lanes": "shiftsim.data.maps",
    "shiftsim.data.lanes.map": "shiftsim.data.maps.build",
    "shiftsim.data.lanes.pieces": "shiftsim.data.maps.segments",
    "shiftsim.data.opendrive": "shiftsim.data.maps.opendrive",
    "shiftsim.data.opendrive.map": "shiftsim.data.maps.opendrive.map",
    "shiftsim.data.opendrive.reading": "shiftsim.data.maps.opendrive.reading",
    "shiftsim.data.tracks": "shiftsim.data.readers.tracks",
    "shiftsim.data.tracks.build": "shiftsim.data.readers.build",
    "shiftsim.sim.traffic.constant_velocity": "shiftsim.sim.traffic.mixed",
    "shiftsim.sim.traffic.scripted": "shiftsim.sim.traffic.mixed",
    "shiftsim.data.tracks.scenarios": "shiftsim.data.readers.scenarios",
}


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        from shiftsim.errors import no_attribute

        raise no_attribute("module 'shiftsim'", ("shiftsim",), name, _PUBLIC)
    globals()[name] = value = _load(_PUBLIC[name])
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})


def _load(target: str) -> Any:
    from importlib import import_module

    module, _, name = target.partition(":")
    return getattr(import_module(module), name) if name else import_module(module)


class _Deprecated:
    """Imports modules under their earlier paths; asked last, for what nobody else finds."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
        from importlib.machinery import ModuleSpec

        return ModuleSpec(name, _Deprecated) if name in _DEPRECATED else None  # type: ignore[arg-type]

    @staticmethod
    def create_module(spec: Any) -> None:
        return None

    @staticmethod
    def exec_module(module: Any) -> None:
        """Fill a module with the names of the one that it is now."""
        new = _DEPRECATED[module.__name__]
        _warn(module.__name__, new)
        names = vars(_load(new))
        vars(module).update({k: v for k, v in names.items() if not k.startswith("__")})
        module.__path__ = []
        module.__getattr__ = lambda name: deprecated_name(new, name)


def deprecated_name(module: str, name: str) -> Any:
    """A name that a module has no longer, for its `__getattr__`."""
    new = _DEPRECATED.get(f"{module}:{name}")
    if new is None:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    _warn(f"{module}.{name}", new.replace(":", "."))
    return _load(new)


def _warn(old: str, new: str) -> None:
    import warnings

    warnings.warn(f"{old} is now {new}", DeprecationWarning, stacklevel=3)


sys.meta_path.append(_Deprecated)  # type: ignore[arg-type]
