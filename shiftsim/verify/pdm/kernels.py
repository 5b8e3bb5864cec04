"""Parts of PDM-Closed that need no map: one function per file of the `kernels` folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.errors import DataError, ShiftsimError
from shiftsim.geometry.paths import make_path, project, window
from shiftsim.planners.pdm.brake import brake_poses
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.rollout import follow, read_pose
from shiftsim.planners.pdm.route import offset_poses
from shiftsim.planners.proposals.comfort import SIGNALS, comfort
from shiftsim.planners.proposals.tracker import SCORED, drive_proposals
from shiftsim.planners.routes.search import search_cheapest, search_levels
from shiftsim.verify.array_file import EXACT, ArrayFile
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.pdm.steps import verify_step, verify_summary
from shiftsim.verify.report import Report
from shiftsim.world.state import NUM_STATE, PACIFICA, center_poses

COORDINATE_TOLERANCE = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
SIGNAL_TOLERANCE = 1e-6  # comfort signals: rounded to 8 decimals, then differentiated
_ERRORS = (
    *(ShiftsimError, OSError, BadZipFile, KeyError),
    *(ValueError, TypeError, IndexError, AttributeError),
)
_SEARCHES = {
    "bfs_roadblock": {"kind", "n", "edges", "start", "forward", "targets", "max_depth"},
    "lane_dijkstra": {
        *("kind", "n", "edges", "length", "block"),
        *("candidates", "start", "target_block"),
    },
}


def verify_kernels(folder: Path, report: Report) -> None:
    """Compare every file of the folder.

    Args:
        folder: The `kernels` folder.
        report: Receives the comparisons.
    """
    summary: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.iterdir()):
        try:
            if path.suffix == ".npz" and path.stem in _CHECKS:
                file = ArrayFile(path, report)
                _CHECKS[path.stem](file)
                file.finish()
            elif path.name == "graph_search.json":
                _graph_search(path, report)
            elif path.name.startswith("step_") and path.suffix == ".npz":
                summary[path.stem] = verify_step(path, report)
            elif path.name.startswith("step_") and path.suffix == ".json":
                if path.stem != "step_core_summary" and not path.with_suffix(".npz").exists():
                    report.fail("step", path.name, "its outputs (.npz) are missing")
            else:
                report.skip(f"file kernels/{path.name}")
        except _ERRORS as error:
            report.fail(path.stem, path.name, f"cannot be compared: {error!r}")
    path = folder / "step_core_summary.json"
    if path.exists():
        verify_summary(path, report, summary)
    elif summary:
        report.skip("file kernels/step_core_summary.json is missing")


def _idm(file: ArrayFile) -> None:
    limits = file.take("speed_limit_mps", -1)
    fractions = np.array(DEFAULT.speed_fractions)
    limits = np.where(np.isnan(limits), DEFAULT.fallback_velocity, limits)
    targets = fractions[file.take("policy_idx", len(limits))] * limits
    before = file.take("prev_progress_velocity", len(limits), 2)
    leads = file.take("lead_progress_velocity_rear", len(limits), 3)
    expected = file.take("next_progress_velocity", len(limits), 2)
    ours = np.empty(2)
    for case, target in enumerate(targets):
        follow(before[case], leads[case], target, DEFAULT.following, ours)
        file.compare("next_progress_velocity", case, ours, expected[case])


def _tracker(file: ArrayFile) -> None:
    poses = file.take("proposal_poses", -1, -1, SCORED + 1, 3)
    shape = poses.shape[:2]
    ego = file.take("ego_state", shape[0], NUM_STATE)
    expected = {
        "velocity_profile": file.take("velocity_profile", *shape, SCORED),
        "curvature_profile": file.take("curvature_profile", *shape, SCORED),
        "simulated_states": file.take("simulated_states", *shape, SCORED + 1, NUM_STATE),
    }
    for case in range(shape[0]):
        driven = drive_proposals(poses[case], ego[case])
        for (name, theirs), ours in zip(expected.items(), driven, strict=True):
            file.compare(name, case, ours, theirs[case])


def _comfort(file: ArrayFile) -> None:
    states = file.take("states", -1, SCORED + 1, NUM_STATE)
    signals, bounded = comfort(states, DEFAULT.comfort)
    expected = file.take("is_comfortable", len(states), len(SIGNALS))
    for case in range(len(states)):
        file.compare("is_comfortable", case, bounded[case], expected[case], EXACT)
        for index, name in enumerate(SIGNALS):
            theirs = file.take(name, len(states), SCORED + 1)[case]
            file.compare(name, case, signals[case, index], theirs, SIGNAL_TOLERANCE)
    file.note("states: all but heading, ax and ay are not read by the test")


def _emergency_brake(file: ArrayFile) -> None:
    states = file.take("ego_state", -1, NUM_STATE)
    expected = file.take("center_poses_every_2s", len(states), 5, 3)
    for case, ego in enumerate(states):
        centers = center_poses(brake_poses(ego, PACIFICA))[::20]
        file.compare("center_poses", case, centers, expected[case], COORDINATE_TOLERANCE)
    file.note("ego_state: all but pose, vx, ax and yaw rate are not read by the brake")


def _path(file: ArrayFile) -> None:
    cases = sorted({int(name.split("_")[0]) for name in file.arrays})
    for case in cases:
        poses = file.take(f"{case}_vertices", -1, 3)
        path = make_path(poses)
        file.compare("progress", case, path.progress, file[f"{case}_progress"])
        at = np.empty((len(file[f"{case}_query_s"]), 3))
        for row, progress in enumerate(file.take(f"{case}_query_s", -1).tolist()):
            read_pose(path, progress, at[row])
        file.compare("poses", case, at, file[f"{case}_poses"], COORDINATE_TOLERANCE)
        points = file.take(f"{case}_query_xy", -1, 2).tolist()
        along = [project(path, x, y, 0)[0] for x, y in points]
        file.compare("projection", case, along, file[f"{case}_projection"])
        for name, offset in (("m", -1.0), ("p", 1.0)):
            moved = offset_poses(poses, offset)
            theirs = file[f"{case}_offset_{name}"]
            file.compare("offset", case, moved, theirs, COORDINATE_TOLERANCE)
        for row, (low, high) in enumerate(file.take(f"{case}_substring_iv", -1, 2).tolist()):
            first, last = window(path, low, high)
            line = path.xy[first:last]
            if len(line) < 2:
                ends = np.clip([low, high], 0.0, path.progress[-1]).tolist()
                line = np.array(substring(shapely.LineString(path.xy), *ends).coords)
            theirs = file[f"{case}_substring_{row}"]
            file.compare("substring", case, line, theirs, COORDINATE_TOLERANCE)


def _graph_search(path: Path, report: Report) -> None:
    for number, case in enumerate(read_json(path)):
        where = f"case {number}"
        known = _SEARCHES.get(case["kind"])
        if known is None:
            report.skip(f"graph_search.json: cases of kind {case['kind']!r}")
            continue
        for extra in sorted(set(case) - known - {"found", "path"}):
            report.skip(f"graph_search.json: field {extra!r}")
        found, nodes = _search(case)
        report.compare(f"{case['kind']} found", where, found, case["found"])
        report.compare(f"{case['kind']} path", where, [str(n) for n in nodes], case["path"])


def _search(case: dict[str, Any]) -> tuple[bool, list[int]]:
    after: list[list[int]] = [[] for _ in range(case["n"])]
    before: list[list[int]] = [[] for _ in range(case["n"])]
    for start, end in case["edges"]:
        after[start].append(end)
        before[end].append(start)
    if case["kind"] == "bfs_roadblock":
        neighbours = after if case["forward"] else before
        goals = {int(target) for target in case["targets"]}
        blocks = search_levels(neighbours.__getitem__, int(case["start"]), goals, case["max_depth"])
        return blocks.found, blocks.path if case["forward"] else blocks.path[::-1]
    allowed = {int(edge) for edge in case["candidates"]}
    if not len(case["length"]) == len(case["block"]) == case["n"]:
        raise DataError("graph_search.json: a lane has no length or no block")
    lanes = search_cheapest(
        case["start"],
        lambda edge: [n for n in after[edge] if n in allowed],
        case["length"].__getitem__,
        lambda edge: case["block"][edge] == case["target_block"],
    )
    return lanes.found, lanes.path


_CHECKS: dict[str, Callable[[ArrayFile], None]] = {
    "idm": _idm,
    "tracker_sim": _tracker,
    "comfort": _comfort,
    "emergency_brake": _emergency_brake,
    "path": _path,
}
