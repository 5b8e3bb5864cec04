"""Metrics of the nuplan folder: recorded rollouts, scored by us and by the official stack."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from shiftsim.errors import DataError
from shiftsim.metrics import MetricResult, judge, measure
from shiftsim.sim.log import SimulationLog
from shiftsim.verify import worlds
from shiftsim.verify.files import COMPARED, EXACT, Groups, Source, open_tables
from shiftsim.verify.metric_worlds import SCORE_TOLERANCES, found_along
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import read_tables
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, Tracks

TABLES = read_tables(__file__)
PROFILES = {"default": "nuplan", "deepplan": "deepplan"}
# how the devkit files each metric, and the units of scores that have one
RECORDED, CATEGORIES, UNITS = (COMPARED[what] for what in ("recorded", "category", "unit"))
RUN_TABLES = "ego objects route collisions scores metrics statistics time_series".split()


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
    tables = open_tables(expected, report, *RUN_TABLES)
    replayed = open_tables(logged, report, "objects")["objects"] if logged else tables["objects"]
    experts = open_tables(logged or expected, report, "log_ego")["log_ego"]
    tables["objects"].table.note("no metric reads it", "height")
    for run in tables["ego"].of_mode(mode):
        scene, challenge, _ = run
        with report.attempt("recorded rollout", " ".join(run)):
            entry, road = scenes.entries[scene], scenes.maps[scenes.entries[scene]["map"]]
            seen = tables["objects"][run] if challenge == "R" else replayed[scene, "NR", "*"]
            log = _rollout(tables["ego"][run], experts[scene, "iteration"], seen, road)
            times = log.expert_time_us[: len(log.ego)]
            columns = {"iteration": np.arange(len(times)), "time_us": times}
            columns |= {name: worlds.ego_columns(log.ego)[name] for name in RECORDED}
            tables["ego"].match(run, columns, RECORDED, quantity="recorded")
            measured = measure(log, road)
            contacts, names = measured.collisions, found_along(measured, road)
            names["samples"] = np.arange(len(measured.time_us))
            names["kinds"] = [AgentKind(one.kind).name for one in contacts]
            names["is_time"] = [one.time_us in measured.at_fault_times for one in contacts]
            for name, rows in TABLES.items():
                rows.match(tables[name][run], " ".join(run), **names)
            for thresholds, profile in PROFILES.items():
                result = judge(measured, profile)
                _compare_profile((*run, thresholds), result, entry, tables)
                if profile == "nuplan":
                    _compare_series(run, result, tables["time_series"])
    for table in tables.values():
        table.finish(mode)


def _rollout(rows: Source, expert: Source, objects: Source, road: VectorMap) -> SimulationLog:
    ego, logged = (
        worlds.ego_states({n: part[n] for n in worlds.EGO_COLUMNS}) for part in (rows, expert)
    )
    times, tracks = expert["time_us"].astype(np.int64), tracks_of(objects, len(ego))
    scenario = worlds.make_scenario("recorded", road, times, logged, tracks)
    return replace(worlds.recorded_log(scenario, ego), time_us=rows["time_us"].astype(np.int64))


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


def _compare_profile(
    key: tuple[str, ...], result: MetricResult, entry: Source, tables: dict[str, Groups]
) -> None:
    """Compare scores and statistics under one threshold set."""
    scores = {name: np.nan if s is None else s for name, s in result.scores.items()}
    row = {"scenario": entry["token"], "scenario_type": entry["scenario_type"], **scores}
    row |= {"score": result.score}
    tables["scores"].match(key, {name: [value] for name, value in row.items()})
    tables["metrics"].match_keys(key, [(name,) for name in scores])
    for name, score in scores.items():
        filed = {"category": [CATEGORIES.get(name, "Planning")], "unit": [UNITS.get(name)]}
        atol = {"score": SCORE_TOLERANCES.get(name, EXACT)}
        tables["metrics"].match((*key, name), {**filed, "score": [score]}, atol)
    found = result.statistics
    tables["statistics"].match_keys(key, [(s.metric, s.name) for s in found])
    for s in found:
        ours = {"unit": [s.unit or None], "type": [s.kind or None], "value": [s.value]}
        is_exact = s.unit in ("boolean", "count")
        tables["statistics"].match((*key, s.metric, s.name), ours, EXACT if is_exact else None)


def _compare_series(run: tuple[str, ...], result: MetricResult, table: Groups) -> None:
    times = result.measurements.time_us
    table.match_keys(run, [(metric,) for metric in result.series])
    for metric, series in result.series.items():
        columns = {"unit": [series.unit or None] * len(times), "index": np.arange(len(times))}
        columns |= {"time_us": times, "value": series.values}
        atol = EXACT if series.unit == "boolean" else None
        table.match((*run, metric), columns, atol, quantity="series")
