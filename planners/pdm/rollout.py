"""Proposals of PDM-Closed: every path driven by every target speed, behind what is ahead (§6, §10).

Array axes: L paths, F target speeds, 81 time indices.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.geometry.rings import ring_distance
from shiftsim.planners.idm.corridor import HIT
from shiftsim.planners.pdm.corridor import Corridor, fill_corridor, make_corridor
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Occupants, forecast_ranks
from shiftsim.planners.pdm.parameters import DT, SCORED, STEPS, FollowingModel
from shiftsim.planners.pdm.path import PdmPath, interpolate, project
from shiftsim.planners.pdm.route import box_to_ring
from shiftsim.world.state import VX, VehicleParameters

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
    ranks = np.full((NUM_FORECASTS, len(occupants.ignored)), -1)
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
    footprint = np.empty((4, 2))
    sides, centroids = corridor.sides, corridor.progress
    ignored, headings, speeds = occupants.ignored, occupants.headings, occupants.speeds
    hits = np.empty(len(ignored), np.int64)
    num_boxes = len(speeds)
    for step in range(first, last + 1):
        forecast = step // 2
        num_hits = 0
        for index in range(len(ignored)):
            if sides[forecast, index] == HIT and not ignored[index]:
                hits[num_hits] = index
                num_hits += 1
        # nuPlan: one lead for all policies of a path, cleared once per time index; what a policy
        # does not overwrite it inherits from the one before (pdm-closed.md §11 Q2)
        lead_speed, rear = 0.0, 0.0
        for policy in range(len(targets)):
            progress, speed = motion[policy, step - 1, 0], motion[policy, step - 1, 1]
            pose, lead = poses[policy, step - 1], leads[policy, step]
            if step % 2 == 1:
                for column in range(3):  # nuPlan: at index 1 these are zeros (§11 Q3)
                    lead[column] = leads[policy, step - 1, column]
            else:
                x = pose[0] + size[2] * np.cos(pose[2])
                y = pose[1] + size[2] * np.sin(pose[2])
                lead[0] = path.progress[-1]
                if _any_ahead(hits[:num_hits], centroids[forecast], progress):
                    box_corners(x, y, pose[2], size[0], size[1], footprint)
                    found, distance = _nearest(
                        hits[:num_hits],
                        centroids[forecast],
                        progress,
                        footprint,
                        occupants.boxes[forecast],
                        occupants.centers[forecast],
                        occupants.radii,
                        occupants.light_xy,
                        occupants.light_ptr,
                        ranks[forecast],
                    )
                    if found < 0:
                        return step
                    lead[0] = progress + distance
                    if found < num_boxes:
                        turn = wrap_angle(headings[found] - pose[2])
                        lead_speed = speeds[found] * np.cos(turn)
                else:
                    rear = 0.5 * size[0]
                lead[1], lead[2] = lead_speed, rear
            accel = acceleration(progress, speed, lead, targets[policy], model)
            motion[policy, step, 0] = progress + 0.1 * speed
            motion[policy, step, 1] = speed + 0.1 * accel
            interpolate(path, motion[policy, step, 0], poses[policy, step])
    return DONE


@lean_kernel
def _any_ahead(hits: IntArray, centroids: FloatArray, progress: float) -> bool:
    for index in hits:
        if centroids[index] > progress:
            return True
    return False


@lean_kernel
def _nearest(
    hits: IntArray,
    centroids: FloatArray,
    progress: float,
    footprint: FloatArray,
    boxes: FloatArray,
    centers: FloatArray,
    radii: FloatArray,
    light_xy: FloatArray,
    light_ptr: IntArray,
    ranks: IntArray,
) -> tuple[int, float]:
    """The occupant ahead nearest to the footprint, by rank on ties, and its distance [m].

    The occupant is -1 where ranks are needed and not known.
    """
    x = 0.5 * (footprint[0, 0] + footprint[2, 0])
    y = 0.5 * (footprint[0, 1] + footprint[2, 1])
    radius = np.hypot(footprint[0, 0] - x, footprint[0, 1] - y) + 1e-6
    best, found, is_tied = np.inf, -1, False
    for index in hits:
        if not centroids[index] > progress:
            continue
        light = index - len(radii)
        if light >= 0:
            ring = light_xy[light_ptr[light] : light_ptr[light + 1]]
            distance = box_to_ring(footprint, ring)
        else:
            away = np.hypot(centers[index, 0] - x, centers[index, 1] - y)
            if away - radius - radii[index] > best:
                continue
            distance = ring_distance(footprint, boxes[index])
        if distance < best:
            best, found, is_tied = distance, index, False
        elif distance == best:
            if ranks[index] < 0:
                is_tied = True
            elif ranks[index] < ranks[found]:
                found = index
    if is_tied:
        return -1, best
    return found, best


@lean_kernel
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
        progress, speed = motion[row, 0], motion[row, 1]
        out[row, 0] = progress + 0.1 * speed
        accel = acceleration(progress, speed, leads[row], targets[row], model)
        out[row, 1] = speed + 0.1 * accel
    return out
