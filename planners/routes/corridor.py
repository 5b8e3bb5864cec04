"""What stands in the corridor ahead: a stretch of a path, buffered by half the ego's width.

A plan asks for many stretches of one path, and what is around stands still meanwhile. Which objects
the corridor of a segment of the path touches is therefore decided once, when it is first asked for;
a stretch adds its two ends, which may lie within a segment.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import (
    BAND,
    CLEAR,
    HIT,
    OPEN,
    RUN,
    Path,
    is_run_near,
    pose_at,
    side_of_cap,
)
from shiftsim.geometry.rings import (
    SLACK,
    distance_bound,
    point_segment_distance,
    ring_bounds,
    ring_segment_distance,
    rings_touch,
)
from shiftsim.kernels import FloatArray, IntArray, kernel

# beside CLEAR, HIT and OPEN: not looked at yet, and touched by the ego's footprint itself
UNKNOWN, MET = -1, 3


class Objects(NamedTuple):
    """Polygons around the ego. M objects."""

    xy: FloatArray  # (V, 2) vertices of all rings, not closed [m]
    ptr: IntArray  # (M + 1,) first vertex of each ring
    headings: FloatArray  # (M,) heading, 0 for a red light [rad]
    speeds: FloatArray  # (M,) speed, 0 for static objects and red lights [m/s]


class ObstacleCache(NamedTuple):
    """What is known of the objects along a path of S segments, for one width of the corridor."""

    half_width: float  # of the corridor [m]
    # (M, S) of the corridor of each segment: UNKNOWN, CLEAR, HIT or OPEN, int8
    sides: np.ndarray
    hits: IntArray  # (M,) a segment that is known to be HIT, or UNKNOWN
    bounds: FloatArray  # (M, 4) of the objects: min x, min y, max x, max y [m]
    runs: IntArray  # (M, 2) first and last run of the path that come near, or UNKNOWN


def make_survey(path: Path, half_width: float, count: int) -> ObstacleCache:
    """Nothing is known yet of so many objects."""
    sides = np.full((count, len(path.xy) - 1), UNKNOWN, np.int8)
    hits, runs = np.full(count, UNKNOWN), np.full((count, 2), UNKNOWN)
    return ObstacleCache(half_width, sides, hits, np.empty((count, 4)), runs)


@kernel
def start_survey(survey: ObstacleCache, path: Path, objects: Objects, progress: float) -> None:
    """Find out which runs of the path, from a progress on, come near each object."""
    first = max(int(np.searchsorted(path.progress, progress)) - 1, 0) // RUN
    reach = 2.0 * (1.0 + BAND) * survey.half_width  # covers the corners of the square ends
    for index in range(len(survey.hits)):
        ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
        bounds = ring_bounds(ring)
        for column in range(4):
            survey.bounds[index, column] = bounds[column]
        for run in range(first, len(path.runs)):
            if is_run_near(path.runs, run, bounds, reach):
                if survey.runs[index, 0] == UNKNOWN:
                    survey.runs[index, 0] = run
                survey.runs[index, 1] = run


@kernel
def find_sides(
    path: Path,
    low: float,  # progress at which the stretch begins, within the path [m]
    high: float,  # progress at which it ends, within the path [m]
    footprint: FloatArray,  # (4, 2) of the ego [m]
    objects: Objects,
    survey: ObstacleCache,
    ends: FloatArray,  # (4, 2) scratch
    out: IntArray,  # (M,)
) -> None:
    """Decide which objects touch the corridor or the footprint, as far as distances can.

    CLEAR, HIT, OPEN or MET is written to `out` where UNKNOWN stands.
    """
    # the stretch: both ends, and the vertices `first` ... `stop` - 1 between them, as in `sub_path`
    first = int(np.searchsorted(path.progress, low, side="right"))
    stop = int(np.searchsorted(path.progress, high, side="left"))
    has_ends = first < len(path.progress) and stop > 0
    if not has_ends:
        first, stop = (0, 2) if stop == 0 else (len(path.progress) - 2, len(path.progress))
    has_length = _write_ends(path, low, high, first, stop, has_ends, ends)
    for index in range(len(out)):
        if out[index] != UNKNOWN:
            continue
        ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
        if rings_touch(footprint, ring):
            out[index] = MET
        elif not has_length:
            out[index] = OPEN
        elif survey.runs[index, 0] == UNKNOWN:
            out[index] = CLEAR
        else:
            out[index] = _side(path, first, stop, has_ends, ends, ring, survey, index)


@kernel
def _write_ends(
    path: Path, low: float, high: float, first: int, stop: int, has_ends: bool, ends: FloatArray
) -> bool:
    """Write the first two and the last two points of a stretch that differ; whether there are."""
    count = max(stop - first, 0)
    if has_ends:
        ends[0, 0], ends[0, 1], _ = pose_at(path, low)
        ends[3, 0], ends[3, 1], _ = pose_at(path, high)
    else:
        ends[0, 0], ends[0, 1] = path.xy[first, 0], path.xy[first, 1]
        ends[3, 0], ends[3, 1] = path.xy[stop - 1, 0], path.xy[stop - 1, 1]
    for side in range(2):
        here, after = (0, 1) if side == 0 else (3, 2)
        x, y = ends[here, 0], ends[here, 1]
        is_found = False
        for place in range(count + 1):
            if place == count:
                ends[after, 0], ends[after, 1] = ends[3 - here, 0], ends[3 - here, 1]
            else:
                vertex = first + place if side == 0 else stop - 1 - place
                ends[after, 0], ends[after, 1] = path.xy[vertex, 0], path.xy[vertex, 1]
            if ends[after, 0] != x or ends[after, 1] != y:
                is_found = True
                break
        if not is_found:
            return False
    return True


@kernel
def _side(
    path: Path,
    first: int,
    stop: int,
    has_ends: bool,
    ends: FloatArray,
    ring: FloatArray,
    survey: ObstacleCache,
    index: int,
) -> int:
    """CLEAR, HIT or OPEN: whether the ring of an object touches the corridor of a stretch."""
    if first <= survey.hits[index] < stop - 1:
        return HIT
    inner, outer = (1.0 - BAND) * survey.half_width, (1.0 + BAND) * survey.half_width
    low, high = survey.runs[index, 0] * RUN, (survey.runs[index, 1] + 1) * RUN
    answer = CLEAR
    for segment in range(max(first, low), min(stop - 1, high)):
        side = _segment_side(path, segment, ring, survey, index)
        if side == HIT:
            return HIT
        if side == OPEN:
            answer = OPEN
    if has_ends:
        for side in range(2):
            # the end lies within a segment of the path, which is decided as a whole first
            segment = first - 1 if side == 0 else stop - 1
            if (side == 1 and stop <= first) or not low <= segment < min(high, len(path.xy) - 1):
                continue
            if _segment_side(path, segment, ring, survey, index) == CLEAR:
                continue
            a, b = (ends[0], ends[1]) if side == 0 else (ends[2], ends[3])
            distance = ring_segment_distance(ring, a, b, outer, False)
            if distance <= inner:
                return HIT
            if distance <= outer:
                answer = OPEN
    bounds = survey.bounds[index]
    around = (bounds[0], bounds[1], bounds[2], bounds[3])
    first_cap = side_of_cap(ends[1], ends[0], survey.half_width, ring, around)
    last_cap = side_of_cap(ends[2], ends[3], survey.half_width, ring, around)
    if first_cap == HIT or last_cap == HIT:
        return HIT
    return answer if first_cap == last_cap == CLEAR else OPEN


@kernel
def _segment_side(
    path: Path, segment: int, ring: FloatArray, survey: ObstacleCache, index: int
) -> int:
    """CLEAR, HIT or OPEN: whether a ring touches the corridor of a segment, without its ends."""
    known = survey.sides[index, segment]
    if known == UNKNOWN:
        inner, outer = (1.0 - BAND) * survey.half_width, (1.0 + BAND) * survey.half_width
        before = survey.sides[index, segment - 1] if segment > 0 else UNKNOWN
        starts_outside = before == CLEAR or before == OPEN
        a, b = path.xy[segment], path.xy[segment + 1]
        distance = ring_segment_distance(ring, a, b, outer, starts_outside)
        known = HIT if distance <= inner else (OPEN if distance <= outer else CLEAR)
        survey.sides[index, segment] = known
        if known == HIT:
            survey.hits[index] = segment
    return known


@kernel
def find_lead(
    footprint: FloatArray, objects: Objects, bounds: FloatArray, sides: IntArray
) -> tuple[int, float]:
    """The object nearest to the footprint (4, 2) and its gap [m]; (-1, inf) if all are CLEAR.

    `bounds` (M, 4) are those of the objects. It may be OPEN; those farther away need not be
    decided. Of those that are MET it is the first.
    """
    for index in range(len(sides)):
        if sides[index] == MET:
            return index, 0.0
    low_x, low_y, high_x, high_y = ring_bounds(footprint)
    found, best, best_gap = -1, np.inf, np.inf
    for index in range(len(sides)):
        apart_x = max(bounds[index, 0] - high_x, low_x - bounds[index, 2])
        apart_y = max(bounds[index, 1] - high_y, low_y - bounds[index, 3])
        if sides[index] != CLEAR and not max(apart_x, apart_y) > best + SLACK:
            ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
            distance, gap = _ring_gap(footprint, ring)
            if distance < best:
                found, best, best_gap = index, distance, gap
    return found, best_gap


@kernel
def lead_speed(objects: Objects, index: int, heading: float) -> float:
    """Speed of an object along a heading [m/s]."""
    return objects.speeds[index] * np.cos(wrap_angle(objects.headings[index] - heading))


@kernel
def is_tied(sides: IntArray, answers: FloatArray, lead: int) -> bool:
    """Whether another object than the lead is MET, and has another answer.

    `answers` (M,) are what follows where an object is the lead, read where one is MET.
    """
    for index in range(len(sides)):
        if sides[index] == MET and index != lead and answers[index] != answers[lead]:
            return True
    return False


class Index:
    """The spatial index that nuPlan asks for the lead."""

    def __init__(self, objects: Objects) -> None:
        """Take the objects that may stand in the corridor."""
        self._objects = objects
        self._found: list[int] = []
        self._tree: shapely.STRtree | None = None

    def settle(self, sides: IntArray, footprint: FloatArray) -> None:
        """Keep one of the objects that the footprint (4, 2) touches; the others become CLEAR.

        `sides` (M,) says which are MET. No object may be OPEN.
        """
        # nuPlan rule 159: the index of what is in the corridor answers with the first that it finds
        found = np.flatnonzero(sides != CLEAR).tolist()
        if self._tree is None or found != self._found:  # seldom more than once in a plan
            self._found, self._tree = found, shapely.STRtree(self._polygons(found))
        lead = found[self._tree.nearest(shapely.polygons(footprint))]
        met = np.flatnonzero(sides == MET)
        sides[met[met != lead]] = CLEAR

    def _polygons(self, indices: list[int]) -> np.ndarray:
        """(K,) polygons of some objects."""
        xy, ptr = self._objects.xy, self._objects.ptr.tolist()
        rings = [xy[ptr[i] : ptr[i + 1]] for i in indices]
        owners = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
        polygons: np.ndarray = shapely.polygons(
            shapely.linearrings(np.concatenate(rings), indices=owners)
        )
        return polygons


@kernel
def _ring_gap(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance between a box and a ring, and the same measured between their nearest points [m].

    They do not touch.
    """
    # nuPlan rule 154: the gap is the latter, and the nearest point on an edge is rounded to what a
    # coordinate in UTM can hold; hence not `ring_distance`
    reach = distance_bound(a, b)
    low_x, low_y, high_x, high_y = ring_bounds(a)
    low_x, low_y, high_x, high_y = low_x - reach, low_y - reach, high_x + reach, high_y + reach
    best, gap = np.inf, np.inf
    # from the vertices of the box to the edges of the ring, then the other way round; on ties the
    # first pair counts
    for i in range(len(a)):
        before = len(b) - 1
        for j in range(len(b)):
            c, d = b[before], b[j]
            before = j
            if not (
                max(c[0], d[0]) < low_x
                or min(c[0], d[0]) > high_x
                or max(c[1], d[1]) < low_y
                or min(c[1], d[1]) > high_y
            ):
                distance = point_segment_distance(a[i, 0], a[i, 1], c[0], c[1], d[0], d[1])
                if distance < best:
                    best, gap = distance, _gap_to_edge(a[i], c, d)
    for i in range(len(b)):
        p = b[i]
        if low_x <= p[0] <= high_x and low_y <= p[1] <= high_y:
            for j in range(len(a)):
                c, d = a[j - 1], a[j]
                distance = point_segment_distance(p[0], p[1], c[0], c[1], d[0], d[1])
                if distance < best:
                    best, gap = distance, _gap_to_edge(p, c, d)
    return best, gap


@kernel
def _gap_to_edge(p: FloatArray, a: FloatArray, b: FloatArray) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    along = ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square if square > 0.0 else 0.0
    along = min(max(along, 0.0), 1.0)
    x = b[0] if along == 1.0 else a[0] + along * dx
    y = b[1] if along == 1.0 else a[1] + along * dy
    return np.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2)
