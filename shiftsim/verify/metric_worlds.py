"""Worlds in plain JSON, scored by the official metric classes: the metrics without any importer."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.metrics import DEEPPLAN, NUPLAN, Measurements, MetricResult, judge, measure
from shiftsim.metrics.collision import at_fault_counts
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, within_bounds
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.files import COMPARED, Source, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.verify.worlds import ego_states, make_scenario, read_map, read_objects, recorded_log
from shiftsim.world.map import VectorMap

SCORE_TOLERANCES: dict[str, float] = COMPARED["scores.parquet"]["atol"]
TABLES = read_tables(__file__)


def verify_metric_worlds(folder: Path, report: Report) -> None:
    """Compare every world of the folder, under both threshold profiles."""
    verify_files(folder, report, {}, {"*.json": _compare})


def read_world(world: dict[str, Any]) -> tuple[SimulationLog, VectorMap]:
    """Rollout and map of one world."""
    return _read(Source("metric_world", "field", world, Report()))


def _read(world: Source) -> tuple[SimulationLog, VectorMap]:
    road = read_map(world.each("map")[0], "incoming")
    time_us = np.array(world["time_us"], np.int64)
    ego, expert = (
        ego_states(dict(zip(world["state_columns"], np.transpose(world[name]), strict=True)))
        for name in ("ego", "expert")
    )
    things = world.each("objects")
    if len(time_us) != len(expert) or any(len(o["frames"]) != len(time_us) for o in things):
        raise DataError(f"{len(time_us)} time stamps, other numbers of expert states or of frames")
    token = f"world {world.values.get('world')}"
    tracks = read_objects(things, len(time_us))
    return recorded_log(make_scenario(token, road, time_us, expert, tracks), ego), road


def _compare(world: Source, where: str) -> None:
    report, (log, road) = world.report, _read(world)
    world.note("label", "world", "kind")
    # a connector lies in a roadblock connector, a lane in a roadblock
    kinds = road.block_of >= road.num_roadblocks
    is_connector = np.arange(len(road.edges)) >= road.num_lanes
    report.compare("kind of edges and their roadblocks", where, kinds, is_connector)
    expected, measured = world.each("expected")[0], measure(log, road)
    for name, profile in (("deepplan", DEEPPLAN), ("default", NUPLAN)):
        scores, result = expected.each(f"scores_{name}")[0], judge(measured, profile)
        scores.match(f"{where} {name}", known_scores(result), SCORE_TOLERANCES, quantity="score")
    order = list(BOUNDED_SIGNALS.values())
    expected.match(where, {"comfort_flag_order": order}, quantity="")
    series = expected.each("series")[0]
    TABLES["series"].match(series, where, **_series(measured, result, road))
    statistics = {one.name: one.value for one in result.statistics}
    progress = series.each("progress_statistics")[0]
    TABLES["progress"].match(progress, where, found=statistics)
    contacts, found = series.each("collisions"), measured.collisions
    report.compare("number of collisions", where, len(found), len(contacts))
    for ours, theirs in zip(found, contacts, strict=False):
        kind = f"{ours.collision_type.upper()}_COLLISION"
        TABLES["collisions"].match(theirs, f"{where} {ours.token}", contact=ours, kind=kind)


def known_scores(result: MetricResult) -> dict[str, float]:
    """Scores by metric, and the whole `score`; without those that have no value."""
    scores = {**result.scores, "score": result.score}
    return {name: score for name, score in scores.items() if score is not None}


def _series(measured: Measurements, result: MetricResult, road: VectorMap) -> dict[str, Any]:
    """What `metric_worlds.toml` speaks of."""
    samples, corners, ttc = range(len(measured.time_us)), measured.corners, measured.ttc.values
    return {
        **{"measured": measured, "result": result},
        "route": [measured.route.ids(road, i) for i in samples],
        "corners": [[corners.ids(road, i, corner) for corner in range(4)] for i in samples],
        "common": measured.is_common.astype(np.int64),
        "inside": (~measured.drivable.outside.any(axis=1)).astype(np.int64),
        "at_fault": np.array(measured.at_fault_times, np.int64),
        "counts": at_fault_counts(measured.collisions),
        "ttc": np.where(np.isinf(ttc), np.nan, ttc),
        "flags": within_bounds(measured.comfort, NUPLAN),
        "deepplan": within_bounds(measured.comfort, DEEPPLAN),
    }
