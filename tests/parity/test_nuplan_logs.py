"""The importer against what the official stack reads from the same logs and maps.

Maps are compared behind the map interface of `compat`.
"""

import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any, Literal

import numpy as np
import places
import pyarrow.parquet as pq
import pytest
import shapely
from nuplan_logs import list_scenarios, read_scenario
from parity_cases import (
    Cases,
    File,
    Rows,
    Scenes,
    change_column,
    change_json,
    ids,
    noticed,
    object_ids,
    open_tables,
    read_file,
)

from shiftsim.compat import nuplan as compat
from shiftsim.data.nuplan.log import Log, open_log, read_boxes, read_ego
from shiftsim.data.nuplan.scenarios import find_maps, load_map
from shiftsim.data.readers.routes import follow_blocks
from shiftsim.verify.rollouts import LOGGED, ego_columns, light_columns, object_columns
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, EgoState

pytestmark = [pytest.mark.golden, pytest.mark.reference("nuplan")]

POSE = [1e-6, 1e-6, 1e-7]  # m, m, rad
MAX_SECONDS = 60.0  # nuPlan looks so far ahead at most for a route
ROW, SAMPLE = 0.05, 0.1  # s, nominal distance of log rows and of the samples asked for
EXCERPTS = {  # of log_ego: samples asked for, horizon in rows, direction, from which iteration
    "past_2s": (20, 40, -1, 0),
    "future_8s_of_iteration_0": (80, 160, 1, 0),
    "future_8s_of_last_iteration": (16, 160, 1, -1),
}


def test_logs(folder: Path, cases: Cases) -> None:
    """Logged ego states, objects, lights and facts of the scenes."""
    scenes, expected = Scenes(folder, cases), folder / "expected"
    ego, objects, lights = open_tables(
        expected, cases, "log_ego", "objects", "traffic_lights"
    ).values()
    scripts = open_tables(folder, cases, "scripted")["scripted"]
    meta = read_file(expected / "scenario_meta.json", cases, "scenario_meta.json")
    meta.what = "scene"
    for name, entry in scenes.entries.items():
        with open_log(folder / entry["db"]) as log:
            scene = scenes[name]
            compare_facts(scene, log, name, entry, meta.each(name)[0])
            offered = bool(log.is_offered[log.row_of[entry["token"]]])
            cases.compare("scenes.json offered by the log", name, offered, True)
            drawn = sorted(planner[9:] for of, planner in scripts if of == name)  # scripted_…
            named = sorted(script["name"] for script in entry["scripts"])
            cases.compare("scenes.json scripts", name, drawn, named)
            rows = {"iteration": scene.iteration_rows}
            for kind, (*sampled, at) in EXCERPTS.items():
                rows[kind] = excerpt_rows(scene.time_us, int(scene.iteration_times[at]), *sampled)
            for kind, read in rows.items():
                ours = {"index": np.arange(len(read)), "time_us": scene.time_us[read]}
                ego.match((name, kind), ours | ego_columns(scene.ego[read]))
            objects.match((name, "NR", "*"), logged_objects(scene, log), LOGGED)
            lights.match((name,), light_columns(scene))
    for source in (ego, lights, meta, *scenes.entries.values()):
        source.finish()


def compare_facts(scene: Scenario, log: Log, name: str, entry: File, meta: File) -> None:
    times, begin = scene.iteration_times, log.row_of[scene.token]
    # nuPlan rule 602: both stamps become seconds first, the difference is cut to microseconds
    duration = float(times[-1]) * 1e-6 - float(times[0]) * 1e-6
    ahead = min(float(log.time_us[-1] - log.time_us[begin]) * 1e-6, MAX_SECONDS)
    samples = int(ahead / SAMPLE), int(ahead / ROW), 1
    driven = read_ego(log, begin, len(log.time_us))
    driven = driven[excerpt_rows(log.time_us, int(times[0]), *samples) - begin]
    count = log.database.query("SELECT COUNT(*) FROM track", "table 'track'")[0][0]
    listed = {
        "scene": scene.log_name,
        "db": f"logs/{scene.log_name}.db",
        "map": log.map_name,
        "token": scene.token,
        "scenario_type": scene.scenario_type,
        "t0_us": times[0],
        "route_roadblock_ids": scene.route,
        "mission_goal": scene.mission_goal,
        "n_lidar_pc": len(log.time_us),
        "n_tracks": count,
        "time_jitter": bool((np.diff(log.time_us) != 50_000).any()),
        "epsg": scene.map.epsg,
    }
    entry.match(name, listed, {"mission_goal": POSE}, quantity="scenes.json")
    facts = {
        "log_name": scene.log_name,
        "token": scene.token,
        "iterations": scene.num_iterations,
        "route_roadblock_ids": scene.route,
        "route_from_expert": ids(scene.map.blocks, follow_blocks(scene.map, driven[:, :2])),
        "mission_goal": scene.mission_goal,
        "expert_goal_state": scene.expert[-1, :3],
        "database_interval": ROW / scene.mapping[2],
        "duration_s": int(duration * 1e6) / 1e6,
        "time_us": times,
    }
    atol = {"mission_goal": POSE, "expert_goal_state": POSE}
    meta.match(name, facts, atol, quantity="meta")


def excerpt_rows(time_us: Any, now: int, num: int, horizon: int, direction: int) -> np.ndarray:
    """Rows that nuPlan reads for `num` samples over `horizon` rows ahead (1) or back (-1)."""
    step = (horizon + 1) // num
    side: Literal["left", "right"] = "left" if direction > 0 else "right"  # nuPlan rule 431
    row = int(np.searchsorted(time_us, now, side)) - (direction < 0)
    rows = row + direction * step * np.arange(1, num + 1)
    # nuPlan rule 604: rows are counted, and those outside the log are silently left out
    return np.sort(rows[(rows >= 0) & (rows < len(time_us))])


def logged_objects(scene: Scenario, log: Log) -> dict[str, Any]:
    """Objects of every sample, in nuPlan's order, with their heights (which only the log has)."""
    sampled = np.searchsorted(log.time_us, scene.iteration_times[:-1])
    boxes = read_boxes(log, int(sampled[0]), int(sampled[-1]) + 1)
    tracks = scene.tracks.rows(scene.iteration_rows[:-1])
    heights = boxes.values[np.isin(boxes.row, sampled), 7]
    return {**object_columns(tracks, *np.nonzero(tracks.valid)), "height": heights}


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    scenes, expected = Scenes(folder), folder / "expected"
    read = {folder / name for name in ("scenes.json", "scripted.parquet", "RESULTS.md")}
    read |= {folder / entry["db"] for entry in scenes.entries.values()} | {*expected.iterdir()}
    name_rest(folder, read, cases)
    cases.note("RESULTS.md (for reading; repeats scores.parquet)")
    cases.note("maps/*.json: raster layers of the index (not used for planning)")
    cases.note("scenes.json: purpose of each script (a label)")


def name_rest(folder: Path, read: set[Path], cases: Cases) -> None:
    """Name every file below a folder that nothing reads; its maps, and their index, are read."""
    read |= {*find_maps(folder / "maps").values(), *(folder / "maps").glob("*maps*.json")}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path not in read and path.name != "README.md":
            cases.skip(f"file {path.relative_to(folder)}")
    cases.note("README.md (for reading)")


# --- maps

POINT = np.array([30.0, -1.75, 0.0])  # m, where the map of the tiny world is asked
NEAR = 80.0  # m, half width of the square of `proximal`
DRIVABLE = np.array([[30.0, 0.0], [100.0, -6.0], [30.0, -8.0], [210.0, -6.0]])
ORIGINS = {32632: np.array([600000.0, 5300000.0, 0.0])}  # of the poses, by coordinate system
TINY = (15.0, -3.0, 0.5)  # mapping of the tiny world: README of the folder
# columns of `map_lines` and `map_queries`
AXES = ("x", "y", "heading")
EDGES = ("LANE", "LANE_CONNECTOR")
NEAR_POINT = 20.0  # m, half width of the square of the `near20` columns
HOLDING = (*EDGES, "ROADBLOCK", "ROADBLOCK_CONNECTOR", "INTERSECTION", "CROSSWALK")
NEARBY = (*EDGES, "STOP_LINE")
AREAS = ("DRIVABLE_AREA", "INTERSECTION")


def test_maps(folder: Path, cases: Cases) -> None:
    compare_maps(folder / "expected", Scenes(folder).maps, cases)


def compare_maps(expected: Path, maps: dict[str, VectorMap], cases: Cases) -> None:
    tables = open_tables(expected, cases, "map_objects", "map_lines", "map_queries")
    compared = compare_objects, compare_lines, compare_queries
    for table, compare in zip(tables.values(), compared, strict=True):
        for city, road in maps.items() if len(table) else ():
            compare(*nuplan_map(road), city, table)
        table.finish()


def nuplan_map(road: VectorMap) -> tuple[Any, Any]:
    """A map behind nuPlan's interface, and its layers by name."""
    compat.install()
    from nuplan.common.maps.maps_datatypes import SemanticMapLayer

    from shiftsim.compat.nuplan.bridge.map import BridgeMap

    return BridgeMap(road), SemanticMapLayer


def ends(thing: Any) -> dict[str, Any]:
    return {
        "incoming": object_ids(thing.incoming_edges),
        "outgoing": object_ids(thing.outgoing_edges),
    }


def lane(thing: Any) -> dict[str, Any]:
    return {
        "roadblock_id": thing.get_roadblock_id(),
        "speed_limit_mps": thing.speed_limit_mps,
        **ends(thing),
        "baseline_length": thing.baseline_path.length,
    }


ATTRIBUTES: dict[str, Any] = {  # what objects of each layer say
    "LANE": lambda thing: {
        **lane(thing),
        "index": thing.index,
        "left_lane": object_ids(thing.adjacent_edges)[0],
        "right_lane": object_ids(thing.adjacent_edges)[1],
    },
    "LANE_CONNECTOR": lambda thing: {
        **lane(thing),
        "has_traffic_lights": thing.has_traffic_lights(),
        "stop_lines": object_ids(thing.stop_lines),
    },
    "ROADBLOCK": lambda thing: {**ends(thing), "interior": object_ids(thing.interior_edges)},
    "ROADBLOCK_CONNECTOR": lambda thing: {
        **ends(thing),
        "interior": object_ids(thing.interior_edges),
        "intersection": object_ids([thing.intersection])[0],
    },
    "STOP_LINE": lambda thing: {"stop_line_type": thing.stop_line_type},
    **{name: lambda thing: {} for name in ("INTERSECTION", "CROSSWALK", "WALKWAYS")},
    **{name: lambda thing: {} for name in ("CARPARK_AREA", "DRIVABLE_AREA")},
}


def compare_objects(road: Any, layers: Any, city: str, objects: Rows) -> None:
    for name, attributes in ATTRIBUTES.items():
        found = sorted(road.objects(layers[name]), key=lambda thing: thing.id)
        # rows may come in another order than in the map; nothing reads the order of this table
        rows, where = objects[city, name], f"{city} {name}"
        rows = rows.at(np.argsort(rows["id"].astype(str), kind="stable"))
        if not rows.match(where, {"id": [thing.id for thing in found]}):
            continue
        for row, thing in enumerate(found):
            shape = shapely.from_wkb(rows["polygon_wkb"][row])
            theirs = json.loads(rows["attributes"][row]) | outline(shape)
            given = File("map_objects", "attribute", theirs, objects.table.report)
            ours = attributes(thing) | outline(thing.polygon)
            given.match(f"{where} {thing.id}", ours, {"baseline_length": 1e-6, "outline": 1e-6})
            given.finish()


def outline(shape: shapely.Polygon) -> dict[str, Any]:
    """Vertices, and how many each ring has."""
    rings = [np.asarray(ring.coords) for ring in (shape.exterior, *shape.interiors)]
    return {"rings": [len(ring) for ring in rings], "outline": np.concatenate(rings)}


def compare_lines(road: Any, layers: Any, city: str, lines: Rows) -> None:
    for name in EDGES:
        for edge in road.objects(layers[name]):
            sides = {"left_boundary": edge.left_boundary, "right_boundary": edge.right_boundary}
            for line, side in {"baseline": edge.baseline_path, **sides}.items():
                poses = side.discrete_path
                ours = {"layer": [name] * len(poses), "index": np.arange(len(poses))}
                ours |= {axis: [getattr(pose, axis) for pose in poses] for axis in AXES}
                lines.match((city, edge.id, line), ours)


def compare_queries(road: Any, layers: Any, city: str, queries: Rows) -> None:
    answers, nearby = [], [layers[name] for name in NEARBY]
    for point in shapely.points(queries[city,]["x"], queries[city,]["y"]):
        found = {name: road.get_all_map_objects(point, layers[name]) for name in HOLDING}
        near = road.get_proximal_map_objects(point, NEAR_POINT, nearby)
        found |= {f"near20_{kind.name}": things for kind, things in near.items()}
        answer = {name: ",".join(sorted(thing.id for thing in found[name])) for name in found}
        answer |= {f"in_{name}": road.is_in_layer(point, layers[name]) for name in AREAS}
        _, away = road.get_distance_to_nearest_map_object(point, layers.DRIVABLE_AREA)
        lane, distance = road.get_distance_to_nearest_map_object(point, layers.LANE)
        along = road.source.progress_on(road.source.edge(lane), point.x, point.y)
        line = road.get_map_object(lane, layers.LANE).baseline_path
        pose = line.get_nearest_pose_from_position(point)
        answer |= {
            "drivable_area_distance": away,
            "nearest_lane": lane,
            "nearest_lane_distance": distance,
            "lane_arc_length": along,
            **{f"lane_pose_{axis}": getattr(pose, axis) for axis in AXES},
        }
        arc = line.get_nearest_arc_length_from_position(point)
        answers.append({**answer, "lane_curvature": line.get_curvature_at_arc_length(arc)})
    queries.match((city,), {name: [answer[name] for answer in answers] for name in answers[0]})


# --- the tiny world


@pytest.mark.reference("nuplan_format")
def test_tiny_world(folder: Path, cases: Cases) -> None:
    """Every field of `devkit_readback.json` against what is in `logs` and `maps`."""
    path, logs = folder / "devkit_readback.json", sorted((folder / "logs").glob("*.db"))
    file = read_file(path, cases, "readback")
    for extra in logs[1:]:
        cases.skip(f"logs/{extra.name}: a second log")
    compare_readback(folder, logs[0], file)
    file.finish()
    name_rest(folder, {*logs, path}, cases)


def compare_readback(folder: Path, path: Path, file: File) -> None:
    with open_log(path) as log:
        tagged = [[t, i] for t, i in zip(log.types, log.tokens, strict=True) if t != "unknown"]
        start, road = int(log.time_us[0]), load_map(find_maps(folder / "maps"), log.map_name)
    scene, origin = read_scenario(path, tagged[0][1], road, TINY), ORIGINS[road.epsg]
    row, now = int(scene.iteration_rows[0]), int(scene.iteration_times[0])
    ego, kinds = EgoState(now, scene.ego[row]), scene.tracks.kinds[scene.tracks.valid[row]]
    world, layers = nuplan_map(road)
    place, points = shapely.Point(POINT + origin), shapely.points(DRIVABLE + origin[:2])
    near = world.get_proximal_map_objects(place, NEAR, world.get_available_map_objects())
    lanes = world.get_all_map_objects(place, layers.LANE)
    of_type = list_scenarios(path, types=frozenset(["near_multiple_vehicles"]))
    readback = {
        "scenarios_all": len(list_scenarios(path)),
        "tagged": tagged,
        "scenarios_by_type": len(of_type),
        "iterations": scene.num_iterations,
        "interval": 0.05 / scene.mapping[2],
        "goal": np.array(scene.mission_goal, np.float64) - origin,
        "route": scene.route,
        "past2s": len(excerpt_rows(scene.time_us, now, 20, 40, -1)),
        "future8s": len(excerpt_rows(scene.time_us, now, 80, 160, 1)),
        "objects": [AgentKind(kind).name for kind in kinds.tolist()],
        "lights": [[int(i), status.name] for i, status in scene.traffic_lights.listed(row)],
        "lanes_at_point": object_ids(lanes),
        "in_drivable": [world.is_in_layer(at, layers.DRIVABLE_AREA) for at in points],
    }
    lists = ("tagged", "objects", "lights", "lanes_at_point", "out", "inc", "stop", "interior")
    atol = {"interval": 1e-12, "goal": [1e-6, 1e-6, 1e-9]}
    file.match(path.name, readback, atol, quantity="readback", unordered=lists)
    first = lanes[0]
    connector = first.outgoing_edges[0]
    parts = {
        "ego_t0": {
            "rear": ego.pose - origin,
            "center": (ego.center - origin)[:2],
            "speed": ego.speed,
            "t": now - start,
        },
        "lane": {
            "roadblock": first.get_roadblock_id(),
            "speed": first.speed_limit_mps,
            "out": object_ids(first.outgoing_edges),
            "inc": object_ids(first.incoming_edges),
            "length": first.baseline_path.length,
            "left": first.left_boundary.id,
            "right": first.right_boundary.id,
            "index": first.index,
            "adjacent": object_ids(first.adjacent_edges),
        },
        "connector": {
            "id": connector.id,
            "lights": connector.has_traffic_lights(),
            "stop": object_ids(connector.stop_lines),
            "inc": object_ids(connector.incoming_edges),
            "out": object_ids(connector.outgoing_edges),
            "rb": connector.get_roadblock_id(),
        },
        "roadblock": {
            "out": object_ids(first.parent.outgoing_edges),
            "interior": object_ids(first.parent.interior_edges),
        },
        "proximal": {kind.name: len(things) for kind, things in near.items()},
    }
    atol = {"rear": [1e-6, 1e-6, 1e-9], "center": 1e-6, "speed": 1e-9, "length": 1e-3}
    for name, ours in parts.items():
        theirs = file.each(name)[0]
        ours = {key: value for key, value in ours.items() if name != "proximal" or key in theirs}
        theirs.match(path.name, ours, atol, quantity=f"readback {name}", unordered=lists)


# --- proof that a changed value is noticed

SCENE = "s06_right_turn_ped"


@pytest.fixture
def copy(nuplan_reference: Path, tmp_path: Path) -> Path:
    """A reference folder with one scene, so that it can be changed."""
    out = tmp_path / "nuplan"
    shutil.copytree(nuplan_reference / "maps", out / "maps")
    for name in ("logs", "expected"):
        (out / name).mkdir()
    shutil.copy(nuplan_reference / "logs" / f"{SCENE}.db", out / "logs")
    listed = json.loads((nuplan_reference / "scenes.json").read_text())
    (out / "scenes.json").write_text(json.dumps([s for s in listed if s["scene"] == SCENE]))
    tables = [f"expected/{name}" for name in ("log_ego", "objects", "traffic_lights")]
    for name in ("scripted", *tables):
        table = pq.read_table(nuplan_reference / f"{name}.parquet", filters=[("scene", "=", SCENE)])
        pq.write_table(table, out / f"{name}.parquet")
    for name in ("map_objects", "map_lines", "map_queries"):
        table = pq.read_table(nuplan_reference / "expected" / f"{name}.parquet")
        rows = range(0, len(table), 20 if name == "map_queries" else 1)
        pq.write_table(table.take(list(rows)), out / "expected" / f"{name}.parquet")
    meta = json.loads((nuplan_reference / "expected" / "scenario_meta.json").read_text())
    (out / "expected" / "scenario_meta.json").write_text(json.dumps({SCENE: meta[SCENE]}))
    return out


@pytest.mark.parametrize(
    ("table", "column"),
    [
        *(("log_ego", name) for name in ("index", "time_us", "heading", "vx", "center_y")),
        *(("objects", name) for name in ("track_token", "type", "x", "length", "height")),
        *(("traffic_lights", name) for name in ("lane_connector_id", "status")),
        *(("map_objects", name) for name in ("id", "attributes")),
        *(("map_lines", name) for name in ("line", "x", "heading")),
        *(("map_queries", name) for name in ("LANE", "in_INTERSECTION", "nearest_lane")),
        *(("map_queries", name) for name in ("lane_arc_length", "lane_curvature", "near20_LANE")),
        *(("scenes.json", name) for name in ("n_tracks", "route_roadblock_ids", "t0_us")),
        *(("meta", name) for name in ("route_from_expert", "duration_s", "expert_goal_state")),
    ],
)
@pytest.mark.thorough
def test_a_changed_value_is_noticed(copy: Path, table: str, column: str) -> None:
    cases, expected = Cases(), copy / "expected"
    if table == "scenes.json":
        change_json(copy / table, copy / table, 0, column)
    elif table == "meta":
        path = expected / "scenario_meta.json"
        change_json(path, path, SCENE, column)
    else:
        path = expected / f"{table}.parquet"
        change_column(path, path, column, amount=0.1)
    assert noticed(test_maps if table.startswith("map_") else test_logs, copy, cases)


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE lidar_box SET x = x + 1e-5",
        "UPDATE ego_pose SET acceleration_x = acceleration_x + 1e-9",
        "UPDATE traffic_light_status SET status = 'yellow'",
        "UPDATE scene SET roadblock_ids = '1 2'",
        "DELETE FROM track WHERE rowid = 1",
    ],
)
def test_a_changed_log_is_noticed(statement: str, copy: Path) -> None:
    cases = Cases()
    connection = sqlite3.connect(next((copy / "logs").iterdir()))
    connection.execute(statement)
    connection.commit()
    connection.close()
    assert noticed(test_logs, copy, cases)


def test_other_files_are_named(copy: Path) -> None:
    cases = Cases()
    shutil.copy(next((copy / "logs").iterdir()), copy / "logs" / "other.db")
    test_every_file_is_known(copy, cases)
    assert list(cases.not_covered) == ["file logs/other.db"]


@pytest.mark.parametrize(
    "keys",
    [("tagged",), ("goal", 0), ("past2s",), ("lane", "length"), ("connector", "id")],
)
def test_a_changed_field_of_the_tiny_world_is_noticed(keys: Any, tmp_path: Path) -> None:
    folder, cases = tmp_path / "format", Cases()
    shutil.copytree(places.GOLDEN / "nuplan_format", folder)
    path = folder / "devkit_readback.json"
    change_json(path, path, *keys)
    assert noticed(test_tiny_world, folder, cases)
