"""Which of the scenarios that logs offer a filter of nuPlan takes, in nuPlan's order of steps.

First lists are thinned out, of all logs at once; then every scenario is judged by itself.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from shiftsim.data.nuplan.filter import ScenarioFilter
from shiftsim.data.nuplan.log import UNTAGGED, Log, read_ego
from shiftsim.data.nuplan.scenarios import ROW_SECONDS, ScenarioEntry
from shiftsim.data.recording import Window
from shiftsim.errors import ConfigError
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.state import VX, VY, center_poses


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
