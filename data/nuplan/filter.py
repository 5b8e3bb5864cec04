"""Which scenarios to take: nuPlan's scenario-filter YAML, or a plain list of tokens.

Only the flat YAML that these files use is read: one level of keys, scalars and lists of scalars.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shiftsim.errors import ConfigError

_TOKEN = re.compile(r"[0-9a-f]{16}\Z")
_KEY = re.compile(r"([A-Za-z_]\w*)\s*:(?:\s+(.*))?\Z")
_WORDS: dict[str, "Scalar"] = {"null": None, "~": None, "": None, "true": True, "false": False}

Scalar = str | int | float | bool | None

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
    """A choice of scenarios; None means no restriction.

    Attributes:
        tokens: Scenario tokens.
        types: Scenario types.
        logs: Log names.
        maps: Map names.
        remove_invalid_goals: Whether scenes without a goal are left out.
    """

    tokens: frozenset[str] | None = None
    types: frozenset[str] | None = None
    logs: frozenset[str] | None = None
    maps: frozenset[str] | None = None
    remove_invalid_goals: bool = False


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
        return ScenarioFilter(tokens=_token_list(path, text))
    return _from_values(path, read_flat_yaml(path, text))


def _token_list(path: Path, text: str) -> frozenset[str]:
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    return _tokens(path, [line for line in lines if line])


def _tokens(path: Path, values: list[Scalar]) -> frozenset[str]:
    for value in values:
        if not isinstance(value, str) or not _TOKEN.match(value):
            raise ConfigError(
                f"{path}: {value!r} is not a token", hint="tokens have 16 hexadecimal digits"
            )
    if not values:
        raise ConfigError(f"{path}: there is no token in it", hint="one token per line")
    return frozenset(str(value) for value in values)


def _from_values(path: Path, values: Mapping[str, Scalar | list[Scalar]]) -> ScenarioFilter:
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


def _names(
    path: Path, values: Mapping[str, Scalar | list[Scalar]], key: str
) -> frozenset[str] | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, str) and value.startswith("${"):
        return None  # refers to another file: the logs given on the command line are searched
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ConfigError(f"{path}: {key} is not a list of names", hint="write it as a list")
    return frozenset(str(item) for item in value)


def read_flat_yaml(path: Path, text: str) -> dict[str, Scalar | list[Scalar]]:
    """Keys with scalars or lists of scalars.

    Raises:
        ConfigError: Anything else is in the file.
    """
    out: dict[str, Scalar | list[Scalar]] = {}
    items: list[Scalar] | None = None  # of the key whose list may follow
    key = ""
    for number, raw in enumerate(text.splitlines(), 1):
        line = _without_comment(raw).rstrip()
        if not line or line == "---":
            continue
        where = f"{path}: line {number}"
        if line.lstrip().startswith("- ") and items is not None:
            items.append(_scalar(where, line.lstrip()[2:].strip()))
            out[key] = items
            continue
        match = _KEY.match(line)
        if match is None:
            raise _unreadable(where, raw)
        key, value = match[1], (match[2] or "").strip()
        if key in out:
            raise ConfigError(f"{where}: {key!r} occurs twice", hint="keep one of them")
        out[key] = _value(where, value)
        items = [] if value == "" else None
    return out


def _unreadable(where: str, line: str) -> ConfigError:
    return ConfigError(
        f"{where}: cannot read {line.strip()!r}",
        hint="only keys with scalars or lists are read, as in nuPlan's scenario filters",
    )


def _without_comment(line: str) -> str:
    quote = ""
    for index, char in enumerate(line):
        if quote:
            quote = "" if char == quote else quote
        elif char in "'\"":
            quote = char
        elif char == "#" and (index == 0 or line[index - 1].isspace()):
            return line[:index]
    return line


def _value(where: str, text: str) -> Scalar | list[Scalar]:
    if text.startswith("["):
        if not text.endswith("]"):
            raise _unreadable(where, text)
        inner = text[1:-1].strip()
        return [_scalar(where, part.strip()) for part in inner.split(",")] if inner else []
    return _scalar(where, text)


def _scalar(where: str, text: str) -> Scalar:
    if text[:1] in ("'", '"'):
        if len(text) < 2 or text[-1] != text[0] or text[0] in text[1:-1]:
            raise _unreadable(where, text)
        return text[1:-1]
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if text[:1] in "[]{}&*!|>%@`," or (": " in text):
        raise _unreadable(where, text)
    if _TOKEN.match(text):
        return text  # sixteen digits without quotes are still a token
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
