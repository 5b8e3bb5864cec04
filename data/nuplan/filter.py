"""Which scenarios to take: nuPlan's scenario-filter YAML, or a plain list of tokens."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from shiftsim.errors import ConfigError

_TOKEN = re.compile(r"[0-9a-f]{16}\Z")

# Keys that choose among scenarios in ways of their own: they must be off, unless tokens are given.
_SAMPLING = ("num_scenarios_per_type", "limit_total_scenarios", "timestamp_threshold_s")
_UNSUPPORTED = (
    "ego_displacement_minimum_m",
    "ego_start_speed_threshold",
    "ego_stop_speed_threshold",
    "fraction_in_neighbor_threshold",
    "token_set_path",
)
_NEUTRAL = ("_target_", "_convert_", "shuffle", "speed_noise_tolerance")
_USED = ("scenario_types", "scenario_tokens", "log_names", "map_names", "remove_invalid_goals")


@dataclass(frozen=True)
class ScenarioFilter:
    """A choice of scenarios; None means no restriction."""

    tokens: frozenset[str] | None = None  # scenario tokens
    types: frozenset[str] | None = None  # scenario types
    logs: frozenset[str] | None = None  # log names
    maps: frozenset[str] | None = None  # map names
    remove_invalid_goals: bool = False  # whether scenes without a goal are left out


def read_filter(path: Path) -> ScenarioFilter:
    """Read a scenario filter (.yaml, .yml) or a list of tokens, one per line (any other ending).

    Raises:
        ConfigError: The file cannot be read, or asks for something that is not supported.
    """
    try:
        text = Path(path).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not readable: {error}", hint="check the path") from error
    if Path(path).suffix not in (".yaml", ".yml"):
        lines = [line.split("#")[0].strip() for line in text.splitlines()]
        return ScenarioFilter(tokens=_tokens(path, [line for line in lines if line]))
    return _from_values(path, _read_yaml(path, text))


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
    tokens = values.get("scenario_tokens")
    if tokens is not None and not isinstance(tokens, list):
        raise ConfigError(f"{path}: scenario_tokens is not a list", hint="write it as a list")
    for key, value in values.items():
        given_tokens = key in _SAMPLING and tokens is not None
        off = value is None or value is False or given_tokens
        if key in (*_USED, *_NEUTRAL) or (key in (*_SAMPLING, *_UNSUPPORTED) and off):
            continue
        if key == "expand_scenarios" and not value:
            continue
        raise ConfigError(
            f"{path}: {key}: {value!r} is not supported",
            hint="give scenario_tokens, or choose by types and map_names only",
        )
    return ScenarioFilter(
        tokens=None if tokens is None else _tokens(path, tokens),
        types=_names(path, values, "scenario_types"),
        logs=_names(path, values, "log_names"),
        maps=_names(path, values, "map_names"),
        remove_invalid_goals=values.get("remove_invalid_goals") is True,
    )


def _names(path: Path, values: Mapping[str, Any], key: str) -> frozenset[str] | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, str) and value.startswith("${"):
        return None  # refers to another file: the logs given on the command line are searched
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ConfigError(f"{path}: {key} is not a list of names", hint="write it as a list")
    return frozenset(str(item) for item in value)


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


def _read_yaml(path: Path, text: str) -> dict[str, Any]:
    try:
        values = yaml.load(text, _Loader)
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
