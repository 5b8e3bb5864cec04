"""Which scenarios to take: nuPlan's scenario-filter YAML, or a plain list of tokens.

What logs offer is filtered in nuPlan's order of steps: first lists are thinned out, of all logs at
once; then every scenario is judged by itself.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml

from shiftsim.data.nuplan.log import UNTAGGED, Log, read_ego
from shiftsim.data.nuplan.scenarios import ROW_SECONDS, ScenarioEntry
from shiftsim.data.recording import Window
from shiftsim.errors import ConfigError
from shiftsim.files import expand
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.state import VX, VY, center_poses

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
            what = f"{path}: {value!r} is not a token"
            raise ConfigError(what, hint="tokens have 16 hexadecimal digits")
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
        words = f"{path}: line 1: no keys with values"
        raise ConfigError(words, hint="give one of nuPlan's scenario filters")
    return values


def thin_out(entries: Sequence[ScenarioEntry], chosen: ScenarioFilter) -> list[ScenarioEntry]:
    """The entries that are left of those of all logs, in the order of the logs.

    nuPlan rule 432: so many per type, then so many in all, then those far enough apart in time.
    Raises ConfigError: nuPlan would draw some of them at random.
    """
    by_type: dict[str, list[ScenarioEntry]] = {}
    for entry in entries:
        by_type.setdefault(entry.scenario_type, []).append(entry)
    if chosen.per_type is not None:
        for kind, found in by_type.items():
            _refuse_draw(chosen, "num_scenarios_per_type", chosen.per_type, len(found))
            by_type[kind] = _every_nth(found, chosen.per_type)
    if chosen.limit is not None:
        by_type = _limit(by_type, chosen, chosen.limit)
    if chosen.min_gap_s is not None:
        by_type = {kind: _apart(found, chosen.min_gap_s) for kind, found in by_type.items()}
    return [entry for found in by_type.values() for entry in found]


def _refuse_draw(chosen: ScenarioFilter, key: str, wanted: int, count: int) -> None:
    if chosen.shuffle and wanted < count:
        raise ConfigError(
            f"{chosen.source}: {key} with shuffle: true: nuPlan draws {wanted} of {count} scenarios"
            " at random, and differently in every setting of its own",
            hint="set shuffle: false, or list the scenarios in scenario_tokens",
        )


def _every_nth(entries: list[ScenarioEntry], count: int) -> list[ScenarioEntry]:
    return entries[:: max(len(entries) // count, 1)][:count]


def _limit(
    by_type: dict[str, list[ScenarioEntry]], chosen: ScenarioFilter, limit: float
) -> dict[str, list[ScenarioEntry]]:
    """So many in all, or a share of all; those without a tag go first."""
    total = sum(map(len, by_type.values()))
    is_share = isinstance(limit, float)
    wanted = math.ceil(limit * total) if is_share else int(limit)
    if wanted >= total and not is_share:
        return by_type
    if total == 0:
        return {}
    untagged = by_type.get(UNTAGGED, [])
    if total - wanted < len(untagged):
        num_left = len(untagged) - (total - wanted)
        _refuse_draw(chosen, "limit_total_scenarios", num_left, len(untagged))
        return by_type | {UNTAGGED: _every_nth(untagged, num_left)}
    tagged = [e for kind, found in by_type.items() if kind != UNTAGGED for e in found]
    _refuse_draw(chosen, "limit_total_scenarios", wanted, len(tagged))
    out: dict[str, list[ScenarioEntry]] = {}
    for entry in _every_nth(sorted(tagged, key=lambda entry: entry.token), wanted):
        out.setdefault(entry.scenario_type, []).append(entry)
    return out


def _apart(entries: list[ScenarioEntry], gap_s: float) -> list[ScenarioEntry]:
    """Those of one type that follow the last one kept by a number of seconds, over all logs."""
    out: list[ScenarioEntry] = []
    for entry in sorted(entries, key=lambda entry: entry.time_us):
        if not out or entry.time_us * 1e-6 >= out[-1].time_us * 1e-6 + gap_s:
            out.append(entry)
    return out


def is_taken(
    log: Log, window: Window, road: Callable[[], VectorMap], chosen: ScenarioFilter
) -> bool:
    """Whether a filter takes one scenario of a log, by how its ego drives and where."""
    return all(is_good for _, is_good in judgements(log, window, road, chosen))


def judgements(
    log: Log, window: Window, road: Callable[[], VectorMap], chosen: ScenarioFilter
) -> Iterator[tuple[str, bool]]:
    """Fields of a filter that judge scenarios one by one, and whether each takes this one."""
    start, stop, noise = chosen.start_speed, chosen.stop_speed, chosen.speed_noise
    if (chosen.min_way, start, stop) != (None, None, None):
        states = _future(log, window)
        speeds = np.hypot(states[:, VX], states[:, VY])
    if chosen.min_way is not None:
        steps = np.diff(center_poses(states[1:, :3])[:, :2], axis=0)
        yield "min_way", not np.sum(np.linalg.norm(steps, axis=1)) < chosen.min_way
    if start is not None:
        yield "start_speed", _crosses(speeds, start, noise)[0]
    if stop is not None:
        yield "stop_speed", _crosses(speeds, stop, noise)[1]
    if chosen.min_share is not None:
        yield "min_share", _is_among(log, window, chosen.token_set, chosen.min_share)
    if chosen.route_radius is not None:
        yield "route_radius", _has_route(log, window, road(), chosen.route_radius)


def _future(log: Log, window: Window) -> FloatArray:
    """(K, 11) states of the ego at iteration 0, and as nuPlan samples the scenario behind it."""
    rows, times = window.iteration_rows, log.time_us[window.iteration_rows]
    # nuPlan rule 602
    duration = int((float(times[-1]) * 1e-6 - float(times[0]) * 1e-6) * 1e6) / 1e6
    count = int(duration / (ROW_SECONDS / window.mapping[2]))
    step = (int(duration / ROW_SECONDS) + 1) // count
    first = int(np.searchsorted(log.time_us, times[0]))  # nuPlan rule 431
    sampled = first + step * np.arange(1, count + 1)
    sampled = sampled[sampled < len(log.time_us)]
    start = int(rows[0])
    low, high = min(first, start), max(start, int(sampled[-1])) + 1
    return read_ego(log, low, high)[np.concatenate([[start], sampled]) - low]


def _crosses(speeds: FloatArray, threshold: float, noise: float) -> tuple[bool, bool]:
    """Whether speeds (K,) rise above a threshold, and fall to it, by more than a noise [m/s].

    nuPlan rule 433: from the lowest speed since the last fall, and the highest since the last rise.
    """
    highest = lowest = float(speeds[0])
    rises = falls = False
    for speed in speeds[1:].tolist():
        if speed > highest:
            highest = speed
            if highest > threshold >= lowest and highest - lowest > noise:
                rises, lowest = True, highest
        if speed < lowest:
            lowest = speed
            if highest > threshold >= lowest and highest - lowest > noise:
                falls, highest = True, lowest
    return rises, falls


def _is_among(log: Log, window: Window, tokens: frozenset[str] | None, share: float) -> bool:
    """Whether enough rows of the iterations are in a set, if it is given."""
    own = {log.tokens[row] for row in window.iteration_rows.tolist()}
    if tokens is None or share == 1.0:  # nuPlan rule 434
        return tokens is None or own == tokens
    return len(own & tokens) / len(own) > share


def _has_route(log: Log, window: Window, road: VectorMap, radius: float) -> bool:
    """Whether a lane or connector of the route has three vertices in a row near the ego."""
    start = int(window.iteration_rows[0])
    x, y = read_ego(log, start, start + 1)[0, :2].tolist()
    for edge in road.edges.within_box(x, y, radius).tolist():
        block = int(road.block_of[edge])
        line = road.baselines.at(edge)
        near = np.flatnonzero((line[:, 0] - x) ** 2 + (line[:, 1] - y) ** 2 <= radius**2)
        # nuPlan rule 435: vertices between the first and the last one near count, too
        enough = len(near) and near[-1] - near[0] >= 2
        if enough and block >= 0 and road.blocks.ids[block] in window.route:
            return True
    return False
