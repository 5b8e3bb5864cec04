"""Parts of PDM-Closed that need no map: one function per file of the `kernels` folder."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.errors import DataError
from shiftsim.geometry.polylines import make_path, project, window
from shiftsim.planners.pdm import rollout, step
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.route import offset_poses
from shiftsim.planners.proposals.comfort import SIGNALS, comfort
from shiftsim.planners.proposals.tracker import SCORED, drive_proposals
from shiftsim.planners.routes.graph import search_cheapest, search_levels
from shiftsim.verify.files import TOLERANCE, Source, read_arrays, read_json, verify_files
from shiftsim.verify.pdm.steps import verify_step, verify_summary
from shiftsim.verify.report import Report
from shiftsim.world.state import NUM_STATE, PACIFICA, center_poses

COORDINATES = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
SIGNAL_TOLERANCE = 1e-6  # comfort signals: rounded to 8 decimals, then differentiated


def verify_kernels(folder: Path, report: Report) -> None:
    """Compare every file of the folder."""
    facts: dict[str, dict[str, Any]] = {}
    parts: dict[str, Callable[[Path], object]] = {
        **{f"{stem}.npz": partial(_verify_file, report, part) for stem, part in CHECKS.items()},
        "graph_search.json": partial(_graph_search, report),
        "step_core_summary.json": partial(verify_summary, report, facts),  # sorted behind the steps
        "step_*.json": partial(verify_step, report, facts),
        "step_*.npz": lambda path: path.with_suffix(".json").stat(),  # must have its inputs
    }
    verify_files(folder, report, parts)
    if facts and not (folder / "step_core_summary.json").exists():
        report.skip("file kernels/step_core_summary.json is missing")


def _verify_file(report: Report, part: Callable[[Source], None], path: Path) -> None:
    file = read_arrays(path, report)
    part(file)
    file.finish()


def _idm(file: Source) -> None:
    limits = file.take("speed_limit_mps", -1)
    limits = np.where(np.isnan(limits), DEFAULT.fallback_velocity, limits)
    targets = np.array(DEFAULT.speed_fractions)[file.take("policy_idx", len(limits))] * limits
    before = file.take("prev_progress_velocity", len(limits), 2)
    leads = file.take("lead_progress_velocity_rear", len(limits), 3)
    ours = np.empty((len(limits), 2))
    for case in zip(before, leads, targets, ours, strict=True):
        rollout.follow(*case[:3], DEFAULT.following, case[3])
    file.match_rows({"next_progress_velocity": ours}, TOLERANCE)


def _tracker(file: Source) -> None:
    poses = file.take("proposal_poses", -1, -1, SCORED + 1, 3)
    egos = file.take("ego_state", len(poses), NUM_STATE)
    driven = [drive_proposals(*case) for case in zip(poses, egos, strict=True)]
    names = ("velocity_profile", "curvature_profile", "simulated_states")
    file.match_rows(dict(zip(names, zip(*driven, strict=True), strict=True)), TOLERANCE)


def _comfort(file: Source) -> None:
    signals, bounded = comfort(file.take("states", -1, SCORED + 1, NUM_STATE), DEFAULT.comfort)
    ours = dict(zip(SIGNALS, signals.transpose(1, 0, 2), strict=True))
    file.match_rows({"is_comfortable": bounded, **ours}, SIGNAL_TOLERANCE)
    file.note("states: all but heading, ax and ay are not read by the test")


def _emergency_brake(file: Source) -> None:
    states = file.take("ego_state", -1, NUM_STATE)
    ours = [center_poses(step.brake_poses(ego, PACIFICA))[::20] for ego in states]
    file.match_rows({"center_poses_every_2s": ours}, COORDINATES)
    file.note("ego_state: all but pose, vx, ax and yaw rate are not read by the brake")


def _path(file: Source) -> None:
    for case in sorted({int(name.split("_")[0]) for name in file}):
        given = file.below(f"{case}_")
        poses, queries = given.take("vertices", -1, 3), given.take("query_s", -1)
        path, at = make_path(poses), np.empty((len(queries), 3))
        for progress, pose in zip(queries.tolist(), at, strict=True):
            rollout.read_pose(path, progress, pose)
        points = given.take("query_xy", -1, 2).tolist()
        ours = {
            "progress": path.progress,
            "projection": [project(path, x, y, 0)[0] for x, y in points],
            "poses": at,
            "offset_m": offset_poses(poses, -1.0),
            "offset_p": offset_poses(poses, 1.0),
        }
        for row, (low, high) in enumerate(given.take("substring_iv", -1, 2).tolist()):
            first, last = window(path, low, high)
            line = path.xy[first:last]
            if len(line) < 2:
                ends = np.clip([low, high], 0.0, path.progress[-1]).tolist()
                line = np.array(substring(shapely.LineString(path.xy), *ends).coords)
            ours[f"substring_{row}"] = line
        along = dict.fromkeys(("progress", "projection"), TOLERANCE)
        given.match(f"case {case}", ours, {**along, "": COORDINATES})


def _graph_search(report: Report, path: Path) -> None:
    for number, content in enumerate(read_json(path)):
        case = Source(content["kind"], "field", content, report)
        found, nodes = _search(case)
        ours = {"found": found, "path": [str(node) for node in nodes]}
        case.match(f"case {number}", ours)
        case.finish()


def _search(case: Source) -> tuple[bool, list[int]]:
    is_forward = case["kind"] != "bfs_roadblock" or case["forward"]
    after: list[list[int]] = [[] for _ in range(case["n"])]
    for edge in case["edges"]:
        start, end = edge if is_forward else edge[::-1]
        after[start].append(end)
    if case["kind"] == "bfs_roadblock":
        goals = {int(target) for target in case["targets"]}
        found = search_levels(after.__getitem__, int(case["start"]), goals, case["max_depth"])
        return found.found, found.path if is_forward else found.path[::-1]
    allowed, lengths, blocks = set(map(int, case["candidates"])), case["length"], case["block"]
    if not len(lengths) == len(blocks) == case["n"]:
        raise DataError("a lane has no length or no block")
    found = search_cheapest(
        case["start"],
        lambda lane: [n for n in after[lane] if n in allowed],
        lengths.__getitem__,
        lambda lane: blocks[lane] == case["target_block"],
    )
    return found.found, found.path


CHECKS = {
    **{"idm": _idm, "tracker_sim": _tracker, "comfort": _comfort},
    **{"emergency_brake": _emergency_brake, "path": _path},
}
