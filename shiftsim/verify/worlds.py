"""What reference files hold of a rollout: columns of official tables, and worlds in plain JSON.

The metric worlds were scored by the official metric classes: the metrics without any importer.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.errors import DataError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics import DEEPPLAN, NUPLAN, Measurements, MetricResult, evaluate, measure
from shiftsim.metrics.collision import at_fault_counts
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, within_bounds
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.verify.files import COMPARED, Source, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.world import state
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario, scenario_of_rows
from shiftsim.world.state import AgentKind, Tracks, tracks_of_boxes

TABLES = read_tables(__file__)
SCORE_TOLERANCES: dict[str, float] = COMPARED["scores.parquet"]["atol"]
# Columns of an ego state in the words of the official tables, in the order of `state.STATE_COLUMNS`
_STEERING = ("tire_steering_angle", "tire_steering_rate")
EGO_COLUMNS = (*state.STATE_COLUMNS[:7], *_STEERING, "angular_velocity", "angular_acceleration")
CENTER_COLUMNS = ("center_x", "center_y", "center_heading")
BOX_COLUMNS = ("x", "y", "heading", "vx", "vy", "length", "width")
_IS_CONNECTOR = {"lane": False, "connector": True, "roadblock": False, "roadblock_connector": True}
_SHORT = {"omega": "angular_velocity", "alpha": "angular_acceleration"}


def ego_states(columns: Mapping[str, Any]) -> FloatArray:
    """(R, 11) ego states from columns by name; what has no column is 0."""
    out = np.zeros((len(next(iter(columns.values()))), state.NUM_STATE))
    for name, values in columns.items():
        out[:, EGO_COLUMNS.index(_SHORT.get(name, name))] = values
    return out


def ego_columns(states: FloatArray) -> dict[str, FloatArray]:
    """Columns of the official tables by name, from (R, 11) ego states: rear axle and centre."""
    columns = np.concatenate([states, state.center_poses(states[:, :3])], axis=1)
    return dict(zip((*EGO_COLUMNS, *CENTER_COLUMNS), columns.T, strict=True))


def object_columns(tracks: Tracks, rows: IntArray, index: IntArray) -> dict[str, Any]:
    """Columns of `objects.parquet` but for heights: tracks at rows, both (R,)."""
    kinds = tracks.kinds[index]
    # the official table shows static objects, which have no velocity, as standing
    moves = tracks.velocities[rows, index]
    moves = np.where(kinds[:, None] > state.LAST_AGENT_KIND, np.nan_to_num(moves), moves)
    values = [tracks.poses[rows, index], moves, tracks.sizes[rows, index]]
    return {
        "iteration": rows,
        "track_token": [tracks.tokens[i] for i in index.tolist()],
        "type": [AgentKind(kind).name for kind in kinds.tolist()],
        **dict(zip(BOX_COLUMNS, np.concatenate(values, axis=1).T, strict=True)),
    }


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
    boxes = np.full((count, len(kinds), len(BOX_COLUMNS)), np.nan)
    boxes[iteration, track] = np.column_stack([rows[n].astype(np.float64) for n in BOX_COLUMNS])
    return tracks_of_boxes(boxes, [AgentKind[kind] for kind in kinds.values()], list(kinds))


def kind_of(thing: Source) -> AgentKind:
    """Type of an object that is listed."""
    return AgentKind[thing["type"].upper()]


def read_map(world: Source, *fields: str) -> VectorMap:
    """The map of a world; `DataError` if an id names nothing.

    The world holds `edges` and `intersections`, perhaps `roadblocks` and `drivable_area`, perhaps
    `stop_lines`; its edges also hold the `fields`, named as in `EdgeSpec`.
    """
    blocks, stops = (world[n] if n in world else {} for n in ("roadblocks", "stop_lines"))
    road = build_map(
        "world",
        edges=[
            EdgeSpec(
                is_connector=_IS_CONNECTOR[edge["kind"]],
                polygon=shapely.Polygon(edge["polygon"]),
                baseline=np.array(edge["baseline"], np.float64),
                block_id=edge["roadblock"] if blocks else "",
                **{name: edge[name] for name in ("id", "outgoing", "speed_limit", *fields)},
            )
            for edge in world.each("edges")
        ],
        blocks=[
            BlockSpec(name, _IS_CONNECTOR[block["kind"]], shapely.Polygon(block["polygon"]))
            for name, block in blocks.items()
        ],
        intersections=_areas(enumerate(world["intersections"])),
        drivable_areas=_areas(enumerate(world["drivable_area"])) if blocks else (),
        stop_polygons=_areas(stops.items()),
    )
    # an edge of a map without blocks is in none
    if lost := [flaw for flaw in road.flaws if blocks or "roadblock" not in flaw]:
        raise DataError(f"ids that name nothing: {', '.join(lost)}")
    return road


def _areas(rings: Iterable[tuple[object, Any]]) -> list[AreaSpec]:
    return [AreaSpec(str(name), shapely.Polygon(ring)) for name, ring in rings]


def read_scenario(world: Source, road: VectorMap, ego: FloatArray) -> Scenario:
    """The scenario of a world from its map and its ego states (T, 11).

    The world also holds `time_us` and `objects`, which list x, y, heading, vx, vy per frame.
    """
    time_us = np.array(world["time_us"], np.int64)
    objects = sorted(world.each("objects"), key=kind_of)
    counts = {len(ego), *(len(thing["frames"]) for thing in objects)}
    if counts != {len(time_us)}:
        raise DataError(f"{sorted(counts)} frames for {len(time_us)} time stamps")
    values = np.full((len(time_us), len(objects), 7), np.nan)
    for column, thing in enumerate(objects):
        for row, frame in enumerate(thing["frames"]):
            if frame is not None:
                values[row, column] = [*frame, thing["length"], thing["width"]]
    kinds, tokens = [kind_of(thing) for thing in objects], [thing["token"] for thing in objects]
    tracks = tracks_of_boxes(values, kinds, tokens)
    return scenario_of_rows(f"world {world.values.get('world')}", road, time_us, ego, tracks)


def recorded_log(scenario: Scenario, ego: FloatArray) -> SimulationLog:
    """A rollout of which only the ego states (K, 11) are known; the scenario has the expert's."""
    log = as_recorded(scenario)
    if len(ego) != len(log.ego):
        raise DataError(f"{len(ego)} ego states, {len(log.ego) + 1} of the expert")
    return replace(log, ego=ego)


def verify_metric_worlds(folder: Path, report: Report) -> None:
    """Compare every world of the folder, under both threshold profiles."""
    verify_files(folder, report, {}, {"*.json": _compare_world})


def read_world(world: dict[str, Any]) -> tuple[SimulationLog, VectorMap]:
    """Rollout and map of one world."""
    return _read_world(Source("metric_world", "field", world, Report()))


def _read_world(world: Source) -> tuple[SimulationLog, VectorMap]:
    road = read_map(world.each("map")[0], "incoming")
    ego, expert = (
        ego_states(dict(zip(world["state_columns"], np.transpose(world[name]), strict=True)))
        for name in ("ego", "expert")
    )
    return recorded_log(read_scenario(world, road, expert), ego), road


def _compare_world(world: Source, where: str) -> None:
    report, (log, road) = world.report, _read_world(world)
    world.note("label", "world", "kind")
    # a connector lies in a roadblock connector, a lane in a roadblock
    kinds = road.block_of >= road.num_roadblocks
    is_connector = np.arange(len(road.edges)) >= road.num_lanes
    report.compare("kind of edges and their roadblocks", where, kinds, is_connector)
    expected, measured, flags = world.each("expected")[0], measure(log, road), {}
    for name, profile in (("deepplan", DEEPPLAN), ("default", NUPLAN)):
        scores, result = expected.each(f"scores_{name}")[0], evaluate(measured, profile)
        scores.match(f"{where} {name}", known_scores(result), SCORE_TOLERANCES, quantity="score")
        flags[name] = within_bounds(measured.comfort, profile)
    order = list(BOUNDED_SIGNALS.values())
    expected.match(where, {"comfort_flag_order": order}, quantity="")
    series, found = expected.each("series")[0], found_along(measured, road)
    names = {"result": result, "counts": at_fault_counts(measured.collisions), "flags": flags}
    names["inside"] = ~measured.drivable.outside.any(axis=1)
    names["ttc"] = np.where(np.isinf(measured.ttc.values), np.nan, measured.ttc.values)
    TABLES["series"].match(series, where, **found, **names)
    progress = {one.name: one.value for one in result.statistics}
    TABLES["progress"].match(series.each("progress_statistics")[0], where, statistics=progress)
    listed, contacts = series.each("collisions"), measured.collisions
    report.compare("number of collisions", where, len(contacts), len(listed))
    for contact, kind, theirs in zip(contacts, found["types"], listed, strict=False):
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
