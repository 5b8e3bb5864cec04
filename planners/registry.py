"""Makes planners: by name, by `package.module:Class`, from a class or an instance.

`nuplan:package.module:Class` is a planner written against nuPlan's interface, `policy:FILE` one
that acts in the environment. Nothing is imported before it is asked for.
"""

import copy
import hashlib
import importlib
import inspect
import pickle
import sys
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from shiftsim.errors import ConfigError, MissingExtraError, ShiftsimError, one_of, readable
from shiftsim.files import import_named, place_of
from shiftsim.planners.prototype import PlannerPrototype, close_planner
from shiftsim.planners.table import PLANNERS as PLANNERS
from shiftsim.planners.table import readiness as readiness
from shiftsim.sim.planner import BatchPlanner, Planner, sees_recording

# planners of another interface: prefix -> module with from_spec(spec), which is what makes them
_ADAPTERS = {"nuplan:": "shiftsim.compat.nuplan", "policy:": "shiftsim.env.policy"}
_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
_NO_PICKLE = (pickle.PicklingError, TypeError, AttributeError, NotImplementedError, RuntimeError)


def load_planner(spec: str, arguments: Mapping[str, Any] | None = None) -> Planner:
    """A new planner, or the errors of `shiftsim.load_planner`.

    `spec` is a registered name, or `package.module:Class` of a custom planner, which may lie in the
    current directory, or `file.py:Class`; with `nuplan:` before it where it is written for nuPlan.
    Or `policy:FILE` (see `shiftsim.env.policy`). Texts among the arguments are converted to what
    its constructor asks for. A learned planner without a `checkpoint` takes its published file from
    the folder of checkpoints, else our own weights where there are any.
    """
    factory = planner_factory(spec)
    values = _bind(spec, factory, arguments or {})
    planner = _construct(spec, lambda: factory(**values))
    _require_methods(spec, planner)
    return cast(Planner, planner)


def _construct(name: str, make: Callable[[], Any]) -> Any:
    try:
        return make()
    except ShiftsimError:
        raise
    except (Exception, SystemExit) as error:  # of users' code
        where = place_of(error)
        raise ConfigError(
            f"planner {name!r} cannot be made: {type(error).__name__}: {readable(error)}"
            f"{where and f' ({where})'}",
            hint="check its constructor, and its arguments with --planner-arg key=value",
        ) from error


def planner_factory(spec: str, adapter: str = "", method: str = "plan") -> Any:
    """The class, or other callable, that makes the planner `spec` (see `load_planner`).

    An adapter gives its prefix, which is left out of `spec`, and a method of its planners.

    Raises ConfigError: there is none. MissingExtraError: it needs more than nuPlan's shims have.
    """
    for prefix, module_name in _ADAPTERS.items():
        if spec.startswith(prefix):
            return importlib.import_module(module_name).from_spec(spec)
    entry, full = PLANNERS.get(spec), adapter + spec
    if entry is None and spec.endswith(".py"):
        raise ConfigError(
            f"planner {full!r} is a file: which of its classes is meant?",
            hint=f"write {full}:MyPlanner",
        )
    if entry is None and ":" not in spec:
        one_of("planner", spec, PLANNERS)
    module_name, _, attribute = (spec if entry is None else entry.target).rpartition(":")
    in_file = module_name.endswith(".py")
    if not module_name or not attribute.isidentifier() or (":" in module_name and not in_file):
        raise ConfigError(
            f"planner {full!r} is not of the form package.module:Class or file.py:Class",
            hint="for example my_package.my_module:MyPlanner, or ./my_file.py:MyPlanner",
        )
    try:
        module = import_named(module_name)
    except MissingExtraError:
        raise
    except ImportError as error:
        raise ConfigError(
            f"planner {full!r}: module {module_name!r} cannot be imported ({error})",
            hint=_import_hint(spec, module_name, error),
        ) from error
    factory = getattr(module, attribute, None)
    if not callable(factory):
        kinds = {n: v for n, v in vars(module).items() if inspect.isclass(v) and hasattr(v, method)}
        names = [name for name, kind in kinds.items() if not inspect.isabstract(kind)]
        raise ConfigError(
            f"planner {full!r}: module {module_name!r} has no class {attribute!r}",
            hint=f"planners in it: {', '.join(sorted(names)) or 'none'}",
        )
    return factory


def planner_fingerprint(spec: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """All that tells one planner from another, as JSON values; errors are those of `load_planner`.

    Custom planners carry the hash of their module's source, policies and file arguments that of the
    file, learned planners that of their checkpoint and the kind of their device; what else they
    depend on is not seen.
    """
    entry = PLANNERS.get(spec)
    factory = planner_factory(spec)
    values = _bind(spec, factory, arguments or {})
    learned: dict[str, Any] = {}
    if entry is not None and entry.checkpoint is not None:
        learned = factory.fingerprint(**values)
        values["device"] = learned.pop("device")
        values.pop("checkpoint", None)
    out: dict[str, Any] = {
        "planner": spec,
        "target": spec if entry is None else entry.target,
        "arguments": {
            name: str(value) if isinstance(value, Path) else value
            for name, value in sorted(values.items())
        },
        **learned,
    }
    made_of = getattr(factory, "files", {})  # of a policy
    files = made_of | {n: v for n, v in values.items() if isinstance(v, Path)}
    if files:
        out["files"] = {name: _hash_file(path, spec, name) for name, path in sorted(files.items())}
    is_users = entry is None and not made_of
    source = inspect.getsourcefile(inspect.unwrap(factory)) if is_users else None
    if source is not None:
        out["source"] = hashlib.sha256(Path(source).read_bytes()).hexdigest()
    return out


@dataclass
class RunPlanner:
    """A planner of a run: what identifies it, and how each process makes it."""

    name: str  # as in tables
    source: Any  # A name, `package.module:Class`, a class, or an instance
    arguments: Mapping[str, Any]  # passed to the constructor of a name or class
    fingerprint: Mapping[str, Any]  # all that tells it from another planner, as JSON values
    in_batches: bool = False  # whether it answers for several scenarios at once
    batch_size: int = 0  # how many of them; 0 for as many as the run says
    ask: Any = None  # of `LearnedPlanner.asking`, where another process has the network

    @cached_property
    def prototype(self) -> PlannerPrototype:
        """The planner of this process, whose copies drive."""
        return PlannerPrototype(self.make)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "prototype"}

    def close(self) -> None:
        """Let the planner of this process release what it holds."""
        if (prototype := vars(self).pop("prototype", None)) is not None:
            close_planner(prototype.planner)

    def make(self) -> Planner:
        """An instance of its own."""
        if self.ask is not None:
            return cast(Planner, planner_factory(self.source).asking(self.ask))
        if isinstance(self.source, str):
            return load_planner(self.source, self.arguments)
        if inspect.isclass(self.source):
            return cast(Planner, self.source(**self.arguments))
        if isinstance(self.source, BatchPlanner):
            return self.source.fork()
        if hasattr(self.source, "identify"):  # it is isolated, and has its copies elsewhere
            return cast(Planner, self.source)
        try:
            return cast(Planner, copy.deepcopy(self.source))
        except _NO_PICKLE as error:
            what = f"planner {self.name!r} cannot be copied, as every scenario needs it: {error}"
            raise ConfigError(what, hint="give its class, or package.module:Class") from error

    @property
    def on_gpu(self) -> bool:
        """Whether it is one of the table whose network is on a GPU."""
        known = PLANNERS.get(self.source) if isinstance(self.source, str) else None
        is_learned = known is not None and known.checkpoint is not None
        return is_learned and self.fingerprint["arguments"]["device"] == "cuda"

    @property
    def can_travel(self) -> bool:
        """Whether workers can be sent it: they do not import what the main script defines."""
        try:
            return isinstance(self.source, str) or b"__main__" not in pickle.dumps(self.source)
        except _NO_PICKLE:
            return False


def run_planner(source: Any, arguments: Mapping[str, Any], name: str = "") -> RunPlanner:
    """A planner given by name, class or instance; it is made here, else it is a ShiftsimError.

    It is called `name` in tables, by default as `planner_name` says.
    """
    name = name or planner_name(source)
    if isinstance(source, str):
        fingerprint = planner_fingerprint(source, arguments)
    elif hasattr(source, "identify"):
        fingerprint = source.identify()
    else:
        fingerprint = _object_fingerprint(source, arguments)
    found = RunPlanner(name, source, arguments, fingerprint)
    planner = _construct(name, lambda: found.prototype.planner)
    _require_methods(name, planner)
    if sees_recording(planner):
        found.fingerprint = {**fingerprint, "sees_recording": True}
    found.in_batches = isinstance(planner, BatchPlanner)
    return found


def planner_name(source: Any) -> str:
    """How a planner given by name, class or instance is called in tables."""
    if isinstance(source, str):
        return source
    kind = _class_of(source)
    return str(getattr(source, "name", "") or kind.__name__)


def own_name(planner: RunPlanner) -> str:
    """The `name` of a custom planner's class or instance; where it has none, what it is called.

    Names of registered planners, which a class may inherit, are theirs alone.
    """
    found = planner.prototype.planner
    is_isolated = hasattr(planner.source, "identify")
    own = getattr(found, "called" if is_isolated else "name", "")
    is_free = isinstance(own, str) and own.isprintable() and "=" not in own and own.strip()
    return str(own) if is_free and own not in PLANNERS else planner.name


def takes_argument(source: Any, name: str) -> bool:
    """Whether the constructor of a planner given by name or class has a parameter of that name."""
    if isinstance(source, str):
        source = planner_factory(source)
    elif not inspect.isclass(source):
        return False
    try:
        return name in inspect.signature(source).parameters
    except (TypeError, ValueError):
        return False


def _class_of(source: Any) -> Any:
    return source if inspect.isclass(source) else type(source)


def _object_fingerprint(source: object, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """A class's code and an instance's state, as far as they can be seen."""
    kind, digest = _class_of(source), hashlib.sha256()
    try:
        digest.update(inspect.getsource(kind).encode())
    except (OSError, TypeError):
        digest.update(repr(sorted(vars(kind))).encode())
    state = "" if source is kind else state_digest(getattr(source, "__dict__", None))
    digest.update(state.encode())
    is_seen = source is kind or (state and getattr(source, "is_seen", True))
    return {
        "planner": f"{kind.__module__}:{kind.__qualname__}",
        "arguments": dict(sorted(arguments.items())),
        "source": digest.hexdigest(),
        **({} if is_seen else {"unseen": True}),
    }


def state_digest(value: object) -> str:
    """SHA-256 of a value; empty where it cannot be pickled, so that nobody can compare it."""
    try:
        return hashlib.sha256(pickle.dumps(value)).hexdigest()
    except Exception:  # of users' code
        return ""


def _hash_file(path: Path, spec: str, argument: str) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigError(
            f"planner {spec!r}: argument {argument}={str(path)!r} cannot be read ({error.strerror})"
        ) from error


def _require_methods(name: str, planner: object) -> None:
    for method in ("reset", "plan"):
        if not callable(getattr(planner, method, None)):
            raise ConfigError(
                f"planner {name!r}: {type(planner).__name__} has no method {method}()",
                hint="a planner has reset(self, scene) and plan(self, observation)",
            )


def _import_hint(spec: str, module_name: str, error: ImportError) -> str:
    if (error.name or "").partition(".")[0] == "nuplan":
        return f"if it is written for nuPlan, write nuplan:{spec}"
    if not module_name.endswith(".py"):
        return "install it, or run from the folder that holds it"
    if not Path(module_name).is_file():
        return "check the path"
    if "relative import" in str(error):
        return "import from the same folder without dots, as in `from helper import thing`"
    if isinstance(error, ModuleNotFoundError):
        return f"install it where shiftsim is: {sys.executable} -m pip install …"
    return "rename the file" if "rename the file" in str(error) else "repair it"


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
            if isinstance(value, bool) or (kind is int and isinstance(value, float)):
                raise TypeError
            return kind(value)
        return kind(value) if kind in (str, Path) else value
    except (KeyError, TypeError, ValueError):
        raise ConfigError(
            f"planner {spec!r}: argument {name}={value!r} is not a {kind.__name__}",
            hint=f"--planner-arg {name}=<{kind.__name__}>",
        ) from None


def _kind_of(parameter: inspect.Parameter) -> Any:
    """What an argument is to be converted to; `object` where nothing is known."""
    annotation = parameter.annotation
    options = [a for a in typing.get_args(annotation) if a is not types.NoneType]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        annotation = options[0] if len(options) == 1 else object
    if annotation is parameter.empty and isinstance(parameter.default, (bool, int, float, str)):
        annotation = type(parameter.default)
    return annotation if isinstance(annotation, type) else object
