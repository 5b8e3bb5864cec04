"""The tiny world in nuPlan's own formats against what the devkit read from it."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.nuplan.log import open_log
from shiftsim.data.nuplan.mapping import Mapping
from shiftsim.data.nuplan.scenarios import find_maps, list_scenarios, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.verify.files import COMPARED, fields_of, read_fields
from shiftsim.verify.nuplan.logs import excerpt_rows, name_rest
from shiftsim.verify.nuplan.maps import layer, nuplan_map, point
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, LightStatus, center_poses, speeds

_MAPPING: Mapping = (15.0, -3.0, 0.5)  # README of the folder
_TYPE = "near_multiple_vehicles"
_POINT = (30.0, -1.75)  # m, where the map is asked
_NEAR = 80.0  # m, half width of the square of `proximal`
_DRIVABLE = ((30.0, 0.0), (100.0, -6.0), (30.0, -8.0), (210.0, -6.0))
_ORIGINS = {32632: (600000.0, 5300000.0)}  # of the coordinates, by coordinate system
_POSE = np.array([1e-6, 1e-6, 1e-9])
_TOLERANCES: dict[str, Any] = {"rear": _POSE, "goal": _POSE, "center": 1e-6, "length": 1e-3}
_TOLERANCES |= {"interval": 1e-12, "speed": 1e-9}
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
    with report.attempt("readback", path.name):
        for name, part in _read_back(folder, logs[0]).items():
            theirs, label = expected.each(name)[0] if name else expected, f"readback {name}".strip()
            theirs.match(path.name, part, _TOLERANCES, quantity=label, unordered=_UNORDERED)
    expected.finish()
    name_rest(folder, {*logs, path}, report)


def _read_back(folder: Path, path: Path) -> dict[str, dict[str, Any]]:
    """Our side of the objects in the file, by name; its other fields are those of ``""``."""
    with open_log(path) as log:
        tagged = [[t, i] for t, i in zip(log.types, log.tokens, strict=True) if t != "unknown"]
        start, map_name = int(log.time_us[0]), log.map_name
    road = load_map(find_maps(folder / "maps"), map_name)
    scene, origin = read_scenario(path, tagged[0][1], road, _MAPPING), np.array(_ORIGINS[road.epsg])
    world, place = nuplan_map(road), point(*(origin + _POINT))
    lanes = world.get_all_map_objects(place, layer("LANE"))
    near = world.get_proximal_map_objects(place, _NEAR, world.get_available_map_objects())
    area = layer("DRIVABLE_AREA")
    whole = {
        "scenarios_all": len(list_scenarios(path)),
        "tagged": tagged,
        "scenarios_by_type": len(list_scenarios(path, types=frozenset([_TYPE]))),
        "lanes_at_point": [lane.id for lane in lanes],
        "in_drivable": [world.is_in_layer(point(*(origin + at)), area) for at in _DRIVABLE],
    }
    return {
        **{name: fields_of(lanes[0], paths) for name, paths in COMPARED["readback"].items()},
        "proximal": {kind.name: len(found) for kind, found in near.items()},
        "ego_t0": _ego_fields(scene, start, origin),
        "": whole | _scene_fields(scene, origin),
    }


def _ego_fields(scene: Scenario, start: int, origin: FloatArray) -> dict[str, Any]:
    row = int(scene.iteration_rows[0])
    state = scene.ego[row]
    return {
        "rear": state[:3] - np.append(origin, 0.0),
        "center": center_poses(state[None, :3])[0, :2] - origin,
        "speed": float(speeds(state)),
        "t": int(scene.time_us[row]) - start,
    }


def _scene_fields(scene: Scenario, origin: FloatArray) -> dict[str, Any]:
    row, now = int(scene.iteration_rows[0]), int(scene.iteration_times[0])
    kinds, goal = scene.tracks.kinds[scene.tracks.valid[row]], scene.mission_goal
    lights = scene.traffic_lights.listed(row)
    return {
        "iterations": scene.num_iterations,
        "interval": 0.05 / scene.mapping[2],
        "goal": None if goal is None else goal - np.append(origin, 0.0),
        "route": list(scene.route),
        "past2s": len(excerpt_rows(scene.time_us, now, 20, 40, -1)),
        "future8s": len(excerpt_rows(scene.time_us, now, 80, 160, 1)),
        "objects": [AgentKind(kind).name for kind in kinds.tolist()],
        "lights": [[int(name), LightStatus(status).name] for name, status in lights],
    }
