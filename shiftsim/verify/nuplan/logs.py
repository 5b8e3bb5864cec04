"""The importer against what the official stack reads from the same logs and maps."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.nuplan.boxes import read_boxes
from shiftsim.data.nuplan.log import Log, open_log, read_ego
from shiftsim.data.nuplan.scenarios import find_maps
from shiftsim.verify.files import Groups, Source, read_json
from shiftsim.verify.nuplan.maps import METRES, RADIANS, verify_maps
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.worlds import ego_columns, object_columns
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LightStatus

POSE = np.array([METRES, METRES, RADIANS])
_POSES = dict.fromkeys(("mission_goal", "expert_goal_state"), POSE)
LOG_TOLERANCES = {
    **dict.fromkeys(("x", "y", "center_x", "center_y"), METRES),
    **dict.fromkeys(("heading", "center_heading"), RADIANS),
}
# What log_ego holds: name -> samples asked for, horizon in rows, direction, from which iteration.
_EXCERPTS = {
    "past_2s": (20, 40, -1, 0),
    "future_8s_of_iteration_0": (80, 160, 1, 0),
    "future_8s_of_last_iteration": (16, 160, 1, -1),
}
_MAX_SECONDS = 60.0  # nuPlan looks so far ahead at most for a route
_ROW, _SAMPLE = 0.05, 0.1  # s, nominal distance of log rows and of the samples asked for


def verify_nuplan_import(folder: Path, report: Report) -> None:
    """Compare maps, logged ego states, objects, lights and scene facts with the official ones."""
    scenes, expected = Scenes(folder), folder / "expected"
    verify_maps(expected, scenes.maps, report)
    ego = Groups(expected / "log_ego.parquet", report, ("scene", "kind"))
    objects = Groups(expected / "objects.parquet", report)
    lights = Groups(expected / "traffic_lights.parquet", report, ("scene",))
    scripts = Groups(folder / "scripted.parquet", report, ("scene", "planner"))
    listed = [Source("scenes.json", "field", entry, report) for entry in scenes.entries.values()]
    path = expected / "scenario_meta.json"
    meta = Source("scenario_meta.json", "scene", read_json(path), report)
    for entry in listed:
        name = entry["scene"]
        with report.attempt("importer", name), open_log(folder / entry["db"]) as log:
            scene = scenes[name]
            drawn = sorted(planner[9:] for of, planner in scripts if of == name)  # scripted_…
            _compare_facts(entry, meta.each(name)[0], scene, log, drawn)
            for kind in ("iteration", *_EXCERPTS):
                ego.match((name, kind), _ego(kind, scene), LOG_TOLERANCES)
            objects.match((name, "NR", "*"), _objects(scene, log), LOG_TOLERANCES)
            lights.match((name,), light_columns(scene))
    for table in (ego, lights):
        table.finish()
    for source in (meta, *listed):
        source.finish()
    read = {*expected.iterdir(), *(folder / entry["db"] for entry in scenes.entries.values())}
    read |= {folder / name for name in ("scenes.json", "scripted.parquet", "RESULTS.md")}
    name_rest(folder, read, report)
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


def _compare_facts(
    entry: Source, meta: Source, scene: Scenario, log: Log, drawn: list[str]
) -> None:
    """Compare what `scenes.json` and `scenario_meta.json` say of a scene."""
    where, times, tracks = entry["scene"], scene.iteration_times, "SELECT COUNT(*) FROM track"
    # nuPlan rule 602: both stamps become seconds first, the difference is cut to microseconds
    duration = float(times[-1]) * 1e-6 - float(times[0]) * 1e-6
    offered = bool(log.is_offered[log.row_of[entry["token"]]])
    entry.report.compare("scenes.json offered by the log", where, offered, True)
    names = sorted(script["name"] for script in entry["scripts"])
    entry.report.compare("scenes.json scripts", where, drawn, names)
    both = {
        "token": scene.token,
        "route_roadblock_ids": list(scene.route),
        "mission_goal": scene.mission_goal,
    }
    ours = {
        "scene": scene.log_name,
        "db": f"logs/{scene.log_name}.db",
        "map": log.map_name,
        "scenario_type": scene.scenario_type,
        "t0_us": int(times[0]),
        "n_lidar_pc": len(log.time_us),
        "n_tracks": log.database.query(tracks, "table 'track'")[0][0],
        "time_jitter": bool((np.diff(log.time_us) != 50_000).any()),
        "epsg": scene.map.epsg,
    }
    entry.match(where, both | ours, _POSES)
    ours = {
        "log_name": scene.log_name,
        "iterations": scene.num_iterations,
        "route_from_expert": expert_route(scene.map, expert_points(log, log.row_of[scene.token])),
        "database_interval": 0.05 / scene.mapping[2],
        "duration_s": int(duration * 1e6) / 1e6,
        "time_us": times,
        "expert_goal_state": scene.expert[-1, :3],
    }
    meta.match(where, both | ours, _POSES, quantity="meta")


def expert_points(log: Log, row: int) -> FloatArray:
    """(K, 2) rear axle positions after a row that nuPlan derives a route from [m]."""
    ahead = min((int(log.time_us[-1]) - int(log.time_us[row])) * 1e-6, _MAX_SECONDS)
    number, available = int(ahead / _SAMPLE), int(ahead / _ROW) + 1
    step = available // number
    last = min(row + step * number + 1, len(log.time_us))
    return read_ego(log, row, last)[step::step, :2]


def expert_route(road: VectorMap, points: FloatArray) -> list[str]:
    """Ids of the blocks that points (K, 2) pass through, in order."""
    route: list[int] = []
    after: list[int] = []
    for x, y in points.tolist():
        holding = road.blocks.containing(x, y).tolist()
        if route and route[-1] in holding:
            continue
        if route and not after:
            after = road.block_outgoing.at(route[-1]).tolist()
        # nuPlan rule 603: successors of the last block go first; only where none of them holds the
        # point are there others, and of these roadblocks go before connectors
        after = [block for block in after if block in holding]
        after = after or [block for block in holding if block < road.num_roadblocks] or holding
        if len(after) == 1:
            route.append(after.pop())
    return [road.blocks.ids[block] for block in route]


def excerpt_rows(scene: Scenario, row: int, num: int, horizon: int, direction: int) -> IntArray:
    """Rows that nuPlan reads for `num` samples over `horizon` rows ahead (1) or back (-1)."""
    step = (horizon + 1) // num
    side: Literal["left", "right"] = "left" if direction > 0 else "right"  # nuPlan rule 431
    row = int(np.searchsorted(scene.time_us, scene.time_us[row], side)) - (direction < 0)
    rows = row + direction * step * np.arange(1, num + 1)
    # nuPlan rule 604: rows are counted, and those outside the log are silently left out
    return np.sort(rows[(rows >= 0) & (rows < len(scene.time_us))])


def _ego(kind: str, scene: Scenario) -> dict[str, Any]:
    rows = scene.iteration_rows
    if kind in _EXCERPTS:
        num, horizon, direction, iteration = _EXCERPTS[kind]
        rows = excerpt_rows(scene, int(rows[iteration]), num, horizon, direction)
    samples = {"index": np.arange(len(rows)), "time_us": scene.time_us[rows]}
    return {**samples, **ego_columns(scene.ego[rows])}


def _objects(scene: Scenario, log: Log) -> dict[str, Any]:
    """Objects of every sample, in nuPlan's order, with their heights (which only the log has)."""
    sampled = np.searchsorted(log.time_us, scene.iteration_times[:-1])
    boxes = read_boxes(log, int(sampled[0]), int(sampled[-1]) + 1)
    tracks = scene.tracks.rows(scene.iteration_rows[:-1])
    heights = boxes.values[np.isin(boxes.row, sampled), 7]
    return {**object_columns(tracks, *np.nonzero(tracks.valid)), "height": heights}


def light_columns(scene: Scenario) -> dict[str, Any]:
    """Lights of every sample that are listed."""
    sampled, lights = scene.iteration_rows[:-1], scene.traffic_lights
    iteration, connector = np.nonzero(lights.status[sampled] != LightStatus.ABSENT)
    status = lights.status[sampled][iteration, connector]
    return {
        "iteration": iteration,
        "lane_connector_id": [int(lights.connector_ids[index]) for index in connector],
        "status": [LightStatus(code).name for code in status.tolist()],
        "timestamp": scene.time_us[sampled][iteration],
    }
