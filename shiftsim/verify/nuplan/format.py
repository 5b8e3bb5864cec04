"""The tiny world in nuPlan's own formats against what the devkit read from it."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.data.nuplan.log import open_log
from shiftsim.data.nuplan.mapping import Mapping
from shiftsim.data.nuplan.scenarios import find_maps, list_scenarios, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.verify.files import read_fields
from shiftsim.verify.nuplan.logs import excerpt_rows, name_rest
from shiftsim.verify.nuplan.maps import nuplan_map
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.world.state import AgentKind, EgoState

TABLES = read_tables(__file__)
_MAPPING: Mapping = (15.0, -3.0, 0.5)  # README of the folder
_TYPE = "near_multiple_vehicles"
_POINT = np.array([30.0, -1.75, 0.0])  # m, where the map is asked
_NEAR = 80.0  # m, half width of the square of `proximal`
_DRIVABLE = np.array([[30.0, 0.0], [100.0, -6.0], [30.0, -8.0], [210.0, -6.0]])
_ORIGINS = {32632: np.array([600000.0, 5300000.0, 0.0])}  # of the poses, by coordinate system


def verify_nuplan_format(folder: Path, report: Report) -> None:
    """Compare every field of `devkit_readback.json` with what is in `logs` and `maps`."""
    path, logs = folder / "devkit_readback.json", sorted((folder / "logs").glob("*.db"))
    expected = read_fields(path, report, "readback")
    if not logs:
        raise DataError(f"{folder / 'logs'}: there is no log (.db)")
    for extra in logs[1:]:
        report.skip(f"logs/{extra.name}: a second log")
    with report.attempt("readback", path.name):
        names = _read_back(folder, logs[0])
        for part, table in TABLES.items():
            theirs = expected if part == "readback" else expected.each(part)[0]
            table.match(theirs, path.name, **names)
    expected.finish()
    name_rest(folder, {*logs, path}, report)


def _read_back(folder: Path, path: Path) -> dict[str, Any]:
    """What `format.toml` speaks of."""
    with open_log(path) as log:
        tagged = [[t, i] for t, i in zip(log.types, log.tokens, strict=True) if t != "unknown"]
        start, map_name = int(log.time_us[0]), log.map_name
    road = load_map(find_maps(folder / "maps"), map_name)
    scene, origin = read_scenario(path, tagged[0][1], road, _MAPPING), _ORIGINS[road.epsg]
    row, now = int(scene.iteration_rows[0]), int(scene.iteration_times[0])
    ego, kinds = EgoState(now, scene.ego[row]), scene.tracks.kinds[scene.tracks.valid[row]]
    world, layers = nuplan_map(road)
    place, places = shapely.Point(_POINT + origin), shapely.points(_DRIVABLE + origin[:2])
    near = world.get_proximal_map_objects(place, _NEAR, world.get_available_map_objects())
    return {
        **{"scene": scene, "ego": ego, "tagged": tagged, "listed": list_scenarios(path)},
        "listed_of_type": list_scenarios(path, types=frozenset([_TYPE])),
        "interval": 0.05 / scene.mapping[2],
        "goal": np.array(scene.mission_goal, np.float64) - origin,
        "past": excerpt_rows(scene.time_us, now, 20, 40, -1),
        "future": excerpt_rows(scene.time_us, now, 80, 160, 1),
        "kinds": [AgentKind(kind).name for kind in kinds.tolist()],
        "lights": [[int(i), status.name] for i, status in scene.traffic_lights.listed(row)],
        "rear": ego.pose - origin,
        "center": (ego.center - origin)[:2],
        "since_start": now - start,
        "lanes": world.get_all_map_objects(place, layers.LANE),
        "near": {kind.name: len(found) for kind, found in near.items()},
        "in_drivable": [world.is_in_layer(at, layers.DRIVABLE_AREA) for at in places],
    }
