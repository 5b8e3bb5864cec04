"""The exception tree. A message says what is wrong, where, and what to do about it."""

import difflib
import tomllib
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

FAILED = "failed check: "  # begins what a report says of a map that cannot be right
_MAX_TEXT = 100_000  # characters
_MAX_MESSAGE = 1000  # characters


class ShiftsimError(Exception):
    """Base of all errors that a user can cause or repair.

    Attributes:
        message: What is wrong, and where.
        hint: One line that says what to do, may be empty; `str()` has both.

    Example:
        ```python
        try:
            shiftsim.run("idmm")
        except shiftsim.ShiftsimError as error:
            print(error.message, error.hint)
        ```
    """

    def __init__(self, message: str, hint: str = "") -> None:
        # one line, also with the text of another library in it; Gymnasium gives an error here
        message = " ".join(str(message).splitlines())
        if len(message) > _MAX_MESSAGE:
            message = f"{message[:700]} … {message[-250:]}"
        self.message, self.hint = message, hint
        super().__init__(self.message)

    def __str__(self) -> str:
        return f"{self.message}\nhint: {self.hint}" if self.hint else self.message

    def __reduce__(self) -> tuple[type["ShiftsimError"], tuple[str, str]]:
        """Keep the hint when the error travels between processes."""
        return type(self), (self.message, self.hint)


class ConfigError(ShiftsimError):
    """A setting or a command-line value is wrong."""


class DataError(ShiftsimError):
    """A file or store is missing, broken or of another version."""


class ConversionError(DataError):
    """A source recording cannot be converted."""


class MapError(DataError):
    """The map lacks what is needed here."""


class TrafficError(ShiftsimError):
    """A traffic model cannot go on with a scenario."""


class PlannerError(ShiftsimError):
    """A planner failed or returned something invalid."""


class CheckpointError(PlannerError):
    """Weights are missing, have the wrong hash or belong to another network."""


class InvalidTrajectoryError(PlannerError):
    """A planner's trajectory is too short, not finite or does not cover the next step."""


class MissingExtraError(ShiftsimError, ImportError):
    """An optional dependency is not installed."""


def import_extra(module: str, extra: str) -> ModuleType:
    """A module that an extra of shiftsim brings, or a MissingExtraError."""
    try:
        return import_module(module)
    except ImportError as error:
        what = f"{extra} needs {module}, which is not installed"
        raise MissingExtraError(what, f"pip install 'shiftsim[{extra}]'") from error


def readable(value: object) -> str:
    """A value as text that every file can hold; cut where too long."""
    return str(value)[:_MAX_TEXT].encode("utf-8", "backslashreplace").decode()


def plural(count: int, noun: str) -> str:
    """`1 task`, `2 tasks`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names in one line; those beyond `most` are counted: "a, b and 3 more"."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def one_of(what: str, value: str, choices: Iterable[str], others: str = "") -> str:
    """The value, when it is among the choices, or a ConfigError: these, the nearest, `others`."""
    valid = sorted(choices)
    if value in valid:
        return value
    near = nearest(value, valid)
    hint = f"did you mean {near!r}? " if near else ""
    hint += f"available: {', '.join(valid)}{others}"
    raise ConfigError(f"{what} {value!r} unknown", hint)


def beginning(where: str, what: str, text: str, choices: Iterable[str]) -> str:
    """The choice that is the text, or the only one that begins with it; else a ConfigError."""
    valid = sorted(choices)
    if text in valid:
        return text
    found = [choice for choice in valid if choice.startswith(text)]
    if len(found) == 1:
        return found[0]
    if found:
        such = f"such as {', '.join(found[:4])}"
        raise ConfigError(f"{len(found)} {what}s of {where} begin with {text!r}", such)
    starts = {choice[: len(text)]: choice for choice in valid}
    near = difflib.get_close_matches(text, starts, n=1, cutoff=0.75)
    hint = f"did you mean {starts[near[0]]!r}?" if near else f"there are {listed(valid, 3)}"
    hint = hint if valid else f"{where} is empty"
    raise ConfigError(f"{where} has no {what} {text!r}", hint)


def nearest(value: str, choices: Iterable[str]) -> str:
    """The choice that a mistyped value most likely means; empty where none is near."""
    return next(iter(difflib.get_close_matches(value, list(choices), n=1, cutoff=0.5)), "")


def no_attribute(
    what: str, owners: Iterable[str], name: str, names: Iterable[str]
) -> AttributeError:
    """The error where something has no attribute; it says what is most likely meant.

    That is what `synonyms.toml` says in the tables of the `owners`, or the nearest of `names`.
    """
    meant = ""
    if not name.startswith("_"):
        tables = tomllib.loads(Path(__file__).with_name("synonyms.toml").read_text("utf-8"))
        known = [pair for owner in owners for pair in tables.get(owner, {}).items()]
        meant = next((here for keys, here in known if name in keys.split(", ")), "")
        meant = meant or nearest(name, names)
    more = f"; what you mean may be: {meant}" if meant else ""
    return AttributeError(f"{what} has no attribute {name!r}{more}")


def missing_attribute(self: Any, name: str) -> Any:
    """`__getattr__` of an object that has no such attribute: raises what `no_attribute` says."""
    owners = [kind.__name__ for kind in type(self).__mro__]
    # `dir` itself asks for attributes that begin like that
    names = [] if name[0] == "_" else [other for other in dir(self) if other[0] != "_"]
    raise no_attribute(f"{type(self).__name__!r} object", owners, name, names)
