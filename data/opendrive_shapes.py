"""Borders, centre lines and polygons of lanes, from exact curves.

Borders of a lane section share their sample places, so that neighbouring lanes share vertices; the
places are refined until every border stays within the chord error. Baselines are sampled anew after
lanes were joined, evenly in arc length, and small jumps between pieces are spread over some metres.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.opendrive_geometry import Poses, ReferenceLine
from shiftsim.data.opendrive_graph import Piece
from shiftsim.data.opendrive_lanes import section_borders
from shiftsim.data.opendrive_records import OpenDrive, Road

CHORD_ERROR = 0.05  # m, opendrive.md §6
BASELINE_STEP = 0.25  # m, PLUTO takes every fourth vertex as 1 m
_DENSE_STEP = 0.1  # m, of exact points a baseline is drawn through: 0.4 mm on a radius of 3 m
_TARGET_ERROR = 0.02  # m at the middle of a chord; the largest error may lie beside it
_MAX_STEP = 10.0  # m
_MIN_STEP = 0.01  # m
_ROUNDS = 12
_BLEND = 10.0  # m over which a jump between pieces is spread
_NARROW = 2.5  # m, connectors below it are widened (nuPlan's "scaled width")


@dataclass(frozen=True)
class SectionShape:
    """Borders of one lane section at common places.

    Attributes:
        s: (K,) places on the road, ascending [m].
        inner: Per lane, (K, 2) border next to the centre [m].
        outer: Per lane, (K, 2) other border [m].
    """

    s: FloatArray
    inner: dict[int, FloatArray]
    outer: dict[int, FloatArray]


class Shapes:
    """Samples the lanes of a file; sections are evaluated once."""

    def __init__(self, od: OpenDrive, pieces: Iterable[Piece]) -> None:
        self._od = od
        self._lines = {road.id: ReferenceLine(road.geometries) for road in od.roads.values()}
        self._stops: dict[tuple[str, int], set[float]] = defaultdict(set)
        self._sections: dict[tuple[str, int], SectionShape] = {}
        for piece in pieces:
            self._stops[piece.key.road, piece.key.section].update((piece.begin, piece.end))

    def line(self, road: str) -> ReferenceLine:
        """Reference line of a road."""
        return self._lines[road]

    def section(self, road: str, section: int) -> SectionShape:
        """Borders of all lanes of a section."""
        key = road, section
        if key not in self._sections:
            stops = self._stops.get(key, set())
            self._sections[key] = _sample_section(
                self._od.roads[road], section, self._lines[road], stops
            )
        return self._sections[key]

    def borders(self, piece: Piece) -> tuple[FloatArray, FloatArray]:
        """(K, 2) left and right border of a piece in the direction of travel [m]."""
        shape = self.section(piece.key.road, piece.key.section)
        low, high = min(piece.begin, piece.end), max(piece.begin, piece.end)
        kept = (shape.s >= low - 1e-9) & (shape.s <= high + 1e-9)
        inner, outer = shape.inner[piece.key.lane][kept], shape.outer[piece.key.lane][kept]
        forward = piece.end >= piece.begin
        if not forward:
            inner, outer = inner[::-1], outer[::-1]
        return (inner, outer) if (piece.key.lane < 0) == forward else (outer, inner)

    def joined_borders(self, pieces: Sequence[Piece]) -> tuple[FloatArray, FloatArray]:
        """Borders of a chain of pieces; ends that nearly meet become one vertex."""
        parts = [self.borders(piece) for piece in pieces]
        left = _join([part[0] for part in parts])
        right = _join([part[1] for part in parts])
        return left, right

    def centers(self, piece: Piece, s: FloatArray) -> FloatArray:
        """(K, 2) points midway between the borders at `s` (K,) [m]."""
        road = self._od.roads[piece.key.road]
        borders = section_borders(road, piece.key.section, s, mend=True)
        middle = 0.5 * (borders.inner[piece.key.lane] + borders.outer[piece.key.lane])
        return self._poses(piece, s).offset(middle)

    def _poses(self, piece: Piece, s: FloatArray) -> Poses:
        return self._lines[piece.key.road].evaluate(s)

    def ends(self, pieces: Sequence[Piece]) -> tuple[FloatArray, FloatArray]:
        """First and last centre point of a chain of pieces [m]."""
        first = self.centers(pieces[0], np.array([pieces[0].begin]))[0]
        last = self.centers(pieces[-1], np.array([pieces[-1].end]))[0]
        return first, last

    def baseline(
        self,
        pieces: Sequence[Piece],
        start: FloatArray | None = None,
        end: FloatArray | None = None,
    ) -> FloatArray:
        """Centre line of a chain of pieces with a vertex about every 0.25 m.

        Args:
            pieces: In the direction of travel.
            start: (2,) point it must begin at, near its own; None for its own [m].
            end: (2,) point it must end at [m].
        """
        firsts = [self.centers(p, np.array([p.begin, p.end])) for p in pieces]
        jumps = np.zeros((len(pieces) + 1, 2))
        for number in range(1, len(pieces)):
            jumps[number] = firsts[number][0] - firsts[number - 1][1]
        shifts = [(-0.5 * jumps[i], 0.5 * jumps[i + 1]) for i in range(len(pieces))]
        if start is not None:
            shifts[0] = (start - firsts[0][0], shifts[0][1])
        if end is not None:
            shifts[-1] = (shifts[-1][0], end - firsts[-1][1])
        grids = []
        for piece in pieces:
            count = max(int(np.ceil(piece.length / _DENSE_STEP)), 2)
            grids.append(np.linspace(0.0, 1.0, count + 1))
        dense = np.concatenate(
            [
                self._shifted(piece, share, shift)
                for piece, share, shift in zip(pieces, grids, shifts, strict=True)
            ]
        )
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(dense, axis=0).T))])
        count = max(round(float(arc[-1]) / BASELINE_STEP), 1)
        at = np.linspace(0.0, arc[-1], count + 1)
        line = np.stack([np.interp(at, arc, dense[:, 0]), np.interp(at, arc, dense[:, 1])], axis=1)
        line[0], line[-1] = dense[0], dense[-1]
        return line

    def _shifted(
        self, piece: Piece, share: FloatArray, shift: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """Centre points at shares of a piece, its two ends moved by `shift` (2,), (2,)."""
        points = self.centers(piece, piece.begin + share * (piece.end - piece.begin))
        reach = min(_BLEND / piece.length, 0.5) if piece.length > 0 else 0.5
        points += _ramp(share / reach)[:, None] * shift[0]
        points += _ramp((1.0 - share) / reach)[:, None] * shift[1]
        return points

    def widths(self, pieces: Sequence[Piece]) -> tuple[float, float]:
        """Width at the start and at the end of a chain of pieces [m]."""
        out = []
        for piece, s in ((pieces[0], pieces[0].begin), (pieces[-1], pieces[-1].end)):
            road = self._od.roads[piece.key.road]
            borders = section_borders(road, piece.key.section, np.array([s]), mend=True)
            out.append(float(abs(borders.outer[piece.key.lane] - borders.inner[piece.key.lane])[0]))
        return out[0], out[1]


def lane_polygon(left: FloatArray, right: FloatArray) -> shapely.Polygon:
    """The area between two borders of one direction; the largest part where they cross."""
    return largest_part(shapely.Polygon(np.concatenate([left, right[::-1]])))


def largest_part(shape: shapely.Geometry) -> shapely.Polygon:
    """The largest valid polygon of a geometry; an empty polygon where there is none."""
    if not shape.is_valid:
        shape = shapely.make_valid(shape)
    if isinstance(shape, shapely.Polygon):
        return shape
    parts = [p for p in shapely.get_parts(shape) if isinstance(p, shapely.Polygon)]
    nested = [largest_part(p) for p in shapely.get_parts(shape) if hasattr(p, "geoms")]
    return max(parts + nested, key=lambda part: part.area, default=shapely.Polygon())


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
    return 1.0 - x * x * (3.0 - 2.0 * x)


def _join(lines: Sequence[FloatArray]) -> FloatArray:
    out = [lines[0]]
    for line in lines[1:]:
        if np.hypot(*(out[-1][-1] - line[0])) < CHORD_ERROR:
            out[-1] = np.concatenate([out[-1][:-1], 0.5 * (out[-1][-1:] + line[:1])])
            line = line[1:]
        out.append(line)
    return np.concatenate(out)


def _sample_section(
    road: Road, section: int, line: ReferenceLine, stops: set[float]
) -> SectionShape:
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
        bad = np.diff(s) > 2 * _MIN_STEP
        error = np.zeros(len(middles))
        for number, outer in shape.outer.items():
            for points, truth in ((outer, exact.outer), (shape.inner[number], exact.inner)):
                chord = 0.5 * (points[1:] + points[:-1]) - truth[number]
                error = np.maximum(error, np.hypot(*chord.T))
        bad &= error > _TARGET_ERROR
        if not bad.any():
            break
        s = np.sort(np.concatenate([s, middles[bad]]))
        shape = _evaluate_section(road, section, line, s)
    return shape


def _evaluate_section(road: Road, section: int, line: ReferenceLine, s: FloatArray) -> SectionShape:
    borders, poses = section_borders(road, section, s, mend=True), line.evaluate(s)
    points = {id(t): poses.offset(t) for t in borders.inner.values()}
    outer = {}
    for number, t in borders.outer.items():
        points.setdefault(id(t), poses.offset(t))
        outer[number] = points[id(t)]
    return SectionShape(s, {n: points[id(t)] for n, t in borders.inner.items()}, outer)


def _breakpoints(road: Road, section: int, begin: float, end: float) -> list[float]:
    places = [g.s for g in road.geometries] + road.offsets[:, 0].tolist()
    for lane in road.sections[section].lanes.values():
        for records in (lane.widths, lane.borders):
            places += (begin + records[:, 0]).tolist()
    return [s for s in places if begin + _MIN_STEP < s < end - _MIN_STEP]
