"""Parts of PDM-Closed that need no map: one function per file of the `kernels` folder."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.geometry.polylines import make_path, project, window
from shiftsim.planners.pdm import rollout, step
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.route import offset_poses
from shiftsim.planners.proposals.comfort import SIGNALS, comfort
from shiftsim.planners.proposals.tracker import SCORED, drive_proposals
from shiftsim.planners.routes.graph import Search, search_cheapest, search_levels
from shiftsim.verify.files import TOLERANCE, Source, verify_files
from shiftsim.verify.pdm.steps import verify_step, verify_summary
from shiftsim.verify.report import Report
from shiftsim.verify.tables import verify_cases
from shiftsim.world.state import NUM_STATE, PACIFICA, center_poses

COORDINATES = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
SIGNAL_TOLERANCE = 1e-6  # comfort signals: rounded to 8 decimals, then differentiated


def verify_kernels(folder: Path, report: Report) -> None:
    """Compare every file of the folder."""
    facts: dict[str, dict[str, Any]] = {}
    parts: dict[str, Callable[[Path], object]] = {
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
        rollout.read_pose(path, progress, np.full(3, np.nan), pose)
    points = case.take("query_xy", -1, 2).tolist()
    ours = {
        "progress": path.progress,
        "projection": [project(path, x, y, 0)[0] for x, y in points],
        "poses": at,
        "offset_m": offset_poses(poses, -1.0),
        "offset_p": offset_poses(poses, 1.0),
    }
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
    search = _search_blocks if case["kind"] == "bfs_roadblock" else _search_lanes
    found = search(case, after)
    path = [str(node) for node in (found.path if is_forward else found.path[::-1])]
    case.match(where, {"found": found.found, "path": path}, quantity=case["kind"])


def _search_blocks(case: Source, after: list[list[int]]) -> Search:
    goals = {int(target) for target in case["targets"]}
    return search_levels(after.__getitem__, int(case["start"]), goals, case["max_depth"])


def _search_lanes(case: Source, after: list[list[int]]) -> Search:
    allowed = set(map(int, case["candidates"]))
    lengths, blocks = (case.take(name, case["n"]).tolist() for name in ("length", "block"))
    return search_cheapest(
        case["start"],
        lambda lane: [n for n in after[lane] if n in allowed],
        lengths.__getitem__,
        lambda lane: blocks[lane] == case["target_block"],
    )


CHECKS = {
    **{"idm.npz": _idm, "tracker_sim.npz": _tracker, "comfort.npz": _comfort},
    **{"emergency_brake.npz": _emergency_brake, "path.npz": _path},
    "graph_search.json": _graph_search,
}
