"""The interface a planner implements, and what the simulator shows it.

A planner is any object with `reset(scene)` and `plan(observation)`; nothing needs to be subclassed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from shiftsim.geometry.boxes import to_frame, turned
from shiftsim.kernels import KEEPS_READ_ONLY, FloatArray, IntArray, readonly
from shiftsim.world.line import Lead, Line, RedLight, find_lead, next_red, route_line
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    PACIFICA,
    Command,
    EgoState,
    LightStatus,
    Tracks,
    TrafficLights,
    Trajectory,
    VehicleParameters,
)

# nuPlan rule 10: 2.1 s and the present, not 2.0 s
HISTORY_SAMPLES = 22
_share: Any = np.from_dlpack if KEEPS_READ_ONLY else readonly  # read-only views, without a way back
Made = TypeVar("Made")


@dataclass(frozen=True, slots=True)
class SceneInfo:
    """What a planner may know before the first step.

    Attributes:
        map: The map.
        route: Route roadblock ids from start to goal.
        goal: (3,) goal x [m], y [m], heading [rad], or None.
        dt: Nominal time between iterations [s].
        times: (T,) time stamps of the iterations [us].
        token: Id of the scenario.
        log_name: Recording it was cut from.
        vehicle: Dimensions of the ego.
        seed: Seed of the task; what a planner samples is keyed with it and the token.
        expert: The whole recording, future included; None unless the planner declares with
            `sees_recording = True` that it looks at it.
        start: (3,) rear axle at the first iteration x [m], y [m], heading [rad], or None.

    Example:
        ```python
        def reset(self, scene: shiftsim.SceneInfo):
            self.line = scene.route_line()  # poses, arc, speed_limits, …
        ```
    """

    map: VectorMap
    route: tuple[str, ...]
    goal: FloatArray | None
    dt: float
    times: IntArray
    token: str
    log_name: str
    vehicle: VehicleParameters = PACIFICA
    seed: int = 0
    expert: Scenario | None = None
    start: FloatArray | None = None
    _made: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        return (
            f"<SceneInfo {self.token}: map {self.map.name}, route of {len(self.route)} roadblocks, "
            f"{len(self.times)} iterations of {self.dt:.1f} s>"
        )

    @property
    def route_blocks(self) -> list[int]:
        """Blocks of the route, each once; those that the map does not have are left out."""
        index = self.map.blocks.index
        return [index[name] for name in dict.fromkeys(self.route) if name in index]

    @property
    def route_lanes(self) -> list[int]:
        """Lanes and connectors of the route as edges of the map, block by block."""
        return self.map.lanes_of(self.route_blocks)

    def route_line(self, pose: FloatArray | None = None) -> Line:
        """The route as one centre line, from the lane under a pose on.

        Where that lane does not lead on along the route, the line moves to one that does; behind
        the route it goes straight on for 200 m, as far as there are lanes.

        Args:
            pose: (3,) rear axle x [m], y [m], heading [rad]; where the scenario begins if None.

        Raises:
            MapError: There is no lane to begin in.
        """
        given = self.start if pose is None else pose
        return route_line(self.map, self.route_blocks, given, self.vehicle)

    def once(self, make: "Callable[[SceneInfo], Made]") -> Made:
        """What `make(scene)` returns, made when it is first asked for and then kept."""
        if make not in self._made:
            self._made[make] = make(self)
        made: Made = self._made[make]
        return made


@dataclass(frozen=True, slots=True)
class History:
    """The last 2.1 s, up to 22 samples, oldest first; the last one is the present."""

    time_us: IntArray  # (H,) time stamps [us]
    ego: FloatArray  # (H, 11) ego states, columns of `state.STATE_COLUMNS`
    tracks: Tracks  # tracks over the same H samples

    def __repr__(self) -> str:
        return f"<History: {len(self.ego)} samples, {self.tracks.num_tracks} tracks>"


@dataclass(frozen=True, slots=True)
class Observation:
    """What a planner sees at one iteration.

    Attributes:
        iteration: Index of the iteration, from 0.
        time_us: Its log time stamp [us].
        history: The last samples, the present one included.
        lights: Traffic lights of this iteration (one row).

    Example:
        ```python
        def plan(self, observation: shiftsim.Observation):
            x, y, heading = observation.ego.pose
            near = observation.tracks.poses[0, observation.tracks.valid[0]]
            past = observation.history.ego[:, :3]
        ```
    """

    iteration: int
    time_us: int
    history: History
    lights: TrafficLights

    def __repr__(self) -> str:
        return f"<Observation: iteration {self.iteration}, {self.ego!r}, {self.history!r}>"

    @property
    def ego(self) -> EgoState:
        """The present ego state."""
        return EgoState(self.time_us, self.history.ego[-1])

    @property
    def tracks(self) -> Tracks:
        """The present tracks (one row); mind `valid`."""
        return self.history.tracks.rows(slice(-1, None))

    @property
    def traffic_lights(self) -> dict[str, LightStatus]:
        """Status of the listed lane connectors; the last one where one is listed with several."""
        return self.lights.at(0)

    def lead(self, line: Line) -> Lead | None:
        """The nearest box in the corridor of our width along a line: gap, speed, token; or None.

        The gap [m] runs along the line from our front bumper to the box.
        """
        return find_lead(line, self.ego.pose, self.history.tracks)

    def lights_on(self, line: Line) -> RedLight | None:
        """The next red light on a line, or None: gap from our front bumper [m], connector."""
        return next_red(line, self.ego.pose, self.lights)

    def in_ego_frame(self) -> Tracks:
        """The present tracks as the rear axle sees them, x ahead and y to the left (one row)."""
        tracks, pose = self.tracks, self.ego.pose
        seen = tracks.select(tracks.valid[0])
        velocities = turned(seen.velocities, pose[2])
        return replace(seen, poses=to_frame(seen.poses, pose), velocities=velocities)


@runtime_checkable
class Planner(Protocol):
    """What the simulator asks of a planner. Subclassing is not required.

    Optional are `close()`, `name`, `sees_recording` (True where it must be given the recording),
    and `degraded`: a text that says why the plan just returned is a fallback, empty when it is not.
    Such steps are counted, or fail a strict run.

    Example:
        ```python
        class Coast:
            def reset(self, scene):
                pass

            def plan(self, observation):
                return shiftsim.Command(acceleration=-0.5, steering_rate=0.0)


        print(shiftsim.simulate(shiftsim.open_store("demo")["01f13e"], Coast()))
        ```
    """

    def reset(self, scene: SceneInfo) -> None:
        """Prepare for a new scenario: route, goal, map. Called once before the first plan."""

    def plan(self, observation: Observation) -> Trajectory | Command:
        """Return poses from the current ego pose on, or the command itself (no tracker runs)."""


@runtime_checkable
class BatchPlanner(Planner, Protocol):
    """A planner that can answer for several scenarios with one forward pass."""

    def fork(self) -> "BatchPlanner":
        """A planner for one more scenario that shares the network with this one."""

    def plan_batch(
        self, planners: Sequence["BatchPlanner"], observations: Sequence[Observation]
    ) -> list[Trajectory | Command | Exception]:
        """Plans of forks that are in lock step, one per observation.

        An exception in place of a plan ends that scenario and no other.
        """


def sees_recording(planner: object) -> bool:
    """Whether a planner, or a class of planners, declares that it looks at the recording."""
    return getattr(planner, "sees_recording", False) is True


def scene_info(
    scenario: Scenario, seed: int = 0, planner: object = None, start: FloatArray | None = None
) -> SceneInfo:
    """What a planner is told before the first step; `seed` is that of the task.

    The recording is there for a planner that declares it only. It begins in the pose `start` (3,),
    as far as it knows; where the recording does if None.
    """
    times = scenario.iteration_times
    return SceneInfo(
        map=scenario.map,
        route=scenario.route,
        goal=scenario.mission_goal,
        dt=float(np.diff(times).mean() * 1e-6),
        times=readonly(times),
        token=scenario.token,
        log_name=scenario.log_name,
        seed=seed,
        expert=scenario if sees_recording(planner) else None,
        start=readonly(scenario.ego[scenario.iteration_rows[0], :3] if start is None else start),
    )


def past_rows(scenario: Scenario, iteration: int, samples: int = HISTORY_SAMPLES) -> IntArray:
    """(H,) rows of the log that an iteration looks back on, itself last; those it has."""
    row, step = int(scenario.iteration_rows[iteration]), scenario.row_step
    # nuPlan rule 431: back from the last row with that time stamp
    last = int(np.searchsorted(scenario.time_us, scenario.time_us[row], side="right")) - 1
    rows = np.arange(last - (samples - 1) * step, last + 1, step)
    rows[-1] = row
    return rows[rows >= 0]


def rollout_rows(scenario: Scenario) -> tuple[IntArray, int]:
    """Rows of the log that a rollout has: past samples, then iterations; which is iteration 0."""
    rows = np.concatenate([past_rows(scenario, 0)[:-1], scenario.iteration_rows])
    return rows, len(rows) - scenario.num_iterations


def observe_log(
    scenario: Scenario,
    iteration: int,
    *,
    # (H, 11) ego states of the samples, or (11,) of a single one; the recorded ones if None
    ego: FloatArray | None = None,
    tracks: Tracks | None = None,  # tracks over the H samples; the recorded ones if None
    # how many samples to look back on, the present included; 1 is the present alone. A recording
    # that begins later gives fewer: H of them
    samples: int = HISTORY_SAMPLES,
) -> Observation:
    """What a planner would see where the ego is as recorded, or in given states."""
    rows = past_rows(scenario, iteration, samples)
    states = scenario.ego[rows] if ego is None else np.array(ego, np.float64, ndmin=2)
    seen = scenario.tracks.rows(rows) if tracks is None else tracks
    arrays = scenario.time_us[rows], states, seen, scenario.traffic_lights.rows(rows)
    return ObservationBuilder(*arrays).at(iteration, len(rows) - 1)


class ObservationBuilder:
    """What a planner is shown of a rollout: read-only arrays that end with the present row.

    Nothing leads from them to the arrays of the rollout, of which they are views.
    """

    def __init__(
        self, time_us: IntArray, ego: FloatArray, tracks: Tracks, lights: TrafficLights
    ) -> None:
        """Arrays of a rollout."""
        views = [array.view() for array in (time_us, ego, *tracks.arrays, lights.status)]
        for view in views:
            view.flags.writeable = not KEEPS_READ_ONLY  # once, not step by step
        *self._arrays, self._status = views
        self._whose = readonly(tracks.kinds), tracks.tokens
        self._connectors = lights.connector_ids

    def at(self, iteration: int, row: int) -> Observation:
        """What a planner sees at an iteration, which is a row of the arrays."""
        past = slice(max(row + 1 - HISTORY_SAMPLES, 0), row + 1)
        time_us, ego, valid, poses, velocities, sizes = [_share(a[past]) for a in self._arrays]
        tracks = Tracks(valid, poses, velocities, sizes, *self._whose)
        lights = TrafficLights(self._connectors, _share(self._status[row : row + 1]))
        return Observation(iteration, int(time_us[-1]), History(time_us, ego, tracks), lights)
