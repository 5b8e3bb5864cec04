"""Time to collision: everything projected straight ahead for three seconds, and the bound on it."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import AHEAD, BEHIND, bearing_cosine
from shiftsim.geometry.rings import SLACK
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics.collision import BOX_SIZE, Contacts, Ego, FlatTracks, collide, set_box
from shiftsim.metrics.result import (
    Collision,
    MetricPart,
    MetricRow,
    Series,
    Thresholds,
    first_violation,
)
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks

NAME = "time_to_collision_within_bound"
STEP = 0.1  # s
HORIZON = 3.0  # s
# nuPlan rule 63: the horizon itself is not tested
_NUM_TESTS = 29
# nuPlan rule 64: the ego stands below a tenth of the speed that counts for collisions
_STOPPED_SPEED = 5e-3  # m/s


class TimeToCollision(NamedTuple):
    """Time to collision of one rollout."""

    values: FloatArray  # (K,) [s], inf where nothing is hit, 0 at an at-fault collision
    partners: IntArray  # (K,) track that is hit, or -1
    tokens: tuple[str, ...]  # tokens of the tracks


def time_to_collision(
    ego: Ego,
    tracks: FlatTracks,
    contacts: Contacts,
    collisions: tuple[Collision, ...],  # the same contacts with the verdict
    is_common: BoolArray,  # (K,) whether all corners are in the same or in connected lanes
    map: VectorMap,
    named: Tracks,  # for their tokens
) -> TimeToCollision:
    """Smallest time to collision at every sample."""
    num_samples = len(ego.speeds)
    partners = np.full(num_samples, -1)
    for collision in reversed(collisions):
        if collision.at_fault:
            partners[collision.iteration] = named.tokens.index(collision.token)
    values, areas = np.empty(num_samples), map.intersections.polygons
    _time_to_collision(ego, tracks, contacts.first, is_common, areas, values, partners)
    return TimeToCollision(values, partners, named.tokens)


def evaluate(ttc: TimeToCollision, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Score 1 where the bound is exceeded at every sample."""
    bound = thresholds.least_min_ttc
    lowest = float(ttc.values.min())
    violation = first_violation(~(bound < ttc.values), ttc.values, time_us)
    within = float(violation is None)
    if violation is not None and (partner := ttc.partners[violation.iteration]) >= 0:
        violation = violation._replace(partner=ttc.tokens[partner])
    return MetricPart.of(
        MetricRow(NAME, within, lowest, "seconds", bound, violation),
        ("min_time_to_collision", "seconds", "MIN", lowest),
        (NAME, "boolean", "BOOLEAN", within),
        series=Series(f"time_to_collision_under_{HORIZON}_seconds [s]", ttc.values),
    )


@kernel
def _time_to_collision(
    ego: Ego,
    tracks: FlatTracks,
    first: IntArray,  # (N,) sample of the first contact with each track, K where there is none
    is_common: BoolArray,  # (K,) whether all corners are in the same or connected lanes
    intersections: Polygons,
    ttc: FloatArray,  # (K,) written: [s], inf where nothing is hit
    # (K,) track of an at-fault collision at this sample, else -1; the track that is hit is written
    partners: IntArray,
) -> None:
    """Write the time to collision of every sample."""
    speeds, poses, sizes = ego.speeds, tracks.poses, tracks.sizes
    num_samples, num_tracks = tracks.valid.shape
    valid, is_static, velocities = tracks.valid, tracks.is_static, tracks.velocities
    boxes, steps = np.empty((num_tracks + 1, BOX_SIZE)), np.empty((num_tracks + 1, 2))
    listed, scratch, own = np.empty(num_tracks, np.int64), np.empty((2, 4, 2)), boxes[0]
    own_swept, swept = np.empty(BOX_SIZE), np.empty(BOX_SIZE)
    for i in range(num_samples):
        ttc[i] = np.inf
        if partners[i] >= 0:
            ttc[i] = 0.0
            continue
        if speeds[i] <= _STOPPED_SPEED:
            continue
        num, beside = 0, 0  # beside: 0 not asked yet, 1 tracks beside count, -1 they do not
        set_box(own, ego.centers[i], ego.size[0], ego.size[1])
        # nuPlan rule 66: along the heading, whatever the direction of the velocity
        steps[0, 0] = own[2] * speeds[i] * STEP
        steps[0, 1] = own[3] * speeds[i] * STEP
        _stretch(own, speeds[i], own_swept)
        x, y, cos, sin = ego.states[i, 0], ego.states[i, 1], own[2], own[3]
        middle_x, middle_y, lon, lat = own_swept[0], own_swept[1], own_swept[5], own_swept[6]
        for j in range(num_tracks):
            if not valid[i, j] or first[j] <= i:
                continue
            vx = 0.0 if is_static[j] else velocities[i, j, 0]
            vy = 0.0 if is_static[j] else velocities[i, j, 1]
            # generous: what is elongated and further away than this cannot touch
            reach = 0.5 * (sizes[i, j, 0] + sizes[i, j, 1]) + HORIZON * np.sqrt(vx * vx + vy * vy)
            reach += SLACK
            dx, dy = poses[i, j, 0] - middle_x, poses[i, j, 1] - middle_y
            if abs(dx * cos + dy * sin) > lon + reach or abs(dx * sin - dy * cos) > lat + reach:
                continue
            cosine = bearing_cosine(cos, sin, poses[i, j, 0] - x, poses[i, j, 1] - y)
            angle = np.arccos(cosine)  # beside where it is NaN
            if angle > BEHIND:
                continue
            if not angle < AHEAD:
                if beside == 0:
                    # nuPlan rule 65: tracks beside the ego count between lanes and in intersections
                    beside = 1 if not is_common[i] or in_any(intersections, x, y) else -1
                if beside < 0:
                    continue
            box = boxes[num + 1]
            set_box(box, poses[i, j], sizes[i, j, 0], sizes[i, j, 1])
            speed = np.hypot(vx, vy)
            _stretch(box, speed, swept)
            if collide(own_swept, swept, scratch):
                steps[num + 1, 0], steps[num + 1, 1] = box[2] * speed * STEP, box[3] * speed * STEP
                listed[num] = j
                num += 1
        hit = 0
        for k in range(1, _NUM_TESTS + 1 if num > 0 else 1):
            # nuPlan rule 67: positions accumulate rounding step by step
            own[0] += steps[0, 0]
            own[1] += steps[0, 1]
            for index in range(1, num + 1):
                boxes[index, 0] += steps[index, 0]
                boxes[index, 1] += steps[index, 1]
                dx, dy = boxes[index, 0] - own[0], boxes[index, 1] - own[1]
                reach = own[7] + boxes[index, 7]
                # most are too far away, which is decided without a call
                if dx * dx + dy * dy <= reach * reach and collide(own, boxes[index], scratch):
                    hit = index
                    break
            if hit > 0:
                # nuPlan rule 63: times are numpy's arange, whose values are multiples of the step
                ttc[i], partners[i] = STEP * k, listed[hit - 1]
                break


@kernel
def _stretch(box: FloatArray, speed: float, out: FloatArray) -> None:
    """Write the box (8,) that holds another one while it moves through the horizon."""
    distance = speed * HORIZON
    for index in range(BOX_SIZE):  # a slice assignment takes numba seconds to compile
        out[index] = box[index]
    out[0] += 0.5 * distance * box[2]
    out[1] += 0.5 * distance * box[3]
    length, width = 2.0 * box[5] + distance, 2.0 * box[6]
    out[5], out[7] = 0.5 * length, 0.5 * np.sqrt(length * length + width * width)
