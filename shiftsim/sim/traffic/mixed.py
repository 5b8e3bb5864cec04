"""Traffic beside other traffic: what goes straight on, shares a rollout, or crosses in any.

`Mixed` is several models in one rollout, each for tracks of its own. `Scripted` is traffic of any
model, and the pedestrians that an edit adds: they wait for the ego, cross once, and stand.
"""

from collections.abc import Callable, Collection
from typing import Protocol

import numpy as np

from shiftsim.errors import ConfigError, TrafficError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.sim.traffic import Traffic
from shiftsim.world.events import CROSSING_SIZE, ScriptedPedestrian
from shiftsim.world.lanes import find_start
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, Tracks, center_poses

Rule = Collection[int] | Callable[[Tracks], BoolArray]
_SETS_OFF = 50.0  # m, how near along its lane the ego must be
_AT_END = 0.1  # m, a projection on the end of the lane
_WALK = 150  # iterations that a walk takes, and as many more as it starts late


class ConstantVelocity:
    """Everyone goes on as before: straight ahead, with the velocity of the first sighting.

    Vehicles, pedestrians and bicycles keep their velocity and heading, and nobody leaves.
    A track that the recording brings in later begins as recorded. Static objects are replayed.
    """

    def __init__(self) -> None:
        self._moving: BoolArray | None = None
        self._spans = np.zeros(0)

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Note who moves: the tracks `own` (all by default), static objects apart."""
        self._moving = tracks.kinds <= LAST_AGENT_KIND
        if own is not None:
            self._moving = self._moving & np.isin(np.arange(tracks.num_tracks), own)
        self._spans = np.diff(scenario.iteration_times) * 1e-6

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move everyone who was there a step ago."""
        if self._moving is None:
            raise ConfigError("traffic was stepped before it was started", hint="call start first")
        who = np.flatnonzero(self._moving & tracks.valid[row - 1])
        _, poses, velocities, sizes = (array[row - 1, who] for array in tracks.arrays)
        poses[:, :2] += self._spans[iteration] * np.nan_to_num(velocities)
        tracks.put(row, who, poses, velocities, sizes)


class AgentPolicy(Protocol):
    """A traffic model that can share a rollout: `start` is also told which tracks are its own.

    It writes the rows of its own tracks, all of them in one call, and reads those of the others:
    their row of iteration i + 1 holds the recording, or what policies before it have written.
    """

    def start(self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray) -> None:
        """As `Traffic.start`; `own`: (A,) indices of the tracks this policy moves."""

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """As `Traffic.step`."""


class Mixed:
    """Traffic in which every track follows one of several policies, or the recording.

    Each policy comes with the tracks it moves: a set of `AgentKind`, or a function that takes the
    tracks and returns a mask (N,). A track belongs to the first policy that claims it, and to the
    recording if none does. Policies move in the order given, so that a later one sees where the
    earlier ones have gone.
    """

    def __init__(self, *policies: tuple[Rule, AgentPolicy]) -> None:
        self._policies = policies
        for rule, policy in policies:
            if not callable(rule) and (unknown := set(rule) - set(AgentKind)):
                what = f"the tracks of {type(policy).__name__} are of no kind: {unknown.pop()!r}"
                raise ConfigError(what, hint="give AgentKind.VEHICLE and so on")

    def start(self, scenario: Scenario, tracks: Tracks, row: int) -> None:
        """Share the tracks out."""
        free = np.ones(tracks.num_tracks, np.bool_)
        for rule, policy in self._policies:
            claimed = rule(tracks) if callable(rule) else np.isin(tracks.kinds, list(rule))
            if np.shape(claimed) != free.shape:
                raise ConfigError(
                    f"the rule for {type(policy).__name__} returned an array of shape "
                    f"{np.shape(claimed)}",
                    hint=f"return a mask of shape {free.shape}, one entry per track",
                )
            own = free & np.asarray(claimed, np.bool_)
            free &= ~own
            policy.start(scenario, tracks, row, np.flatnonzero(own))

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Let every policy move its own."""
        for _, policy in self._policies:
            policy.step(iteration, ego, tracks, row)


def share_walked(iteration: int, active: int, num_iterations: int) -> float:
    """How much of its way a pedestrian of interPlan has gone that set off at an iteration."""
    return min(max(0, iteration - active) / min(active + _WALK, num_iterations), 1.0)


class Scripted:
    """Traffic of any model, and the pedestrians of an edited scenario."""

    def __init__(self, traffic: Traffic) -> None:
        self._traffic = traffic
        self._pedestrians: tuple[ScriptedPedestrian, ...] = ()
        self._start_times: list[float] = []
        self._seconds = np.zeros(0)

    def start(self, scenario: Scenario, tracks: Tracks, row: int) -> None:
        """Prepare traffic and pedestrians."""
        self._pedestrians = scenario.script.pedestrians if scenario.script else ()
        self._crossings = scenario.script.crossings if scenario.script else ()
        self._map = scenario.map
        self._active = [crossing.iteration for crossing in self._crossings]
        self._start_times = [np.inf] * len(self._pedestrians)
        times = scenario.iteration_times
        self._seconds = (times - times[0]) * 1e-6
        self._traffic.start(scenario, tracks, row)
        now = int(scenario.iteration_rows[0])
        if self._crossings:
            self._cross(0, scenario.ego[now], tracks, row)

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move the pedestrians, which the other traffic then sees, and that traffic."""
        now, after = self._seconds[iteration], self._seconds[iteration + 1]
        x, y, _ = center_poses(ego[None, :3])[0]
        for number, pedestrian in enumerate(self._pedestrians):
            near = (
                np.hypot(pedestrian.start[0] - x, pedestrian.start[1] - y) <= pedestrian.ego_within
            )
            if near and self._start_times[number] == np.inf:
                self._start_times[number] = now
        self._move_pedestrians(after, tracks, row)
        if self._crossings:
            self._cross(iteration + 1, ego, tracks, row)
        self._traffic.step(iteration, ego, tracks, row)
        self._move_pedestrians(after, tracks, row)  # a model may have moved all pedestrians

    def _cross(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move pedestrians of interPlan.

        nuPlan rule 713: they are not there before they set off, report no velocity, walk the slower
        the later they set off, and setting off at iteration 0 is forgotten.
        """
        center = center_poses(ego[None, :3])[0]
        start = find_start(self._map, center)
        if start is None:
            raise TrafficError(
                f"the ego is on no lane at iteration {iteration}, so no pedestrian can look for it",
                hint="interPlan fails here as well",
            )
        lane = self._map.baselines.at(start.edge)
        length = self._map.baselines.length(start.edge)
        for number, crossing in enumerate(self._crossings):
            if not self._active[number]:
                x, y = crossing.start[:2]
                along = self._map.progress_on(start.edge, float(x), float(y))
                if abs(along - length) < _AT_END:
                    along += float(np.hypot(*(crossing.start[:2] - lane[-1])))
                if abs(along - start.progress) > _SETS_OFF:
                    continue
                self._active[number] = iteration
            share = share_walked(iteration, self._active[number], len(self._seconds))
            pose = crossing.start.copy()
            pose[:2] += share * (crossing.end - crossing.start[:2])
            tracks.put(row, crossing.track, pose, 0.0, CROSSING_SIZE)

    def _move_pedestrians(self, seconds: float, tracks: Tracks, row: int) -> None:
        for pedestrian, start_time in zip(self._pedestrians, self._start_times, strict=True):
            poses, velocities, present = pedestrian.walk(np.array([seconds]), start_time)
            if present[0]:
                tracks.put(row, pedestrian.track, poses[0], velocities[0], pedestrian.size)
