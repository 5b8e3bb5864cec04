"""Vehicles driven by planners: each is an ego of its own."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shiftsim.errors import TrafficError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.sim.loop import executable, follow
from shiftsim.sim.planner import ObservationBuilder, Planner, rollout_rows, scene_info
from shiftsim.sim.traffic.lanes import CANDIDATES, NO_LANE, choose_lane, lanes_of, next_lane
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    NUM_STATE,
    PACIFICA,
    VX,
    AgentKind,
    Tracks,
    center_poses,
    map_velocity,
    rear_poses,
)

ROUTE = 400.0  # m of lanes ahead that a vehicle's route leads over
_EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


@dataclass(slots=True)
class _Driver:
    """One vehicle and who drives it."""

    track: int
    planner: Planner
    ego: FloatArray  # (B, 11) its states, by row of the rollout
    tracks: Tracks  # what it sees: the ego in its own place
    observations: ObservationBuilder


class PlannedTraffic:
    """Vehicles on a lane at iteration 0 are driven by a planner, each as the ego is.

    Vehicles whose lane leads nowhere are replayed.

    The planner is told a route along the lanes, at forks the one that bends least, and sees the ego
    among the vehicles. Plans are tracked as the ego's are, with the dimensions of nuPlan's ego
    vehicle; boxes keep their sizes. Other tracks are replayed.
    """

    def __init__(self, make: Callable[[], Planner]) -> None:
        """`make` makes a planner for one vehicle in one rollout."""
        self._make = make
        self._drivers: list[_Driver] = []

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Give every vehicle a planner."""
        vehicles = tracks.valid[row] & (tracks.kinds == AgentKind.VEHICLE)
        if own is not None:
            vehicles &= np.isin(np.arange(tracks.num_tracks), own)
        self._scenario, self._lanes = scenario, lanes_of(scenario.map)
        rows, _ = rollout_rows(scenario)
        self._time_us, self._clock = scenario.time_us[rows], scenario.time_us[rows].tolist()
        self._lights = scenario.traffic_lights.rows(rows)
        self._seen_ego = np.full((len(rows), NUM_STATE), np.nan)
        self._seen_ego[: row + 1] = scenario.ego[rows[: row + 1]]
        self._drivers = []
        for track in np.flatnonzero(vehicles).tolist():
            route = self._route(tracks.poses[row, track])
            if len(route) > 1:  # most planners need two blocks
                self._drivers.append(self._driver(tracks, track, route, row))

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Ask every vehicle's planner, and move it.

        Raises:
            TrafficError: A planner failed.
        """
        self._seen_ego[row - 1] = ego
        for driver in self._drivers:
            self._show(driver, tracks, row - 1)
        for driver in self._drivers:
            try:
                self._move(driver, iteration, row)
            except Exception as error:
                raise TrafficError(
                    f"the planner of vehicle {tracks.tokens[driver.track]!r} failed at iteration "
                    f"{iteration}: {error}",
                    hint="leave the scenario out, or use other traffic",
                ) from error
        for driver in self._drivers:
            state, size = driver.ego[row], tracks.sizes[row - 1, driver.track]
            pose = center_poses(state[None, :3])[0]
            tracks.put(row, driver.track, pose, map_velocity(state), size)

    def _route(self, pose: FloatArray) -> tuple[str, ...]:
        """Roadblocks along the lanes ahead of a pose; none where it is on no lane."""
        found, road = np.empty(CANDIDATES, np.int64), self._scenario.map
        x, y, heading = pose.tolist()
        edge = choose_lane(self._lanes, x, y, heading, NO_LANE, found)
        blocks: list[int] = []
        length, seen = 0.0, set[int]()
        while edge != NO_LANE and length < ROUTE and edge not in seen:
            seen.add(edge)
            block = int(road.block_of[edge])
            if block >= 0 and (not blocks or blocks[-1] != block):
                blocks.append(block)
            length += road.baselines.length(edge)
            edge = next_lane(self._lanes, edge)
        return tuple(road.blocks.ids[block] for block in blocks)

    def _driver(self, tracks: Tracks, track: int, route: tuple[str, ...], row: int) -> _Driver:
        scenario = self._scenario
        ego = np.full((len(self._clock), NUM_STATE), np.nan)
        there = tracks.valid[: row + 1, track]
        first = row - int(np.argmin(there[::-1])) + 1 if not there.all() else 0
        ego[: row + 1] = 0.0
        ego[: row + 1, :3] = rear_poses(tracks.poses[: row + 1, track])
        velocity = np.nan_to_num(tracks.velocities[: row + 1, track])
        heading = tracks.poses[: row + 1, track, 2]
        ego[: row + 1, VX] = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
        if first:  # what is not recorded: straight back with the speed of the first sighting
            ego[:first] = ego[first]
            spans = (self._time_us[first] - self._time_us[:first]) * 1e-6
            way = spans * ego[first, VX]
            ego[:first, 0] -= way * np.cos(ego[first, 2])
            ego[:first, 1] -= way * np.sin(ego[first, 2])
        names = [*tracks.tokens]
        names[track] = "ego"
        seen = replace(tracks.copy(), tokens=tuple(names))
        planner = self._make()
        token, start = f"{scenario.token}:{tracks.tokens[track]}", ego[row, :3].copy()
        scene = scene_info(scenario)
        planner.reset(replace(scene, route=route, goal=None, token=token, start=start))
        driver = _Driver(
            track, planner, ego, seen, ObservationBuilder(self._time_us, ego, seen, self._lights)
        )
        for past in range(row + 1):
            self._show(driver, tracks, past)
        return driver

    def _show(self, driver: _Driver, tracks: Tracks, row: int) -> None:
        """Write what a driver sees of a row: everybody, and the ego where he is himself."""
        seen, track = driver.tracks, driver.track
        for target, source in zip(seen.arrays, tracks.arrays, strict=True):
            target[row] = source[row]
        ego = self._seen_ego[row]
        seen.put(row, track, center_poses(ego[None, :3])[0], map_velocity(ego), _EGO_SIZE)

    def _move(self, driver: _Driver, iteration: int, row: int) -> None:
        """Write the next state of a driver."""
        now_us, next_us = self._clock[row - 1], self._clock[row]
        answer = driver.planner.plan(driver.observations.at(iteration, row - 1))
        plan = executable(answer, now_us, next_us)
        states = driver.ego[row - 1], driver.ego[row]
        follow(plan, (now_us, next_us), states, np.empty(2), np.zeros(2))
