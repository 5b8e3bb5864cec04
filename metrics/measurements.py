"""Measure a rollout once: everything that depends on geometry and on no threshold."""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.errors import DataError
from shiftsim.metrics import collision, drivable_area, driving_direction, progress, speed_limit
from shiftsim.metrics.comfort import MIN_SAMPLES, ComfortSignals, comfort_signals
from shiftsim.metrics.result import Collision
from shiftsim.metrics.route import EdgeLists, LaneChanges, corner_routes, driven_route, lane_changes
from shiftsim.metrics.time_to_collision import TimeToCollision, time_to_collision
from shiftsim.sim.log import SimulationLog
from shiftsim.world.map import VectorMap
from shiftsim.world.state import STATE_COLUMNS, VehicleParameters, center_poses


@dataclass(frozen=True, slots=True)
class Measurements:
    """One rollout, measured. K samples.

    Attributes:
        time_us: (K,) time stamps [us].
        route: Edges of the ego centre.
        corners: (K, 4, C) edges of the corners.
        lanes: Whether the corners share lanes, and the lane changes.
        comfort: The seven signals.
        progress: Progress of ego and expert along the expert's route.
        drivable: Corners outside and their distances.
        collisions: First contacts, in order of time.
        ttc: Time to collision and partner at each sample.
        overspeed: (K,) speed above the limit, 0 where there is none [m/s].
        lane_progress: (K,) progress along the lane since the sample before [m].
    """

    time_us: IntArray
    route: EdgeLists
    corners: EdgeLists
    lanes: LaneChanges
    comfort: ComfortSignals
    progress: progress.Progress
    drivable: drivable_area.DrivableArea
    collisions: tuple[Collision, ...]
    ttc: TimeToCollision
    overspeed: FloatArray
    lane_progress: FloatArray

    @property
    def is_common(self) -> BoolArray:
        """(K,) whether all corners are in the same or in connected lanes."""
        return self.lanes.is_common

    @property
    def at_fault_times(self) -> list[int]:
        """Time stamp of each at-fault collision, ascending [us]."""
        return [c.time_us for c in self.collisions if c.at_fault]


def measure(log: SimulationLog, road: VectorMap) -> Measurements:
    """Measure one rollout; `judge` applies thresholds to the result.

    Args:
        log: The rollout.
        road: Map it was driven on.

    Raises:
        DataError: The rollout is too short, or a state is not finite.
        MapError: The map is such that nuPlan's own code stops.
    """
    _check(log)
    vehicle = VehicleParameters()
    ego, tracks = collision.flat_ego(log.ego, vehicle), collision.flat_tracks(log.tracks)
    # nuPlan's order of evaluation, which decides what is reported when several things are wrong
    route = driven_route(road, ego.centers)
    corners = corner_routes(road, ego.corners)
    lanes = lane_changes(road, corners)
    comfort = comfort_signals(log.time_us, log.ego)
    along = progress.measure(road, ego.centers, center_poses(log.expert_ego[:, :3], vehicle))
    drivable = drivable_area.measure(road, ego.corners, route, corners)
    contacts = collision.first_contacts(ego, tracks)
    collisions = collision.classify(contacts, log.time_us, log.tracks, lanes.is_common)
    ttc = time_to_collision(ego, tracks, contacts, collisions, lanes.is_common, road, log.tracks)
    return Measurements(
        time_us=log.time_us,
        route=route,
        corners=corners,
        lanes=lanes,
        comfort=comfort,
        progress=along,
        drivable=drivable,
        collisions=collisions,
        ttc=ttc,
        overspeed=speed_limit.overspeed(road, route, ego.speeds),
        lane_progress=driving_direction.lane_progress(road, route, ego.centers),
    )


def _check(log: SimulationLog) -> None:
    where = f"rollout of scenario {log.token!r}"
    if len(log.time_us) < MIN_SAMPLES:
        raise DataError(
            f"{where} has {len(log.time_us)} samples; the metrics need {MIN_SAMPLES}",
            f"simulate at least {MIN_SAMPLES + 1} iterations",
        )
    if len(log.expert_ego) == 0:
        raise DataError(f"{where} has no expert states, which progress is measured against")
    if not len(log.time_us) == len(log.ego) == len(log.tracks):
        raise DataError(
            f"{where}: {len(log.time_us)} time stamps, {len(log.ego)} ego states and "
            f"{len(log.tracks)} rows of tracks do not belong together"
        )
    for name, states in (("ego", log.ego), ("expert", log.expert_ego)):
        if not np.isfinite(states).all():
            row, column = (int(i) for i in np.argwhere(~np.isfinite(states))[0])
            raise DataError(
                f"{where}: {name} {STATE_COLUMNS[column]} at sample {row} is not finite"
            )
    tracks = log.tracks
    sums = tracks.poses[..., 0] + tracks.poses[..., 1] + tracks.poses[..., 2]
    sums += tracks.sizes[..., 0] + tracks.sizes[..., 1]  # not finite as soon as one of them is
    broken = tracks.valid & ~np.isfinite(sums)
    if broken.any():
        row, column = (int(i) for i in np.argwhere(broken)[0])
        raise DataError(
            f"{where}: track {tracks.tokens[column]!r} at sample {row} has a pose or size that "
            "is not finite"
        )
