"""Proposals of PDM-Closed: every path driven by every target speed, behind what is ahead.

Array axes: L paths, F target speeds, 81 time indices.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.boxes import circle_around, wrap_angle
from shiftsim.geometry.corridor import CLEAR, HIT, UNDECIDED
from shiftsim.geometry.polylines import Path, pose_at, project
from shiftsim.geometry.rings import ring_bounds, ring_distance
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.pdm.corridor import Corridors, Paths, corridor_shape, fill_corridor
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Forecast, forecast_ranks, ring_of
from shiftsim.planners.pdm.parameters import FollowingModel
from shiftsim.planners.proposals.places import EgoBox, ego_corners
from shiftsim.planners.proposals.tracker import DT, SCORED, STEPS
from shiftsim.world.state import VX, X, Y

MIN_PROGRESS = 1e-5  # m, nuPlan rule 190: keeps clear of a duplicate vertex at the very start
_TIED = -2  # instead of what is nearest
_DONE = -3  # instead of what must be known to go on


class Scene(NamedTuple):
    """What proposals are rolled out in."""

    paths: Paths  # the centerline and those beside it
    forecast: Forecast  # what is around
    size: EgoBox  # of the ego
    model: FollowingModel  # the longitudinal policy


class Proposals(NamedTuple):
    """Policies of all paths; zeros where not rolled out yet."""

    targets: FloatArray  # (F,) target speeds [m/s]
    poses: FloatArray  # (L, F, 81, 3) rear axle x [m], y [m], heading [rad]
    motion: FloatArray  # (L, F, 81, 2) progress [m], speed [m/s]
    leads: FloatArray  # (L, F, 81, 3) progress [m], speed [m/s], rear length [m]
    corridors: Corridors  # what stands in the way
    ranks: IntArray  # (41, M) order of what is around on a forecast map, -1 where not known


def roll_out(
    scene: Scene, ego: FloatArray, targets: FloatArray, horizon: float = STEPS * DT
) -> Proposals:
    """Time indices 0 … 40 of all proposals, from beside the ego (11,).

    Leads are looked for as far as the fastest one gets within `horizon` [s].
    """
    num_paths, num_targets = len(scene.paths.xy), len(targets)
    shape, count = (num_paths, num_targets, STEPS + 1), len(scene.forecast.ignored)
    proposals = Proposals(
        targets,
        np.zeros((*shape, 3)),
        np.zeros((*shape, 2)),
        np.zeros((*shape, 3)),
        Corridors(
            np.zeros((num_paths, 2)),
            0.5 * scene.size.width,
            np.full((num_paths, NUM_FORECASTS, count), CLEAR),
            np.zeros((num_paths, NUM_FORECASTS, count)),
        ),
        np.full((NUM_FORECASTS, count), -1),
    )
    for number in range(num_paths):
        path = scene.paths.at(number)
        progress = project(path, ego[X], ego[Y], 0)[0]
        proposals.poses[number, :, 0] = read_pose(path, progress)
        proposals.motion[number, :, 0] = progress, ego[VX]
        ahead = horizon * abs(float(targets.max()))
        proposals.corridors.spans[number] = progress, progress + ahead
        _roll_on(proposals, scene, number, (0, num_targets - 1), (1, SCORED))
    return proposals


def extend(proposals: Proposals, scene: Scene, best: int) -> FloatArray:
    """Fill time indices 41 … 80 of the proposal numbered `best`; its poses (81, 3)."""
    number, policy = divmod(best, len(proposals.targets))
    _roll_on(proposals, scene, number, (policy, policy), (SCORED + 1, STEPS))
    return proposals.poses[number, policy]


def _roll_on(
    proposals: Proposals,
    scene: Scene,
    number: int,  # of the path
    policies: tuple[int, int],  # the first and the last one
    steps: tuple[int, int],  # time indices to fill; those before are filled
) -> None:
    path, forecast, corridors = scene.paths.at(number), scene.forecast, proposals.corridors
    (step, last), polygon = steps, None
    fill_corridor(path, corridors, forecast, number, (step + 1) // 2, last // 2 + 1)
    while True:
        step, wanted = _roll(number, path, policies, step, last, scene, proposals)
        if wanted == _DONE:
            return
        if wanted == _TIED:
            proposals.ranks[step // 2] = forecast_ranks(forecast, step // 2)
            continue
        if polygon is None:
            low, high = corridors.spans[number].tolist()
            polygon = corridor_shape(path, low, high, corridors.half_width)
            shapely.prepare(polygon)
        touches = polygon.intersects(shapely.Polygon(ring_of(forecast, wanted, step // 2)))
        corridors.occupancy[number, step // 2, wanted] = HIT if touches else CLEAR


@kernel
def read_pose(path: Path, progress: float) -> tuple[float, float, float]:
    """Pose x [m], y [m], heading [rad] at a progress, clamped to the path; zeros for NaN."""
    if progress != progress:
        # nuPlan rule 191: a speed limit of 0 makes progress undefined
        return 0.0, 0.0, 0.0
    x, y, heading = pose_at(path, max(progress, MIN_PROGRESS))
    return x, y, np.arctan2(np.sin(heading), np.cos(heading))


@kernel
def _roll(
    number: int,
    path: Path,
    policies: tuple[int, int],
    first: int,
    last: int,
    scene: Scene,
    proposals: Proposals,
) -> tuple[int, int]:
    """Roll proposals of a path on, from time index `first` to `last`.

    Returns:
        The time index to go on from, and what must be known first: _TIED for the ranks, or which
        of what is around is UNDECIDED; _DONE at the end.
    """
    forecast, size, model = scene.forecast, scene.size, scene.model
    ignored, headings, speeds = forecast.ignored, forecast.headings, forecast.others.speeds
    targets, ranks, end = proposals.targets, proposals.ranks, path.progress[-1]
    motion, poses, leads = proposals.motion, proposals.poses, proposals.leads
    known, along = proposals.corridors.occupancy[number], proposals.corridors.progress[number]
    footprint, hits = np.empty((4, 2)), np.empty(len(ignored), np.int64)
    for step in range(first, last + 1):
        row, num_hits, farthest = step // 2, 0, -np.inf
        if step % 2 == 0:
            for index in range(len(hits)):
                if known[row, index] != CLEAR and not ignored[index]:
                    hits[num_hits] = index
                    num_hits += 1
                    farthest = max(farthest, along[row, index])
        # nuPlan rule 192: one lead for all policies of a path, cleared once per time index; what a
        # policy does not overwrite it inherits from the one before
        lead_speed, rear = 0.0, 0.0
        for policy in range(policies[0], policies[1] + 1):
            progress = motion[number, policy, step - 1, 0]
            speed = motion[number, policy, step - 1, 1]
            if step % 2 == 1:
                for column in range(3):  # nuPlan rule 193: at index 1 these are zeros
                    leads[number, policy, step, column] = leads[number, policy, step - 1, column]
            else:
                leads[number, policy, step, 0] = end
                if farthest > progress:
                    x, y = poses[number, policy, step - 1, 0], poses[number, policy, step - 1, 1]
                    heading = poses[number, policy, step - 1, 2]
                    ego_corners(x, y, heading, size, footprint)
                    found, distance = _nearest(
                        hits[:num_hits], along[row], progress, footprint, forecast, row, ranks[row]
                    )
                    if found == _TIED or known[row, found] == UNDECIDED:
                        return step, found
                    leads[number, policy, step, 0] = progress + distance
                    if found < len(headings):
                        turn = wrap_angle(headings[found] - heading)
                        lead_speed = speeds[row, found] * np.cos(turn)
                else:
                    rear = 0.5 * size.length
                leads[number, policy, step, 1], leads[number, policy, step, 2] = lead_speed, rear
            lead = (
                leads[number, policy, step, 0],
                leads[number, policy, step, 1],
                leads[number, policy, step, 2],
            )
            progress, speed = follow(progress, speed, lead, targets[policy], model)
            motion[number, policy, step, 0], motion[number, policy, step, 1] = progress, speed
            x, y, heading = read_pose(path, progress)
            poses[number, policy, step, 0], poses[number, policy, step, 1] = x, y
            poses[number, policy, step, 2] = heading
    return last, _DONE


@kernel
def _nearest(
    hits: IntArray,
    along: FloatArray,
    progress: float,
    footprint: FloatArray,
    forecast: Forecast,
    row: int,
    ranks: IntArray,
) -> tuple[int, float]:
    """What is nearest to the footprint (4, 2) of all ahead, by rank on ties, and its distance [m].

    Something is ahead; it is _TIED where ranks are needed and not known.
    """
    boxes, centers, radii = forecast.others.boxes, forecast.others.centers, forecast.others.radii
    low_x, low_y, high_x, high_y = ring_bounds(footprint)
    x, y, radius = circle_around(footprint)
    best, found, is_tied = np.inf, -1, False
    for index in hits:
        if not along[index] > progress:
            continue
        light = index - len(radii)
        if light >= 0:
            area = forecast.light_bounds[light]
            apart_x = max(area[0] - high_x, low_x - area[2])
            if max(apart_x, area[1] - high_y, low_y - area[3]) > best:
                continue
            start, stop = forecast.light_ptr[light], forecast.light_ptr[light + 1]
            distance = ring_distance(footprint, forecast.light_xy[start:stop])
        else:
            dx, dy = centers[row, index, 0] - x, centers[row, index, 1] - y
            if np.hypot(dx, dy) - radius - radii[index] > best:
                continue
            distance = ring_distance(footprint, boxes[row, index])
        if distance < best:
            best, found, is_tied = distance, index, False
        elif distance == best:
            if ranks[index] < 0:
                # which of two lights it is makes no difference
                is_tied = is_tied or light < 0 or found < len(radii)
            elif ranks[index] < ranks[found]:
                found = index
    if is_tied:
        return _TIED, best
    return found, best


@kernel
def follow(
    progress: float,
    speed: float,
    lead: tuple[float, float, float],
    target: float,
    model: FollowingModel,
) -> tuple[float, float]:
    """Progress and speed one step later, behind a lead as in `Proposals`."""
    # nuPlan rule 191: a target speed of 0 gives NaN
    closing = speed * (speed - lead[1]) / (2.0 * np.sqrt(model.accel_max * model.decel_max))
    wanted = model.min_gap + speed * model.headway + closing
    gap = max(lead[0] - progress - lead[2], model.min_gap)
    free = (speed / target) ** model.exponent
    accel = model.accel_max * (1.0 - free - (wanted / gap) ** 2)
    if accel < -model.decel_max:
        accel = -model.decel_max
    elif accel > model.accel_max:
        accel = model.accel_max
    return progress + 0.1 * speed, speed + 0.1 * accel
