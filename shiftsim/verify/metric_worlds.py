"""Worlds in plain JSON, scored by the official metric classes: the metrics without any importer."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.metrics import DEEPPLAN, NUPLAN, Measurements, MetricResult, judge, measure
from shiftsim.metrics.collision import at_fault_counts
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, within_bounds
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.files import COMPARED, Source, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.verify.worlds import ego_states, read_map, read_scenario, recorded_log
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
    ego, expert = (
        ego_states(dict(zip(world["state_columns"], np.transpose(world[name]), strict=True)))
        for name in ("ego", "expert")
    )
    return recorded_log(read_scenario(world, road, expert), ego), road


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
    series, found = expected.each("series")[0], found_along(measured, road)
    names = {
        **{"result": result, "counts": at_fault_counts(measured.collisions)},
        "inside": ~measured.drivable.outside.any(axis=1),
        "ttc": np.where(np.isinf(measured.ttc.values), np.nan, measured.ttc.values),
        "flags": within_bounds(measured.comfort, NUPLAN),
        "deepplan": within_bounds(measured.comfort, DEEPPLAN),
        "statistics": {one.name: one.value for one in result.statistics},
    }
    TABLES["series"].match(series, where, **found, **names)
    TABLES["progress"].match(series.each("progress_statistics")[0], where, **names)
    contacts = series.each("collisions")
    report.compare("number of collisions", where, len(found["types"]), len(contacts))
    ours = zip(measured.collisions, found["types"], contacts, strict=False)
    for contact, kind, theirs in ours:
        TABLES["collisions"].match(theirs, f"{where} {contact.token}", contact=contact, kind=kind)


def known_scores(result: MetricResult) -> dict[str, float]:
    """Scores by metric, and the whole `score`; without those that have no value."""
    scores = {**result.scores, "score": result.score}
    return {name: score for name, score in scores.items() if score is not None}


def found_along(measured: Measurements, road: VectorMap) -> dict[str, Any]:
    """What tables say of the way of a rollout: roadblocks at every sample, and collisions."""
    samples, corners = range(len(measured.time_us)), measured.corners
    return {
        "measured": measured,
        "route": [measured.route.ids(road, i) for i in samples],
        "corners": [[corners.ids(road, i, corner) for corner in range(4)] for i in samples],
        "types": [f"{one.collision_type.upper()}_COLLISION" for one in measured.collisions],
    }
