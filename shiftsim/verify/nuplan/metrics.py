"""Metrics of the nuplan folder: recorded rollouts, scored by us and by the official stack."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import DataError, ShiftsimError
from shiftsim.metrics import Measurements, MetricResult, judge, measure
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.report import Report
from shiftsim.verify.tables import RUN_KEY, Group, read_groups
from shiftsim.world import state
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, Tracks, TrafficLights

TOLERANCE = 1e-9
_CONTINUOUS = {"ego_progress_along_expert_route", "speed_limit_compliance", "score"}  # scores
CENTER_TOLERANCE = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
PROFILES = {"default": "nuplan", "deepplan": "deepplan"}
_STATE = {
    "x": state.X,
    "y": state.Y,
    "heading": state.HEADING,
    "vx": state.VX,
    "vy": state.VY,
    "ax": state.AX,
    "ay": state.AY,
    "tire_steering_angle": state.STEERING,
    "tire_steering_rate": state.STEERING_RATE,
    "angular_velocity": state.YAW_RATE,
    "angular_acceleration": state.YAW_ACCEL,
}
_CENTER = ("center_x", "center_y", "center_heading")
_OBJECT = ("track_token", "type", "x", "y", "heading", "length", "width", "height", "vx", "vy")
_CORNERS = ("front_left", "rear_left", "rear_right", "front_right")
_PROFILE_KEY = (*RUN_KEY, "thresholds")
_COLUMNS = {
    "ego": (*RUN_KEY, "iteration", "time_us", *_STATE, *_CENTER),
    "objects": (*RUN_KEY, "iteration", *_OBJECT),
    "route": (*RUN_KEY, "iteration", "center", *_CORNERS, "in_common_or_connected"),
    "collisions": (
        *RUN_KEY,
        "time_us",
        "track_token",
        "type",
        "collision_type",
        "delta_v",
        "at_fault",
        "timestamp_has_at_fault",
    ),
    "metrics": (*_PROFILE_KEY, "metric", "category", "score", "unit"),
    "statistics": (*_PROFILE_KEY, "metric", "statistic", "unit", "type", "value"),
    "time_series": (*RUN_KEY, "metric", "unit", "index", "time_us", "value"),
}
_SCORE_LABELS = (*_PROFILE_KEY, "scenario", "scenario_type")
# how the devkit files each metric: category, unit of its score
_FILED = {
    "ego_lane_change": ("Planning", None),
    "ego_jerk": ("Dynamics", None),
    "ego_lat_acceleration": ("Dynamics", None),
    "ego_lon_acceleration": ("Dynamics", None),
    "ego_lon_jerk": ("Dynamics", None),
    "ego_yaw_acceleration": ("Dynamics", None),
    "ego_yaw_rate": ("Dynamics", None),
    "ego_progress_along_expert_route": ("Planning", None),
    "drivable_area_compliance": ("Planning", "bool"),
    "corners_in_drivable_area": ("Planning", None),
    "no_ego_at_fault_collisions": ("Dynamics", "float"),
    "time_to_collision_within_bound": ("Planning", "bool"),
    "speed_limit_compliance": ("Violations", "float"),
    "ego_is_comfortable": ("Violations", "bool"),
    "ego_is_making_progress": ("Planning", "bool"),
    "driving_direction_compliance": ("Planning", "bool"),
}


@dataclass(frozen=True)
class _Tables:
    """The tables that metrics are compared with, as groups by run (and threshold set)."""

    objects: dict[tuple[str, ...], Group]
    route: dict[tuple[str, ...], Group]
    collisions: dict[tuple[str, ...], Group]
    metrics: dict[tuple[str, ...], Group]
    statistics: dict[tuple[str, ...], Group]
    time_series: dict[tuple[str, ...], Group]
    scores: dict[tuple[str, ...], Group]


def verify_nuplan_metrics(
    folder: Path,
    report: Report,
    maps: dict[str, VectorMap],
    mode: str | None = None,
    *,
    loops: Path | None = None,
) -> None:
    """Score the recorded rollout of every run of `expected/ego.parquet`.

    Args:
        folder: The nuplan folder.
        report: Filled with the comparisons.
        maps: Maps by name.
        mode: Only runs of this challenge (`NR`, `R`, `PT`).
        loops: Folder with the tables of other runs in the same scenes, instead of `expected`.
    """
    expected = folder / "expected"
    scenes = {scene["scene"]: scene for scene in json.loads((folder / "scenes.json").read_text())}
    runs = read_groups((loops or expected) / "ego.parquet")
    experts = read_groups(expected / "log_ego.parquet", ("scene", "kind"))
    tables = _read_tables(loops or expected)
    if loops is not None:
        logged = read_groups(expected / "objects.parquet")
        tables.objects.update({key: rows for key, rows in logged.items() if key[1:] == ("NR", "*")})
    _name_unknown(tables, runs, mode, report)
    report.note("objects height: no metric reads it")
    for run, rows in runs.items():
        if mode not in (None, run[1]):
            continue
        where = " ".join(run)
        try:
            _require(rows, _COLUMNS["ego"])
            log = _rollout(run, rows, experts[run[0], "iteration"], tables)
            road = maps[scenes[run[0]]["map"]]
            measured = measure(log, road)
            _verify_run(where, run, log, road, measured, rows, tables, report)
            for thresholds, profile in PROFILES.items():
                key = (*run, thresholds)
                _verify_profile(key, judge(measured, profile), scenes[run[0]], tables, report)
        except (ShiftsimError, KeyError, ValueError, TypeError, IndexError) as error:
            report.fail("recorded rollout", where, f"{type(error).__name__}: {error}")


def _read_tables(expected: Path) -> _Tables:
    def table(name: str, key: tuple[str, ...] = RUN_KEY) -> dict[tuple[str, ...], Group]:
        return read_groups(expected / f"{name}.parquet", key)

    return _Tables(
        table("objects"),
        table("route"),
        table("collisions"),
        table("metrics", _PROFILE_KEY),
        table("statistics", _PROFILE_KEY),
        table("time_series"),
        table("scores", _PROFILE_KEY),
    )


def _name_unknown(
    tables: _Tables, runs: dict[tuple[str, ...], Group], mode: str | None, report: Report
) -> None:
    """Name columns, runs and threshold sets that nothing compares."""
    for name, known in _COLUMNS.items():
        groups = runs if name == "ego" else getattr(tables, name)
        for column in {c for group in groups.values() for c in group} - set(known):
            report.skip(f"{name}.parquet: column {column!r}")
    for name in ("route", "collisions", "metrics", "statistics", "time_series", "scores"):
        for key in getattr(tables, name):
            if mode not in (None, key[1]):
                continue
            known_set = len(key) == len(RUN_KEY) or key[3] in PROFILES
            if key[: len(RUN_KEY)] not in runs or not known_set:
                report.skip(f"{name}.parquet: rows of {' '.join(key)}")
    for key in tables.objects:
        if mode in (None, key[1]) and key not in runs and key[1:] != ("NR", "*"):
            report.skip(f"objects.parquet: rows of {' '.join(key)}")


def _rollout(run: tuple[str, ...], rows: Group, expert: Group, tables: _Tables) -> SimulationLog:
    scene, challenge, _ = run
    key = run if challenge == "R" else (scene, "NR", "*")
    objects = tables.objects.get(key)
    count = len(rows["time_us"])
    return SimulationLog(
        token=scene,
        time_us=rows["time_us"].astype(np.int64),
        ego=_states(rows),
        tracks=Tracks.empty(count) if objects is None else _tracks(objects, count),
        traffic_lights=TrafficLights.empty(count),
        expert_time_us=expert["time_us"].astype(np.int64),
        expert_ego=_states(expert),
        route=(),
        commands=np.full((count, 2), np.nan),
        noise=np.zeros((count, 2)),
        plans=np.full((count, 11, 3), np.nan),
        planning_seconds=np.zeros(count),
        degraded=np.zeros(count, np.bool_),
    )


def _states(rows: Group) -> FloatArray:
    out = np.zeros((len(rows["x"]), state.NUM_STATE))
    for column, index in _STATE.items():
        out[:, index] = rows[column]
    return out


def _tracks(rows: Group, count: int) -> Tracks:
    _require(rows, _COLUMNS["objects"])
    tokens: dict[str, int] = {}
    columns = np.array([tokens.setdefault(t, len(tokens)) for t in rows["track_token"].tolist()])
    iterations = rows["iteration"].astype(np.int64)
    if iterations.min() < 0 or iterations.max() >= count:
        raise DataError(f"objects at iteration {iterations.max()}, ego at {count} iterations")
    kinds = np.full(len(tokens), -1, np.int64)
    for column, name in zip(columns.tolist(), rows["type"].tolist(), strict=True):
        kind = AgentKind[name]
        if kinds[column] not in (-1, kind):
            raise DataError(f"object {rows['track_token'][column]!r} changes its type")
        kinds[column] = kind
    shape = (count, len(tokens))
    tracks = Tracks(
        valid=np.zeros(shape, np.bool_),
        poses=np.full((*shape, 3), np.nan),
        velocities=np.full((*shape, 2), np.nan),
        sizes=np.full((*shape, 2), np.nan),
        kinds=kinds,
        tokens=tuple(tokens),
    )
    if len(np.unique(iterations * len(tokens) + columns)) != len(iterations):
        raise DataError("an object occurs twice at one iteration")
    tracks.valid[iterations, columns] = True
    for array, names in (
        (tracks.poses, ("x", "y", "heading")),
        (tracks.velocities, ("vx", "vy")),
        (tracks.sizes, ("length", "width")),
    ):
        for index, name in enumerate(names):
            array[iterations, columns, index] = rows[name]
    return tracks


def _verify_run(
    where: str,
    run: tuple[str, ...],
    log: SimulationLog,
    road: VectorMap,
    measured: Measurements,
    rows: Group,
    tables: _Tables,
    report: Report,
) -> None:
    """Compare what no threshold enters: the recorded ego itself, routes and collisions."""
    count = len(log.time_us)
    report.compare("recorded iterations", where, np.arange(count), rows["iteration"])
    report.compare("recorded time stamps", where, log.time_us, log.expert_time_us[:count])
    report.compare("recorded samples", where, count, len(log.expert_time_us) - 1)
    for index, (column, values) in enumerate(
        zip(_CENTER, state.center_poses(log.ego[:, :3]).T, strict=True)
    ):
        atol = TOLERANCE if index == 2 else CENTER_TOLERANCE
        report.compare(f"recorded {column}", where, values, rows[column], atol=atol)
    route = tables.route[run]
    _require(route, _COLUMNS["route"])
    samples = range(count)
    report.compare("route iteration", where, np.arange(count), route["iteration"])
    ours = [",".join(measured.route.ids(road, i)) for i in samples]
    report.compare("route center", where, ours, route["center"].tolist())
    for corner, column in enumerate(_CORNERS):
        ours = [",".join(measured.corners.ids(road, i, corner)) for i in samples]
        report.compare(f"route {column}", where, ours, route[column].tolist())
    column = "in_common_or_connected"
    report.compare(f"route {column}", where, measured.is_common, route[column].astype(np.bool_))
    _verify_collisions(where, measured, tables.collisions.get(run), report)


def _verify_collisions(
    where: str, measured: Measurements, rows: Group | None, report: Report
) -> None:
    ours = measured.collisions
    report.compare("collisions", where, len(ours), 0 if rows is None else len(rows["time_us"]))
    if rows is None or len(rows["time_us"]) != len(ours):
        return
    _require(rows, _COLUMNS["collisions"])
    columns: dict[str, list[Any]] = {
        "time_us": [c.time_us for c in ours],
        "track_token": [c.token for c in ours],
        "type": [AgentKind(c.kind).name for c in ours],
        "collision_type": [f"{c.collision_type.upper()}_COLLISION" for c in ours],
        "delta_v": [c.delta_v for c in ours],
        "at_fault": [c.at_fault for c in ours],
        "timestamp_has_at_fault": [c.time_us in measured.at_fault_times for c in ours],
    }
    for name, values in columns.items():
        theirs = rows[name].astype(np.bool_) if isinstance(values[0], bool) else rows[name].tolist()
        report.compare(f"collisions {name}", where, values, theirs, atol=TOLERANCE)


def _verify_profile(
    key: tuple[str, ...],
    result: MetricResult,
    scene: dict[str, Any],
    tables: _Tables,
    report: Report,
) -> None:
    """Compare scores, statistics and series under one threshold set."""
    where = " ".join(key)
    _verify_metrics(where, result, tables.metrics[key], report)
    _verify_statistics(where, result, tables.statistics[key], report)
    _verify_scores(where, result, scene, tables.scores[key], report)
    if key[3] == "default":
        _verify_series(where, result, tables.time_series[key[:3]], report)


def _verify_metrics(where: str, result: MetricResult, rows: Group, report: Report) -> None:
    _require(rows, _COLUMNS["metrics"])
    report.compare("metrics metric", where, list(result.scores), rows["metric"].tolist())
    for metric, category, score, unit in _records(rows, ("metric", "category", "score", "unit")):
        at = f"{where} {metric}"
        if metric not in result.scores:
            continue  # named by the comparison above
        ours = result.scores[metric]
        value = np.nan if ours is None else ours
        atol = _atol(metric not in _CONTINUOUS)
        report.compare(f"metrics {metric}", at, value, _number(score), atol=atol)
        filed = [_text(item) for item in _FILED[metric]]
        report.compare("metrics category, unit", at, filed, [_text(category), _text(unit)])


def _verify_statistics(where: str, result: MetricResult, rows: Group, report: Report) -> None:
    _require(rows, _COLUMNS["statistics"])
    ours = {(s.metric, s.name): s for s in result.statistics}
    names = list(zip(rows["metric"].tolist(), rows["statistic"].tolist(), strict=True))
    listed = [" ".join(name) for name in sorted(ours)]
    report.compare("statistics present", where, listed, sorted(" ".join(name) for name in names))
    for metric, name, unit, kind, value in _records(
        rows, ("metric", "statistic", "unit", "type", "value")
    ):
        found = ours.get((metric, name))
        if found is None:
            continue  # named by the comparison above
        at = f"{where} {metric}"
        atol = _atol(found.unit in ("boolean", "count"))
        report.compare(f"statistics {name}", at, found.value, _number(value), atol=atol)
        labels = [_text(unit), _text(kind)]
        report.compare("statistics unit, type", f"{at} {name}", [found.unit, found.kind], labels)


def _verify_series(where: str, result: MetricResult, rows: Group, report: Report) -> None:
    _require(rows, _COLUMNS["time_series"])
    metrics = rows["metric"].astype(str)
    report.compare("series present", where, sorted(result.series), sorted(set(metrics.tolist())))
    times = result.measurements.time_us
    for metric, ours in result.series.items():
        at = f"{where} {metric}"
        chosen = np.flatnonzero(metrics == metric)
        units = sorted({_text(unit) for unit in rows["unit"][chosen].tolist()})
        report.compare("series unit", at, [ours.unit], units)
        report.compare("series index", at, np.arange(len(times)), rows["index"][chosen])
        report.compare("series time", at, times, rows["time_us"][chosen])
        values = rows["value"][chosen].astype(np.float64)
        atol = _atol(ours.unit == "boolean")
        report.compare(f"series {metric}", at, ours.values, values, atol=atol)


def _verify_scores(
    where: str, result: MetricResult, scene: dict[str, Any], rows: Group, report: Report
) -> None:
    report.compare("scores rows", where, 1, len(rows["score"]))
    labels = [_text(rows[name][0]) for name in ("scenario", "scenario_type")]
    report.compare("scores scenario", where, [scene["token"], scene["scenario_type"]], labels)
    ours = {**result.scores, "score": result.score}
    columns = set(rows) - set(_SCORE_LABELS)
    for name in sorted(columns - set(ours)):
        report.skip(f"scores.parquet: column {name!r}")
    for name, score in ours.items():
        value = np.nan if score is None else score
        atol = _atol(name not in _CONTINUOUS)
        report.compare(f"scores {name}", where, value, _number(rows[name][0]), atol=atol)


def _records(rows: Group, names: tuple[str, ...]) -> Iterator[tuple[Any, ...]]:
    return zip(*(rows[name].tolist() for name in names), strict=True)


def _atol(is_discrete: bool) -> float:
    return 0.0 if is_discrete else TOLERANCE


def _number(value: object) -> float:
    return np.nan if value is None else float(value)  # type: ignore[arg-type]  # any number


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _require(rows: Group, columns: tuple[str, ...]) -> None:
    for name in columns:
        if name not in rows:
            raise DataError(f"column {name!r} is missing")
