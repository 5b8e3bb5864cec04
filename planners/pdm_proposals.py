"""Proposals of PDM-Closed: every path driven by every target speed, behind what is ahead (§6, §10).

Array axes: L paths, F target speeds, 81 time indices.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, kernel
from shiftsim.geometry import box_corners, ring_distance, wrap_angle
from shiftsim.planners.idm_corridor import HIT
from shiftsim.planners.pdm_centerline import box_to_ring
from shiftsim.planners.pdm_corridor import Corridor, fill_corridor, make_corridor
from shiftsim.planners.pdm_forecast import (
    LIGHT,
    NUM_FORECASTS,
    Occupants,
    forecast_ranks,
    place_ring,
    widest,
)
from shiftsim.planners.pdm_parameters import DT, SCORED, STEPS, FollowingModel
from shiftsim.planners.pdm_path import PdmPath, interpolate, project
from shiftsim.state import VX, VehicleParameters

DONE = -1


class Proposals(NamedTuple):
    """Rear-axle poses, motion along the path, and leads; zeros where not rolled out yet.

    Attributes:
        poses: (L, F, 81, 3) x [m], y [m], heading [rad].
        motion: (L, F, 81, 2) progress [m], speed [m/s].
        leads: (L, F, 81, 3) progress [m], speed [m/s], rear length [m].
        targets: (F,) target speeds [m/s].
        corridors: One per path.
    """

    poses: FloatArray
    motion: FloatArray
    leads: FloatArray
    targets: FloatArray
    corridors: tuple[Corridor, ...]


def start_proposals(
    paths: Sequence[PdmPath],
    ego: FloatArray,
    targets: FloatArray,
    vehicle: VehicleParameters,
    num_occupants: int,
) -> Proposals:
    """Proposals at time index 0: on the paths, beside the ego (11,)."""
    shape = (len(paths), len(targets), STEPS + 1)
    made = Proposals(
        np.zeros((*shape, 3)), np.zeros((*shape, 2)), np.zeros((*shape, 3)), targets, ()
    )
    reach = STEPS * DT * abs(float(targets.max()))
    corridors = []
    pose = np.empty(3)
    for index, path in enumerate(paths):
        progress = project(path, ego[0], ego[1], 0)[0]
        interpolate(path, progress, pose)
        made.poses[index, :, 0] = pose
        made.motion[index, :, 0] = progress, ego[VX]
        corridors.append(
            make_corridor(progress, progress + reach, 0.5 * vehicle.width, num_occupants)
        )
    return made._replace(corridors=tuple(corridors))


def roll_out(
    proposals: Proposals,
    paths: Sequence[PdmPath],
    occupants: Occupants,
    vehicle: VehicleParameters,
    model: FollowingModel,
) -> None:
    """Fill time indices 1 … 40 of all proposals."""
    for index in range(len(paths)):
        _roll_path(
            proposals, index, slice(None), 1, SCORED, paths[index], occupants, vehicle, model
        )


def extend(
    proposals: Proposals,
    best: int,
    paths: Sequence[PdmPath],
    occupants: Occupants,
    vehicle: VehicleParameters,
    model: FollowingModel,
) -> FloatArray:
    """Fill time indices 41 … 80 of the proposal numbered `best`; its poses (81, 3)."""
    index, speed = divmod(best, len(proposals.targets))
    chosen = slice(speed, speed + 1)
    path = paths[index]
    _roll_path(proposals, index, chosen, SCORED + 1, STEPS, path, occupants, vehicle, model)
    return proposals.poses[index, speed]


def _roll_path(
    proposals: Proposals,
    index: int,
    chosen: slice,
    first: int,
    last: int,
    path: PdmPath,
    occupants: Occupants,
    vehicle: VehicleParameters,
    model: FollowingModel,
) -> None:
    corridor = proposals.corridors[index]
    fill_corridor(path, corridor, occupants, (first + 1) // 2, last // 2 + 1)
    ranks = np.full((NUM_FORECASTS, len(occupants.kinds)), -1)
    step = first
    while True:
        step = _roll(
            step,
            last,
            path,
            corridor,
            occupants,
            ranks,
            (vehicle.length, vehicle.width, vehicle.rear_axle_to_center),
            model,
            proposals.targets[chosen],
            proposals.poses[index, chosen],
            proposals.motion[index, chosen],
            proposals.leads[index, chosen],
        )
        if step == DONE:
            return
        ranks[step // 2] = forecast_ranks(occupants, step // 2)


@kernel
def _roll(
    first: int,
    last: int,
    path: PdmPath,
    corridor: Corridor,
    occupants: Occupants,
    ranks: IntArray,
    size: tuple[float, float, float],
    model: FollowingModel,
    targets: FloatArray,
    poses: FloatArray,
    motion: FloatArray,
    leads: FloatArray,
) -> int:
    """Roll the policies of one path on, from time index `first` to `last`.

    Args:
        first: First time index to fill; the one before it is filled.
        last: Last time index to fill.
        path: The path.
        corridor: What stands in its way.
        occupants: The polygons.
        ranks: (41, M) order of the occupants on a forecast map, -1 where not known.
        size: Length and width of the ego, rear axle to centre [m].
        model: The longitudinal policy.
        targets: (F,) target speeds [m/s].
        poses: (F, 81, 3) as in `Proposals`.
        motion: (F, 81, 2) as in `Proposals`.
        leads: (F, 81, 3) as in `Proposals`.

    Returns:
        DONE, or the time index whose ranks are needed to break a tie.
    """
    footprint, ring_room = np.empty((4, 2)), np.empty((widest(occupants), 2))
    hits = np.empty(len(occupants.kinds), np.int64)
    end = path.progress[-1]
    for step in range(first, last + 1):
        forecast = step // 2
        num_hits = 0
        for index in range(len(occupants.kinds)):
            if corridor.sides[forecast, index] == HIT and not occupants.ignored[index]:
                hits[num_hits] = index
                num_hits += 1
        # nuPlan: one lead for all policies of a path, cleared once per time index; what a policy
        # does not overwrite it inherits from the one before (pdm-closed.md §11 Q2)
        lead_speed, rear = 0.0, 0.0
        for policy in range(len(targets)):
            progress, speed = motion[policy, step - 1]
            if step % 2 == 1:
                leads[policy, step] = leads[policy, step - 1]  # nuPlan: at 1 these are zeros (Q3)
            else:
                pose = poses[policy, step - 1]
                center_x = pose[0] + size[2] * np.cos(pose[2])
                center_y = pose[1] + size[2] * np.sin(pose[2])
                box_corners(center_x, center_y, pose[2], size[0], size[1], footprint)
                best, found, is_tied = np.inf, -1, False
                for index in hits[:num_hits]:
                    if not corridor.progress[forecast, index] > progress:
                        continue
                    seconds = 0.1 * (2 * forecast)
                    dx = occupants.circles[index, 0] + seconds * occupants.motion[index, 0]
                    dy = occupants.circles[index, 1] + seconds * occupants.motion[index, 1]
                    around = occupants.circles[index, 2] + 0.5 * (size[0] + size[1])
                    if np.hypot(dx - center_x, dy - center_y) - around > best:
                        continue
                    ring = ring_room[: place_ring(occupants, index, forecast, ring_room)]
                    if occupants.kinds[index] == LIGHT:
                        distance = box_to_ring(footprint, ring)
                    else:
                        distance = ring_distance(footprint, ring)
                    if distance < best:
                        best, found, is_tied = distance, index, False
                    elif distance == best:
                        if ranks[forecast, index] < 0:
                            is_tied = True
                        elif ranks[forecast, index] < ranks[forecast, found]:
                            found = index
                if is_tied:
                    return step
                lead_progress = end
                if found < 0:
                    rear = 0.5 * size[0]
                else:
                    lead_progress = progress + best
                    if occupants.kinds[found] != LIGHT:
                        turn = wrap_angle(occupants.headings[found] - pose[2])
                        lead_speed = occupants.speeds[found] * np.cos(turn)
                leads[policy, step, 0] = lead_progress
                leads[policy, step, 1] = lead_speed
                leads[policy, step, 2] = rear
            accel = acceleration(progress, speed, leads[policy, step], targets[policy], model)
            motion[policy, step, 0] = progress + 0.1 * speed
            motion[policy, step, 1] = speed + 0.1 * accel
            interpolate(path, motion[policy, step, 0], poses[policy, step])
    return DONE


@kernel
def acceleration(
    progress: float, speed: float, lead: FloatArray, target: float, model: FollowingModel
) -> float:
    """Clipped IDM acceleration [m/s^2] behind a lead (3,); NaN where the target speed is 0 (Q6)."""
    closing = speed * (speed - lead[1]) / (2.0 * np.sqrt(model.accel_max * model.decel_max))
    wanted = model.min_gap + speed * model.headway + closing
    gap = max(lead[0] - progress - lead[2], model.min_gap)
    free = (speed / target) ** model.exponent
    accel = model.accel_max * (1.0 - free - (wanted / gap) ** 2)
    if accel < -model.decel_max:
        return -model.decel_max
    if accel > model.accel_max:
        return model.accel_max
    return accel


@kernel
def follow_many(
    motion: FloatArray, leads: FloatArray, targets: FloatArray, model: FollowingModel
) -> FloatArray:
    """(K, 2) progress and speed after one step, for K unrelated rows as in `Proposals`."""
    out = np.empty((len(motion), 2))
    for row in range(len(motion)):
        progress, speed = motion[row]
        out[row, 0] = progress + 0.1 * speed
        accel = acceleration(progress, speed, leads[row], targets[row], model)
        out[row, 1] = speed + 0.1 * accel
    return out
