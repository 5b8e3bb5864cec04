"""Small planners: straight on, nuPlan's SimplePlanner, the recording, and given poses."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, DataError, PlannerError
from shiftsim.kernels import FloatArray, kernel, readonly
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    NUM_STATE,
    STEERING,
    VX,
    VY,
    YAW_RATE,
    Trajectory,
    X,
    Y,
)

_TIMES = 100_000 * np.arange(81)  # us, 8 s
STEPS = 40  # 10 s at 0.25 s
STEP_US = 250_000
POSES = 16
ROWS_BETWEEN = 10  # 0.5 s of a 20 Hz log; nuPlan rule 393: it counts rows, not time
SAMPLES = 81  # 8 s at 0.1 s
_REQUIRED = {"x": 0, "y": 1, "heading": 2}
_OPTIONAL = dict(
    vx=VX, vy=VY, ax=AX, ay=AY, tire_steering_angle=STEERING, angular_velocity=YAW_RATE
)
_HINT = "scripts are tables with scene, planner, time_us, x, y and heading"
_PREFIX = "scripted_"  # of the script's name in reference files


class ConstantVelocity:
    """Drives straight on at the present speed."""

    name = "constant-velocity"

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation) -> Trajectory:
        """Poses every 0.1 s along the present heading."""
        states = np.zeros((len(_TIMES), NUM_STATE))
        _straight(states, observation.history.ego[-1])
        return Trajectory(_TIMES.copy(), states, relative=True)


@kernel
def _straight(states: FloatArray, start: FloatArray) -> None:
    """Write the states (H, 11) every 0.1 s from one on."""
    speed, heading = np.hypot(start[VX], start[VY]), start[HEADING]
    cos, sin = np.cos(heading), np.sin(heading)
    for row in range(len(states)):
        distance = speed * 0.1 * row
        states[row, X], states[row, Y] = start[X] + distance * cos, start[Y] + distance * sin
        states[row, HEADING], states[row, VX] = heading, speed


class Simple:
    """Keeps the heading; a speed above the limit decays towards it."""

    name = "simple"

    def __init__(self, *, max_velocity: float = 5.0) -> None:
        """`max_velocity`: Speed above which it brakes [m/s]."""
        self._max_velocity = float(max_velocity)

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation) -> Trajectory:
        """The present state without acceleration and steering, and 40 steps of 0.25 s from it."""
        states = np.zeros((STEPS + 1, NUM_STATE))
        states[0, :AX] = observation.ego.values[:AX]
        _drive(states, self._max_velocity)
        return Trajectory(observation.time_us + STEP_US * np.arange(STEPS + 1), states)


@kernel
def _drive(states: FloatArray, max_velocity: float) -> None:
    """Write the states (H, 11) that follow from the first one."""
    for row in range(len(states) - 1):
        # nuPlan rule 394: the new acceleration is not written back into the earlier state
        before = states[row].copy()
        speed = np.sqrt(before[VX] ** 2 + before[VY] ** 2)
        if speed > max_velocity:
            before[AX] = max_velocity - speed
        step_bicycle(before, before[AX], 0.0, WHEEL_BASE, STEP_US * 1e-6, states[row + 1])


class LogFuture:
    """Plans the recorded states of the coming 8 s, whatever the simulated ego does."""

    name = "log-future"
    sees_recording = True
    _scenario: Scenario | None = None
    _previous: Trajectory | None = None
    _first: Sequence[int] = ()  # row of the plan's first state, by iteration

    def reset(self, scene: SceneInfo) -> None:
        """Take the recording of the new scenario."""
        self._scenario, self._previous = scene.expert, None
        if scene.expert is not None:
            # nuPlan rule 431: on from the first row with that time stamp
            times = scene.expert.time_us
            self._first = np.searchsorted(times, scene.expert.iteration_times).tolist()

    def plan(self, observation: Observation) -> Trajectory:
        """The recorded state of this iteration and up to 16 later ones, 10 rows apart.

        Rows behind the end of the recording are left out. When none is left, the previous plan is
        repeated (the devkit fails there), as long as there is one.

        Raises:
            PlannerError: The recording ends less than 10 rows behind the first iteration.
        """
        scenario, iteration = self._scenario, observation.iteration
        if scenario is None:
            raise PlannerError("log-future: plan() was called before reset()")
        first = self._first[iteration]
        rows = slice(first, first + POSES * ROWS_BETWEEN + 1, ROWS_BETWEEN)
        times = scenario.time_us[rows].copy()
        if len(times) > 1:
            states = scenario.ego[rows].copy()
            states[0] = scenario.ego[scenario.iteration_rows[iteration]]
            self._previous = Trajectory(times, states)
        if self._previous is None:
            raise PlannerError(
                f"log-future: scenario {scenario.token!r} has no recorded state 0.5 s after "
                f"iteration {iteration}",
                hint="keep at least 0.5 s of log behind the first iteration when converting",
            )
        return self._previous


class Scripted:
    """Plans the next 81 samples of a sequence from a file, whatever the simulated ego does."""

    name = "scripted"

    def __init__(self, file: Path, *, name: str = "") -> None:
        """Read the sequences.

        Args:
            file: Parquet or CSV file with the columns scene (log name or token of the scenario),
                planner (name of the script), time_us (log time stamps), x, y, heading of the rear
                axle in the map frame, and if known vx, vy, ax, ay, tire_steering_angle,
                angular_velocity.
            name: Which script; may be left out where a scene has a single one.
        """
        self._file = Path(file)
        self._script = name.removeprefix(_PREFIX)
        self._scripts = _read(self._file)
        self._sequence: Trajectory | None = None

    def reset(self, scene: SceneInfo) -> None:
        """Choose the sequence of the scenario.

        Raises:
            ConfigError: The file has none for it, or several and no name was given.
        """
        known = {
            script: sequence
            for place in (scene.log_name, scene.token)
            for script, sequence in self._scripts.get(place, {}).items()
        }
        wanted = self._script or (next(iter(known)) if len(known) == 1 else "")
        if wanted not in known:
            names = ", ".join(sorted(known)) or "none"
            asked = f"script {wanted!r}" if wanted else "single script"
            raise ConfigError(
                f"{self._file} has no {asked} for scenario {scene.token!r} "
                f"(log {scene.log_name!r})",
                hint=f"scripts of this scenario: {names}; choose with --planner-arg name=…",
            )
        self._sequence = known[wanted]

    def plan(self, observation: Observation) -> Trajectory:
        """81 samples from the last one that is not after the present.

        Raises:
            PlannerError: The sequence starts after the present.
        """
        if self._sequence is None:
            raise PlannerError("scripted: plan() was called before reset()")
        times = self._sequence.time_us
        first = int(np.searchsorted(times, observation.time_us, side="right")) - 1
        if first < 0:
            raise PlannerError(
                f"{self._file}: the sequence starts at {times[0]} us, after iteration "
                f"{observation.iteration} ({observation.time_us} us)",
                hint="its time stamps must be those of the log",
            )
        rows = slice(first, first + SAMPLES)
        return Trajectory(times[rows].copy(), self._sequence.states[rows].copy())


def _read(path: Path) -> dict[str, dict[str, Trajectory]]:
    """Sequences by scene and name of the script, each in the order of time."""
    columns = _read_columns(path)
    groups: dict[tuple[str, str], list[int]] = {}
    keys = zip(columns["scene"].tolist(), columns["planner"].tolist(), strict=True)
    for row, (scene, script) in enumerate(keys):
        groups.setdefault((str(scene), str(script).removeprefix(_PREFIX)), []).append(row)
    times = _numbers(columns, "time_us", path).astype(np.int64)
    states = np.zeros((len(times), NUM_STATE))
    for column, index in {**_REQUIRED, **_OPTIONAL}.items():
        if column in columns:
            states[:, index] = _numbers(columns, column, path)
    out: dict[str, dict[str, Trajectory]] = {}
    for (scene, script), members in groups.items():
        rows = np.array(members)
        rows = rows[np.argsort(times[rows], kind="stable")]
        if (np.diff(times[rows]) <= 0).any():
            raise DataError(f"{path}: scene {scene!r}, script {script!r}: a time occurs twice")
        out.setdefault(scene, {})[script] = Trajectory(
            readonly(times[rows]), readonly(states[rows])
        )
    return out


def _read_columns(path: Path) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    try:
        read = pa.csv.read_csv if path.suffix.lower() == ".csv" else pa.parquet.read_table
        table = read(path)
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a readable Parquet or CSV file ({error})", _HINT) from error
    for name in ("scene", "planner", "time_us", *_REQUIRED):
        if name not in table.column_names:
            raise DataError(f"{path}: column {name!r} is missing", _HINT)
    return {name: table[name].to_numpy() for name in table.column_names}


def _numbers(columns: dict[str, Any], name: str, path: Path) -> Any:
    values = columns[name]
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise DataError(f"{path}: column {name!r} has values that are not finite numbers")
    return values
