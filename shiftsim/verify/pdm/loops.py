"""Closed loops of PDM-Closed: every call made again from the recorded ego, then driven freely."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.proposals.tracker import STEP_US, STEPS
from shiftsim.sim.planner import scene_info
from shiftsim.verify.files import TOLERANCE, Groups, Source, read_arrays, read_json
from shiftsim.verify.nuplan.metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan.runs import CHALLENGES, Seen, verify_simulation
from shiftsim.verify.pdm.steps import STEP_TOLERANCE, Planned, compare_scores, step_arrays
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes
from shiftsim.world import state
from shiftsim.world.scenario import Scenario

PLAN_TOLERANCES = np.array([2e-5, 2e-5, 1e-6])  # m, m, rad: stored as 32 bit floats
_TABLES = (
    *("metrics", "statistics", "time_series", "route", "collisions", "scores", "objects", "ego"),
    *("steps", "proposals"),
)
_CALL = ("scene", "challenge")
_DRIVEN = {  # column of proposals.parquet → index in a state row
    "sim_x": state.X,
    "sim_y": state.Y,
    "sim_heading": state.HEADING,
    "sim_vx": state.VX,
    "sim_ax": state.AX,
    "sim_steering": state.STEERING,
}


def verify_loops(folder: Path, report: Report, scenes: Scenes, mode: str | None = None) -> None:
    """Compare every run (of one mode) of the `loop` folder."""
    verify_calls(folder, report, scenes, mode)
    logged = scenes.folder / "expected"
    verify_nuplan_metrics(folder, report, scenes, mode, logged=logged)
    verify_simulation(folder, report, scenes, mode, logged=logged)


def verify_calls(
    folder: Path, report: Report, scenes: Mapping[str, Scenario], mode: str | None = None
) -> None:
    """Make every planning call again from the recorded ego state."""
    egos, objects = (Groups(folder / f"{name}.parquet", report) for name in ("ego", "objects"))
    steps = Groups(folder / "steps.parquet", report, _CALL)
    proposals = Groups(folder / "proposals.parquet", report, _CALL)
    static = Source("static.json", "scene", read_json(folder / "static.json"), report)
    known = {f"{name}.parquet" for name in _TABLES} | {"static.json"}
    for key in egos:
        scene, challenge, _ = key
        where, arrays = f"{scene} {challenge}", folder / f"{scene}_{challenge}.npz"
        known.add(arrays.name)
        if mode not in (None, challenge):
            continue
        if scene not in scenes or challenge not in CHALLENGES:
            report.skip(f"closed loop {where}, whose scene or challenge is not known")
            continue
        with report.attempt("PDM loop", where):
            seen = Seen(scenes[scene], egos[key], objects[key], challenge)
            facts = static.each(scene)[0].each(challenge)[0]
            rows, scored = steps[key[:2]], proposals[key[:2]]
            _compare_calls(where, seen, rows, scored, facts, read_arrays(arrays, report, "PDM"))
    for table in (steps, proposals):
        table.finish(mode)
    if mode is None:
        static.finish()
    for path in sorted(folder.iterdir()):
        if path.name not in known:
            report.skip(f"file loop/{path.name}")


def _compare_calls(
    where: str, seen: Seen, steps: Source, proposals: Source, facts: Source, file: Source
) -> None:
    planner, report = PdmClosed(), file.report
    planner.reset(scene_info(seen.scenario, planner=planner))
    count = len(seen.ego)
    times = steps["time_us"][:, None] + STEP_US * np.arange(STEPS + 1)
    steps.match(where, {"iteration": np.arange(count)})
    per_call = proposals.num_rows // count
    numbers = {
        "proposal": np.tile(np.arange(per_call), count),
        "iteration": np.repeat(np.arange(count), per_call),
    }
    proposals.match(where, numbers)
    plans = file.take("trajectory", count, STEPS + 1, 3).astype(np.float64)
    plans[:, :, :2] += file.take("trajectory_origin", 3)[:2]
    for index, plan in enumerate(plans):
        at, observation = f"{where} iteration {index}", seen.at(index)
        step = planner.step(observation)
        sight, road = planner.seen, seen.scenario.map
        assert sight is not None
        planned = Planned(seen.ego[index], sight.tokens, sight.forecast, sight.place, step)
        rows, theirs = steps.at(index), proposals.at(np.arange(per_call) + index * per_call)
        ours: dict[str, Any] = {
            "time_us": observation.time_us,
            "current_lane_id": road.edges.ids[sight.lane],
            "speed_limit_mps": float(road.speed_limits[sight.lane]),
            "collided_ids": ",".join(planner.collided),
            "n_map_tokens": len(sight.tokens),
            "n_drivable_tokens": len(sight.place.selected),
        }
        rows.match(at, ours, quantity="PDM step")
        best = {"best_score": float(theirs["score"].max())}
        rows.match(at, best, TOLERANCE, quantity="PDM")
        ends = {column: step.driven.states[:, -1, number] for column, number in _DRIVEN.items()}
        theirs.match(at, ends, STEP_TOLERANCE, quantity="PDM")
        if compare_scores(at, planned, theirs, (int(rows["best"]), bool(rows["braked"]))):
            report.compare("PDM plan", at, step.poses, plan, atol=PLAN_TOLERANCES)
        if f"proposals_{index}" not in file:
            continue
        ids = [*road.edges.ids, *road.car_parks.ids]
        arrays = step_arrays(planned)
        arrays["proposals"] = arrays.pop("proposal_poses")
        tokens = {
            "map_tokens": sight.tokens,
            "drivable_tokens": [ids[area] for area in sight.place.selected.tolist()],
        }
        stored = {f"{name}_{index}": array for name, array in {**arrays, **tokens}.items()}
        file.match(at, stored, STEP_TOLERANCE)
    file.match(where, {"trajectory_time_us": times})
    file.finish()
    _compare_facts(where, seen, planner, facts)


def _compare_facts(where: str, seen: Seen, planner: PdmClosed, facts: Source) -> None:
    """Compare what is decided once per scenario."""
    road, route, line = seen.scenario.map, planner.route, planner.centerline
    assert route is not None
    assert line is not None
    ours = {
        "scenario_route_ids": list(seen.scenario.route),
        "route_ids": [road.blocks.ids[block] for block in route.corrected],
        "route_lane_ids": [road.edges.ids[edge] for edge in route.lanes.tolist()],
        "centerline": line,
        "centerline_length": float(make_path(line).progress[-1]),
    }
    facts.match(where, ours, TOLERANCE, quantity="PDM static")
    if "ego_state" in facts and facts["ego_state"] is None:
        facts.used.add("ego_state")
        facts.report.note("static.json: ego_state is null")
