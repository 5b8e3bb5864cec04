"""Proposals of PDM-Closed: every path driven by every target speed, behind what is ahead.

Array axes: L paths, F target speeds, 81 time indices.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.boxes import box_corners, circle_around, wrap_angle
from shiftsim.geometry.corridor import CLEAR, UNDECIDED, is_run_near
from shiftsim.geometry.polylines import RUN, Path, pose_before, project
from shiftsim.geometry.rings import (
    SLACK,
    point_segment_distance,
    ring_bounds,
    ring_distance,
    rings_touch,
)
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.pdm.corridor import (
    Corridors,
    Paths,
    corridor_shape,
    decide,
    fill_corridor,
    make_corridors,
)
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Forecast, forecast_ranks
from shiftsim.planners.pdm.parameters import FollowingModel
from shiftsim.planners.proposals.places import EgoBox
from shiftsim.planners.proposals.tracker import DT, SCORED, STEPS
from shiftsim.world.state import VX

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
    last: FloatArray  # (F, 3) where policies are on the path under way, see `read_pose`


class Part(NamedTuple):
    """Which proposals are rolled on, and how far; ends are included."""

    paths: tuple[int, int]
    policies: tuple[int, int]
    steps: tuple[int, int]  # time indices to fill; those before are filled


def roll_out(scene: Scene, ego: FloatArray, targets: FloatArray) -> Proposals:
    """Time indices 0 … 40 of all proposals, from beside the ego (11,)."""
    num_paths, num_targets = len(scene.paths.xy), len(targets)
    shape, count = (num_paths, num_targets, STEPS + 1), len(scene.forecast.ignored)
    proposals = Proposals(
        targets,
        np.zeros((*shape, 3)),
        np.zeros((*shape, 2)),
        np.zeros((*shape, 3)),
        make_corridors(num_paths, 0.5 * scene.size.width, count),
        np.full((NUM_FORECASTS, count), -1),
        np.empty((num_targets, 3)),
    )
    whole = Part((0, num_paths - 1), (0, num_targets - 1), (1, SCORED))
    _roll_on(proposals, scene, ego, whole)
    return proposals


def extend(proposals: Proposals, scene: Scene, ego: FloatArray, best: int) -> FloatArray:
    """Fill time indices 41 … 80 of the proposal numbered `best`; its poses (81, 3)."""
    path, policy = divmod(best, len(proposals.targets))
    _roll_on(proposals, scene, ego, Part((path, path), (policy, policy), (SCORED + 1, STEPS)))
    return proposals.poses[path, policy]


def _roll_on(proposals: Proposals, scene: Scene, ego: FloatArray, part: Part) -> None:
    paths, forecast, corridors = scene.paths, scene.forecast, proposals.corridors
    scratch = np.empty((4, 2)), np.empty(len(forecast.ignored), np.int64)
    at, step, wanted, shape = part.paths[0], 0, _DONE, None
    while True:
        before = at
        at, step, wanted = _roll(
            at, step, part, ego, paths, forecast, scene.size, scene.model, proposals, *scratch
        )
        if wanted == _DONE:
            return
        if wanted == _TIED:
            proposals.ranks[step // 2] = forecast_ranks(forecast, step // 2)
            continue
        if shape is None or before != at:
            low, high = corridors.spans[at].tolist()
            shape = corridor_shape(paths.at(at), low, high, corridors.half_width)
            shapely.prepare(shape)
        decide(shape, corridors, forecast, at, step // 2, wanted)


@kernel
def read_pose(path: Path, progress: float, last: FloatArray, out: FloatArray) -> None:
    """Write the pose (3,) at a progress, clamped to the path, into `out`; zeros for NaN.

    `last` (3,) is of the last call, to go on from: vertex, heading, the same wrapped; NaN before.
    """
    if progress != progress:
        # nuPlan rule 191: a speed limit of 0 makes progress undefined
        out[0], out[1], out[2] = 0.0, 0.0, 0.0
        return
    end = len(path.progress) - 1
    s = min(max(progress, MIN_PROGRESS, path.progress[0]), path.progress[end])
    if last[0] != last[0]:
        last[0] = np.searchsorted(path.progress, s)
    upper = min(max(int(last[0]), 1), end)
    while upper < end and path.progress[upper] < s:
        upper += 1
    while upper > 1 and path.progress[upper - 1] >= s:
        upper -= 1
    out[0], out[1], turn = pose_before(path, upper, s)
    if turn != last[1]:  # it is the same along straight lines
        last[1], last[2] = turn, np.arctan2(np.sin(turn), np.cos(turn))
    last[0], out[2] = upper, last[2]


@kernel
def _roll(
    first_path: int,  # where to go on
    first_step: int,  # likewise; 0 where the path is new
    part: Part,
    ego: FloatArray,  # (11,) ego state
    paths: Paths,
    forecast: Forecast,
    size: EgoBox,
    model: FollowingModel,  # the longitudinal policy
    made: Proposals,
    footprint: FloatArray,  # (4, 2) scratch
    hits: IntArray,  # (M,) scratch
) -> tuple[int, int, int]:
    """Roll proposals on.

    Returns:
        Path and time index to go on from, and what must be known first: _TIED for the ranks, or
        whether the corridor of the path holds something that is UNDECIDED; _DONE where nothing is left.
    """
    begin, last = part.steps
    step = first_step
    for number in range(first_path, part.paths[1] + 1):
        path = Path(
            paths.xy[number], paths.heading[number], paths.progress[number], paths.runs[number]
        )
        if step == 0:
            step = begin
            made.last[:] = np.nan
            if begin == 1:
                _start(path, made, number, ego)
            fill_corridor(path, made.corridors, forecast, number, (begin + 1) // 2, last // 2 + 1)
        sides, along = made.corridors.occupancy[number], made.corridors.progress[number]
        while step <= last:
            wanted = _follow_leads(
                step,
                path,
                forecast,
                size,
                model,
                made.targets,
                part.policies,
                made.poses[number],
                made.motion[number],
                made.leads[number],
                sides[step // 2],
                along[step // 2],
                made.ranks[step // 2],
                made.last,
                footprint,
                hits,
            )
            if wanted != _DONE:
                return number, step, wanted
            step += 1
        step = 0
    return part.paths[1], 0, _DONE


@kernel
def _start(path: Path, made: Proposals, number: int, ego: FloatArray) -> None:
    """Fill time index 0 of a path's proposals: on the path, beside the ego."""
    progress = project(path, ego[0], ego[1], 0)[0]
    poses, motion, targets = made.poses[number], made.motion[number], made.targets
    for policy in range(len(targets)):
        if policy == 0:
            read_pose(path, progress, made.last[0], poses[0, 0])
        for column in range(3):
            poses[policy, 0, column] = poses[0, 0, column]
        motion[policy, 0, 0], motion[policy, 0, 1] = progress, ego[VX]
    fastest = targets[0]
    for target in targets:
        fastest = max(fastest, target)
    made.corridors.spans[number, 0] = progress
    made.corridors.spans[number, 1] = progress + STEPS * DT * abs(fastest)


@kernel
def _follow_leads(
    step: int,
    path: Path,
    forecast: Forecast,
    size: EgoBox,
    model: FollowingModel,
    targets: FloatArray,  # (F,)
    policies: tuple[int, int],  # the first and the last one
    poses: FloatArray,  # (F, 81, 3) as in `Proposals`
    motion: FloatArray,  # (F, 81, 2)
    leads: FloatArray,  # (F, 81, 3)
    sides: IntArray,  # (M,) on the forecast map
    along: FloatArray,  # (M,) progress
    ranks: IntArray,  # (M,)
    last: FloatArray,  # (F, 3) where they are, see `read_pose`
    footprint: FloatArray,
    hits: IntArray,
) -> int:
    """Fill one time index of a path's proposals; what must be known first, or _DONE."""
    others, num_boxes, row = forecast.others, len(forecast.headings), step // 2
    num_hits, farthest = 0, -np.inf
    if step % 2 == 0:
        for index in range(len(hits)):
            if sides[index] != CLEAR and not forecast.ignored[index]:
                hits[num_hits] = index
                num_hits += 1
                farthest = max(farthest, along[index])
    # nuPlan rule 192: one lead for all policies of a path, cleared once per time index; what a
    # policy does not overwrite it inherits from the one before
    lead_speed, rear = 0.0, 0.0
    for policy in range(policies[0], policies[1] + 1):
        before, pose, lead = motion[policy, step - 1], poses[policy, step - 1], leads[policy, step]
        progress = before[0]
        if step % 2 == 1:
            for column in range(3):  # nuPlan rule 193: at index 1 these are zeros
                lead[column] = leads[policy, step - 1, column]
        else:
            lead[0] = path.progress[-1]
            if farthest > progress:
                x = pose[0] + size.rear_axle_to_center * np.cos(pose[2])
                y = pose[1] + size.rear_axle_to_center * np.sin(pose[2])
                box_corners(x, y, pose[2], size.length, size.width, footprint)
                found, distance = _nearest(
                    hits, num_hits, along, progress, footprint, forecast, row, ranks
                )
                if found == _TIED or sides[found] == UNDECIDED:
                    return found
                lead[0] = progress + distance
                if found < num_boxes:
                    turn = wrap_angle(forecast.headings[found] - pose[2])
                    lead_speed = others.speeds[row, found] * np.cos(turn)
            else:
                rear = 0.5 * size.length
            lead[1], lead[2] = lead_speed, rear
        follow(before, lead, targets[policy], model, motion[policy, step])
        read_pose(path, motion[policy, step, 0], last[policy], poses[policy, step])
    return _DONE


@kernel
def _nearest(
    hits: IntArray,
    num_hits: int,
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
    others = forecast.others
    x, y, radius = circle_around(footprint)
    best, found, is_tied = np.inf, -1, False
    for entry in range(num_hits):
        index = hits[entry]
        if not along[index] > progress:
            continue
        light = index - len(others.radii)
        if light >= 0:
            start, stop = forecast.light_ptr[light], forecast.light_ptr[light + 1]
            first, end = forecast.light_run_ptr[light], forecast.light_run_ptr[light + 1]
            ring, runs = forecast.light_xy[start:stop], forecast.light_runs[first:end]
            distance = _light_distance(footprint, ring, forecast.light_bounds[light], runs, best)
        else:
            dx, dy = others.centers[row, index, 0] - x, others.centers[row, index, 1] - y
            if np.hypot(dx, dy) - radius - others.radii[index] > best:
                continue
            distance = ring_distance(footprint, others.boxes[row, index])
        if distance < best:
            best, found, is_tied = distance, index, False
        elif distance == best:
            if ranks[index] < 0:
                # which of two lights it is makes no difference
                is_tied = is_tied or light < 0 or found < len(others.radii)
            elif ranks[index] < ranks[found]:
                found = index
    if is_tied:
        return _TIED, best
    return found, best


@kernel
def _light_distance(
    footprint: FloatArray, ring: FloatArray, bounds: FloatArray, runs: FloatArray, limit: float
) -> float:
    """As `ring_distance`, of a footprint (4, 2) and a red light; anything more beyond `limit`.

    `bounds` (4,) are those of the light, `runs` (R, 4) those of runs of its edges.
    """
    low_x, low_y, high_x, high_y = ring_bounds(footprint)
    apart_x = max(bounds[0] - high_x, low_x - bounds[2])
    apart_y = max(bounds[1] - high_y, low_y - bounds[3])
    if max(apart_x, apart_y) > limit:
        return np.inf
    if max(apart_x, apart_y) <= 0.0 and rings_touch(footprint, ring):
        return 0.0
    square, guess = np.inf, 0  # the run that is probably nearest is the first one
    for vertex in range(0, len(ring), RUN):
        dx, dy = ring[vertex, 0] - footprint[0, 0], ring[vertex, 1] - footprint[0, 1]
        if dx * dx + dy * dy < square:
            square, guess = dx * dx + dy * dy, vertex // RUN
    around, best = (low_x, low_y, high_x, high_y), np.inf
    for turn in range(-1, len(runs)):
        run = guess if turn < 0 else turn
        reach = min(limit, np.sqrt(square), best) + SLACK
        if turn == guess or not is_run_near(runs, run, around, reach):
            continue
        for vertex in range(run * RUN, min((run + 1) * RUN, len(ring))):
            c, d = ring[vertex - 1], ring[vertex]
            if (
                max(c[0], d[0]) < low_x - reach
                or min(c[0], d[0]) > high_x + reach
                or max(c[1], d[1]) < low_y - reach
                or min(c[1], d[1]) > high_y + reach
            ):
                continue
            for corner in range(4):
                p, q = footprint[corner - 1], footprint[corner]
                best = min(best, point_segment_distance(q[0], q[1], c[0], c[1], d[0], d[1]))
                best = min(best, point_segment_distance(d[0], d[1], p[0], p[1], q[0], q[1]))
            reach = min(reach, best + SLACK)
    return best


@kernel
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
