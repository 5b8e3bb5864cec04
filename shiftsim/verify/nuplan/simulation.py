"""Closed loops of the nuplan folder: simulated from the log, compared with the recorded rollout."""

from pathlib import Path

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import ShiftsimError
from shiftsim.metrics import judge, measure
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.verify.report import Report
from shiftsim.verify.tables import Group, read_groups
from shiftsim.world import state
from shiftsim.world.scenario import Scenario

# column of the reference → index in a state row, tolerance
STATE_COLUMNS = {
    "x": (state.X, 1e-6),
    "y": (state.Y, 1e-6),
    "heading": (state.HEADING, 1e-7),
    "vx": (state.VX, 1e-6),
    "vy": (state.VY, 1e-6),
    "ax": (state.AX, 1e-6),
    "ay": (state.AY, 1e-6),
    "tire_steering_angle": (state.STEERING, 1e-6),
    "tire_steering_rate": (state.STEERING_RATE, 1e-6),
    "angular_velocity": (state.YAW_RATE, 1e-6),
    "angular_acceleration": (state.YAW_ACCEL, 1e-6),
}
CENTER_COLUMNS = {"center_x": (0, 1e-6), "center_y": (1, 1e-6), "center_heading": (2, 1e-7)}
SCORE_TOLERANCE = 1e-9
PROFILES = {"default": "nuplan", "deepplan": "deepplan"}
CONTROLLERS = {"NR": "lqr", "PT": "perfect", "R": "lqr"}
TRAFFIC = {"NR": "nonreactive", "PT": "nonreactive", "R": "reactive"}
_SCRIPTED = "scripted_"


def verify_simulation(
    folder: Path, report: Report, scenes: dict[str, Scenario], mode: str | None = None
) -> None:
    """Simulate every run of `expected/ego.parquet` and compare states and scores.

    Args:
        folder: The nuplan folder.
        report: Filled with the comparisons.
        scenes: The scenarios by scene name.
        mode: Only runs of this challenge.
    """
    runs = read_groups(folder / "expected" / "ego.parquet")
    scores = read_groups(
        folder / "expected" / "scores.parquet", ("scene", "challenge", "planner", "thresholds")
    )
    for (scene, challenge, planner), rows in runs.items():
        if mode not in (None, challenge):
            continue
        where = f"{scene} {challenge} {planner}"
        if challenge not in CONTROLLERS or scene not in scenes:
            report.fail("simulation", where, "no such challenge or scene")
            continue
        try:
            log = simulate(
                scenes[scene],
                load_planner(*reference_planner(planner, folder)),
                controller=CONTROLLERS[challenge],
                traffic=TRAFFIC[challenge],
            )
        except ShiftsimError as error:  # nuPlan got through, so this is a difference
            report.fail("simulation", where, str(error))
            continue
        compare_ego(report, where, log.time_us, log.ego, rows)
        measurements = measure(log, scenes[scene].map)
        for thresholds, profile in PROFILES.items():
            expected = scores.get((scene, challenge, planner, thresholds))
            if expected is None:
                report.fail("simulated score", where, f"no row with thresholds {thresholds}")
                continue
            result = judge(measurements, profile)
            for metric, score in {**result.scores, "score": result.score}.items():
                if score is not None:
                    report.compare(
                        "simulated score",
                        f"{where} {thresholds} {metric}",
                        score,
                        float(expected[metric][0]),
                        atol=SCORE_TOLERANCE,
                    )


def reference_planner(name: str, folder: Path) -> tuple[str, dict[str, str]]:
    """Our planner and its arguments for a planner name of the reference."""
    if name.startswith(_SCRIPTED):
        file = str(folder / "scripted.parquet")
        return "scripted", {"file": file, "name": name.removeprefix(_SCRIPTED)}
    return name.replace("_", "-"), {}


def compare_ego(
    report: Report, where: str, time_us: np.ndarray, ego: FloatArray, rows: Group
) -> None:
    """Compare simulated ego states (K, 11) with the rows of one run of `ego.parquet`."""
    report.compare("ego iteration", where, np.arange(len(time_us)), rows["iteration"])
    report.compare("ego time", where, time_us, rows["time_us"])
    for column, (index, tolerance) in STATE_COLUMNS.items():
        report.compare(f"ego {column}", where, ego[:, index], rows[column], atol=tolerance)
    centers = state.center_poses(ego[:, :3])
    for column, (index, tolerance) in CENTER_COLUMNS.items():
        report.compare(f"ego {column}", where, centers[:, index], rows[column], atol=tolerance)
