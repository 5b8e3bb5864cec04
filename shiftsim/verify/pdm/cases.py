"""The pdm folder: PDM-Closed and nuPlan's IDM planner, from kernels to closed loops.

Kernels need no map; recorded routes and calls are made again from the log and map of a scene.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import make_path, project, window
from shiftsim.planners.idm import STEP_US, STEPS, Idm
from shiftsim.planners.pdm import rollout, step
from shiftsim.planners.pdm import route as routes
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.proposals.areas import select_areas
from shiftsim.planners.proposals.comfort import SIGNALS, comfort
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.proposals.tracker import SCORED, drive_proposals
from shiftsim.planners.routes.graph import centerline, search_cheapest, search_levels
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.verify.files import TOLERANCE, Parts, Scenes, Source, verify_files
from shiftsim.verify.nuplan.runs import verify_nuplan_metrics, verify_simulation
from shiftsim.verify.pdm.steps import verify_calls, verify_step, verify_summary
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables, verify_cases
from shiftsim.verify.worlds import object_columns
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, PACIFICA, LightStatus, center_poses

TABLES = read_tables(__file__)
COORDINATES = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
SIGNAL_TOLERANCE = 1e-6  # comfort signals: rounded to 8 decimals, then differentiated


def verify_pdm(folder: Path, report: Report, scenes: Path | None = None) -> None:
    """Compare every file of the folder; arguments as for `shiftsim.verify.verify`."""
    known = Scenes(scenes or folder.resolve().parent / "nuplan")
    parts: Parts = {
        "routes.json": partial(verify_routes, report=report, scenes=known),
        "idm_calls.json": partial(verify_idm_calls, report=report, scenes=known),
        "loop": partial(_verify_loops, report=report, scenes=known),
    }
    if not known.entries:
        lack = "the logs and maps of the scenes are not at hand"
        parts = dict.fromkeys(parts, lambda path: report.skip(f"{path.name}: {lack}"))
    verify_files(folder, report, {"kernels": partial(verify_kernels, report=report), **parts})


def _verify_loops(folder: Path, report: Report, scenes: Scenes) -> None:
    """Compare every run of the `loop` folder: its calls, then driven freely."""
    verify_calls(folder, report, scenes)
    for verify in (verify_nuplan_metrics, verify_simulation):
        verify(folder, report, scenes, logged=scenes.folder / "expected")


def verify_kernels(folder: Path, report: Report) -> None:
    """Compare every file of the folder."""
    facts: dict[str, dict[str, Any]] = {}
    parts: Parts = {
        **{name: partial(verify_cases, CHECKS[name], report=report) for name in CHECKS},
        "step_core_summary.json": partial(verify_summary, report, facts),  # sorted behind the steps
        "step_*.json": partial(verify_step, report, facts),
        "step_*.npz": lambda path: path.with_suffix(".json").stat(),  # must have its inputs
    }
    verify_files(folder, report, parts)
    if facts and not (folder / "step_core_summary.json").exists():
        report.skip("file kernels/step_core_summary.json is missing")


def _idm(case: Source, where: str) -> None:
    limit, after = case["speed_limit_mps"], np.empty(2)
    limit = DEFAULT.fallback_velocity if np.isnan(limit) else limit
    target = DEFAULT.speed_fractions[case["policy_idx"]] * limit
    before = case.take("prev_progress_velocity", 2)
    lead = case.take("lead_progress_velocity_rear", 3)
    rollout.follow(before, lead, target, DEFAULT.following, after)
    case.match(where, {"next_progress_velocity": after}, TOLERANCE)


def _tracker(case: Source, where: str) -> None:
    poses, ego = case.take("proposal_poses", -1, SCORED + 1, 3), case.take("ego_state", NUM_STATE)
    names = ("velocity_profile", "curvature_profile", "simulated_states")
    case.match(where, dict(zip(names, drive_proposals(poses, ego), strict=True)), TOLERANCE)


def _comfort(case: Source, where: str) -> None:
    signals, bounded, _ = comfort(case.take("states", SCORED + 1, NUM_STATE)[None], DEFAULT.comfort)
    ours = {"is_comfortable": bounded[0], **dict(zip(SIGNALS, signals[0], strict=True))}
    case.match(where, ours, SIGNAL_TOLERANCE)
    case.note("states: all but heading, ax and ay are not read by the test")


def _emergency_brake(case: Source, where: str) -> None:
    poses = center_poses(step.brake_poses(case.take("ego_state", NUM_STATE), PACIFICA))
    case.match(where, {"center_poses_every_2s": poses[::20]}, COORDINATES)
    case.note("ego_state: all but pose, vx, ax and yaw rate are not read by the brake")


def _path(case: Source, where: str) -> None:
    poses, queries = case.take("vertices", -1, 3), case.take("query_s", -1)
    path, at = make_path(poses), np.empty((len(queries), 3))
    for progress, pose in zip(queries.tolist(), at, strict=True):
        rollout.read_pose(path, progress, pose)
    projection = [project(path, *xy, 0)[0] for xy in case.take("query_xy", -1, 2).tolist()]
    ours: dict[str, Any] = {"progress": path.progress, "projection": projection, "poses": at}
    ours["offset_m"] = routes.offset_poses(poses, -1.0)
    ours["offset_p"] = routes.offset_poses(poses, 1.0)
    for row, (low, high) in enumerate(case.take("substring_iv", -1, 2).tolist()):
        line = path.xy[slice(*window(path, low, high))]
        if len(line) < 2:
            ends = np.clip([low, high], 0.0, path.progress[-1]).tolist()
            line = np.array(substring(shapely.LineString(path.xy), *ends).coords)
        ours[f"substring_{row}"] = line
    case.match(where, ours, {"progress": TOLERANCE, "projection": TOLERANCE, "": COORDINATES})


def _graph_search(case: Source, where: str) -> None:
    is_forward = case["kind"] != "bfs_roadblock" or case["forward"]
    after: list[list[int]] = [[] for _ in range(case["n"])]
    for edge in case["edges"]:
        start, end = edge if is_forward else edge[::-1]
        after[start].append(end)
    if case["kind"] == "bfs_roadblock":
        goals = {int(target) for target in case["targets"]}
        found = search_levels(after.__getitem__, int(case["start"]), goals, case["max_depth"])
    else:
        allowed = set(map(int, case["candidates"]))
        lengths, blocks = (case.take(name, case["n"]).tolist() for name in ("length", "block"))
        found = search_cheapest(
            case["start"],
            lambda lane: [n for n in after[lane] if n in allowed],
            lengths.__getitem__,
            lambda lane: blocks[lane] == case["target_block"],
        )
    path = [str(node) for node in (found.path if is_forward else found.path[::-1])]
    case.match(where, {"found": found.found, "path": path}, quantity=case["kind"])


def _compare_route(case: Source, where: str, scenario: Scenario) -> None:
    road, ego = scenario.map, np.zeros(NUM_STATE)
    case.note("label", "route_name", "pose_name")
    ego[:3] = case["rear_axle"]
    route = routes.start_route(road, tuple(case["route"]), ego, scenario.token)
    center = center_poses(ego[:3])
    selected = select_areas(road, center[0], center[1], DEFAULT.map_radius)
    areas, errors = routes.lanes_at(road, route, selected, ego)
    ordered = routes.in_index_order(route, selected, areas)
    lane = routes.current_lane(road, route, selected, ego, center, ego_box(PACIFICA))
    line = centerline(road, routes.follow_route(road, route.corrected, lane).path)
    names = {"road": road, "route": route, "ordered": ordered, "lane": lane, "line": line}
    names["errors"] = [errors[areas.index(area)] for area in ordered]
    TABLES["routes"].match(case, where, path=make_path(line), **names)


def _compare_idm(call: Source, where: str, scenario: Scenario) -> None:
    """Inputs and plan of nuPlan's IDM planner, which was called once before."""
    first, iteration = call["first_call_iteration"], call["iteration"]
    if not all(0 <= index < scenario.num_iterations for index in (first, iteration)):
        raise DataError("no such iteration")
    planner, road = Idm(), scenario.map
    planner.reset(scene_info(scenario))
    planner.plan(observe_log(scenario, first, samples=1))
    seen = observe_log(scenario, iteration, samples=1)
    centers, speeds = planner.roll_out(seen)
    reds = [name for name, status in seen.lights.listed(0) if status == LightStatus.RED]
    TABLES["inputs"].match(call, where, scenario=scenario, seen=seen, reds=sorted(reds))
    tracks = seen.tracks
    index = sorted(np.flatnonzero(tracks.valid[0]).tolist(), key=tracks.tokens.__getitem__)
    columns = object_columns(tracks, np.zeros(len(index), np.int64), np.array(index, np.int64))
    kinds = [kind.lower() for kind in columns["type"]]
    things = sorted(call.each("objects"), key=lambda thing: str(thing["token"]))
    listed = {name: [thing[name] for thing in things] for name in TABLES["objects"].rows}
    theirs = Source(call.name, "field", listed, call.report)
    TABLES["objects"].match(theirs, where, columns=columns, kinds=kinds)
    path, times = planner.path, seen.time_us + STEP_US * np.arange(STEPS + 1)
    assert path is not None
    end = [path.end, *path.driven.xy[-1], wrap_angle(float(path.driven.heading[-1]))]
    states = np.column_stack([times, centers, speeds])
    TABLES["plan"].match(call, where, road=road, planner=planner, end=end, states=states)


CHECKS = {
    **{"idm.npz": _idm, "tracker_sim.npz": _tracker, "comfort.npz": _comfort},
    **{"emergency_brake.npz": _emergency_brake, "path.npz": _path},
    "graph_search.json": _graph_search,
}
verify_routes = partial(verify_cases, _compare_route)
verify_idm_calls = partial(verify_cases, _compare_idm)
