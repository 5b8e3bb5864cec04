"""Reactive traffic in small worlds: 100 steps of nuPlan's IDM agents (`idm_world_*.json`)."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.errors import DataError, ShiftsimError
from shiftsim.sim.traffic.idm.agents import order_observed
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.verify.report import Report
from shiftsim.world.map import AreaSpec, EdgeSpec, VectorMap, build_map
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, VY, AgentKind, LightStatus, Tracks, TrafficLights

TOLERANCE = 1e-6  # m, rad, m/s
VEHICLE_COLUMNS = ("token", "x", "y", "heading", "vx", "vy", "path_speed", "route_edge_ids")
_NUMBERS = VEHICLE_COLUMNS[1:7]
_KEYS = {
    *("world", "edges", "intersections", "stop_lines", "objects"),
    *("ego", "lights", "time_us", "expected"),
}
_EDGE_KEYS = {
    *("id", "kind", "baseline", "polygon", "speed_limit"),
    *("outgoing", "has_traffic_lights", "stop_lines"),
}
_OBJECT_KEYS = {"token", "type", "length", "width", "frames"}
_EXPECTED_KEYS = {"vehicles", "vehicle_columns", "order_frame0"}


def verify_idm_world(path: Path, report: Report) -> None:
    """Compare the vehicles of one world after every step, their routes and their order."""
    try:
        world = json.loads(path.read_text("utf-8"))
        _name_unknown(world, path.name, report)
        _compare_world(world, path.stem, report)
    except (ShiftsimError, OSError, ValueError, TypeError, KeyError, IndexError) as error:
        report.fail("idm_world", path.name, f"cannot be compared: {type(error).__name__} {error}")


def _name_unknown(world: dict[str, Any], name: str, report: Report) -> None:
    found: list[tuple[str, set[str]]] = [("field", set(world) - _KEYS)]
    found += [("edge field", set(edge) - _EDGE_KEYS) for edge in world["edges"]]
    found += [("object field", set(item) - _OBJECT_KEYS) for item in world["objects"]]
    found += [("expected field", set(world["expected"]) - _EXPECTED_KEYS)]
    for what, unknown in found:
        for key in sorted(unknown):
            report.skip(f"{name}: {what} {key!r}")
    report.note("idm_world world: a label")
    report.note("idm_world objects: frames of vehicles after the first, and bicycles, are not read")


def _compare_world(world: dict[str, Any], name: str, report: Report) -> None:
    scenario = _make_scenario(world)
    expected = world["expected"]
    report.compare("idm_world columns", name, expected["vehicle_columns"], list(VEHICLE_COLUMNS))
    steps = scenario.num_iterations
    report.compare("idm_world frames", name, steps, len(expected["vehicles"]))
    traffic, tracks = IdmTraffic(), scenario.tracks
    traffic.start(scenario, tracks, 0)
    order = order_observed(tracks.kinds, tracks.valid[0])
    ours = [tracks.tokens[i] for i in order.tolist()]
    report.compare("idm_world order", name, ours, expected["order_frame0"])
    for iteration, vehicles in enumerate(expected["vehicles"][:steps]):
        if iteration:
            traffic.step(iteration - 1, scenario.ego[iteration - 1], tracks, iteration)
        _compare_vehicles(f"{name} {iteration}", traffic, scenario, iteration, vehicles, report)


def _compare_vehicles(
    where: str,
    traffic: IdmTraffic,
    scenario: Scenario,
    iteration: int,
    expected: list[list[Any]],
    report: Report,
) -> None:
    tracks, routes = scenario.tracks, traffic.routes
    index = np.array(list(routes), np.int64)
    tokens = [tracks.tokens[i] for i in index.tolist()]
    if not report.compare("idm_world tokens", where, tokens, [row[0] for row in expected]):
        return
    vehicles = tracks.valid[iteration] & (tracks.kinds == AgentKind.VEHICLE)
    report.compare("idm_world tracks", where, np.flatnonzero(vehicles), index)
    values = np.column_stack(
        [
            tracks.poses[iteration, index],
            tracks.velocities[iteration, index],
            traffic.path_speeds,
        ]
    )
    for column, field in enumerate(_NUMBERS):
        theirs = np.array([row[1 + column] for row in expected], np.float64)
        report.compare(f"idm_world {field}", where, values[:, column], theirs, atol=TOLERANCE)
    for row, route in zip(expected, routes.values(), strict=True):
        ids = [scenario.map.edges.ids[edge] for edge in route]
        report.compare("idm_world route", f"{where} {row[0]}", ids, row[7])
        report.compare("idm_world row", f"{where} {row[0]}", len(row), len(VEHICLE_COLUMNS))


def _make_scenario(world: dict[str, Any]) -> Scenario:
    road = _make_map(world)
    time_us = np.array(world["time_us"], np.int64)
    frames = np.array(world["ego"], np.float64)
    if frames.shape != (len(time_us), VY + 1) or len(world["lights"]) != len(time_us):
        raise DataError(f"ego has shape {frames.shape} for {len(time_us)} time stamps")
    ego = np.zeros((len(time_us), NUM_STATE))
    ego[:, : VY + 1] = frames
    return Scenario(
        token=str(world["world"]),
        scenario_type="unknown",
        log_name="idm_world",
        city=road.name,
        map=road,
        time_us=time_us,
        ego=ego,
        tracks=_make_tracks(world["objects"], len(time_us)),
        traffic_lights=_make_lights(world["lights"], road),
        iteration_rows=np.arange(len(time_us)),
        row_step=1,
        route=(),
        mission_goal=None,
        mapping=(10.0, 0.0, 1.0),
    )


def _make_map(world: dict[str, Any]) -> VectorMap:
    def areas(polygons: dict[str, Any]) -> list[AreaSpec]:
        return [AreaSpec(name, shapely.Polygon(ring)) for name, ring in polygons.items()]

    known = {str(edge["id"]) for edge in world["edges"]}
    for edge in world["edges"]:
        lost = set(map(str, edge["outgoing"])) - known | set(edge["stop_lines"]) - set(
            world["stop_lines"]
        )
        if lost or edge["kind"] not in ("lane", "connector"):
            raise DataError(f"edge {edge['id']!r}: kind {edge['kind']!r}, unknown ids {lost}")
    return build_map(
        "world",
        edges=[
            EdgeSpec(
                id=edge["id"],
                is_connector=edge["kind"] == "connector",
                polygon=shapely.Polygon(edge["polygon"]),
                baseline=np.array(edge["baseline"], np.float64),
                block_id="",
                outgoing=edge["outgoing"],
                speed_limit=edge["speed_limit"],
                has_traffic_lights=bool(edge["has_traffic_lights"]),
                stop_lines=edge["stop_lines"],
            )
            for edge in world["edges"]
        ],
        blocks=[],
        intersections=areas(dict(enumerate(world["intersections"]))),  # type: ignore[arg-type]  # ids are not read
        stop_polygons=areas(world["stop_lines"]),
    )


def _make_tracks(objects: list[dict[str, Any]], num_rows: int) -> Tracks:
    by_kind: Callable[[dict[str, Any]], int] = lambda item: AgentKind[item["type"]]  # noqa: E731
    ordered = sorted(objects, key=by_kind)
    values = np.array([item["frames"] for item in ordered], np.float64)
    values = values.reshape(len(ordered), -1, 5)
    if values.shape[1] != num_rows and len(ordered):
        raise DataError(f"objects have {values.shape[1]} frames, not {num_rows}")
    values = np.ascontiguousarray(values.transpose(1, 0, 2))
    sizes: FloatArray = np.array([[item["length"], item["width"]] for item in ordered])
    return Tracks(
        valid=np.ones((num_rows, len(ordered)), np.bool_),
        poses=np.ascontiguousarray(values[..., :3]),
        velocities=np.ascontiguousarray(values[..., 3:]),
        sizes=np.tile(sizes, (num_rows, 1, 1)),
        kinds=np.array([by_kind(item) for item in ordered], np.int64),
        tokens=tuple(item["token"] for item in ordered),
    )


def _make_lights(lights: list[dict[str, str]], road: VectorMap) -> TrafficLights:
    ids = tuple(sorted({name for row in lights for name in row}))
    for name in ids:
        road.edge(name)
    status = np.full((len(lights), len(ids)), LightStatus.ABSENT, np.int8)
    for row, listed in enumerate(lights):
        for name, word in listed.items():
            status[row, ids.index(name)] = LightStatus[word]
    return TrafficLights(ids, status)
