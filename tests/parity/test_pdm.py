"""PDM-Closed and nuPlan's IDM planner against the official code: kernels, steps, routes, calls.

Kernels need no map; recorded routes and calls are made again from the log and map of a scene. The
closed loops of the folder are also simulated and scored (`test_nuplan_runs.py`).
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
import shapely
from json_worlds import kind_of
from parity_cases import (
    TOLERANCE,
    Cases,
    File,
    Scenes,
    change_array,
    change_column,
    change_json,
    ids,
    name_unknown,
    noticed,
    open_scenes,
    open_tables,
    read_file,
)
from shapely.ops import substring

from shiftsim.geometry import polylines
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import make_path, project, window
from shiftsim.planners.idm import STEP_US as IDM_STEP_US
from shiftsim.planners.idm import STEPS as IDM_STEPS
from shiftsim.planners.idm import Idm
from shiftsim.planners.pdm import forecast, rollout
from shiftsim.planners.pdm import planner as steps_module
from shiftsim.planners.pdm import route as routes
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.planner import PdmClosed, Seen, Step, choose
from shiftsim.planners.pdm.scorer import TTC_STEPS, Place, Scores, score, weighted_mean
from shiftsim.planners.proposals.areas import areas_of, select_areas
from shiftsim.planners.proposals.comfort import SIGNALS, comfort
from shiftsim.planners.proposals.contacts import Obstacles
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.proposals.tracker import SCORED, STEP_US, STEPS, drive_proposals
from shiftsim.planners.routes.graph import centerline, search_cheapest, search_levels
from shiftsim.planners.routes.lead import red_lights
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.verify.rollouts import BOX_COLUMNS, RecordedRun, object_columns
from shiftsim.world.layers import make_layer, make_polygons
from shiftsim.world.state import (
    HEADING,
    NUM_STATE,
    PACIFICA,
    LightStatus,
    center_poses,
    tracks_of_boxes,
)

pytestmark = [pytest.mark.golden, pytest.mark.reference("pdm")]
GOLDEN = places.GOLDEN / "pdm"

COORDINATES = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
SIGNAL = 1e-6  # comfort signals: rounded to 8 decimals, then differentiated
UNSTABLE_BEARING = 1e-7  # rad from dead ahead or dead behind
STORED = np.array([2e-5, 2e-5, 1e-6])  # m, m, rad: plans stored as 32 bit floats
ROLLED = 1e-6  # m, rad, m/s, …: arrays of a step; coordinates near 5e6 are spaced 1e-9
ASIDE = np.array([1e-6, 3e-6])  # m, moves what is exactly ahead or behind to a side


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    name_unknown(folder, cases, "routes.json", "idm_calls.json", "loop", "kernels")
    if (folder / "kernels").is_dir():
        known = [*KERNELS, "step_core_summary.json", "step_*.json", "step_*.npz"]
        name_unknown(folder / "kernels", cases, *known, where="kernels/")


# --- kernels


def compare_idm_kernel(case: File, where: str) -> None:
    limit = case["speed_limit_mps"]
    limit = DEFAULT.fallback_velocity if np.isnan(limit) else limit
    target = DEFAULT.speed_fractions[case["policy_idx"]] * limit
    before = case.take("prev_progress_velocity", 2)
    lead = case.take("lead_progress_velocity_rear", 3)
    after = rollout.follow(*before, tuple(lead), target, DEFAULT.following)
    case.match(where, {"next_progress_velocity": after}, TOLERANCE)


def compare_tracker(case: File, where: str) -> None:
    poses, ego = case.take("proposal_poses", -1, SCORED + 1, 3), case.take("ego_state", NUM_STATE)
    names = ("velocity_profile", "curvature_profile", "simulated_states")
    case.match(where, dict(zip(names, drive_proposals(poses, ego), strict=True)), TOLERANCE)


def compare_comfort(case: File, where: str) -> None:
    signals, bounded, _ = comfort(case.take("states", SCORED + 1, NUM_STATE)[None], DEFAULT.comfort)
    ours = {"is_comfortable": bounded[0], **dict(zip(SIGNALS, signals[0], strict=True))}
    case.match(where, ours, SIGNAL)
    case.note("states: all but heading, ax and ay are not read by the test")


def compare_emergency_brake(case: File, where: str) -> None:
    poses = center_poses(steps_module.brake_poses(case.take("ego_state", NUM_STATE), PACIFICA))
    case.match(where, {"center_poses_every_2s": poses[::20]}, COORDINATES)
    case.note("ego_state: all but pose, vx, ax and yaw rate are not read by the brake")


def compare_path(case: File, where: str) -> None:
    poses, queries = case.take("vertices", -1, 3), case.take("query_s", -1)
    path = make_path(poses)
    at = np.array([rollout.read_pose(path, progress) for progress in queries.tolist()])
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


def compare_graph_search(case: File, where: str) -> None:
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


KERNELS = {
    "idm.npz": compare_idm_kernel,
    "tracker_sim.npz": compare_tracker,
    "comfort.npz": compare_comfort,
    "emergency_brake.npz": compare_emergency_brake,
    "path.npz": compare_path,
    "graph_search.json": compare_graph_search,
}


@pytest.mark.parametrize("name", KERNELS)
def test_kernel(folder: Path, name: str, cases: Cases) -> None:
    if (path := folder / "kernels" / name).is_file():
        compare_kernel(path, cases)


def compare_kernel(path: Path, cases: Cases) -> None:
    for number, case in enumerate(read_file(path, cases, path.stem).cases()):
        KERNELS[path.name](case, f"{path.stem} {number}")


# --- recorded steps, with all their inputs


def test_steps(folder: Path, cases: Cases) -> None:
    if (folder / "kernels").is_dir():
        compare_steps(folder / "kernels", cases)


def compare_steps(folder: Path, cases: Cases) -> None:
    """Plan recorded steps again; `step_core_summary.json` lists what they came to."""
    summary, facts = folder / "step_core_summary.json", {}
    for path in sorted(folder.glob("step_*.npz")):
        inputs = read_file(path.with_suffix(".json"), cases, "step_NNN.json")
        facts[path.stem] = compare_step(inputs, read_file(path, cases, "PDM"), path.stem)
    if not summary.is_file():
        if facts:
            cases.skip("file kernels/step_core_summary.json is missing")
        return
    for entry in read_file(summary, cases).each("rows"):
        entry.name = summary.name
        entry.note("label", "case")
        name = entry["case"]
        entry.match(name, facts[name], {"best_score": 1e-9}, quantity="PDM summary")
        entry.finish()


def compare_step(inputs: File, file: File, where: str) -> dict[str, Any]:
    """Compare one step; what the summary says of it."""
    ego, limit, planner = np.array(inputs["ego_state"]), inputs["speed_limit_mps"], PdmClosed()
    paths = planner.follow(np.array(inputs["centerline"], np.float64))
    seen = see(inputs, ego, paths.at(0))
    step = planner.step_in(seen, paths, ego, np.nan if limit is None else limit, PACIFICA)
    arrays = step_arrays(step)
    ours = {
        "map_tokens": seen.tokens,
        "map_boxes": seen.forecast.others.boxes[[0, 5, 20]],  # at the time indices 0, 11, 40
        "collided_ids": planner.collided,
        "trajectory_time_us": int(inputs["ego_time_us"]) + STEP_US * np.arange(STEPS + 1),
        "proposal_poses": arrays["proposals"],
        **{name: arrays[name] for name in ("idm", "lead", "simulated", "ego_areas")},
    }
    file.match(where, ours, ROLLED)
    rows = [file["scores"], *file.take("multi", 3, -1), *file.take("weighted", 3, -1)]
    rows += [file[name] for name in ("progress_raw", "collision_idx", "ttc_idx")]
    columns = dict(zip(score_columns(step.scores), rows, strict=True))
    theirs = File("PDM", "score", columns, file.report)
    if compare_scores(where, ego, seen, step, theirs, file):
        file.match(where, {"trajectory_rear": step.poses}, ROLLED)
    file.note("compared where the same proposal is chosen", "trajectory_rear")
    scores = step.scores
    facts = {
        "best": step.best,
        "braked": step.braked,
        "best_score": scores.total.max(),
        "n_objects": len(inputs["objects"]),
        "red": len(inputs["red_light_lane_ids"]),
        "collided": len(planner.collided),
        "zero_scores": int((scores.total == 0.0).sum()),
        "at_fault": int(np.isfinite(scores.collision_index).sum()),
        "ttc": int(np.isfinite(scores.ttc_index).sum()),
    }
    inputs.finish()
    file.finish()
    return facts


def see(inputs: File, ego: np.ndarray, line: polylines.Path) -> Seen:
    center, things, parts = center_poses(ego[:3]), inputs.each("objects"), inputs.each("drivable")
    values = np.array([[thing[name] for name in BOX_COLUMNS] for thing in things], np.float64)
    kinds, names = [kind_of(thing) for thing in things], [thing["token"] for thing in things]
    tracks = tracks_of_boxes(values.reshape(1, -1, 7), kinds, names)
    chosen = forecast.select_tracks(tracks, center[0], center[1], set(), DEFAULT)
    shapes = [shapely.Polygon(part["exterior"]) for part in parts]
    drivable, red = make_layer([part["id"] for part in parts], shapes), inputs["red_light_lane_ids"]
    lights = red_lights([], [drivable.rings(drivable.index[name])[0] for name in red])
    tokens = [tracks.tokens[i] for i in chosen] + [forecast.LIGHT_TOKEN + name for name in red]
    crossings = make_polygons([[np.array(r, np.float64)] for r in inputs["intersections"]])
    numbers, on_route = np.arange(len(parts)), np.array([p["on_route"] for p in parts], np.bool_)
    place = Place(areas_of(drivable.polygons, on_route, numbers), numbers, crossings, line)
    return Seen(forecast.make_forecast(tracks, chosen, lights), tokens, place, -1)


def step_arrays(step: Step) -> dict[str, np.ndarray]:
    """Proposals, leads, driven states and areas of a step by the names of the reference."""
    proposals, shape = step.proposals, step.driven.states.shape[:2]
    # the best proposal goes on to 8 s; what is recorded ends where proposals are compared
    rolled = {"proposals": proposals.poses, "idm": proposals.motion, "lead": proposals.leads}
    arrays = {n: array[:, :, : SCORED + 1].reshape(*shape, -1) for n, array in rolled.items()}
    return {**arrays, "simulated": step.driven.states, "ego_areas": step.scores.flags}


def score_columns(scores: Scores) -> dict[str, Any]:
    """Scores of all proposals by the names of the reference."""
    return {
        "score": scores.total,
        "no_collision": scores.no_collision,
        "drivable_area": scores.drivable,
        "driving_direction": scores.direction,
        "progress": scores.progress,
        "ttc": scores.ttc,
        "comfort": scores.comfort,
        "progress_raw": scores.raw_progress,
        "collision_idx": scores.collision_index,
        "ttc_idx": scores.ttc_index,
    }


def compare_scores(
    where: str, ego: np.ndarray, seen: Seen, step: Step, proposals: File, chosen: File
) -> bool:
    """Compare scores, choice and brake decision of an ego (11,); whether the plan is the same."""
    ours = settled(where, seen, step, proposals)
    best, braked = choose(ours, ego, DEFAULT)
    atol = {"score": 1e-9, "progress": 1e-9, "progress_raw": 1e-6}
    proposals.match(where, score_columns(ours), atol, quantity="PDM")
    chosen.match(where, {"best": best, "braked": braked}, quantity="PDM")
    return (step.best, step.braked) == (chosen["best"], chosen["braked"])


def settled(where: str, seen: Seen, step: Step, theirs: File) -> Scores:
    """Our scores, with those times to collision of theirs that hang on an unstable bearing.

    The bearing is an arccos of a number that may round beyond 1 where an object is exactly ahead or
    behind; then it is overlooked. Either outcome is accepted there, and named.
    """
    ours, index = step.scores, theirs["ttc_idx"]
    if (ours.ttc_index == index).all():
        return ours
    states, others = step.driven.states, seen.forecast.others
    counted = others._replace(centroids=others.centroids + ASIDE)
    overlooked = others._replace(ignored=others.ignored | in_line(states, others))
    for boxes in (counted, overlooked):
        other = score(states, seen.place, boxes, ego_box(PACIFICA), DEFAULT)
        rows = (ours.ttc_index != index) & (other.ttc_index == index)
        for row in np.flatnonzero(rows).tolist():
            note = "an object exactly ahead or behind"
            theirs.report.note(f"PDM ttc at {where}, proposal {row}: {note}")
        ttc, ttc_index = np.where(rows, (other.ttc, index), (ours.ttc, ours.ttc_index))
        ours = ours._replace(ttc=ttc, ttc_index=ttc_index)
    factor = ours.no_collision * ours.drivable * ours.direction
    return ours._replace(
        total=factor * weighted_mean(ours.progress, ours.ttc, ours.comfort, DEFAULT)
    )


def in_line(states: np.ndarray, others: Obstacles) -> np.ndarray:
    """(N,) what is exactly ahead of the ego or behind it, from any of its states (P, T, 11)."""
    cos, sin = np.cos(states[..., HEADING, None]), np.sin(states[..., HEADING, None])
    out, times = np.zeros(len(others.radii), np.bool_), np.arange(states.shape[1])
    for later in TTC_STEPS:
        away = others.centroids[(times + later) // 2] - states[:, :, None, :2]
        aside = np.abs(cos * away[..., 1] - sin * away[..., 0])
        out |= (aside < UNSTABLE_BEARING * np.linalg.norm(away, axis=-1)).any(axis=(0, 1))
    return out


# --- routes and calls, from the log and map of a scene


def scene_cases(path: Path, scenes: Scenes, cases: Cases) -> Any:
    """The cases of a list with their scenes; those of other scenes are not covered."""
    for number, case in enumerate(read_file(path, cases, path.stem).cases()):
        if (scene := case["scene"]) in scenes.entries:
            yield case, f"{path.stem} {number} {scene}", scenes[scene]
        else:
            cases.skip(f"{path.name}: scene {scene}, which is not at hand")
            case.used.update(case)


@pytest.mark.files("routes.json")
def test_routes(path: Path, scenes: Scenes, cases: Cases) -> None:
    for case, where, scenario in scene_cases(path, scenes, cases):
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
        ours = {
            "start_block": ids(road.blocks, route.start.block),
            "start_candidates": ids(road.blocks, route.start.others),
            "corrected": ids(road.blocks, route.corrected),
            "route_lanes": ids(road.edges, route.lanes),
            "intersecting_lanes": ids(road.edges, route.areas.lane[ordered]),
            "heading_errors": [errors[areas.index(area)] for area in ordered],
            "current_lane": ids(road.edges, lane),
            "n_centerline": len(line),
            "centerline_first": line[0],
            "centerline_last": line[-1],
            "centerline_length": make_path(line).progress[-1],
        }
        case.match(where, ours, TOLERANCE, quantity="PDM")


@pytest.mark.files("idm_calls.json")
def test_idm_calls(path: Path, scenes: Scenes, cases: Cases) -> None:
    """Inputs and plan of nuPlan's IDM planner, which was called once before."""
    for call, where, scenario in scene_cases(path, scenes, cases):
        planner, road = Idm(), scenario.map
        planner.reset(scene_info(scenario))
        planner.plan(observe_log(scenario, call["first_call_iteration"], samples=1))
        seen = observe_log(scenario, call["iteration"], samples=1)
        centers, speeds = planner.roll_out(seen)
        reds = [name for name, status in seen.lights.listed(0) if status == LightStatus.RED]
        inputs = {  # what the call recorded of its inputs is also in the log
            "route": scenario.route,
            "time_us": seen.time_us,
            "ego_center": seen.ego.center,
            "ego_rear_velocity": seen.ego.values[3:5],
            "red_connectors": reds,
        }
        # the order of the connectors means nothing
        call.match(where, inputs, TOLERANCE, quantity="IDM input", unordered=("red_connectors",))
        tracks = seen.tracks
        index = sorted(np.flatnonzero(tracks.valid[0]).tolist(), key=tracks.tokens.__getitem__)
        columns = object_columns(tracks, np.zeros(len(index), np.int64), np.array(index, np.int64))
        columns["token"] = columns.pop("track_token")
        columns["type"] = [kind.lower() for kind in columns["type"]]
        del columns["iteration"]
        things = sorted(call.each("objects"), key=lambda thing: str(thing["token"]))
        listed = {name: [thing[name] for thing in things] for name in columns}
        theirs = File(call.name, "field", listed, cases)
        theirs.match(where, columns, TOLERANCE, quantity="IDM input")
        driven, times = planner.path, seen.time_us + IDM_STEP_US * np.arange(IDM_STEPS + 1)
        assert driven is not None
        heading = wrap_angle(float(driven.driven.heading[-1]))
        plan = {
            "edges": ids(road.edges, planner.route_plan.path),
            "path_found": planner.route_plan.found,
            "target_velocity": planner.target_velocity,
            "path_points": len(driven.driven.progress),
            "path_end": [driven.end, *driven.driven.xy[-1], heading],
            "polyline_length": driven.line_arc[-1],
            "trajectory": np.column_stack([times, centers, speeds]),
        }
        call.match(where, plan, TOLERANCE, quantity="IDM")


# --- calls in closed loops


def test_loops(folder: Path, scenes: Scenes, cases: Cases) -> None:
    if (folder / "loop").is_dir():
        compare_calls(folder / "loop", scenes, cases)


def compare_calls(folder: Path, scenes: Scenes, cases: Cases) -> None:
    """Make every planning call of closed loops again from the recorded ego state."""
    if not scenes.entries:
        cases.skip("loop: the logs and maps of the scenes are not at hand")
        return
    tables = open_tables(folder, cases, "ego", "objects", "steps", "proposals")
    egos, objects, steps, proposals = tables.values()
    static = read_file(folder / "static.json", cases, "static.json")
    for key in egos.of_mode():
        call, where = key[:2], " ".join(key[:2])
        run = RecordedRun(scenes[key[0]], egos[key], objects[key], key[1])
        file = read_file(folder / f"{'_'.join(call)}.npz", cases, "PDM")
        planner = compare_loop(where, run, steps[call], proposals[call], file)
        road = run.scenario.map
        facts = {
            "scenario_route_ids": run.scenario.route,
            "route_ids": ids(road.blocks, planner.route.corrected),
            "route_lane_ids": ids(road.edges, planner.route.lanes),
            "centerline": planner.centerline,
            "centerline_length": planner.paths.progress[0, -1],
            "ego_state": None,
        }
        theirs = static.each(key[0])[0].each(key[1])[0]
        theirs.match(where, facts, TOLERANCE, quantity="PDM static")
    steps.finish()
    proposals.finish()
    if cases.mode is None:
        static.finish()
    tables_of_runs = "ego objects route collisions scores metrics statistics time_series".split()
    known = [f"{name}.parquet" for name in (*tables_of_runs, "steps", "proposals")]
    runs = [f"{'_'.join(key[:2])}.npz" for key in egos]
    name_unknown(folder, cases, "static.json", *known, *runs, where="loop/")


def compare_loop(
    where: str, run: RecordedRun, steps: File, proposals: File, file: File
) -> PdmClosed:
    """Compare every call of one run; the planner after the last one."""
    planner, road = PdmClosed(), run.scenario.map
    planner.reset(scene_info(run.scenario, planner=planner))
    count, per_call = len(run.ego), proposals.num_rows // len(run.ego)
    calls, numbers = np.arange(count), np.arange(per_call)
    steps.match(where, {"iteration": calls})
    rows = {"proposal": np.tile(numbers, count), "iteration": np.repeat(calls, per_call)}
    proposals.match(where, rows)
    times = steps["time_us"][:, None] + STEP_US * np.arange(STEPS + 1)
    file.match(where, {"trajectory_time_us": times})
    plans = file.take("trajectory", count, STEPS + 1, 3).astype(np.float64)
    plans[:, :, :2] += file.take("trajectory_origin", 3)[:2]
    for index, plan in enumerate(plans):
        at, observation = f"{where} iteration {index}", run.at(index)
        step, seen = planner.step(observation), planner.seen
        assert seen is not None
        row, theirs = steps.at(index), proposals.at(numbers + index * per_call)
        ours = {
            "time_us": observation.time_us,
            "best_score": theirs["score"].max(),  # of its proposals
            "current_lane_id": ids(road.edges, seen.lane),
            "speed_limit_mps": road.speed_limits[seen.lane],
            "collided_ids": ",".join(planner.collided),
            "n_map_tokens": len(seen.tokens),
            "n_drivable_tokens": len(seen.place.selected),
        }
        row.match(at, ours, {"best_score": 1e-9}, quantity="PDM step")
        ends = step.driven.states[:, -1]  # the last states that are simulated
        columns = {"x": 0, "y": 1, "heading": 2, "vx": 3, "ax": 5, "steering": 7}
        driven = {f"sim_{name}": ends[:, column] for name, column in columns.items()}
        theirs.match(at, driven, ROLLED, quantity="PDM")
        if compare_scores(at, run.ego[index], seen, step, theirs, row):
            file.report.compare("PDM plan", at, step.poses, plan, atol=STORED)
        if f"proposals_{index}" in file:
            names = [*road.edges.ids, *road.car_parks.ids]
            areas = [names[area] for area in seen.place.selected.tolist()]
            arrays = {"map_tokens": seen.tokens, "drivable_tokens": areas, **step_arrays(step)}
            file.match(at, {f"{name}_{index}": arrays[name] for name in arrays}, ROLLED)
    file.finish()
    return planner


# --- proof that a changed value is noticed


@pytest.fixture
def golden_scenes(nuplan_reference: Path) -> Scenes:
    return open_scenes(nuplan_reference)


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        ("idm", "next_progress_velocity"),
        ("tracker_sim", "velocity_profile"),
        ("tracker_sim", "simulated_states"),
        ("comfort", "is_comfortable"),
        ("emergency_brake", "center_poses_every_2s"),
        ("path", "1_poses"),
        ("path", "2_substring_4"),
        ("graph_search", "path"),
    ],
)
def test_a_changed_kernel_is_noticed(stem: str, name: str, tmp_path: Path) -> None:
    path, cases = tmp_path / f"{stem}.{'json' if stem == 'graph_search' else 'npz'}", Cases()
    if stem == "graph_search":
        change_json(GOLDEN / "kernels" / path.name, path, 3, name)
    else:
        change_array(GOLDEN / "kernels" / path.name, path, name, amount=1e-3)
    assert noticed(compare_kernel, path, cases)


@pytest.mark.parametrize(
    "name",
    [
        *("map_tokens", "map_boxes", "proposal_poses", "idm", "lead", "simulated", "ego_areas"),
        *("multi", "weighted", "progress_raw", "scores", "best", "braked", "trajectory_rear"),
        *("trajectory_time_us", "ego_state", "speed_limit_mps", "objects"),
    ],
)
def test_a_changed_step_is_noticed(name: str, tmp_path: Path) -> None:
    cases = Cases()
    for path in (GOLDEN / "kernels").glob("step_004.*"):
        shutil.copy(path, tmp_path)
    if name in json.loads((tmp_path / "step_004.json").read_text()):
        keys = {"ego_state": (name, 0), "objects": (name, 0, "x")}.get(name, (name,))
        change_json(tmp_path / "step_004.json", tmp_path / "step_004.json", *keys, amount=0.01)
    else:
        path = tmp_path / "step_004.npz"
        with np.load(path) as archive:
            finite = np.flatnonzero(np.ones(archive[name].size))
            if archive[name].dtype.kind == "f":
                finite = np.flatnonzero(np.isfinite(archive[name].reshape(-1)))
        change_array(path, path, name, int(finite[-1]), amount=1e-3)
    assert noticed(compare_steps, tmp_path, cases)


@pytest.mark.parametrize(
    "name", ["start_block", "corrected", "heading_errors", "current_lane", "centerline_length"]
)
def test_a_changed_route_is_noticed(name: str, tmp_path: Path, golden_scenes: Scenes) -> None:
    path, cases = tmp_path / "routes.json", Cases()
    case = json.loads((GOLDEN / "routes.json").read_text())[0]
    path.write_text(json.dumps([case]))
    change_json(path, path, 0, name)
    assert noticed(test_routes, path, golden_scenes, cases)


@pytest.mark.parametrize(
    "keys",
    [
        *(("edges",), ("path_found",), ("target_velocity",), ("path_end", 3), ("trajectory",)),
        *(("objects", 0, "width"), ("route",), ("ego_center", 2), ("time_us",)),
    ],
)
def test_a_changed_call_is_noticed(keys: Any, tmp_path: Path, golden_scenes: Scenes) -> None:
    path, cases = tmp_path / "idm_calls.json", Cases()
    calls = json.loads((places.GOLDEN / "planners" / path.name).read_text())
    path.write_text(json.dumps(calls[1:2]))
    change_json(path, path, 0, *keys, amount=1e-6)
    assert noticed(test_idm_calls, path, golden_scenes, cases)


def test_the_order_of_red_connectors_means_nothing(tmp_path: Path, golden_scenes: Scenes) -> None:
    calls = json.loads((places.GOLDEN / "planners" / "idm_calls.json").read_text())
    call = max(calls, key=lambda one: len(one["red_connectors"]))
    path = tmp_path / "idm_calls.json"
    for names, is_equal in ((call["red_connectors"][::-1], True), (["1"], False)):
        cases = Cases()
        path.write_text(json.dumps([{**call, "red_connectors": names}]))
        test_idm_calls(path, golden_scenes, cases)
        assert bool(cases.mismatches) is not is_equal


@pytest.mark.parametrize(
    ("table", "name"),
    [
        *(("steps", name) for name in ("best", "braked", "current_lane_id", "n_map_tokens")),
        *(("proposals", name) for name in ("score", "ttc", "sim_x", "drivable_area")),
        *(("npz", name) for name in ("trajectory", "simulated_0", "drivable_tokens_0")),
        *(("static", name) for name in ("route_ids", "centerline")),
    ],
)
def test_a_changed_loop_is_noticed(
    table: str, name: str, tmp_path: Path, golden_scenes: Scenes
) -> None:
    folder, cases = Path(shutil.copytree(GOLDEN / "loop", tmp_path / "loop")), Cases()
    run = next(folder.glob("*.npz"))
    if table == "npz":
        change_array(run, run, name, amount=1e-3)
    elif table == "static":
        scene, _, challenge = run.stem.rpartition("_")
        change_json(folder / "static.json", folder / "static.json", scene, challenge, name)
    else:
        change_column(folder / f"{table}.parquet", folder / f"{table}.parquet", name, amount=0.01)
    assert noticed(compare_calls, folder, golden_scenes, cases)
