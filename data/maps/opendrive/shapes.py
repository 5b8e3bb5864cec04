"""Borders, centre lines and polygons of lanes, from exact curves.

Borders of a lane section share their sample places, so that neighbouring lanes share vertices; the
places are refined until every border stays within the chord error. Baselines are sampled anew after
lanes were joined, evenly in arc length, and small jumps between pieces are spread over some metres.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np
import shapely
from shapely.geometry.polygon import orient
from shapely.ops import substring

from shiftsim.data.maps.opendrive.curves import ReferenceLine
from shiftsim.data.maps.opendrive.graph import Graph, LaneSegment
from shiftsim.data.maps.opendrive.lanes import BEFORE_END, LaneKey, SectionBorders, section_borders
from shiftsim.data.maps.opendrive.records import OpenDrive, Road
from shiftsim.data.polygons import largest_part
from shiftsim.kernels import FloatArray, IntArray

CHORD_ERROR = 0.05  # m
BASELINE_STEP = 0.25  # m, nuPlan rule 510: PLUTO takes every fourth vertex as 1 m
_DENSE_STEP = 0.1  # m, of exact points a baseline is drawn through: 0.4 mm on a radius of 3 m
_TARGET_ERROR = 0.02  # m at the middle of a chord; the largest error may lie beside it
_MAX_STEP = 10.0  # m
_MIN_STEP = 0.01  # m
_ROUNDS = 12
_STEP = 0.01  # m, beyond which a jump of the middle of a lane is spread
_CORNER, _MIN_STRETCH = 0.3, 0.7  # rad, and m between corners, to be kept as vertices
_KINK, _BEND = 0.1, 5.0  # rad, and m, of ends that are bent into the direction of a neighbour
_BLEND = 10.0  # m over which a jump between pieces is spread
_FOLD, _ROUNDING = 2.0, 2.0  # rad of turn where a line runs back, and m about a corner made round
_NARROW = 2.5  # m, nuPlan rule 511: connectors below it are widened


class Shapes:
    """Samples the lanes of a file; sections are evaluated once."""

    def __init__(self, od: OpenDrive, graph: Graph) -> None:
        self._od = od
        self.lines = {road.id: ReferenceLine(road.geometries) for road in od.roads.values()}
        self._stops: dict[tuple[str, int], set[float]] = defaultdict(set)
        self._sections: dict[tuple[str, int], tuple[FloatArray, SectionBorders]] = {}
        chains = [lane.segments for lane in graph.lanes]
        chains += [connector.segments for connector in graph.connectors]
        for piece in chain(*chains, graph.dropped):
            self._stops[piece.key.road, piece.key.section].update((piece.begin, piece.end))

    def section(self, road: str, section: int) -> tuple[FloatArray, SectionBorders]:
        """Places along a section (K,), and there points (K, 2) of the borders of its lanes [m]."""
        key = road, section
        if key not in self._sections:
            place = self._od.roads[road], section, self.lines[road]
            self._sections[key] = _sample_section(*place, self._stops.get(key, set()))
        return self._sections[key]

    def borders(self, piece: LaneSegment) -> tuple[FloatArray, FloatArray]:
        """(K, 2) left and right border of a piece in the direction of travel [m]."""
        s, shape = self.section(piece.key.road, piece.key.section)
        low, high = piece.span
        inside = (s >= low - 1e-9) & (s <= high + 1e-9)
        inner, outer = (side[piece.key.lane][inside] for side in (shape.inner, shape.outer))
        if not piece.is_forward:
            inner, outer = inner[::-1], outer[::-1]
        return (inner, outer) if (piece.key.lane < 0) == piece.is_forward else (outer, inner)

    def joined_borders(self, segments: Sequence[LaneSegment]) -> tuple[FloatArray, FloatArray]:
        """Borders of a chain of segments; ends that nearly meet become one vertex."""
        left, right = zip(*map(self.borders, segments), strict=True)
        return join_lines(left), join_lines(right)

    def centers(self, piece: LaneSegment, s: FloatArray) -> FloatArray:
        """(K, 2) points midway between the borders at `s` (K,) [m]."""
        low, high = piece.span
        return self._middles(piece.key, np.clip(s, low, max(high - BEFORE_END, low)))

    def _middles(self, key: LaneKey, s: FloatArray) -> FloatArray:
        borders = section_borders(self._od.roads[key.road], key.section, s, repair=True, look_up=s)
        middle = 0.5 * (borders.inner[key.lane] + borders.outer[key.lane])
        return self.lines[key.road].evaluate(s).offset(middle)

    def baseline(
        self,
        segments: Sequence[LaneSegment],  # in the direction of travel
        start: FloatArray | None = None,  # (2,) where it must begin, near its own start [m]
        end: FloatArray | None = None,  # (2,) where it must end [m]
    ) -> FloatArray:
        """Centre line of a chain of segments with a vertex about every 0.25 m."""
        pieces = [part for segment in segments for part in self._without_steps(segment)]
        firsts = [self.centers(p, np.array([p.begin, p.end])) for p in pieces]
        jumps = np.zeros((len(pieces) + 1, 2))
        for number, (before, after) in enumerate(pairwise(firsts), start=1):
            jumps[number] = after[0] - before[1]
        shifts = [(-0.5 * jumps[i], 0.5 * jumps[i + 1]) for i in range(len(pieces))]
        if start is not None:
            shifts[0] = (start - firsts[0][0], shifts[0][1])
        if end is not None:
            shifts[-1] = (shifts[-1][0], end - firsts[-1][1])
        return divide(unfold(np.concatenate(list(map(self._shifted, pieces, shifts)))))

    def _without_steps(self, piece: LaneSegment) -> list[LaneSegment]:
        """The piece, cut where the middle of the lane jumps."""
        road = self._od.roads[piece.key.road]
        low, high = piece.span
        places = np.array(_breakpoints(road, piece.key.section, low, high))
        if len(places) == 0:
            return [piece]
        jumps = self._middles(piece.key, places) - self._middles(piece.key, places - BEFORE_END)
        cuts = np.unique(places[np.hypot(*jumps.T) > _STEP]).tolist()
        stops = [low, *cuts, high] if piece.is_forward else [high, *cuts[::-1], low]
        return [replace(piece, begin=a, end=b) for a, b in pairwise(stops)]

    def _shifted(self, piece: LaneSegment, shift: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Dense centre points of a piece, its two ends moved by `shift` (2,), (2,)."""
        share = np.linspace(0.0, 1.0, max(int(np.ceil(piece.length / _DENSE_STEP)), 2) + 1)
        points = self.centers(piece, piece.begin + share * (piece.end - piece.begin))
        room = 0.5 if shift[0].any() and shift[1].any() else 1.0
        reach = min(_BLEND / piece.length, room) if piece.length > 0 else room
        points += _ramp(share / reach)[:, None] * shift[0]
        points += _ramp((1.0 - share) / reach)[:, None] * shift[1]
        return points

    def widths(self, pieces: Sequence[LaneSegment]) -> tuple[float, float]:
        """Width at the start and at the end of a chain of pieces [m]."""
        out = []
        for piece, s in ((pieces[0], pieces[0].begin), (pieces[-1], pieces[-1].end)):
            road = self._od.roads[piece.key.road]
            borders = section_borders(road, piece.key.section, np.array([s]), repair=True)
            out.append(float(abs(borders.outer[piece.key.lane] - borders.inner[piece.key.lane])[0]))
        return out[0], out[1]


def arc_lengths(line: FloatArray) -> FloatArray:
    """(K,) distance of each vertex of a line (K, 2) from its start [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])


def points_at(line: FloatArray, along: FloatArray, at: FloatArray) -> FloatArray:
    """(N, 2) points of a line (K, 2) at `at` (N,); `along` (K,) is where its vertices are."""
    return np.stack([np.interp(at, along, values) for values in line.T], axis=1)


def unfold(line: FloatArray) -> FloatArray:
    """A line (K, 2) without the parts that run backwards, as on the inner side of a tight arc.

    Where the line crosses itself about such a part, that loop is cut off and the corner made round;
    where it does not, the line stays as it is.
    """
    arc, (at, turns) = arc_lengths(line), corners(line)
    for begin, end in pairwise(at[turns > _FOLD].tolist()):
        before, after = shapely.LineString(line[: begin + 1]), shapely.LineString(line[end:])
        meet = shapely.get_coordinates(shapely.intersection(before, after))
        if arc[end] - arc[begin] < _STEP or not len(meet):
            continue
        enter = shapely.line_locate_point(before, shapely.points(meet)).max()
        place = shapely.get_coordinates(shapely.line_interpolate_point(before, enter))
        leave = arc[end] + shapely.line_locate_point(after, shapely.points(place))[0]
        r = min(_ROUNDING, enter, arc[-1] - leave)
        ends = points_at(line, arc, np.array([enter - r, leave + r]))
        t = np.linspace(0.0, 1.0, 33)[:, None]
        bend = (1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * place + t**2 * ends[1]
        head, tail = line[arc < enter - r], line[arc > leave + r]
        return unfold(np.concatenate([head, bend, tail]))
    return line


def corners(line: FloatArray) -> tuple[IntArray, FloatArray]:
    """Vertices within a line (K, 2) that are apart, and by how much it turns there [rad]."""
    steps = np.diff(line, axis=0)
    moving = np.flatnonzero(np.hypot(*steps.T) > 1e-6)
    headings = np.arctan2(steps[moving, 1], steps[moving, 0])
    turns: FloatArray = np.abs((np.diff(headings) + np.pi) % (2 * np.pi) - np.pi)
    return moving[1:], turns


def divide(dense: FloatArray) -> FloatArray:
    """A line through dense points with a vertex about every 0.25 m; sharp corners stay vertices."""
    arc, (at, turns) = arc_lengths(dense), corners(dense)
    stops = [0.0]
    for corner in arc[at[turns > _CORNER]]:
        if min(corner - stops[-1], arc[-1] - corner) > _MIN_STRETCH:
            stops.append(float(corner))
    parts = [
        np.linspace(a, b, max(round((b - a) / BASELINE_STEP), 1), endpoint=False)
        for a, b in pairwise([*stops, float(arc[-1])])
    ]
    line = points_at(dense, arc, np.concatenate([*parts, arc[-1:]]))
    line[0], line[-1] = dense[0], dense[-1]
    return line


def bend_ends(line: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """A line (K, 2) that leaves and arrives in the directions of its neighbours, without kinks."""
    bent = _bend_start(line, before[-1] - before[-2])
    return _bend_start(bent[::-1], after[0] - after[1])[::-1]


def _bend_start(line: FloatArray, direction: FloatArray) -> FloatArray:
    heading, wanted = (v / max(float(np.hypot(*v)), 1e-9) for v in (line[1] - line[0], direction))
    if heading @ wanted > np.cos(_KINK) or heading @ wanted < np.cos(1.0):
        return line
    arc = arc_lengths(line)
    reach = min(_BEND, 0.5 * float(arc[-1]))
    if reach < 2 * BASELINE_STEP:
        return line
    share = np.clip(arc / reach, 0.0, 1.0)
    return line + (arc * (1.0 - share) ** 2)[:, None] * (wanted - heading)


def lane_polygon(left: FloatArray, right: FloatArray) -> shapely.Polygon:
    """The area between two borders of one direction; the largest part where they cross."""
    return largest_part(shapely.Polygon(np.concatenate([left, right[::-1]])))


def unfold_borders(
    left: FloatArray, right: FloatArray, area: shapely.Polygon
) -> tuple[FloatArray, FloatArray]:
    """Borders of a lane; those that fold or cross are the two sides of its `area` instead.

    On the inner side of a bend that is tighter than the lane is wide a border runs back and forth
    beyond the lane; the area is without these parts.
    """
    if area.is_empty or shapely.Polygon(np.concatenate([left, right[::-1]])).is_valid:
        return left, right
    ring = orient(area, -1.0).exterior  # along the left border, and back along the right one
    ends = shapely.points([left[0], left[-1], right[-1], right[0]])
    begin, *stops = shapely.line_locate_point(ring, ends)
    left_end, right_end = begin + (stops[:2] - begin) % ring.length
    right_begin = begin + ring.length - (begin - stops[2]) % ring.length
    is_whole = shapely.distance(ring, ends).max() < CHORD_ERROR  # else it crosses itself
    if not (is_whole and begin < left_end <= right_end < right_begin):
        return left, right
    twice = shapely.LineString(np.concatenate([ring.coords, ring.coords[1:]]))
    parts = substring(twice, begin, left_end), substring(twice, right_end, right_begin)
    left, right = map(shapely.get_coordinates, parts)
    return left, right[::-1]


def widen(left: FloatArray, right: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Spread two borders about their middle to `width` where they are closer than 2.5 m."""
    if len(left) != len(right):
        return left, right
    across = left - right
    wide = np.hypot(*across.T)
    factor = np.where(
        (wide < min(width, _NARROW)) & (wide > 1e-3), width / np.maximum(wide, 1e-3), 1.0
    )
    middle, half = 0.5 * (left + right), 0.5 * across * factor[:, None]
    return middle + half, middle - half


def _ramp(x: FloatArray) -> FloatArray:
    """1 at 0, 0 from 1 on, flat at both."""
    x = np.clip(x, 0.0, 1.0)
    return 1.0 - x**3 * (10.0 + x * (6.0 * x - 15.0))


def join_lines(lines: Sequence[FloatArray]) -> FloatArray:
    """One line of lines (K, 2) that follow each other; ends that nearly meet become one vertex."""
    out = [lines[0]]
    for line in lines[1:]:
        if np.hypot(*(out[-1][-1] - line[0])) < CHORD_ERROR:
            out[-1] = np.concatenate([out[-1][:-1], 0.5 * (out[-1][-1:] + line[:1])])
            line = line[1:]
        out.append(line)
    return np.concatenate(out)


def _sample_section(
    road: Road, section: int, line: ReferenceLine, stops: set[float]
) -> tuple[FloatArray, SectionBorders]:
    begin, end = road.sections[section].s, road.section_end(section)
    s = np.array(sorted({begin, end, *stops, *_breakpoints(road, section, begin, end)}))
    steps = np.maximum(np.ceil(np.diff(s) / _MAX_STEP).astype(np.int64), 1)
    s = np.concatenate(
        [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(s[:-1], s[1:], steps, strict=True)]
        + [s[-1:]]
    )
    shape = _evaluate_section(road, section, line, s)
    for _ in range(_ROUNDS):
        middles = 0.5 * (s[1:] + s[:-1])
        if len(middles) == 0:
            break
        exact = _evaluate_section(road, section, line, middles)
        error = np.zeros(len(middles))
        for number, outer in shape.outer.items():
            for points, truth in ((outer, exact.outer), (shape.inner[number], exact.inner)):
                chord = 0.5 * (points[1:] + points[:-1]) - truth[number]
                error = np.maximum(error, np.hypot(*chord.T))
        bad = (np.diff(s) > 2 * _MIN_STEP) & (error > _TARGET_ERROR)
        if not bad.any():
            break
        s = np.sort(np.concatenate([s, middles[bad]]))
        shape = _evaluate_section(road, section, line, s)
    return s, shape


def _evaluate_section(
    road: Road, section: int, line: ReferenceLine, s: FloatArray
) -> SectionBorders:
    borders, poses = section_borders(road, section, s, repair=True), line.evaluate(s)
    sides = borders.inner, borders.outer
    points = {id(t): poses.offset(t) for side in sides for t in side.values()}
    return SectionBorders(*({n: points[id(t)] for n, t in side.items()} for side in sides))


def _breakpoints(road: Road, section: int, begin: float, end: float) -> list[float]:
    places = [g.s for g in road.geometries] + road.offsets[:, 0].tolist()
    for lane in road.sections[section].lanes.values():
        for records in (lane.widths, lane.borders):
            places += (road.sections[section].s + records[:, 0]).tolist()
    return [s for s in places if begin + _MIN_STEP < s < end - _MIN_STEP]
