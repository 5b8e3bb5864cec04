"""Proposals of PDM-Closed: every path driven by every target speed, behind what is ahead.

Array axes: L paths, F target speeds, 81 time indices.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.geometry.boxes import box_corners, circle_around, wrap_angle
from shiftsim.geometry.polylines import HIT, Path, pose_at, project
from shiftsim.geometry.rings import ring_distance
from shiftsim.planners.pdm.corridor import Corridor, fill_corridor, make_corridor
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Forecast, forecast_ranks
from shiftsim.planners.pdm.parameters import FollowingModel
from shiftsim.planners.proposals.places import EgoBox
from shiftsim.planners.proposals.tracker import DT, SCORED, STEPS
from shiftsim.world.state import VX

MIN_PROGRESS = 1e-5  # m, nuPlan rule 190: keeps clear of a duplicate vertex at the very start
_DONE = -1
_TIED = -2  # instead of what is nearest


class Scene(NamedTuple):
    """What proposals are rolled out in."""

    paths: Sequence[Path]  # the centerline and those beside it
    forecast: Forecast  # what is around
    size: EgoBox  # of the ego
    model: FollowingModel  # the longitudinal policy


class Rows(NamedTuple):
    """Policies of one path; zeros where not rolled out yet."""

    targets: FloatArray  # (F,) target speeds [m/s]
    poses: FloatArray  # (F, 81, 3) x [m], y [m], heading [rad]
    motion: FloatArray  # (F, 81, 2) progress [m], speed [m/s]
    leads: FloatArray  # (F, 81, 3) progress [m], speed [m/s], rear length [m]


class Proposals(NamedTuple):
    """Rear-axle poses, motion along the path, and leads, as in `Rows`, of all paths."""

    targets: FloatArray  # (F,) target speeds [m/s]
    poses: FloatArray  # (L, F, 81, 3)
    motion: FloatArray  # (L, F, 81, 2)
    leads: FloatArray  # (L, F, 81, 3)
    corridors: tuple[Corridor, ...]  # one per path

    def rows(self, path: int, chosen: slice = slice(None)) -> Rows:
        """Some of the policies of a path."""
        arrays = (self.poses, self.motion, self.leads)
        return Rows(self.targets[chosen], *(array[path, chosen] for array in arrays))


def start_proposals(scene: Scene, ego: FloatArray, targets: FloatArray) -> Proposals:
    """Proposals at time index 0: on the paths, beside the ego (11,)."""
    shape = (len(scene.paths), len(targets), STEPS + 1)
    poses, motion = np.zeros((*shape, 3)), np.zeros((*shape, 2))
    reach = STEPS * DT * abs(float(targets.max()))
    half_width, count = 0.5 * scene.size.width, len(scene.forecast.ignored)
    corridors = []
    for index, path in enumerate(scene.paths):
        progress = project(path, ego[0], ego[1], 0)[0]
        read_pose(path, progress, poses[index, 0, 0])
        poses[index, :, 0] = poses[index, 0, 0]
        motion[index, :, 0] = progress, ego[VX]
        corridors.append(make_corridor(progress, progress + reach, half_width, count))
    return Proposals(targets, poses, motion, np.zeros((*shape, 3)), tuple(corridors))


def roll_out(proposals: Proposals, scene: Scene) -> None:
    """Fill time indices 1 … 40 of all proposals."""
    for index in range(len(scene.paths)):
        _roll_path(proposals, scene, index, proposals.rows(index), range(1, SCORED + 1))


def extend(proposals: Proposals, scene: Scene, best: int) -> FloatArray:
    """Fill time indices 41 … 80 of the proposal numbered `best`; its poses (81, 3)."""
    index, speed = divmod(best, len(proposals.targets))
    chosen = proposals.rows(index, slice(speed, speed + 1))
    _roll_path(proposals, scene, index, chosen, range(SCORED + 1, STEPS + 1))
    return proposals.poses[index, speed]


def _roll_path(proposals: Proposals, scene: Scene, index: int, rows: Rows, steps: range) -> None:
    path, corridor, forecast = scene.paths[index], proposals.corridors[index], scene.forecast
    last = steps[-1]
    fill_corridor(path, corridor, forecast, (steps[0] + 1) // 2, last // 2 + 1)
    ranks = np.full((NUM_FORECASTS, len(forecast.ignored)), -1)
    around, scratch = (path, corridor, forecast, ranks), (np.empty((4, 2)), ranks[0].copy())
    step = steps[0]
    while True:
        step = _roll(step, last, *around, scene.size, scene.model, rows, *scratch)
        if step == _DONE:
            return
        ranks[step // 2] = forecast_ranks(forecast, step // 2)


@lean_kernel
def read_pose(path: Path, progress: float, out: FloatArray) -> None:
    """Write the pose (3,) at a progress, clamped to the path, into `out`; zeros for NaN."""
    if progress != progress:
        # nuPlan rule 191: a speed limit of 0 makes progress undefined
        out[0], out[1], out[2] = 0.0, 0.0, 0.0
        return
    out[0], out[1], turn = pose_at(path, max(progress, MIN_PROGRESS))
    out[2] = np.arctan2(np.sin(turn), np.cos(turn))


@lean_kernel
def _roll(
    first: int,  # first time index to fill; the one before it is filled
    last: int,  # last time index to fill
    path: Path,
    corridor: Corridor,  # what stands in its way
    forecast: Forecast,
    ranks: IntArray,  # (41, M) order of what is around on a forecast map, -1 where not known
    size: EgoBox,
    model: FollowingModel,  # the longitudinal policy
    rows: Rows,
    footprint: FloatArray,  # (4, 2) scratch
    hits: IntArray,  # (M,) scratch
) -> int:
    """Roll the policies of one path on, from time index `first` to `last`.

    Returns:
        _DONE, or the time index whose ranks are needed to break a tie.
    """
    others, num_boxes = forecast.others, len(forecast.headings)
    for step in range(first, last + 1):
        row = step // 2
        num_hits, farthest = 0, -np.inf
        for index in range(len(hits)):
            if corridor.sides[row, index] == HIT and not forecast.ignored[index]:
                hits[num_hits] = index
                num_hits += 1
                farthest = max(farthest, corridor.progress[row, index])
        # nuPlan rule 192: one lead for all policies of a path, cleared once per time index; what a
        # policy does not overwrite it inherits from the one before
        lead_speed, rear = 0.0, 0.0
        for policy in range(len(rows.targets)):
            before, pose = rows.motion[policy, step - 1], rows.poses[policy, step - 1]
            progress, lead = before[0], rows.leads[policy, step]
            if step % 2 == 1:
                for column in range(3):  # nuPlan rule 193: at index 1 these are zeros
                    lead[column] = rows.leads[policy, step - 1, column]
            else:
                lead[0] = path.progress[-1]
                if farthest > progress:
                    x = pose[0] + size.rear_axle_to_center * np.cos(pose[2])
                    y = pose[1] + size.rear_axle_to_center * np.sin(pose[2])
                    box_corners(x, y, pose[2], size.length, size.width, footprint)
                    found, distance = _nearest(
                        hits[:num_hits],
                        corridor.progress[row],
                        progress,
                        footprint,
                        others.boxes[row],
                        others.centers[row],
                        others.radii,
                        forecast.light_xy,
                        forecast.light_ptr,
                        forecast.light_bounds,
                        ranks[row],
                    )
                    if found == _TIED:
                        return step
                    lead[0] = progress + distance
                    if found < num_boxes:
                        turn = wrap_angle(forecast.headings[found] - pose[2])
                        lead_speed = others.speeds[row, found] * np.cos(turn)
                else:
                    rear = 0.5 * size.length
                lead[1], lead[2] = lead_speed, rear
            follow(before, lead, rows.targets[policy], model, rows.motion[policy, step])
            read_pose(path, rows.motion[policy, step, 0], rows.poses[policy, step])
    return _DONE


@lean_kernel
def _nearest(
    hits: IntArray,
    along: FloatArray,
    progress: float,
    footprint: FloatArray,
    boxes: FloatArray,
    centers: FloatArray,
    radii: FloatArray,
    light_xy: FloatArray,
    light_ptr: IntArray,
    light_bounds: FloatArray,
    ranks: IntArray,
) -> tuple[int, float]:
    """What is nearest to the footprint (4, 2) of all ahead, by rank on ties, and its distance [m].

    Something is ahead; it is _TIED where ranks are needed and not known. The rows of the forecast
    map are handed over because the whole forecast takes longer to hand over than to use.
    """
    x, y, radius = circle_around(footprint)
    best, found, is_tied = np.inf, -1, False
    for index in hits:
        if not along[index] > progress:
            continue
        light = index - len(radii)
        if light >= 0:
            bounds = light_bounds[light]
            apart_x = max(bounds[0] - x, x - bounds[2])
            apart_y = max(bounds[1] - y, y - bounds[3])
            if max(apart_x, apart_y) - radius > best:
                continue
            ring = light_xy[light_ptr[light] : light_ptr[light + 1]]
        else:
            ring, center = boxes[index], centers[index]
            if np.hypot(center[0] - x, center[1] - y) - radius - radii[index] > best:
                continue
        distance = ring_distance(footprint, ring)
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


@lean_kernel
def follow(
    before: FloatArray, lead: FloatArray, target: float, model: FollowingModel, out: FloatArray
) -> None:
    """Write progress and speed (2,) one step after `before`, behind a lead (3,)."""
    # nuPlan rule 191: a target speed of 0 gives NaN
    progress, speed = before[0], before[1]
    closing = speed * (speed - lead[1]) / (2.0 * np.sqrt(model.accel_max * model.decel_max))
    wanted = model.min_gap + speed * model.headway + closing
    gap = max(lead[0] - progress - lead[2], model.min_gap)
    free = (speed / target) ** model.exponent
    accel = model.accel_max * (1.0 - free - (wanted / gap) ** 2)
    if accel < -model.decel_max:
        accel = -model.decel_max
    elif accel > model.accel_max:
        accel = model.accel_max
    out[0], out[1] = progress + 0.1 * speed, speed + 0.1 * accel
