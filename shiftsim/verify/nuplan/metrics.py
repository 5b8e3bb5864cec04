"""Metrics of the nuplan folder: recorded rollouts, scored by us and by the official stack."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.metrics import Measurements, MetricResult, judge, measure
from shiftsim.verify import worlds
from shiftsim.verify.files import EXACT, RUN_KEY, TOLERANCE, Groups, Source
from shiftsim.verify.metric_worlds import SCORE_TOLERANCES
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, Tracks

PROFILES = {"default": "nuplan", "deepplan": "deepplan"}
PROFILE_KEY = (*RUN_KEY, "thresholds")
_TABLES = {
    **dict.fromkeys(("objects", "route", "collisions"), RUN_KEY),
    "scores": PROFILE_KEY,
    "metrics": (*PROFILE_KEY, "metric"),
    "statistics": (*PROFILE_KEY, "metric", "statistic"),
    "time_series": (*RUN_KEY, "metric"),
}
# coordinates near 4e6 are spaced 5e-10
RECORDED = {"center_x": 2e-9, "center_y": 2e-9, "center_heading": TOLERANCE}
_CORNERS = ("front_left", "rear_left", "rear_right", "front_right")
# how the devkit files each metric: the category of those that are not of Planning, and the units
# of scores that have one
CATEGORIES = {
    **dict.fromkeys(("speed_limit_compliance", "ego_is_comfortable"), "Violations"),
    **dict.fromkeys(("ego_jerk", "ego_lon_jerk", "ego_yaw_acceleration"), "Dynamics"),
    **dict.fromkeys(("ego_lat_acceleration", "ego_lon_acceleration"), "Dynamics"),
    **dict.fromkeys(("ego_yaw_rate", "no_ego_at_fault_collisions"), "Dynamics"),
}
UNITS = {
    **dict.fromkeys(("no_ego_at_fault_collisions", "speed_limit_compliance"), "float"),
    **dict.fromkeys(("drivable_area_compliance", "time_to_collision_within_bound"), "bool"),
    **dict.fromkeys(("ego_is_comfortable", "ego_is_making_progress"), "bool"),
    "driving_direction_compliance": "bool",
}


def verify_nuplan_metrics(
    expected: Path,
    report: Report,
    scenes: Scenes,
    mode: str | None = None,
    *,
    logged: Path | None = None,
) -> None:
    """Score the recorded rollout of every run of `ego.parquet` (of one mode).

    `expected` holds the tables of the runs, and where there is no `logged` those of the logs.
    """
    runs = Groups(expected / "ego.parquet", report)
    tables = {n: Groups(expected / f"{n}.parquet", report, key) for n, key in _TABLES.items()}
    replayed = Groups(logged / "objects.parquet", report) if logged else tables["objects"]
    experts = Groups((logged or expected) / "log_ego.parquet", report, ("scene", "kind"))
    tables["objects"].table.note("no metric reads it", "height")
    for run in runs:
        if mode not in (None, run[1]):
            continue
        with report.attempt("recorded rollout", " ".join(run)):
            entry, objects = scenes.entries[run[0]], replayed[run[0], "NR", "*"]
            if run[1] == "R":
                objects = tables["objects"][run]
            road = scenes.maps[entry["map"]]
            measured = _measure(run, runs[run], objects, experts[run[0], "iteration"], road)
            _compare_run(run, measured, road, tables)
            for thresholds, profile in PROFILES.items():
                result = judge(measured, profile)
                _compare_profile((*run, thresholds), result, entry, tables)
                if profile == "nuplan":
                    _compare_series(run, result, tables["time_series"])
    for table in (runs, *tables.values()):
        table.finish(mode)


def _measure(
    run: tuple[str, ...], rows: Source, objects: Source, expert: Source, road: VectorMap
) -> Measurements:
    """Compare what the tables say of the ego itself, and measure the rollout."""
    ego, logged = (
        worlds.ego_states({n: part[n] for n in worlds.EGO_COLUMNS}) for part in (rows, expert)
    )
    times, tracks = expert["time_us"].astype(np.int64), tracks_of(objects, len(ego))
    scenario = worlds.make_scenario(run[0], road, times, logged, tracks)
    log = replace(worlds.recorded_log(scenario, ego), time_us=rows["time_us"].astype(np.int64))
    columns, count = worlds.ego_columns(ego), len(logged) - 1
    ours = {"iteration": np.arange(count), "time_us": times[:count]}
    ours |= {name: columns[name] for name in RECORDED}
    rows.match(" ".join(run), ours, RECORDED, quantity="recorded")
    return measure(log, road)


def tracks_of(rows: Source, count: int) -> Tracks:
    """Dense tracks over `count` iterations from rows of `objects.parquet`."""
    names, iteration = rows["track_token"].tolist(), rows["iteration"].astype(np.int64)
    kinds = dict(zip(names, rows["type"].tolist(), strict=True))
    column = {token: index for index, token in enumerate(kinds)}
    track = [column[token] for token in names]
    if not ((iteration >= 0) & (iteration < count)).all():
        raise DataError(f"objects at iterations which the ego does not have, of {count}")
    if len({*zip(iteration.tolist(), track, strict=True)}) != len(track):
        raise DataError("an object occurs twice at one iteration")
    if [kinds[token] for token in names] != rows["type"].tolist():
        raise DataError("an object changes its type")
    values = np.column_stack([rows[name].astype(np.float64) for name in worlds.BOX_COLUMNS])
    where = iteration, np.array(track, np.int64)
    return worlds.make_tracks((count, len(kinds)), where, values, list(kinds.values()), list(kinds))


def _compare_run(
    run: tuple[str, ...], measured: Measurements, road: VectorMap, tables: dict[str, Groups]
) -> None:
    """Compare what no threshold enters: routes and collisions."""
    samples = range(len(measured.time_us))
    ours = {
        "iteration": np.arange(len(samples)),
        "center": [",".join(measured.route.ids(road, i)) for i in samples],
        "in_common_or_connected": measured.is_common,
    }
    for corner, column in enumerate(_CORNERS):
        ours[column] = [",".join(measured.corners.ids(road, i, corner)) for i in samples]
    tables["route"].match(run, ours)
    found = measured.collisions
    contacts = {
        "time_us": [c.time_us for c in found],
        "track_token": [c.token for c in found],
        "type": [AgentKind(c.kind).name for c in found],
        "collision_type": [f"{c.collision_type.upper()}_COLLISION" for c in found],
        "delta_v": [c.delta_v for c in found],
        "at_fault": [c.at_fault for c in found],
        "timestamp_has_at_fault": [c.time_us in measured.at_fault_times for c in found],
    }
    tables["collisions"].match(run, contacts, TOLERANCE)


def _compare_profile(
    key: tuple[str, ...], result: MetricResult, entry: dict[str, Any], tables: dict[str, Groups]
) -> None:
    """Compare scores and statistics under one threshold set."""
    scores = {name: np.nan if s is None else s for name, s in result.scores.items()}
    row = {"scenario": entry["token"], "scenario_type": entry["scenario_type"], **scores}
    row |= {"score": result.score}
    tables["scores"].match(key, {name: [value] for name, value in row.items()}, SCORE_TOLERANCES)
    tables["metrics"].match_keys(key, [(name,) for name in scores])
    for name, score in scores.items():
        filed = {"category": [CATEGORIES.get(name, "Planning")], "unit": [UNITS.get(name)]}
        atol = {"score": SCORE_TOLERANCES.get(name, EXACT)}
        tables["metrics"].match((*key, name), {**filed, "score": [score]}, atol)
    found = result.statistics
    tables["statistics"].match_keys(key, [(s.metric, s.name) for s in found])
    for s in found:
        filed = {"unit": [s.unit or None], "type": [s.kind or None]}
        atol = {"value": EXACT if s.unit in ("boolean", "count") else TOLERANCE}
        tables["statistics"].match((*key, s.metric, s.name), {**filed, "value": [s.value]}, atol)


def _compare_series(run: tuple[str, ...], result: MetricResult, table: Groups) -> None:
    times = result.measurements.time_us
    table.match_keys(run, [(metric,) for metric in result.series])
    for metric, ours in result.series.items():
        columns = {
            "unit": [ours.unit or None] * len(times),
            "index": np.arange(len(times)),
            "time_us": times,
            "value": ours.values,
        }
        atol = {"value": EXACT if ours.unit == "boolean" else TOLERANCE}
        table.match((*run, metric), columns, atol, quantity="series")
