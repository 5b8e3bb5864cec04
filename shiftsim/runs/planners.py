"""The planners of a run: by name, class or instance; how to make them, and what identifies them."""

import copy
import hashlib
import inspect
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

from shiftsim.errors import ConfigError, ShiftsimError
from shiftsim.runs.config import Value
from shiftsim.sim.planner import BatchPlanner, Planner

# what constructors of users' planners are likely to raise
_CANNOT_MAKE = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    RuntimeError,
    OSError,
    ImportError,
)
_NO_PICKLE = (pickle.PicklingError, TypeError, AttributeError, NotImplementedError, RuntimeError)


@dataclass(frozen=True, slots=True)
class PlannerEntry:
    """A planner of a run: how to make it, and what identifies it.

    Attributes:
        name: As in tables.
        source: A name, `package.module:Class`, a class, or an instance.
        arguments: Passed to the constructor of a name or class.
        fingerprint: All that tells it from another planner, as JSON values.
        in_batches: Whether it answers for several scenarios at once.
    """

    name: str
    source: Any
    arguments: Mapping[str, Value]
    fingerprint: Mapping[str, Any]
    in_batches: bool = False

    def make(self) -> Planner:
        """An instance of its own for one worker."""
        if isinstance(self.source, str):
            from shiftsim.planners.registry import load_planner

            loaded: Planner = load_planner(self.source, dict(self.arguments))
            return loaded
        if inspect.isclass(self.source):
            made: Planner = cast(Any, self.source)(**self.arguments)
            return made
        own: Planner = copy.deepcopy(self.source)
        return own


def planner_name(source: Any) -> str:
    """How a planner given by name, class or instance is called in tables."""
    if isinstance(source, str):
        return source
    kind = source if inspect.isclass(source) else type(source)
    return str(getattr(source, "name", "") or kind.__name__)


def planner_entry(source: Any, arguments: Mapping[str, Value]) -> PlannerEntry:
    """Describe a planner given by name, class or instance; it is made once to see that it works.

    Raises:
        ShiftsimError: It does not exist, or cannot be made.
    """
    if isinstance(source, str):
        from shiftsim.planners.registry import planner_fingerprint

        entry = PlannerEntry(
            source, source, arguments, planner_fingerprint(source, dict(arguments))
        )
    else:
        kind = source if inspect.isclass(source) else type(source)
        fingerprint = _object_fingerprint(kind, source, arguments)
        entry = PlannerEntry(planner_name(source), source, arguments, fingerprint)
    try:
        planner = entry.make()
    except ShiftsimError:
        raise
    except _CANNOT_MAKE as error:
        raise ConfigError(
            f"planner {entry.name!r} cannot be made: {type(error).__name__}: {error}",
            hint="check its arguments with --planner-arg key=value",
        ) from error
    for method in ("reset", "plan"):
        if not callable(getattr(planner, method, None)):
            raise ConfigError(
                f"planner {entry.name!r} has no method {method}()",
                hint="a planner has reset(scene) and plan(observation)",
            )
    close_planner(planner)
    return replace(entry, in_batches=isinstance(planner, BatchPlanner))


def _object_fingerprint(
    kind: type, source: object, arguments: Mapping[str, Value]
) -> dict[str, Any]:
    """A class's code and an instance's state, as far as they can be seen."""
    digest = hashlib.sha256()
    try:
        digest.update(inspect.getsource(kind).encode())
    except (OSError, TypeError):
        digest.update(repr(sorted(vars(kind))).encode())
    if source is not kind:
        try:
            digest.update(pickle.dumps(getattr(source, "__dict__", None)))
        except _NO_PICKLE as error:  # then its state merely has no digest
            digest.update(type(error).__name__.encode())
    return {
        "planner": f"{kind.__module__}:{kind.__qualname__}",
        "arguments": dict(sorted(arguments.items())),
        "source": digest.hexdigest(),
    }


def can_travel(entry: PlannerEntry) -> bool:
    """Whether a planner can be sent to a worker process.

    A class defined in the main script cannot: workers do not import that script.
    """
    if isinstance(entry.source, str):
        return True
    kind = entry.source if inspect.isclass(entry.source) else type(entry.source)
    if kind.__module__ == "__main__":
        return False
    try:
        pickle.dumps(entry.source)
    except _NO_PICKLE:
        return False
    return True


def takes_argument(source: Any, name: str) -> bool:
    """Whether the constructor of a planner given by name or class has a parameter of that name."""
    if isinstance(source, str):
        from shiftsim.planners.registry import planner_factory

        source = planner_factory(source)
    elif not inspect.isclass(source):
        return False
    try:
        return name in inspect.signature(source).parameters
    except (TypeError, ValueError):
        return False


def close_planner(planner: object) -> None:
    """Let a planner release what it holds."""
    close = getattr(planner, "close", None)
    if callable(close):
        close()
