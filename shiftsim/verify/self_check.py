"""A few outputs of nuPlan's own code that come with the package, against what is computed here."""

from zipfile import BadZipFile

import numpy as np

from shiftsim.data.store.map import read_map_file
from shiftsim.errors import DataError
from shiftsim.files import PACKAGE
from shiftsim.metrics import evaluate, measure
from shiftsim.metrics.comfort import comfort_signals, within_bounds
from shiftsim.metrics.result import PROFILES
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.verify.report import EXACT, TOLERANCE, Named, Report
from shiftsim.verify.rollouts import SCORES, ego_states, recorded_log
from shiftsim.world.scenario import scenario_of_rows
from shiftsim.world.state import Tracks

REFERENCE = PACKAGE / "verify" / "reference"
_SIGNALS = ("heading", "vx", "ax", "ay", "omega", "alpha")


def _check_bicycle(arrays: Named, report: Report) -> None:
    state = np.empty(arrays["in_state"].shape[1])
    for case, (before, command, dt_us, after) in enumerate(
        zip(*(arrays[name] for name in ("in_state", "cmd", "dt_us", "out_state")), strict=True)
    ):
        step_bicycle(before, *command.tolist(), WHEEL_BASE, step_seconds(0, int(dt_us)), state)
        report.compare("bicycle step", f"case {case}", state, after, atol=TOLERANCE)


def _check_tracker(arrays: Named, report: Report) -> None:
    commands = np.column_stack([arrays["accel_cmd"], arrays["steer_rate_cmd"]])
    for case, (begin, end) in enumerate(zip(*_bounds(arrays["traj_ptr"]), strict=True)):
        columns = {name: arrays[f"traj_{name}"][begin:end] for name in ("x", "y", "heading")}
        plan = arrays["traj_time_us"][begin:end], ego_states(columns)
        now, ego = int(arrays["now_us"][case]), arrays["ego_state"][case]
        command = lqr.track(now, ego, *plan, lqr.NUPLAN)[1:]
        report.compare("tracker command", f"case {case}", command, commands[case], atol=TOLERANCE)


def _check_comfort(arrays: Named, report: Report) -> None:
    for case, (begin, end) in enumerate(zip(*_bounds(arrays["sig_ptr"]), strict=True)):
        states = ego_states({name: arrays[f"sig_in_{name}"][begin:end] for name in _SIGNALS})
        signals = comfort_signals(arrays["sig_in_time_us"][begin:end], states)
        for name, profile in PROFILES.items():
            flags = within_bounds(signals, profile)
            theirs = arrays["within_default" if name == "nuplan" else f"within_{name}"][case]
            report.compare(f"comfort, {name}", f"case {case}", [*flags, all(flags)], theirs)


def _bounds(ends: np.ndarray) -> tuple[list[int], list[int]]:
    return ends[:-1].tolist(), ends[1:].tolist()


def _check_metrics(arrays: Named, report: Report) -> None:
    road = read_map_file(REFERENCE / "metric_world.arrow")
    time_us, expert = arrays["time_us"], arrays["expert"]
    scenario = scenario_of_rows("world", road, time_us, expert, Tracks.empty(len(time_us)))
    measured = measure(recorded_log(scenario, arrays["ego"]), road)
    for name, profile in PROFILES.items():
        result = evaluate(measured, profile)
        for metric, score in {**result.scores, "score": result.score}.items():
            if score is not None:
                theirs, atol = arrays[f"{name} {metric}"], SCORES.get(metric, EXACT)
                report.compare(f"score {metric}", name, score, theirs, atol=atol)


CHECKS = {
    "bicycle_steps.npz": _check_bicycle,
    "lqr_commands.npz": _check_tracker,
    "comfort_signals.npz": _check_comfort,
    "metric_world.npz": _check_metrics,
}


def check_reference(name: str, report: Report) -> None:
    """Compare with one file, a name in `CHECKS`.

    Raises:
        DataError: The file is missing or damaged.
    """
    path = REFERENCE / name
    try:
        with np.load(path, allow_pickle=False) as archive:
            CHECKS[name](dict(archive), report)
    except (OSError, BadZipFile, LookupError, ValueError) as error:
        raise DataError(f"{path}: {error}", hint="install shiftsim again") from error
