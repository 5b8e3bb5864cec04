"""The tiny world in nuPlan's own formats against what the devkit read from it."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.nuplan.log import open_log
from shiftsim.data.nuplan.mapping import Mapping
from shiftsim.data.nuplan.scenarios import find_maps, list_scenarios, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.verify.files import read_fields
from shiftsim.verify.nuplan.logs import excerpt_rows, name_rest
from shiftsim.verify.nuplan.maps import attributes_of, near_square
from shiftsim.verify.report import Report
from shiftsim.world.layers import in_any
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, AgentKind, LightStatus, center_poses

_MAPPING: Mapping = (15.0, -3.0, 0.5)  # README of the folder
_TYPE = "near_multiple_vehicles"
_POINT = (30.0, -1.75)  # m, where the map is asked
_NEAR = 80.0  # m, half width of the square of `proximal`
_DRIVABLE = ((30.0, 0.0), (100.0, -6.0), (30.0, -8.0), (210.0, -6.0))
_ORIGINS = {32632: (600000.0, 5300000.0)}  # of the coordinates, by coordinate system
_POSE = np.array([1e-6, 1e-6, 1e-9])
_TOLERANCES: dict[str, Any] = {"rear": _POSE, "goal": _POSE, "center": 1e-6, "length": 1e-3}
_TOLERANCES |= {"interval": 1e-12, "speed": 1e-9}
# Fields of a lane and of a connector as of `attributes_of`
_BOTH = {"out": "outgoing", "inc": "incoming"}
_LANE = {"roadblock": "roadblock_id", "speed": "speed_limit_mps", **_BOTH}
_LANE |= {"length": "baseline_length", "index": "index"}
_CONNECTOR = {"rb": "roadblock_id", "lights": "has_traffic_lights", "stop": "stop_lines", **_BOTH}
# Lists whose order means nothing
_UNORDERED = {"tagged", "objects", "lights", "lanes_at_point", "out", "inc", "stop", "interior"}


def verify_nuplan_format(folder: Path, report: Report) -> None:
    """Compare every field of `devkit_readback.json` with what is in `logs` and `maps`."""
    path = folder / "devkit_readback.json"
    expected = read_fields(path, report, "readback")
    logs = sorted((folder / "logs").glob("*.db"))
    if not logs:
        raise DataError(f"{folder / 'logs'}: there is no log (.db)")
    for extra in logs[1:]:
        report.skip(f"logs/{extra.name}: a second log")
    ours = _read_back(folder, logs[0])
    expected.match_tree(path.name, ours, _TOLERANCES, unordered=_UNORDERED)
    expected.finish()
    name_rest(folder, {*logs, path}, report)


def _read_back(folder: Path, path: Path) -> dict[str, Any]:
    with open_log(path) as log:
        tagged = [[t, i] for t, i in zip(log.types, log.tokens, strict=True) if t != "unknown"]
        start, map_name = int(log.time_us[0]), log.map_name
    if not tagged:
        raise DataError(f"{path}: no row is tagged")
    road = load_map(find_maps(folder / "maps"), map_name)
    if road.epsg not in _ORIGINS:
        raise DataError(f"map {road.name!r}: epsg {road.epsg} has no known origin")
    origin = np.array(_ORIGINS[road.epsg])
    return {
        "scenarios_all": len(list_scenarios(path)),
        "tagged": tagged,
        "scenarios_by_type": len(list_scenarios(path, types=frozenset([_TYPE]))),
        **_scene_fields(read_scenario(path, tagged[0][1], road, _MAPPING), start, origin),
        **_map_fields(road, origin),
    }


def _scene_fields(scene: Scenario, start: int, origin: FloatArray) -> dict[str, Any]:
    row = int(scene.iteration_rows[0])
    state, moved = scene.ego[row], np.append(origin, 0.0)
    kinds = scene.tracks.kinds[scene.tracks.valid[row]]
    lights = scene.traffic_lights.listed(row)
    return {
        "iterations": scene.num_iterations,
        "interval": 0.05 / scene.mapping[2],
        "ego_t0": {
            "rear": state[:3] - moved,
            "center": (center_poses(state[None, :3])[0] - moved)[:2],
            "speed": float(np.hypot(state[VX], state[VY])),
            "t": int(scene.time_us[row]) - start,
        },
        "goal": None if scene.mission_goal is None else scene.mission_goal - moved,
        "route": list(scene.route),
        "past2s": len(excerpt_rows(scene, row, 20, 40, -1)),
        "future8s": len(excerpt_rows(scene, row, 80, 160, 1)),
        "objects": [AgentKind(kind).name for kind in kinds.tolist()],
        "lights": [[int(name), LightStatus(status).name] for name, status in lights],
    }


def _map_fields(road: VectorMap, origin: FloatArray) -> dict[str, Any]:
    x, y = origin + _POINT
    lanes = road.lanes_at(x, y)
    if not lanes or not len(road.outgoing.at(lanes[0])):
        raise DataError(f"map {road.name!r}: no lane at {_POINT}, or it leads nowhere")
    lane, connector = lanes[0], int(road.outgoing.at(lanes[0])[0])
    own, after = attributes_of(road, "LANE", lane), attributes_of(road, "LANE_CONNECTOR", connector)
    block = attributes_of(road, "ROADBLOCK", int(road.block_of[lane]))
    left, right = road.boundary_ids[lane]
    near = (
        *("LANE", "LANE_CONNECTOR", "ROADBLOCK", "ROADBLOCK_CONNECTOR", "STOP_LINE", "CROSSWALK"),
        *("INTERSECTION", "WALKWAYS", "CARPARK_AREA"),
    )
    drivable = road.drivable_areas.polygons
    return {
        "lanes_at_point": [road.edges.ids[index] for index in lanes],
        "lane": {
            **{name: own[field] for name, field in _LANE.items()},
            **{"left": left, "right": right, "adjacent": [own["left_lane"], own["right_lane"]]},
        },
        "connector": {
            **{name: after[field] for name, field in _CONNECTOR.items()},
            "id": road.edges.ids[connector],
        },
        "roadblock": {"out": block["outgoing"], "interior": block["interior"]},
        "proximal": {name: len(near_square(road, name, x, y, _NEAR)) for name in near},
        "in_drivable": [bool(in_any(drivable, *(origin + point))) for point in _DRIVABLE],
    }
