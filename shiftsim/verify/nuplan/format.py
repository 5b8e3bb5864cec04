"""The tiny world in nuPlan's own formats against what the devkit read from it."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.nuplan.log import open_log
from shiftsim.data.nuplan.mapping import Mapping
from shiftsim.data.nuplan.scenarios import find_maps, list_scenarios, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.verify.nuplan.maps import connectors_near
from shiftsim.verify.nuplan.reading import excerpt_rows, read_json
from shiftsim.verify.report import Report
from shiftsim.world.layers import in_any
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, AgentKind, LightStatus, center_poses

_MAPPING: Mapping = (15.0, -3.0, 0.5)  # README of the folder
_TYPE = "near_multiple_vehicles"
_POINT = (30.0, -1.75)  # m, where the map is asked
_NEAR = 80.0  # m, half width of the square of `proximal`
_DRIVABLE = ((30.0, 0.0), (100.0, -6.0), (30.0, -8.0), (210.0, -6.0))
_ORIGINS = {32632: (600000.0, 5300000.0)}  # of the coordinates, by coordinate system
_TOLERANCES: dict[str, float | tuple[float, ...]] = {
    "interval": 1e-12,
    "ego_t0.rear": (1e-6, 1e-6, 1e-9),
    "ego_t0.center": 1e-6,
    "ego_t0.speed": 1e-9,
    "goal": (1e-6, 1e-6, 1e-9),
    "lane.speed": 1e-9,
    "lane.length": 1e-3,
}
_AS_SETS = {"tagged", "objects", "lights", "lanes_at_point", "lane.out", "lane.inc"} | {
    "connector.stop",
    "connector.inc",
    "connector.out",
    "roadblock.out",
    "roadblock.interior",
}


def verify_nuplan_format(folder: Path, report: Report) -> None:
    """Compare every field of `devkit_readback.json`.

    Args:
        folder: Folder with `logs`, `maps` and `devkit_readback.json`.
        report: Filled with the comparisons.
    """
    expected = read_json(folder / "devkit_readback.json")
    logs = sorted((folder / "logs").glob("*.db"))
    if not logs:
        raise DataError(f"{folder / 'logs'}: there is no log (.db)")
    for extra in logs[1:]:
        report.skip(f"logs/{extra.name}: a second log")
    ours = _read_back(folder, logs[0])
    for field, value in expected.items():
        if field not in ours:
            report.skip(f"devkit_readback.json: field {field!r}")
        elif isinstance(value, dict):
            _compare_fields(field, ours[field], value, report)
        else:
            _compare(field, ours[field], value, report)
    for field in sorted(set(ours) - set(expected)):
        report.skip(f"devkit_readback.json: field {field!r} is missing")
    known = {logs[0], *logs[1:], *find_maps(folder / "maps").values()}
    known |= set((folder / "maps").glob("*maps*.json")) | {folder / "devkit_readback.json"}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path not in known and path.name != "README.md":
            report.skip(f"{path.relative_to(folder)} is not part of the folder's format")
    report.note("README.md (for reading)")


def _compare_fields(
    field: str, ours: dict[str, Any], theirs: dict[str, Any], report: Report
) -> None:
    for name, value in theirs.items():
        if name in ours:
            _compare(f"{field}.{name}", ours[name], value, report)
        else:
            report.skip(f"devkit_readback.json: field '{field}.{name}'")
    for name in sorted(set(ours) - set(theirs)):
        report.skip(f"devkit_readback.json: field '{field}.{name}' is missing")


def _compare(field: str, ours: Any, theirs: Any, report: Report) -> None:
    if field in _AS_SETS:
        ours, theirs = sorted(map(repr, ours)), sorted(map(repr, theirs))
    elif field == "lane.adjacent":
        ours, theirs = [str(i) for i in ours], [str(i) for i in theirs]
    tolerance = _TOLERANCES.get(field, 0.0)
    if isinstance(tolerance, tuple):
        if report.compare("readback", f"{field} form", np.shape(ours), np.shape(theirs)):
            for index, (a, b, atol) in enumerate(zip(ours, theirs, tolerance, strict=True)):
                report.compare("readback", f"{field} {index}", a, b, atol=atol)
        return
    report.compare("readback", field, ours, theirs, atol=tolerance)


def _read_back(folder: Path, path: Path) -> dict[str, Any]:
    with open_log(path) as log:
        tagged = [[t, i] for t, i in zip(log.types, log.tokens, strict=True) if t != "unknown"]
        start, map_name = int(log.time_us[0]), log.map_name
    if not tagged:
        raise DataError(f"{path}: no row is tagged")
    road = load_map(find_maps(folder / "maps"), map_name)
    scene = read_scenario(path, tagged[0][1], road, _MAPPING)
    return {
        "scenarios_all": len(list_scenarios(path)),
        "tagged": tagged,
        "scenarios_by_type": len(list_scenarios(path, types=frozenset([_TYPE]))),
        **_scene_fields(scene, start),
        **_map_fields(road),
    }


def _origin(road: VectorMap) -> FloatArray:
    if road.epsg not in _ORIGINS:
        raise DataError(f"map {road.name!r}: epsg {road.epsg} has no known origin")
    return np.array(_ORIGINS[road.epsg])


def _scene_fields(scene: Scenario, start: int) -> dict[str, Any]:
    row = int(scene.iteration_rows[0])
    state, origin = scene.ego[row], np.append(_origin(scene.map), 0.0)
    center = center_poses(state[None, :3])[0] - origin
    goal = None if scene.mission_goal is None else (scene.mission_goal - origin).tolist()
    kinds = scene.tracks.kinds[scene.tracks.valid[row]]
    past = excerpt_rows(scene, row, 20, 40, -1)
    future = excerpt_rows(scene, row, 80, 160, 1)
    return {
        "iterations": scene.num_iterations,
        "interval": 0.05 / scene.mapping[2],
        "ego_t0": {
            "rear": (state[:3] - origin).tolist(),
            "center": center[:2].tolist(),
            "speed": float(np.hypot(state[VX], state[VY])),
            "t": int(scene.time_us[row]) - start,
        },
        "goal": goal,
        "route": list(scene.route),
        "past2s": len(past),
        "future8s": len(future),
        "objects": [AgentKind(kind).name for kind in kinds.tolist()],
        "lights": [
            [int(connector), LightStatus(status).name]
            for connector, status in scene.traffic_lights.at(row).items()
        ],
    }


def _map_fields(road: VectorMap) -> dict[str, Any]:
    origin = _origin(road)
    x, y = origin + _POINT
    lanes = road.lanes_at(x, y)
    if not lanes:
        raise DataError(f"map {road.name!r}: no lane at {_POINT}")
    drivable = road.drivable_areas.polygons
    return {
        "lanes_at_point": [road.edges.ids[lane] for lane in lanes],
        **_lane_fields(road, lanes[0]),
        "proximal": _proximal(road, x, y),
        "in_drivable": [bool(in_any(drivable, *(origin + point))) for point in _DRIVABLE],
    }


def _lane_fields(road: VectorMap, lane: int) -> dict[str, Any]:
    def edges(indices: Any) -> list[str]:
        return [road.edges.ids[i] for i in indices.tolist()]

    def neighbour(index: int) -> str | None:
        return None if index == NONE else road.edges.ids[index]

    if not len(road.outgoing.at(lane)):
        raise DataError(f"map {road.name!r}: lane {road.edges.ids[lane]!r} leads nowhere")
    block = int(road.block_of[lane])
    first = int(road.outgoing.at(lane)[0])
    left, right = road.boundary_ids[lane]
    return {
        "lane": {
            "roadblock": road.blocks.ids[block],
            "speed": float(road.speed_limits[lane]),
            "out": edges(road.outgoing.at(lane)),
            "inc": edges(road.incoming.at(lane)),
            "length": road.baselines.length(lane),
            "left": left,
            "right": right,
            "index": int(road.lane_index[lane]),
            "adjacent": [
                neighbour(int(road.left_lane[lane])),
                neighbour(int(road.right_lane[lane])),
            ],
        },
        "connector": {
            "id": road.edges.ids[first],
            "lights": bool(road.has_traffic_lights[first]),
            "stop": [road.stop_polygons.ids[i] for i in road.stop_lines.at(first).tolist()],
            "inc": edges(road.incoming.at(first)),
            "out": edges(road.outgoing.at(first)),
            "rb": road.blocks.ids[int(road.block_of[first])],
        },
        "roadblock": {
            "out": [road.blocks.ids[i] for i in road.block_outgoing.at(block).tolist()],
            "interior": edges(road.block_edges.at(block)),
        },
    }


def _proximal(road: VectorMap, x: float, y: float) -> dict[str, int]:
    edges = road.edges.within_box(x, y, _NEAR)
    blocks = road.blocks.within_box(x, y, _NEAR)
    areas = {
        "STOP_LINE": road.stop_polygons,
        "CROSSWALK": road.crosswalks,
        "INTERSECTION": road.intersections,
        "WALKWAYS": road.walkways,
        "CARPARK_AREA": road.car_parks,
    }
    return {
        "LANE": int((edges < road.num_lanes).sum()),
        "LANE_CONNECTOR": len(connectors_near(road, x, y, _NEAR)),
        "ROADBLOCK": int((blocks < road.num_roadblocks).sum()),
        "ROADBLOCK_CONNECTOR": int((blocks >= road.num_roadblocks).sum()),
        **{name: len(layer.within_box(x, y, _NEAR)) for name, layer in areas.items()},
    }
