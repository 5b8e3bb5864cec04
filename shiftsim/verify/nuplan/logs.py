"""The importer against what the official stack reads from the same logs and maps.

Of the tiny world in nuPlan's own formats this is a file, `devkit_readback.json`. Maps are compared
behind the map interface of `compat`; sections in capitals are what the objects of a layer say.
"""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely

from shiftsim.compat import nuplan as compat
from shiftsim.data.nuplan.boxes import read_boxes
from shiftsim.data.nuplan.log import Log, open_log, read_ego
from shiftsim.data.nuplan.mapping import Mapping
from shiftsim.data.nuplan.scenarios import find_maps, list_scenarios, load_map, read_scenario
from shiftsim.data.readers.routes import follow_blocks
from shiftsim.errors import DataError
from shiftsim.kernels import IntArray
from shiftsim.verify.files import COMPARED, Groups, Scenes, Source, open_tables, read_file
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.verify.worlds import ego_columns, object_columns
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, EgoState

LOG_TOLERANCES: dict[str, float] = COMPARED["log_ego.parquet"]["atol"]
TABLES = read_tables(__file__)
_MAX_SECONDS = 60.0  # nuPlan looks so far ahead at most for a route
_ROW, _SAMPLE = 0.05, 0.1  # s, nominal distance of log rows and of the samples asked for
# of the tiny world, and of what the devkit read from it
_MAPPING: Mapping = (15.0, -3.0, 0.5)  # README of the folder
_POINT = np.array([30.0, -1.75, 0.0])  # m, where the map is asked
_NEAR = 80.0  # m, half width of the square of `proximal`
_DRIVABLE = np.array([[30.0, 0.0], [100.0, -6.0], [30.0, -8.0], [210.0, -6.0]])
_ORIGINS = {32632: np.array([600000.0, 5300000.0, 0.0])}  # of the poses, by coordinate system
# columns of `map_lines` and `map_queries`
_AXES = ("x", "y", "heading")
_EDGES = ("LANE", "LANE_CONNECTOR")
_NEAR_POINT = 20.0  # m, half width of the square of the `near20` columns
_ASKED = COMPARED["asked"]  # layers, by what is asked of them


def verify_nuplan_import(folder: Path, report: Report) -> None:
    """Compare maps, logged ego states, objects, lights and scene facts with the official ones."""
    scenes, expected = Scenes(folder, report), folder / "expected"
    verify_maps(expected, scenes.maps, report)
    tables = open_tables(expected, report, "log_ego", "objects", "traffic_lights")
    ego, objects, lights = tables.values()
    scripts = open_tables(folder, report, "scripted")["scripted"]
    meta = read_file(expected / "scenario_meta.json", report, "scenario_meta.json")
    meta.what = "scene"
    for name, entry in scenes.entries.items():
        with report.attempt("importer", name), open_log(folder / entry["db"]) as log:
            scene, names = scenes[name], _facts(scenes[name], log)
            TABLES["listed"].match(entry, name, **names)
            TABLES["meta"].match(meta.each(name)[0], name, **names)
            offered = bool(log.is_offered[log.row_of[entry["token"]]])
            report.compare("scenes.json offered by the log", name, offered, True)
            drawn = sorted(planner[9:] for of, planner in scripts if of == name)  # scripted_…
            named = sorted(script["name"] for script in entry["scripts"])
            report.compare("scenes.json scripts", name, drawn, named)
            rows = {"iteration": scene.iteration_rows}
            for kind, (*sampled, at) in COMPARED["excerpts"].items():
                rows[kind] = excerpt_rows(scene.time_us, int(scene.iteration_times[at]), *sampled)
            for kind, read in rows.items():
                ours = {"index": np.arange(len(read)), "time_us": scene.time_us[read]}
                ego.match((name, kind), ours | ego_columns(scene.ego[read]))
            objects.match((name, "NR", "*"), _objects(scene, log), LOG_TOLERANCES)
            lights.match((name,), light_columns(scene))
    read_here = {folder / name for name in ("scenes.json", "scripted.parquet", "RESULTS.md")}
    read_here |= {folder / entry["db"] for entry in scenes.entries.values()}
    used: list[Groups | Source] = [ego, lights, meta, *scenes.entries.values()]
    for source in used:
        source.finish()
    name_rest(folder, {*expected.iterdir(), *read_here}, report)
    report.note("RESULTS.md (for reading; repeats scores.parquet)")
    report.note("maps/*.json: raster layers of the index (not used for planning)")
    report.note("scenes.json: purpose of each script (a label)")


def name_rest(folder: Path, read: set[Path], report: Report) -> None:
    """Name every file below a folder that nothing reads; its maps, and their index, are read."""
    read |= {*find_maps(folder / "maps").values(), *(folder / "maps").glob("*maps*.json")}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path not in read and path.name != "README.md":
            report.skip(f"file {path.relative_to(folder)}")
    report.note("README.md (for reading)")


def _facts(scene: Scenario, log: Log) -> dict[str, Any]:
    times, begin = scene.iteration_times, log.row_of[scene.token]
    # nuPlan rule 602: both stamps become seconds first, the difference is cut to microseconds
    duration = float(times[-1]) * 1e-6 - float(times[0]) * 1e-6
    ahead = min(float(log.time_us[-1] - log.time_us[begin]) * 1e-6, _MAX_SECONDS)
    samples = int(ahead / _SAMPLE), int(ahead / _ROW), 1
    driven = read_ego(log, begin, len(log.time_us))
    driven = driven[excerpt_rows(log.time_us, int(times[0]), *samples) - begin]
    return {
        **{"scene": scene, "log": log, "road": scene.map, "times": times},
        "num_tracks": log.database.query("SELECT COUNT(*) FROM track", "table 'track'")[0][0],
        "jitter": bool((np.diff(log.time_us) != 50_000).any()),
        "driven": follow_blocks(scene.map, driven[:, :2]),
        "interval": _ROW / scene.mapping[2],
        "duration": int(duration * 1e6) / 1e6,
    }


def excerpt_rows(time_us: IntArray, now: int, num: int, horizon: int, direction: int) -> IntArray:
    """Rows that nuPlan reads for `num` samples over `horizon` rows ahead (1) or back (-1)."""
    step = (horizon + 1) // num
    side: Literal["left", "right"] = "left" if direction > 0 else "right"  # nuPlan rule 431
    row = int(np.searchsorted(time_us, now, side)) - (direction < 0)
    rows = row + direction * step * np.arange(1, num + 1)
    # nuPlan rule 604: rows are counted, and those outside the log are silently left out
    return np.sort(rows[(rows >= 0) & (rows < len(time_us))])


def _objects(scene: Scenario, log: Log) -> dict[str, Any]:
    """Objects of every sample, in nuPlan's order, with their heights (which only the log has)."""
    sampled = np.searchsorted(log.time_us, scene.iteration_times[:-1])
    boxes = read_boxes(log, int(sampled[0]), int(sampled[-1]) + 1)
    tracks = scene.tracks.rows(scene.iteration_rows[:-1])
    heights = boxes.values[np.isin(boxes.row, sampled), 7]
    return {**object_columns(tracks, *np.nonzero(tracks.valid)), "height": heights}


def light_columns(scene: Scenario) -> dict[str, Any]:
    """Lights of every sample that are listed."""
    rows, lights = scene.iteration_rows[:-1].tolist(), scene.traffic_lights
    listed = [(i, *light) for i, row in enumerate(rows) for light in lights.listed(row)]
    return {
        "iteration": [i for i, _, _ in listed],
        "lane_connector_id": [int(name) for _, name, _ in listed],
        "status": [status.name for _, _, status in listed],
        "timestamp": [int(scene.time_us[rows[i]]) for i, _, _ in listed],
    }


def verify_nuplan_format(folder: Path, report: Report) -> None:
    """Compare every field of `devkit_readback.json` with what is in `logs` and `maps`."""
    path, logs = folder / "devkit_readback.json", sorted((folder / "logs").glob("*.db"))
    expected = read_file(path, report, "readback")
    if not logs:
        raise DataError(f"{folder / 'logs'}: there is no log (.db)")
    for extra in logs[1:]:
        report.skip(f"logs/{extra.name}: a second log")
    with report.attempt("readback", path.name):
        names = _read_back(folder, logs[0])
        TABLES["readback"].match(expected, path.name, **names)
        for part in ("ego_t0", "lane", "connector", "roadblock", "proximal"):
            TABLES[part].match(expected.each(part)[0], path.name, **names)
    expected.finish()
    name_rest(folder, {*logs, path}, report)


def _read_back(folder: Path, path: Path) -> dict[str, Any]:
    with open_log(path) as log:
        tagged = [[t, i] for t, i in zip(log.types, log.tokens, strict=True) if t != "unknown"]
        start, road = int(log.time_us[0]), load_map(find_maps(folder / "maps"), log.map_name)
    scene, origin = read_scenario(path, tagged[0][1], road, _MAPPING), _ORIGINS[road.epsg]
    row, now = int(scene.iteration_rows[0]), int(scene.iteration_times[0])
    ego, kinds = EgoState(now, scene.ego[row]), scene.tracks.kinds[scene.tracks.valid[row]]
    world, layers = nuplan_map(road)
    place, places = shapely.Point(_POINT + origin), shapely.points(_DRIVABLE + origin[:2])
    near = world.get_proximal_map_objects(place, _NEAR, world.get_available_map_objects())
    return {
        **{"scene": scene, "ego": ego, "tagged": tagged, "listed": list_scenarios(path)},
        "listed_of_type": list_scenarios(path, types=frozenset(["near_multiple_vehicles"])),
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


def verify_maps(expected: Path, maps: dict[str, VectorMap], report: Report) -> None:
    """Compare map_objects, map_lines and map_queries with maps by name."""
    tables = open_tables(expected, report, "map_objects", "map_lines", "map_queries")
    parts = _compare_objects, _compare_lines, _compare_queries
    for (name, table), compare in zip(tables.items(), parts, strict=True):
        for city, road in maps.items() if len(table) else ():
            with report.attempt(name, city):
                compare(*nuplan_map(road), city, table)
        table.finish()


def nuplan_map(road: VectorMap) -> tuple[Any, Any]:
    """A map behind nuPlan's interface, and its layers by name."""
    compat.install()
    from nuplan.common.maps.maps_datatypes import SemanticMapLayer

    from shiftsim.compat.nuplan.bridge.map import BridgeMap

    return BridgeMap(road), SemanticMapLayer


def _compare_objects(road: Any, layers: Any, city: str, objects: Groups) -> None:
    for name in filter(str.isupper, TABLES):
        found = sorted(road.objects(layers[name]), key=lambda thing: thing.id)
        # rows may come in another order than in the map; nothing reads the order of this table
        rows, where = objects[city, name], f"{city} {name}"
        rows = rows.at(np.argsort(rows["id"].astype(str), kind="stable"))
        if not rows.match(where, {"id": [thing.id for thing in found]}):
            continue
        for row, thing in enumerate(found):
            shape = shapely.from_wkb(rows["polygon_wkb"][row])
            theirs = json.loads(rows["attributes"][row]) | _outline(shape)
            given = Source("map_objects", "attribute", theirs, objects.table.report)
            TABLES[name].match(given, f"{where} {thing.id}", object=thing)
            TABLES["outline"].match(given, f"{where} {thing.id}", **_outline(thing.polygon))
            given.finish()


def _outline(shape: shapely.Polygon) -> dict[str, Any]:
    rings = [np.asarray(ring.coords) for ring in (shape.exterior, *shape.interiors)]
    return {"rings": [len(ring) for ring in rings], "outline": np.concatenate(rings)}


def _compare_lines(road: Any, layers: Any, city: str, lines: Groups) -> None:
    for name in _EDGES:
        for edge in road.objects(layers[name]):
            sides = {"left_boundary": edge.left_boundary, "right_boundary": edge.right_boundary}
            for line, side in {"baseline": edge.baseline_path, **sides}.items():
                poses = side.discrete_path
                ours = {"layer": [name] * len(poses), "index": np.arange(len(poses))}
                ours |= {axis: [getattr(pose, axis) for pose in poses] for axis in _AXES}
                lines.match((city, edge.id, line), ours)


def _compare_queries(road: Any, layers: Any, city: str, queries: Groups) -> None:
    answers, nearby = [], [layers[name] for name in _ASKED["near20"]]
    for point in shapely.points(queries[city,]["x"], queries[city,]["y"]):
        found = {name: road.get_all_map_objects(point, layers[name]) for name in _ASKED["holding"]}
        near = road.get_proximal_map_objects(point, _NEAR_POINT, nearby)
        found |= {f"near20_{kind.name}": things for kind, things in near.items()}
        answer = {name: ",".join(sorted(thing.id for thing in found[name])) for name in found}
        answer |= {f"in_{name}": road.is_in_layer(point, layers[name]) for name in _ASKED["in"]}
        _, away = road.get_distance_to_nearest_map_object(point, layers.DRIVABLE_AREA)
        lane, distance = road.get_distance_to_nearest_map_object(point, layers.LANE)
        answer["drivable_area_distance"] = away
        along = road.source.progress_on(road.source.edge(lane), point.x, point.y)
        answer |= {
            "nearest_lane": lane,
            "nearest_lane_distance": distance,
            "lane_arc_length": along,
        }
        line = road.get_map_object(lane, layers.LANE).baseline_path
        pose = line.get_nearest_pose_from_position(point)
        answer |= {f"lane_pose_{axis}": getattr(pose, axis) for axis in _AXES}
        arc = line.get_nearest_arc_length_from_position(point)
        answers.append({**answer, "lane_curvature": line.get_curvature_at_arc_length(arc)})
    queries.match((city,), {name: [answer[name] for answer in answers] for name in answers[0]})
