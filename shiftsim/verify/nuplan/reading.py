"""The importer against what the official stack reads from the same logs and maps."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import IntArray
from shiftsim.data.nuplan.boxes import read_boxes
from shiftsim.data.nuplan.log import open_log
from shiftsim.data.nuplan.mapping import Mapping
from shiftsim.data.nuplan.scenarios import find_maps, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.verify.expert_route import expert_points, expert_route
from shiftsim.verify.nuplan.maps import verify_maps
from shiftsim.verify.report import Report
from shiftsim.verify.tables import Group, read_groups
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, LightStatus, center_poses

MAPPING: Mapping = (15.0, 0.0, 0.5)  # the reference scenes start at their tag, README "Log files"
_METRES, _RADIANS = 1e-6, 1e-7

_EGO_COLUMNS = {  # column -> index in a state row, tolerance
    "x": (0, _METRES),
    "y": (1, _METRES),
    "heading": (2, _RADIANS),
    "vx": (3, 0.0),
    "vy": (4, 0.0),
    "ax": (5, 0.0),
    "ay": (6, 0.0),
    "tire_steering_angle": (7, 0.0),
    "tire_steering_rate": (8, 0.0),
    "angular_velocity": (9, 0.0),
    "angular_acceleration": (10, 0.0),
}
_CENTER_COLUMNS = {
    "center_x": (0, _METRES),
    "center_y": (1, _METRES),
    "center_heading": (2, _RADIANS),
}
_BOX_COLUMNS = {
    "x": (0, _METRES),
    "y": (1, _METRES),
    "heading": (2, _RADIANS),
    "vx": (3, 0.0),
    "vy": (4, 0.0),
    "length": (5, 0.0),
    "width": (6, 0.0),
    "height": (7, 0.0),
}
# What log_ego holds: name -> samples asked for, horizon in rows, direction, from which iteration.
_EXCERPTS = {
    "past_2s": (20, 40, -1, 0),
    "future_8s_of_iteration_0": (80, 160, 1, 0),
    "future_8s_of_last_iteration": (16, 160, 1, -1),
}


def load_maps(folder: Path) -> dict[str, VectorMap]:
    """All maps of a nuplan reference folder, by name."""
    files = find_maps(folder / "maps")
    return {name: load_map(files, name) for name in files}


def load_scenes(folder: Path) -> dict[str, Scenario]:
    """All scenes of a nuplan reference folder, by name, cut with (15 s, 0 s, 0.5)."""
    maps = load_maps(folder)
    return {entry["scene"]: _load_scene(folder, entry, maps) for entry in _manifest(folder)}


def _load_scene(folder: Path, entry: dict[str, Any], maps: dict[str, VectorMap]) -> Scenario:
    if entry["map"] not in maps:
        raise DataError(f"{folder / 'scenes.json'}: unknown map {entry['map']!r}")
    return read_scenario(folder / entry["db"], entry["token"], maps[entry["map"]], MAPPING)


def _manifest(folder: Path) -> list[dict[str, Any]]:
    entries = read_json(folder / "scenes.json")
    for entry in entries:
        missing = {"scene", "db", "map", "token"} - set(entry)
        if missing:
            raise DataError(f"{folder / 'scenes.json'}: a scene has no {min(missing)!r}")
    return entries


def read_json(path: Path) -> Any:
    """Content of a JSON file of a reference folder."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable JSON: {error}") from error


def verify_nuplan_import(folder: Path, report: Report) -> None:
    """Compare maps, logged ego states, objects, lights and scene facts with the official ones.

    Args:
        folder: Folder with `scenes.json`, `logs`, `maps` and `expected`.
        report: Filled with the comparisons.
    """
    maps = load_maps(folder)
    manifest = _manifest(folder)
    scenes = {e["scene"]: _load_scene(folder, e, maps) for e in manifest}
    verify_maps(folder, maps, report)
    ego = _groups(folder, "log_ego", ("scene",), report)
    boxes = _groups(folder, "objects", ("scene", "challenge", "planner"), report)
    lights = _groups(folder, "traffic_lights", ("scene",), report)
    meta_path = folder / "expected" / "scenario_meta.json"
    meta = read_json(meta_path) if meta_path.exists() else {}
    if not meta_path.exists():
        report.skip("expected/scenario_meta.json is missing")
    for entry in manifest:
        name, scene = entry["scene"], scenes[entry["scene"]]
        _verify_manifest(folder, entry, scene, report)
        if name in meta:
            _verify_meta(folder / entry["db"], name, meta[name], scene, report)
        else:
            report.skip(f"scene {name} is not in scenario_meta.json")
        if (name,) in ego:
            _verify_ego(name, ego[(name,)], scene, report)
        else:
            report.skip(f"scene {name} is not in log_ego")
        _verify_objects(folder, entry, boxes.get((name, "NR", "*")), scene, report)
        _verify_lights(name, lights.get((name,)), scene, report)
    for where, known in (
        ("scenario_meta.json", meta),
        ("log_ego", ego),
        ("traffic_lights", lights),
    ):
        for key in known:
            name = key if isinstance(key, str) else key[0]
            if name not in scenes:
                report.skip(f"{where}: scene {name} is not in scenes.json")
    _name_files(folder, manifest, maps, report)


def _groups(
    folder: Path, name: str, key: tuple[str, ...], report: Report
) -> dict[tuple[str, ...], Group]:
    path = folder / "expected" / f"{name}.parquet"
    if not path.exists():
        report.skip(f"expected/{name}.parquet is missing")
        return {}
    return read_groups(path, key)


def _name_files(
    folder: Path, manifest: list[dict[str, Any]], maps: dict[str, VectorMap], report: Report
) -> None:
    """Name every file among the inputs that nothing reads."""
    files = find_maps(folder / "maps")
    used = {folder / entry["db"] for entry in manifest} | {files[name] for name in maps}
    used |= set((folder / "maps").glob("*maps*.json"))
    for path in sorted(p for sub in ("logs", "maps") for p in (folder / sub).rglob("*")):
        if path.is_file() and path not in used:
            report.skip(f"{path.relative_to(folder)} is not named by scenes.json or the map index")
    report.note("README.md, RESULTS.md (for reading; RESULTS repeats scores.parquet)")
    report.note("maps/*.json: raster layers of the index (not used for planning)")
    report.note("scenes.json: purpose of each script (a label)")


def _verify_manifest(folder: Path, entry: dict[str, Any], scene: Scenario, report: Report) -> None:
    where = f"scenes.json: {entry['scene']}"
    with open_log(folder / entry["db"]) as log:
        tracks = log.database.query("SELECT COUNT(*) FROM track", "table 'track'")[0][0]
        num_rows, map_name, times = len(log.time_us), log.map_name, log.time_us
        offered = bool(log.is_offered[log.row_of[entry["token"]]])
    jitter = bool((np.diff(times) != 50_000).any())
    ours = {
        "scene": scene.log_name,
        "db": f"logs/{scene.log_name}.db",
        "map": map_name,
        "scenario_type": scene.scenario_type,
        "token": scene.token,
        "t0_us": int(scene.iteration_times[0]),
        "route_roadblock_ids": list(scene.route),
        "n_lidar_pc": num_rows,
        "n_tracks": tracks,
        "time_jitter": jitter,
        "epsg": scene.map.epsg,
        "scripts": _script_names(folder, entry["scene"]),
    }
    report.compare("scenes.json", f"{where}: offered by the log", offered, True)
    for field, value in entry.items():
        if field == "mission_goal":
            _compare_pose(report, "scenes.json", f"{where}: {field}", scene.mission_goal, value)
        elif field == "scripts":
            names = sorted(script["name"] for script in value)
            report.compare("scenes.json", f"{where}: {field}", ours[field], names)
        elif field in ours:
            report.compare("scenes.json", f"{where}: {field}", ours[field], value)
        else:
            report.skip(f"scenes.json: field {field!r}")
    for field in sorted(set(ours) - set(entry)):
        report.skip(f"scenes.json: field {field!r} of {entry['scene']} is missing")


def _script_names(folder: Path, scene: str) -> list[str]:
    path = folder / "scripted.parquet"
    groups = read_groups(path, ("scene", "planner")) if path.exists() else {}
    return sorted(planner.removeprefix("scripted_") for name, planner in groups if name == scene)


def _compare_pose(
    report: Report, quantity: str, where: str, ours: object, theirs: list[float] | None
) -> None:
    if ours is None or theirs is None:
        report.compare(quantity, where, ours is None, theirs is None)
        return
    pose = np.asarray(ours)
    report.compare(quantity, f"{where} [m]", pose[:2], theirs[:2], atol=_METRES)
    report.compare(quantity, f"{where} [rad]", pose[2:], theirs[2:], atol=_RADIANS)


def _verify_meta(
    path: Path, name: str, meta: dict[str, Any], scene: Scenario, report: Report
) -> None:
    times = scene.iteration_times
    with open_log(path) as log:
        route = expert_route(scene.map, expert_points(log, log.row_of[scene.token]))
    # nuPlan: both stamps become seconds first, and the difference is cut to whole microseconds.
    duration = float(times[-1]) * 1e-6 - float(times[0]) * 1e-6
    ours = {
        "token": scene.token,
        "log_name": scene.log_name,
        "iterations": scene.num_iterations,
        "route_roadblock_ids": list(scene.route),
        "route_from_expert": route,
        "database_interval": 0.05 / scene.mapping[2],
        "duration_s": int(duration * 1e6) / 1e6,
        "time_us": times.tolist(),
    }
    poses = {"mission_goal": scene.mission_goal, "expert_goal_state": scene.expert[-1, :3]}
    for field, value in meta.items():
        where = f"{name}: {field}"
        if field in poses:
            _compare_pose(report, "scenario_meta", where, poses[field], value)
        elif field in ours:
            report.compare("scenario_meta", where, ours[field], value)
        else:
            report.skip(f"scenario_meta.json: field {field!r}")
    for field in sorted((set(ours) | set(poses)) - set(meta)):
        report.skip(f"scenario_meta.json: field {field!r} of {name} is missing")


def _verify_ego(name: str, group: Group, scene: Scenario, report: Report) -> None:
    known = {"scene", "kind", "index", "time_us", *_EGO_COLUMNS, *_CENTER_COLUMNS}
    _name_columns("log_ego", group, known, report)
    for kind in sorted(set(group["kind"].tolist()) | {"iteration", *_EXCERPTS}):
        rows = _excerpt_rows(kind, scene)
        if rows is None:
            report.skip(f"log_ego: kind {kind!r}")
            continue
        chosen = group["kind"] == kind
        where = f"{name}: {kind}"
        states = scene.ego[rows]
        report.compare("log_ego", f"{where}: index", np.arange(len(rows)), group["index"][chosen])
        report.compare(
            "log_ego", f"{where}: time_us", scene.time_us[rows], group["time_us"][chosen]
        )
        centers = center_poses(states[:, :3])
        for values, columns in ((states, _EGO_COLUMNS), (centers, _CENTER_COLUMNS)):
            for column, (index, atol) in columns.items():
                _compare_column(
                    report,
                    "log_ego",
                    f"{where}: {column}",
                    values[:, index],
                    group,
                    column,
                    chosen,
                    atol,
                )


def _compare_column(
    report: Report,
    quantity: str,
    where: str,
    ours: Any,
    group: Group,
    column: str,
    chosen: Any,
    atol: float,
) -> None:
    if column not in group:
        report.skip(f"{quantity}: column {column!r} is missing")
        return
    report.compare(quantity, where, ours, group[column][chosen], atol=atol)


def _excerpt_rows(kind: str, scene: Scenario) -> Any:
    if kind == "iteration":
        return scene.iteration_rows
    if kind not in _EXCERPTS:
        return None
    num, horizon, direction, iteration = _EXCERPTS[kind]
    return excerpt_rows(scene, int(scene.iteration_rows[iteration]), num, horizon, direction)


def excerpt_rows(scene: Scenario, row: int, num: int, horizon: int, direction: int) -> IntArray:
    """Rows that nuPlan reads for `num` samples over `horizon` rows ahead (1) or back (-1).

    Rows are counted, and those outside the log are silently left out (nuplan-simulation.md §1).
    """
    step = (horizon + 1) // num
    rows = row + direction * step * np.arange(1, num + 1)
    return np.sort(rows[(rows >= 0) & (rows < len(scene.time_us))])


def _name_columns(table: str, group: Group, known: set[str], report: Report) -> None:
    for column in group:
        if column not in known:
            report.skip(f"{table}: column {column!r}")


def _verify_objects(
    folder: Path, entry: dict[str, Any], group: Group | None, scene: Scenario, report: Report
) -> None:
    """Objects of every sample, in nuPlan's order, with their heights (which only the log has)."""
    name = entry["scene"]
    with open_log(folder / entry["db"]) as log:
        rows = np.searchsorted(log.time_us, scene.iteration_times[:-1])
        boxes = read_boxes(log, int(rows[0]), int(rows[-1]) + 1)
    chosen = np.isin(boxes.row, rows)
    iteration = np.searchsorted(rows, boxes.row[chosen])
    tokens = [token for token, keep in zip(boxes.token, chosen, strict=True) if keep]
    kinds = boxes.kind[chosen]
    values = boxes.values[chosen].copy()
    values[kinds > AgentKind.BICYCLE, 3:5] = np.nan  # static objects have no velocity
    _verify_dense(name, iteration, tokens, values, scene, report)
    values[kinds > AgentKind.BICYCLE, 3:5] = 0.0  # and the official table shows none as 0
    if group is None:
        report.compare("objects (log)", f"{name}: number", len(tokens), 0)
        return
    known = {"scene", "challenge", "planner", "iteration", "track_token", "type", *_BOX_COLUMNS}
    _name_columns("objects", group, known, report)
    everything = np.ones(len(group["iteration"]), np.bool_)
    exact = {
        "iteration": iteration,
        "track_token": np.array(tokens, object),
        "type": np.array([AgentKind(k).name for k in kinds.tolist()], object),
    }
    for column, ours in exact.items():
        where = f"{name}: {column}"
        _compare_column(report, "objects (log)", where, ours, group, column, everything, 0.0)
    for column, (index, atol) in _BOX_COLUMNS.items():
        where = f"{name}: {column}"
        ours = values[:, index]
        _compare_column(report, "objects (log)", where, ours, group, column, everything, atol)


def _verify_dense(
    name: str, iteration: Any, tokens: list[str], values: Any, scene: Scenario, report: Report
) -> None:
    """The dense tracks of the scenario hold the same boxes in the same order."""
    tracks = scene.tracks.rows(scene.iteration_rows[:-1])
    frame, track = np.nonzero(tracks.valid)
    ours = np.column_stack([tracks.poses[frame, track], tracks.velocities[frame, track]])
    ours = np.column_stack([ours, tracks.sizes[frame, track]])
    where = f"{name}: dense tracks"
    names = np.array([tracks.tokens[i] for i in track.tolist()], object)
    report.compare("objects (log)", f"{where}: iteration", frame, iteration)
    report.compare("objects (log)", f"{where}: token", names, np.array(tokens, object))
    report.compare("objects (log)", f"{where}: values", ours, values[:, :7])


def _verify_lights(name: str, group: Group | None, scene: Scenario, report: Report) -> None:
    rows = scene.iteration_rows[:-1]
    lights = scene.traffic_lights
    iteration, connector = np.nonzero(lights.status[rows] != LightStatus.ABSENT)
    status = lights.status[rows][iteration, connector]
    if group is None:
        report.compare("traffic_lights", f"{name}: number", len(iteration), 0)
        return
    ours = {
        "iteration": iteration,
        "lane_connector_id": np.array([int(lights.connector_ids[c]) for c in connector], np.int64),
        "status": np.array([LightStatus(int(s)).name for s in status], object),
        "timestamp": scene.time_us[rows][iteration],
    }
    _name_columns("traffic_lights", group, {"scene", *ours}, report)
    everything = np.ones(len(group["iteration"]), np.bool_)
    for column, values in ours.items():
        where = f"{name}: {column}"
        _compare_column(report, "traffic_lights", where, values, group, column, everything, 0.0)
