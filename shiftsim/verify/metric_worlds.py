"""Worlds in plain JSON, scored by the official metric classes: the metrics without any importer."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.errors import DataError, ShiftsimError
from shiftsim.metrics import Measurements, MetricResult, judge, measure
from shiftsim.metrics.collision import at_fault_counts
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, within_bounds
from shiftsim.metrics.thresholds import DEEPPLAN, NUPLAN
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.report import Report
from shiftsim.world.map import AreaSpec, BlockSpec, EdgeSpec, VectorMap, build_map
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    NUM_STATE,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    AgentKind,
    Tracks,
    TrafficLights,
    X,
    Y,
)

TOLERANCE = 1e-9
_CONTINUOUS = {"ego_progress_along_expert_route", "speed_limit_compliance", "score"}  # scores
_COLUMNS = {
    "x": X,
    "y": Y,
    "heading": HEADING,
    "vx": VX,
    "vy": VY,
    "ax": AX,
    "ay": AY,
    "omega": YAW_RATE,
    "alpha": YAW_ACCEL,
}
_WORLD = {"map", "time_us", "expert", "ego", "state_columns", "objects", "expected"}
_LABELS = {"world", "kind"}
_EXPECTED = {"scores_default", "scores_deepplan", "series", "comfort_flag_order"}
_EDGE = {
    "id",
    "kind",
    "baseline",
    "polygon",
    "speed_limit",
    "incoming",
    "outgoing",
    "roadblock",
}


def verify_metric_worlds(folder: Path, report: Report) -> None:
    """Compare every world of the folder, under both threshold profiles.

    Args:
        folder: Folder with `metric_world_*.json`.
        report: Filled with the comparisons.
    """
    report.note("world, kind: labels of a world")
    for path in sorted(folder.iterdir()):
        if path.suffix != ".json" or not path.is_file():
            if path.name.startswith("README"):
                continue
            report.skip(f"{path.name}: not a world")
            continue
        try:
            world = json.loads(path.read_text())
            _verify_world(path.stem, world, report)
        except (
            ShiftsimError,
            KeyError,
            TypeError,
            ValueError,
            IndexError,
            AttributeError,
        ) as error:
            report.fail("world", path.stem, f"{type(error).__name__}: {error}")


def read_world(world: dict[str, Any]) -> tuple[SimulationLog, VectorMap]:
    """Rollout and map of one world."""
    road = _read_map(world["map"])
    time_us = np.array(world["time_us"], np.int64)
    expert = _states(world["expert"], world["state_columns"])
    ego = _states(world["ego"], world["state_columns"])
    if len(time_us) != len(expert) or not 0 < len(ego) <= len(time_us):
        raise DataError(f"{len(ego)} ego, {len(expert)} expert states, {len(time_us)} time stamps")
    count = len(ego)
    log = SimulationLog(
        token=f"world {world.get('world')}",
        time_us=time_us[:count],
        ego=ego,
        tracks=_tracks(world["objects"], count),
        traffic_lights=TrafficLights.empty(count),
        expert_time_us=time_us,
        expert_ego=expert,
        route=(),
        commands=np.full((count, 2), np.nan),
        noise=np.zeros((count, 2)),
        plans=np.full((count, 11, 3), np.nan),
        planning_seconds=np.zeros(count),
        degraded=np.zeros(count, np.bool_),
    )
    return log, road


def _states(rows: list[list[float]], columns: list[str]) -> FloatArray:
    out = np.zeros((len(rows), NUM_STATE))
    out[:, [_COLUMNS[name] for name in columns]] = np.array(rows, np.float64)
    return out


def _tracks(objects: list[dict[str, Any]], count: int) -> Tracks:
    frames = np.full((count, len(objects), 5), np.nan)
    for column, thing in enumerate(objects):
        for row, frame in enumerate(thing["frames"][:count]):
            if frame is not None:
                frames[row, column] = frame
    valid = ~np.isnan(frames[..., 0])
    sizes = np.array([[o["length"], o["width"]] for o in objects], np.float64).reshape(-1, 2)
    return Tracks(
        valid=valid,
        poses=np.ascontiguousarray(frames[..., :3]),
        velocities=np.ascontiguousarray(frames[..., 3:]),
        sizes=np.where(valid[..., None], sizes, np.nan),
        kinds=np.array([AgentKind[o["type"]] for o in objects], np.int64),
        tokens=tuple(o["token"] for o in objects),
    )


def _read_map(world: dict[str, Any]) -> VectorMap:
    edges = [
        EdgeSpec(
            id=edge["id"],
            is_connector=_is_connector(edge["kind"], "lane", "connector"),
            polygon=shapely.Polygon(edge["polygon"]),
            baseline=np.array(edge["baseline"], np.float64),
            block_id=edge["roadblock"],
            incoming=edge["incoming"],
            outgoing=edge["outgoing"],
            speed_limit=edge["speed_limit"],
        )
        for edge in world["edges"]
    ]
    blocks = [
        BlockSpec(
            id=name,
            is_connector=_is_connector(block["kind"], "roadblock", "roadblock_connector"),
            polygon=shapely.Polygon(block["polygon"]),
        )
        for name, block in world["roadblocks"].items()
    ]
    return build_map(
        "world",
        edges=edges,
        blocks=blocks,
        intersections=_areas(world["intersections"]),
        drivable_areas=_areas(world["drivable_area"]),
    )


def _areas(rings: list[list[list[float]]]) -> list[AreaSpec]:
    return [AreaSpec(str(index), shapely.Polygon(ring)) for index, ring in enumerate(rings)]


def _is_connector(kind: str, plain: str, connector: str) -> bool:
    if kind not in (plain, connector):
        raise DataError(f"kind {kind!r} is neither {plain!r} nor {connector!r}")
    return kind == connector


def _verify_world(where: str, world: dict[str, Any], report: Report) -> None:
    _name_unknown(where, "", world, _WORLD | _LABELS, report)
    _name_unknown(where, "expected.", world["expected"], _EXPECTED, report)
    for edge in world["map"]["edges"]:
        _name_unknown(where, "map.edges.", edge, _EDGE, report)
    report.compare("number of states", where, len(world["ego"]), len(world["expert"]) - 1)
    for thing in world["objects"]:
        report.compare("number of frames", where, len(thing["frames"]), len(world["expert"]))
    log, road = read_world(world)
    if road.flaws:
        report.fail("map", where, f"ids that name nothing: {road.flaws}")
    _check_kinds(where, road, report)
    measured = measure(log, road)
    expected = world["expected"]
    results = {"default": judge(measured, NUPLAN), "deepplan": judge(measured, DEEPPLAN)}
    for name, result in results.items():
        _verify_scores(f"{where} {name}", result, expected[f"scores_{name}"], report)
    order = list(expected["comfort_flag_order"])
    report.compare("comfort_flag_order", where, list(BOUNDED_SIGNALS.values()), order)
    ours = _series(measured, results["default"], road)
    for name in ours.keys() | expected["series"].keys():
        if name not in ours:
            report.skip(f"series {name!r}")
        elif name not in expected["series"]:
            report.fail(name, where, "missing from the file")
        else:
            _compare_tree(name, where, ours[name], expected["series"][name], report)


def _check_kinds(where: str, road: VectorMap, report: Report) -> None:
    """A connector lies in a roadblock connector, a lane in a roadblock."""
    kinds = [road.block_of[e] >= road.num_roadblocks for e in range(len(road.edges))]
    is_connector = [road.is_connector(e) for e in range(len(road.edges))]
    report.compare("kind of edges and their roadblocks", where, kinds, is_connector)


def _name_unknown(
    where: str, prefix: str, found: dict[str, Any], known: set[str], report: Report
) -> None:
    for name in found.keys() - known:
        report.skip(f"{where}: {prefix}{name}")


def _verify_scores(
    where: str, result: MetricResult, expected: dict[str, float], report: Report
) -> None:
    ours = {name: score for name, score in result.scores.items() if score is not None}
    ours["score"] = result.score
    for name in ours.keys() | expected.keys():
        if name not in expected:
            report.fail(f"score {name}", where, "missing from the file")
        elif name not in ours:
            report.skip(f"score {name!r}")
        else:
            atol = TOLERANCE if name in _CONTINUOUS else 0.0
            report.compare(f"score {name}", where, ours[name], expected[name], atol=atol)


def _series(measured: Measurements, result: MetricResult, road: VectorMap) -> dict[str, Any]:
    samples = range(len(measured.time_us))
    statistics = {s.name: s.value for s in result.statistics}
    progress = (
        "expert_total_progress_along_route",
        "ego_total_progress_along_route",
        "ego_expert_progress_along_route_ratio",
    )
    ttc = measured.ttc.values
    return {
        "driven_route": [measured.route.ids(road, i) for i in samples],
        "corner_routes": [
            [measured.corners.ids(road, i, corner) for corner in range(4)] for i in samples
        ],
        "common_or_connected": measured.is_common.astype(np.int64),
        "corners_in_drivable_area": (~measured.drivable.outside.any(axis=1)).astype(np.int64),
        "collisions": [
            {
                "time_us": c.time_us,
                "token": c.token,
                "type": f"{c.collision_type.upper()}_COLLISION",
                "ego_delta_v": c.delta_v,
            }
            for c in measured.collisions
        ],
        "at_fault_times": np.array(measured.at_fault_times, np.int64),
        "at_fault_counts": at_fault_counts(measured.collisions),
        "time_to_collision": [None if math.isinf(value) else value for value in ttc.tolist()],
        "overspeed": measured.overspeed,
        "progress_1s_along_lane": result.series["driving_direction_compliance"].values,
        "ego_progress": measured.progress.ego,
        "progress_statistics": {name: statistics[name] for name in progress if name in statistics},
        "comfort_flags": within_bounds(measured.comfort, NUPLAN),
        "comfort_flags_deepplan": within_bounds(measured.comfort, DEEPPLAN),
    }


def _compare_tree(name: str, where: str, ours: Any, expected: Any, report: Report) -> None:
    """Compare JSON values: objects by key, lists of objects by position, the rest as arrays."""
    if isinstance(ours, dict):
        for key in ours.keys() | expected.keys():
            if key not in expected:
                report.fail(f"{name} {key}", where, "missing from the file")
            elif key not in ours:
                report.fail(f"{name} {key}", where, "not among ours")
            else:
                _compare_tree(f"{name} {key}", where, ours[key], expected[key], report)
    elif name == "collisions":
        report.compare("number of collisions", where, len(ours), len(expected))
        for our, their in zip(ours, expected, strict=False):
            _compare_tree("collision", where, our, their, report)
    elif name in ("driven_route", "corner_routes"):
        report.compare(name, where, _as_text(ours), _as_text(expected))
    elif name == "time_to_collision":
        inf = [
            [math.inf if value is None else value for value in side] for side in (ours, expected)
        ]
        report.compare(name, where, inf[0], np.array(inf[1], np.float64), atol=TOLERANCE)
    elif isinstance(ours, np.ndarray) and len(ours) == 0:
        report.compare(name, where, 0, len(expected))
    else:
        report.compare(name, where, ours, expected, atol=TOLERANCE)


def _as_text(lists: list[Any]) -> list[str]:
    return [json.dumps(item) for item in lists]
