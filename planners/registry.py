"""Planners by name, and users' own ones by `package.module:Class`.

`nuplan:package.module:Class` is a planner written against nuPlan's interface.

Nothing is imported before it is asked for.
"""

import hashlib
import importlib
import importlib.util
import inspect
import sys
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shiftsim.errors import CheckpointError, ConfigError, MissingExtraError, one_of
from shiftsim.files import checkpoint_folder
from shiftsim.sim.planner import Planner


@dataclass(frozen=True, slots=True)
class Published:
    """A checkpoint as its authors publish it.

    Attributes:
        file: What is published.
        project: Name of the project that publishes it.
        name: File or folder in the folder of checkpoints, where it is found by itself.
    """

    file: str
    project: str
    name: str


@dataclass(frozen=True, slots=True)
class PlannerEntry:
    """One registered planner.

    Attributes:
        name: Its name everywhere.
        kind: `rule-based`, `oracle` (looks at the recording), `replay` or `learned`.
        target: `package.module:Class`.
        description: One line.
        arguments: Names of the arguments it takes.
        checkpoint: What a learned planner loads; it also needs the extra `learned`.
    """

    name: str
    kind: str
    target: str
    description: str
    arguments: tuple[str, ...] = ()
    checkpoint: Published | None = None


_ENTRIES = (
    PlannerEntry(
        "carl",
        "learned",
        "shiftsim.planners.learned.carl.planner:Carl",
        "a policy trained by reinforcement learning on a raster of the surroundings",
        ("checkpoint", "device"),
        Published(
            "nuPlan/checkpoints/nuplan_51892_1B/model_best.pth",
            "autonomousvision/CaRL",
            "nuplan_51892_1B",
        ),
    ),
    PlannerEntry(
        "constant-velocity",
        "rule-based",
        "shiftsim.planners.basic.constant_velocity:ConstantVelocity",
        "keeps heading and speed",
    ),
    PlannerEntry(
        "diffusion-planner",
        "learned",
        "shiftsim.planners.learned.diffusion.planner:DiffusionPlanner",
        "samples the future of ego and neighbours with a diffusion transformer",
        ("checkpoint", "device"),
        Published(
            "model.pth and args.json", "ZhengYinan-AIR/Diffusion-Planner", "diffusion-planner"
        ),
    ),
    PlannerEntry(
        "idm",
        "rule-based",
        "shiftsim.planners.idm.planner:Idm",
        "nuPlan's IDM planner: follows the route's lanes behind the nearest object",
        ("target_velocity", "min_gap", "headway", "accel_max", "decel_max"),
    ),
    PlannerEntry(
        "log-future",
        "oracle",
        "shiftsim.planners.basic.log_future:LogFuture",
        "drives the recorded future",
    ),
    PlannerEntry(
        "pdm-closed",
        "rule-based",
        "shiftsim.planners.pdm.planner:PdmClosed",
        "drives 15 proposals along the route in its head and takes the best one",
        (
            "speed_fractions",
            "lateral_offsets",
            "fallback_velocity",
            "min_gap",
            "headway",
            "accel_max",
            "decel_max",
            "map_radius",
        ),
    ),
    PlannerEntry(
        "plantf",
        "learned",
        "shiftsim.planners.learned.plantf.planner:PlanTF",
        "imitation with a transformer over agents and map",
        ("checkpoint", "device"),
        Published("planTF.ckpt", "jchengai/planTF", "planTF.ckpt"),
    ),
    PlannerEntry(
        "pluto",
        "learned",
        "shiftsim.planners.learned.pluto.planner:Pluto",
        "imitation with contrastive learning, and a choice among its plans by rules",
        ("checkpoint", "device"),
        Published("pluto_1M_aux_cil.ckpt", "jchengai/pluto", "pluto_1M_aux_cil.ckpt"),
    ),
    PlannerEntry(
        "scripted",
        "replay",
        "shiftsim.planners.basic.scripted:Scripted",
        "replays pose sequences from a Parquet or CSV file",
        ("file", "name"),
    ),
    PlannerEntry(
        "simple",
        "rule-based",
        "shiftsim.planners.basic.simple:Simple",
        "nuPlan's SimplePlanner: straight on, slows down to a limit",
        ("max_velocity",),
    ),
)
PLANNERS = types.MappingProxyType({entry.name: entry for entry in _ENTRIES})

# planners of another interface: prefix -> module with install() and factory(class)
_ADAPTERS = {"nuplan:": "shiftsim.compat.nuplan"}

_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def load_planner(spec: str, arguments: Mapping[str, Any] | None = None) -> Planner:
    """A new planner.

    Args:
        spec: Registered name, or `package.module:Class` of an own planner, which may lie in the
            current directory; with `nuplan:` before it where it is written for nuPlan.
        arguments: Arguments of its constructor; texts are converted to what it asks for.

    A learned planner without a `checkpoint` takes its published file from the folder of
    checkpoints.

    Raises:
        ConfigError: The name, the module, the class or an argument is wrong.
        CheckpointError: A learned planner has no checkpoint, or the wrong one.
        MissingExtraError: A learned planner needs PyTorch.
    """
    factory = planner_factory(spec)
    values = _bind(spec, factory, _completed(spec, arguments or {}))
    planner = factory(**values)
    _require_methods(spec, planner)
    return planner


def planner_factory(spec: str) -> Any:
    """The class, or other callable, that makes the planner `spec` (see `load_planner`).

    Raises:
        ConfigError: There is none.
        MissingExtraError: It needs more of nuPlan's devkit than its stand-ins have.
    """
    for prefix, adapter in _ADAPTERS.items():
        if spec.startswith(prefix):
            if spec.count(":") != 2:
                raise ConfigError(
                    f"planner {spec!r} is not of the form {prefix}package.module:Class",
                    hint=f"for example {prefix}my_package.my_module:MyPlanner",
                )
            compat = importlib.import_module(adapter)
            compat.install()
            return compat.factory(planner_factory(spec.removeprefix(prefix)))
    entry = PLANNERS.get(spec)
    if entry is None and ":" not in spec:
        one_of("planner", spec, PLANNERS)
    module_name, _, attribute = (spec if entry is None else entry.target).partition(":")
    if not module_name or not attribute.isidentifier():
        raise ConfigError(
            f"planner {spec!r} is not of the form package.module:Class",
            hint="for example my_package.my_module:MyPlanner",
        )
    if entry is None and (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)
    try:
        module = importlib.import_module(module_name)
    except MissingExtraError:
        raise
    except ImportError as error:
        raise ConfigError(
            f"planner {spec!r}: module {module_name!r} cannot be imported ({error})",
            hint="install it, or run from the directory that holds it",
        ) from error
    factory = getattr(module, attribute, None)
    if not callable(factory):
        names = [n for n, v in vars(module).items() if inspect.isclass(v) and hasattr(v, "plan")]
        raise ConfigError(
            f"planner {spec!r}: module {module_name!r} has no class {attribute!r}",
            hint=f"planners in it: {', '.join(sorted(names)) or 'none'}",
        )
    return factory


def planner_fingerprint(spec: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """All that tells one planner from another, as JSON values.

    Own planners carry the hash of their module's source, file arguments that of the file, learned
    planners that of their checkpoint and the kind of their device; what else they depend on is not
    seen.

    Raises:
        ConfigError: The planner or an argument is wrong.
        CheckpointError: A learned planner has no checkpoint.
        MissingExtraError: A learned planner needs PyTorch.
    """
    entry = PLANNERS.get(spec)
    factory = planner_factory(spec)
    values = _bind(spec, factory, _completed(spec, arguments or {}))
    learned = {}
    if entry is not None and entry.checkpoint is not None:
        from shiftsim.planners.learned.checkpoint import checkpoint_fingerprint
        from shiftsim.planners.learned.device import resolve_device

        learned["checkpoint"] = checkpoint_fingerprint(values.pop("checkpoint"), spec)
        values["device"] = resolve_device(values.get("device", "cpu")).partition(":")[0]
    out: dict[str, Any] = {
        "planner": spec,
        "target": spec if entry is None else entry.target,
        "arguments": {
            name: str(value) if isinstance(value, Path) else value
            for name, value in sorted(values.items())
        },
        **learned,
    }
    files = {n: v for n, v in values.items() if isinstance(v, Path)}
    if files:
        out["files"] = {name: _hash_file(path, spec, name) for name, path in sorted(files.items())}
    source = inspect.getsourcefile(inspect.unwrap(factory)) if entry is None else None
    if source is not None:
        out["source"] = hashlib.sha256(Path(source).read_bytes()).hexdigest()
    return out


def readiness(entry: PlannerEntry) -> str:
    """What is missing to run a planner without further ado, in one line; empty where nothing."""
    if entry.checkpoint is None:
        return ""
    if importlib.util.find_spec("torch") is None:
        return "needs PyTorch: pip install 'shiftsim[learned]'"
    path = checkpoint_folder() / entry.checkpoint.name
    return "" if path.exists() else f"no checkpoint: give one, or put it at {path}"


def _completed(spec: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Arguments with the published checkpoint where a learned planner is given none."""
    entry = PLANNERS.get(spec)
    if entry is None or entry.checkpoint is None:
        return arguments
    from shiftsim.planners.learned.checkpoint import how_to_get
    from shiftsim.planners.learned.device import require_torch

    require_torch(f"planner {spec!r}")
    if arguments.get("checkpoint"):
        return arguments
    path = checkpoint_folder() / entry.checkpoint.name
    if not path.exists():
        raise CheckpointError(f"planner {spec!r} needs a checkpoint", hint=how_to_get(spec))
    return {**arguments, "checkpoint": str(path)}


def _hash_file(path: Path, spec: str, argument: str) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigError(
            f"planner {spec!r}: argument {argument}={str(path)!r} cannot be read ({error.strerror})"
        ) from error


def _require_methods(spec: str, planner: object) -> None:
    for method in ("reset", "plan"):
        if not callable(getattr(planner, method, None)):
            raise ConfigError(
                f"planner {spec!r}: {type(planner).__name__} has no method {method}()",
                hint="a planner has reset(self, scene) and plan(self, observation)",
            )


def _bind(spec: str, factory: Any, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments converted to what the constructor asks for."""
    try:
        parameters = inspect.signature(factory, eval_str=True).parameters
    except (TypeError, ValueError, NameError):
        return dict(arguments)
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    known = {n: p for n, p in parameters.items() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    unknown = sorted(set(arguments) - set(known))
    if unknown and not takes_any:
        raise ConfigError(
            f"planner {spec!r} has no argument {unknown[0]!r}",
            hint=f"its arguments: {', '.join(known) or 'none'}",
        )
    missing = [n for n, p in known.items() if p.default is p.empty and n not in arguments]
    if missing:
        raise ConfigError(
            f"planner {spec!r} needs the argument {missing[0]!r}",
            hint=f"--planner-arg {missing[0]}=…",
        )
    return {
        name: _convert(spec, name, value, known[name]) if name in known else value
        for name, value in arguments.items()
    }


def _convert(spec: str, name: str, value: Any, parameter: inspect.Parameter) -> Any:
    kind = _kind_of(parameter)
    try:
        if kind is bool:
            return value if isinstance(value, bool) else _WORDS[str(value).lower()]
        if kind in (int, float):
            return _number(value, kind)
        return kind(value) if kind in (str, Path) else value
    except (KeyError, TypeError, ValueError):
        raise ConfigError(
            f"planner {spec!r}: argument {name}={value!r} is not a {kind.__name__}",
            hint=f"--planner-arg {name}=<{kind.__name__}>",
        ) from None


def _number(value: Any, kind: type) -> Any:
    if isinstance(value, bool) or (kind is int and isinstance(value, float)):
        raise TypeError
    return kind(value)


def _kind_of(parameter: inspect.Parameter) -> type:
    """What an argument is to be converted to; `object` where nothing is known."""
    annotation = parameter.annotation
    options = [a for a in typing.get_args(annotation) if a is not types.NoneType]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        annotation = options[0] if len(options) == 1 else object
    if annotation is parameter.empty and isinstance(parameter.default, (bool, int, float, str)):
        annotation = type(parameter.default)
    return annotation if isinstance(annotation, type) else object
