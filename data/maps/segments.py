"""Lane pieces, as readers of data sets with maps hand them over, and their geometry.

A piece is what a data set calls a lane, lane segment or lanelet: two borders in the direction of
travel and what follows it. `build.py` makes the map of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from shiftsim.data.maps.builder import StopArea as StopArea
from shiftsim.data.maps.opendrive import shapes
from shiftsim.data.maps.opendrive.control import STOP_LINE_DEPTH
from shiftsim.kernels import FloatArray

_APART = 1e-3  # m, closer vertices of a source are one


@dataclass(frozen=True)
class LanePiece:
    """One lane of a source, in the direction of travel."""

    id: str  # id in the source, unique among the pieces
    left: FloatArray  # (K, 2) left border [m]
    right: FloatArray  # (K', 2) right border [m]
    center: FloatArray | None = None  # (K'', 2) centre line [m]; None: midway between the borders
    successors: tuple[str, ...] = ()  # ids of the pieces that follow; unknown ones are left out
    left_neighbor: str | None = None  # id of the piece beside it, of whatever direction
    right_neighbor: str | None = None
    is_connector: bool = False  # whether the source says that it lies in an intersection
    speed_limit: float | None = None  # [m/s]; None where the source has none
    # name of the light that governs it: for whoever drives on it, if it is a connector, else for
    # whoever leaves it
    light: str | None = None

    @cached_property
    def middle(self) -> FloatArray:
        """(K, 2) its centre line [m]."""
        if self.center is not None:
            return self.center
        borders = [(line, _shares(line)) for line in (self.left, self.right)]
        at = np.unique(np.concatenate([shares for _, shares in borders]))
        left, right = (shapes.points_at(line, shares, at) for line, shares in borders)
        return 0.5 * (left + right)

    @cached_property
    def length(self) -> float:
        """Length of its centre line [m]."""
        return float(np.hypot(*np.diff(self.middle, axis=0).T).sum())

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """Its area; empty where the borders enclose none."""
        return shapes.lane_polygon(self.left, self.right)

    @property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """First and last cross-section (2, 2), from the left to the right border [m]."""
        return np.stack([self.left[0], self.right[0]]), np.stack([self.left[-1], self.right[-1]])

    @property
    def chord(self) -> FloatArray:
        """(2,) from its first to its last centre point [m]."""
        return self.middle[-1] - self.middle[0]


def stop_area(piece: LanePiece, kind: int, ends: FloatArray | None = None) -> StopArea | None:
    """The stop polygon before the stop line of a piece.

    `ends` (2, 2) are those of the line [m], where it is not the end of the piece. None where the
    line encloses nothing with what lies before it.
    """
    ends = piece.ends[1] if ends is None else ends
    step = piece.middle[-2] - piece.middle[-1]
    back = STOP_LINE_DEPTH * step / np.hypot(*step)
    polygon = shapely.Polygon(np.concatenate([ends, ends[::-1] + back])).buffer(0)
    found = isinstance(polygon, shapely.Polygon) and polygon.area > 0
    return StopArea(polygon, kind, piece.id) if found else None


@dataclass(frozen=True)
class MapSource:
    """All that a source tells of a map, in a local metric frame."""

    name: str  # of the map
    pieces: Sequence[LanePiece]  # lanes that cars may use
    drivable_areas: Sequence[shapely.Polygon] = ()  # they and `paved` none: union of the lanes
    paved: Sequence[shapely.Polygon] = ()  # drivable, too: merged and cut into tiles
    stop_areas: Sequence[StopArea] = ()
    crosswalks: Sequence[shapely.Polygon] = ()
    walkways: Sequence[shapely.Polygon] = ()
    car_parks: Sequence[shapely.Polygon] = ()


@dataclass(frozen=True)
class Part:
    """A part of a piece; `begin` < `end` are shares of its length."""

    piece: LanePiece
    begin: float = 0.0
    end: float = 1.0

    @property
    def length(self) -> float:
        """Length of its centre line [m]."""
        return self.piece.length * (self.end - self.begin)

    def split(self, at: float) -> tuple["Part", "Part"]:
        """The parts before and after a distance from its start [m]."""
        share = self.begin + at / self.piece.length
        return Part(self.piece, self.begin, share), Part(self.piece, share, self.end)

    def cut(self, line: FloatArray) -> FloatArray:
        """A line along the piece (K, 2), as far as it belongs to the part."""
        if (self.begin, self.end) == (0.0, 1.0):
            return line
        shares = _shares(line)
        inside = shares[(shares > self.begin) & (shares < self.end)]
        return shapes.points_at(line, shares, np.concatenate([[self.begin], inside, [self.end]]))


def joined_borders(segments: Sequence[Part]) -> tuple[FloatArray, FloatArray]:
    """Borders (K, 2), (K', 2) of segments that follow each other [m]."""
    left = shapes.join_lines([part.cut(part.piece.left) for part in segments])
    return left, shapes.join_lines([part.cut(part.piece.right) for part in segments])


def baseline(
    segments: Sequence[Part], start: FloatArray | None = None, end: FloatArray | None = None
) -> FloatArray:
    """Centre line of segments that follow each other, with a vertex about every 0.25 m.

    `start` and `end` (2,) are where it must begin and end, near its own ends [m].
    """
    line = shapes.join_lines([part.cut(part.piece.middle) for part in segments])
    if start is not None and end is not None:
        line = shapes.points_at(line, _shares(line), _dense(line))
        share = _shares(line)[:, None]
        line = line + (1.0 - share) * (start - line[0]) + share * (end - line[-1])
    return shapes.divide(line)


def clean_line(points: FloatArray) -> FloatArray:
    """A line (K, 2) without repeated vertices; fewer than two remain where it has no length."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    return points[np.concatenate([[True], steps > _APART])] if len(points) else points


def _dense(line: FloatArray) -> FloatArray:
    """Shares of the vertices of a line and of points between them, a metre or less apart."""
    shares = _shares(line)
    length = float(np.hypot(*np.diff(line, axis=0).T).sum())
    count = int(np.ceil(length / (4 * shapes.BASELINE_STEP))) + 1
    return np.unique(np.concatenate([shares, np.linspace(0.0, 1.0, count)]))


def _shares(line: FloatArray) -> FloatArray:
    """(K,) how far along a line (K, 2) its vertices are, 0 to 1."""
    along = shapes.arc_lengths(line)
    return along / max(along[-1], 1e-9)
