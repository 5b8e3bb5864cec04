"""Simulation logs of recorded drives: the tracker on every sample, the comfort signals of the ego.

The logs are nuPlan's own; what the official tracker, bicycle and extractors make of them is
compared with ours.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from parity_cases import Cases, Rows, name_unknown, read_file

from shiftsim.metrics.comfort import comfort_signals
from shiftsim.sim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.verify.rollouts import read_ego
from shiftsim.verify.simulation_log import Recorded, read_simulation_log
from shiftsim.world.state import STATE_COLUMNS

pytestmark = [pytest.mark.golden, pytest.mark.slow, pytest.mark.reference("nuplan_real_logs")]

STEP = 1e-12  # m/s^2, rad/s, m, …: of one step of the tracker
PLACE = 1e-9  # m; coordinates near 4e6 are spaced 5e-10
SIGNALS = {  # by name in the file
    **{"lon_accel": "lon_accel", "lat_accel": "lat_accel", "jerk": "mag_jerk"},
    **{"lon_jerk": "lon_jerk", "yaw_rate": "yaw_rate", "yaw_accel": "yaw_accel"},
}


def read_logs(folder: Path, cases: Cases) -> dict[str, Recorded]:
    """The logs of a folder by token."""
    paths = sorted(folder.glob("*.msgpack.xz"))
    return {path.name.partition(".")[0]: read_simulation_log(path, cases) for path in paths}


def step_all(recorded: Recorded) -> dict[str, np.ndarray]:
    """What every plan of a log makes of the state it was planned in, over the step to the next."""
    states, time_us, plans = read_ego(recorded.ego), recorded.ego["ego_time_us"], recorded.plans
    assert plans is not None
    out, commands = np.empty(states.shape), np.empty((len(states), 2))
    for row, (now, after) in enumerate(pairwise([*time_us.tolist(), recorded.dropped_us])):
        plan = plans.at(plans["iteration"] == row)
        given = now, after, states[row], plan["time_us"], read_ego(plan), 0.0, 0.0
        raise_for_status(track_and_step(*given, out[row], commands[row]), now, plan["time_us"])
    names = ("acceleration_command", "steering_rate_command", *STATE_COLUMNS)
    return dict(zip(names, np.column_stack([commands, out]).T, strict=True))


def test_tracker(folder: Path, cases: Cases) -> None:
    steps = read_file(folder / "tracker_steps.parquet", cases)
    rows, logs = Rows(steps, ["token"]), read_logs(folder, cases)
    rows.match_keys((), [(token,) for token in logs])
    for token, recorded in logs.items():
        ours = step_all(recorded)
        size = len(ours["x"])
        ours["iteration"] = np.arange(size)
        rows.match((token,), ours, {"": STEP, "x": PLACE, "y": PLACE})
    rows.finish()


def test_comfort(folder: Path, cases: Cases) -> None:
    signals = read_file(folder / "comfort_signals.parquet", cases)
    rows, logs = Rows(signals, ["token"]), read_logs(folder, cases)
    rows.match_keys((), [(token,) for token in logs])
    for token, recorded in logs.items():
        time_us = recorded.ego["ego_time_us"]
        made = comfort_signals(time_us, read_ego(recorded.ego))
        ours = {name: getattr(made, field) for name, field in SIGNALS.items()}
        rows.match((token,), {**ours, "sample": np.arange(len(time_us)), "time_us": time_us})
    rows.finish()


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    known = ("*.msgpack.xz", "tracker_steps.parquet", "comfort_signals.parquet")
    name_unknown(folder, cases, *known)
