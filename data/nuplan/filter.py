"""Which scenarios to take: nuPlan's scenario-filter YAML, or a plain list of tokens."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml

from shiftsim.errors import ConfigError
from shiftsim.files import expand

_TOKEN = re.compile(r"[0-9a-f]{16}\Z")


@dataclass(frozen=True)
class ScenarioFilter:
    """A choice of scenarios; None means no restriction. The latter half is `sampling`'s."""

    tokens: frozenset[str] | None = None  # scenario tokens
    types: frozenset[str] | None = None  # scenario types
    logs: frozenset[str] | None = None  # log names
    maps: frozenset[str] | None = None  # map names
    remove_invalid_goals: bool = False  # whether scenes without a goal are left out
    per_type: int | None = None  # scenarios of each type
    limit: int | float | None = None  # scenarios in all, or their share
    min_gap_s: float | None = None  # between scenarios of a type [s]
    min_way: float | None = None  # of the ego's centre [m]
    start_speed: float | None = None  # which the ego must come to exceed [m/s]
    stop_speed: float | None = None  # which the ego must come down to [m/s]
    speed_noise: float = 0.1  # changes up to this do not count there [m/s]
    token_set: frozenset[str] | None = None  # rows of logs …
    min_share: float | None = None  # … of which a scenario must have more than this share
    route_radius: float | None = None  # within which the ego must have its route [m]
    shuffle: bool = False  # whether nuPlan draws at random where it leaves out
    source: str = ""  # the file


def read_filter(path: Path) -> ScenarioFilter:
    """Read a scenario filter (.yaml, .yml) or a list of tokens, one per line (any other ending).

    Raises ConfigError: the file cannot be read, or asks for something that is not supported.
    """
    if Path(path).suffix not in (".yaml", ".yml"):
        lines = [line.split("#")[0].strip() for line in _read_text(path).splitlines()]
        return ScenarioFilter(tokens=_tokens(path, [line for line in lines if line]))
    return _from_values(path, read_yaml(path))


def _read_text(path: Path) -> str:
    try:
        return Path(path).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not readable: {error}", hint="check the path") from error


def _tokens(path: Path, values: list[Any]) -> frozenset[str]:
    for value in values:
        if not isinstance(value, str) or not _TOKEN.match(value):
            raise ConfigError(
                f"{path}: {value!r} is not a token", hint="tokens have 16 hexadecimal digits"
            )
    if not values:
        raise ConfigError(f"{path}: there is no token in it", hint="one token per line")
    return frozenset(str(value) for value in values)


def _from_values(path: Path, values: Mapping[str, Any]) -> ScenarioFilter:
    if values.get("expand_scenarios"):
        what = f"{path}: expand_scenarios: true makes scenarios of a single row"
        raise ConfigError(what, "nothing can be simulated in them: set it to false")
    known = {*_KEYS, "_target_", "_convert_", "expand_scenarios", "token_set_path"}
    for key, value in values.items():
        if key not in known and value is not None and value is not False:
            what = f"{path}: {key}: {value!r} is not known"
            raise ConfigError(what, f"leave it out; known are {', '.join(sorted(known))}")
    found = {name: read(path, values, key) for key, (name, read) in _KEYS.items()}
    if found["speed_noise"] is None:
        del found["speed_noise"]
    if not 0.0 <= (found["min_share"] or 0.0) <= 1.0:
        what = f"fraction_in_token_set_threshold is {found['min_share']:g}"
        raise ConfigError(f"{path}: {what}, not within 0 … 1", hint="give a share")
    if isinstance(found["per_type"], float):
        raise ConfigError(f"{path}: num_scenarios_per_type is a share", hint="give a whole number")
    token_set = _token_set(path, values) if found["min_share"] is not None else None
    return ScenarioFilter(token_set=token_set, source=str(path), **found)


def _token_list(path: Path, values: Mapping[str, Any], key: str) -> frozenset[str] | None:
    tokens = values.get(key)
    if tokens is not None and not isinstance(tokens, list):
        raise ConfigError(f"{path}: {key} is not a list", hint="write it as a list")
    return None if tokens is None else _tokens(path, tokens)


def _number(path: Path, values: Mapping[str, Any], key: str) -> float | None:
    value = values.get(key)
    if value is None or (type(value) in (int, float) and np.isfinite(value)):
        return value
    raise ConfigError(f"{path}: {key}: {value!r} is not a number", hint="give one, or null")


def _count(path: Path, values: Mapping[str, Any], key: str) -> int | float | None:
    """A number of scenarios, or a share of them."""
    value = _number(path, values, key)
    if value is None or (0.0 < value < 1.0 if isinstance(value, float) else value > 0):
        return value
    raise ConfigError(
        f"{path}: {key}: {value!r} is neither a number of scenarios nor a share of them",
        hint="give a whole number above 0, or null; limit_total_scenarios may be a share below 1.0",
    )


def _token_set(path: Path, values: Mapping[str, Any]) -> frozenset[str] | None:
    """Tokens of rows from the JSON file that a filter names."""
    name = values.get("token_set_path")
    if name is None:
        return None
    try:
        tokens = json.loads(expand(str(name)).read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = f"{path}: token_set_path: {name}: not readable JSON: {error}"
        raise ConfigError(what, hint="give a path that holds from the current folder") from error
    if not isinstance(tokens, list) or not all(isinstance(token, str) for token in tokens):
        what = f"{path}: token_set_path: {name}: not a list of tokens"
        raise ConfigError(what, hint="give a JSON list of texts")
    return frozenset(tokens)


def _names(path: Path, values: Mapping[str, Any], key: str) -> frozenset[str] | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, str) and value.startswith("${"):
        return None  # refers to another file: the logs given on the command line are searched
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ConfigError(f"{path}: {key} is not a list of names", hint="write it as a list")
    return frozenset(str(item) for item in value)


# keys of nuPlan's scenario filters: the field that holds each, and how it is read
_KEYS: dict[str, tuple[str, Callable[[Path, Mapping[str, Any], str], Any]]] = {
    "scenario_tokens": ("tokens", _token_list),
    "scenario_types": ("types", _names),
    "log_names": ("logs", _names),
    "map_names": ("maps", _names),
    "remove_invalid_goals": (
        "remove_invalid_goals",
        lambda _, values, key: values.get(key) is True,
    ),
    "num_scenarios_per_type": ("per_type", _count),
    "limit_total_scenarios": ("limit", _count),
    "timestamp_threshold_s": ("min_gap_s", _number),
    "ego_displacement_minimum_m": ("min_way", _number),
    "ego_start_speed_threshold": ("start_speed", _number),
    "ego_stop_speed_threshold": ("stop_speed", _number),
    "speed_noise_tolerance": ("speed_noise", _number),
    "fraction_in_token_set_threshold": ("min_share", _number),
    "ego_route_radius": ("route_radius", _number),
    "shuffle": ("shuffle", lambda _, values, key: values.get(key) is True),
}
# fields in the order in which scenarios are left out: by lists, all together; then one by one
LISTED = ("logs", "maps", "tokens", "types", "remove_invalid_goals")
THINNED = ("per_type", "limit", "min_gap_s")
KEY_OF = {field: key for key, (field, _) in _KEYS.items()}  # key of a field


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # Any to the checker
    """Plain values only; sixteen digits without quotes are a token, no key occurs twice."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        first: [("tag:yaml.org,2002:str", _TOKEN), *found]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping, refused where a key occurs twice."""
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"{key.value!r} occurs twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file of nuPlan, or a ConfigError; sixteen digits are a token."""
    try:
        values = yaml.load(_read_text(path), _Loader)
    except yaml.MarkedYAMLError as error:
        line = 0 if error.problem_mark is None else error.problem_mark.line + 1
        what = f"{path}: line {line}: {error.problem}"
        raise ConfigError(what, hint="repair the YAML there") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML: {error}", hint="check the path") from error
    if not isinstance(values, dict):
        raise ConfigError(
            f"{path}: line 1: no keys with values", hint="give one of nuPlan's scenario filters"
        )
    return values
