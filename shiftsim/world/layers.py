"""Flat geometry of a map layer: polygons with holes, a grid over them, polylines, ragged lists.

Kernels take the NamedTuples of this file as they are. Arrays are read-only: maps never change, and
kernels see one type of array for all of them. Point queries cost one grid look-up and a few
exact point-in-polygon tests; results come in the order of the layer, as nuPlan's tables do.
"""

from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from shiftsim.errors import MapError
from shiftsim.geometry.polylines import arc_lengths, project_on_polyline
from shiftsim.geometry.rings import (
    EXTERIOR,
    INTERIOR,
    locate_in_polygon,
    orientation,
    polygon_distance,
    segments_meet,
)
from shiftsim.kernels import FloatArray, IntArray, kernel, readonly

if TYPE_CHECKING:
    from rtree.index import Index

_MIN_CELL, _MAX_CELL = 4.0, 64.0  # m
_CELLS_PER_POLYGON = 4
_MAX_ENTRIES = 1 << 26  # of the cells of a layer, half a gigabyte


class Lists(NamedTuple):
    """Ragged integer lists: list i is `items[ptr[i] : ptr[i + 1]]`."""

    ptr: IntArray
    items: IntArray

    def at(self, index: int) -> IntArray:
        """List number `index`."""
        return self.items[self.ptr[index] : self.ptr[index + 1]]

    def __repr__(self) -> str:
        return f"<Lists: {len(self.ptr) - 1} lists of {len(self.items)} numbers>"


class Polylines(NamedTuple):
    """Many polylines: line i has the vertices `xy[ptr[i] : ptr[i + 1]]`."""

    xy: FloatArray  # (V, 2) vertices [m]
    ptr: IntArray  # (M + 1,) first vertex of each line
    arc: FloatArray  # (V,) arc length at each vertex from the start of its line [m]

    def at(self, index: int) -> FloatArray:
        """(K, 2) vertices of line `index` [m]."""
        return self.xy[self.ptr[index] : self.ptr[index + 1]]

    def length(self, index: int) -> float:
        """Length of line `index` [m]."""
        return float(self.arc[self.ptr[index + 1] - 1])

    def __repr__(self) -> str:
        return f"<Polylines: {len(self.ptr) - 1} lines of {len(self.xy)} vertices>"


class Polygons(NamedTuple):
    """Many polygons with holes, and a uniform grid that lists the polygons near each cell."""

    xy: FloatArray  # (V, 2) vertices of all rings; the closing vertex is not repeated [m]
    ring_ptr: IntArray  # (R + 1,) first vertex of each ring
    poly_ptr: IntArray  # (M + 1,) first ring of each polygon; the first ring is the shell
    bounds: FloatArray  # (M, 4) min x, min y, max x, max y [m]
    grid: FloatArray  # (3,) x and y of the grid's corner, cell size [m]
    shape: IntArray  # (2,) number of cells along x and y
    # (cells + 1,) first entry of each cell in `cell_items`, cell = ix * shape[1] + iy
    cell_ptr: IntArray
    cell_items: IntArray  # polygon indices, ascending within a cell


def make_lists(rows: Iterable[Sequence[int]]) -> Lists:
    """Ragged lists from Python lists."""
    lists = [np.asarray(row, np.int64) for row in rows]
    items = np.concatenate([np.zeros(0, np.int64), *lists])
    return Lists(readonly(_starts(lists)), readonly(items))


def _starts(parts: Sequence[Sized]) -> IntArray:
    """(n + 1,) where each of n parts begins when they stand in a row, and where the last ends."""
    return np.cumsum([0, *map(len, parts)], dtype=np.int64)


def make_polylines(lines: Sequence[FloatArray]) -> Polylines:
    """Polylines from (K, 2) vertex arrays [m]; an empty array stands for a missing line."""
    ptr = _starts(lines)
    parts = [np.asarray(line, np.float64).reshape(-1, 2) for line in lines]
    xy = np.concatenate([np.zeros((0, 2)), *parts])
    return Polylines(readonly(xy), readonly(ptr), readonly(arc_lengths(xy, ptr)))


def make_polygons(polygons: Sequence[Sequence[FloatArray]]) -> Polygons:
    """Polygons from lists of rings (shell first, then holes), each ring (V, 2) [m]."""
    rings = [_open_ring(ring) for polygon in polygons for ring in polygon]
    xy = np.concatenate([np.zeros((0, 2)), *rings])
    return index_polygons(xy, _starts(rings), _starts(polygons))


def index_polygons(xy: FloatArray, ring_ptr: IntArray, poly_ptr: IntArray) -> Polygons:
    """Add bounds and the grid to flat polygons (arrays as in `Polygons`).

    Raises ValueError: they are so many and so large that the grid would fill the memory.
    """
    count = len(poly_ptr) - 1
    bounds = np.empty((count, 4))
    if count:
        starts = ring_ptr[poly_ptr[:-1]]
        bounds[:, :2] = np.minimum.reduceat(xy, starts)
        bounds[:, 2:] = np.maximum.reduceat(xy, starts)
    low = bounds[:, :2].min(axis=0) if count else np.zeros(2)
    high = bounds[:, 2:].max(axis=0) if count else np.zeros(2)
    area = float(np.prod(np.maximum(high - low, 1.0)))
    cell = float(
        np.clip(np.sqrt(area / (_CELLS_PER_POLYGON * max(count, 1))), _MIN_CELL, _MAX_CELL)
    )
    shape = (np.floor((high - low) / cell).astype(np.int64) + 1).astype(np.int64)
    first = np.floor((bounds[:, :2] - low) / cell).astype(np.int64)
    last = np.minimum(np.floor((bounds[:, 2:] - low) / cell).astype(np.int64), shape - 1)
    if np.prod(last - first + 1.0, axis=1).sum() > _MAX_ENTRIES:
        raise ValueError("too many polygons cover too much of the map")
    cell_ptr, cell_items = _fill_cells(first, last, shape)
    grid = np.array([low[0], low[1], cell])
    arrays = (xy, ring_ptr, poly_ptr, bounds, grid, shape, cell_ptr, cell_items)
    return Polygons(*(readonly(array) for array in arrays))


def join_polygons(parts: Sequence[Polygons]) -> Polygons:
    """Several sets of polygons as one, in their order."""
    counts = ([part.ring_ptr for part in parts], [part.poly_ptr for part in parts])
    ptrs = (np.cumsum(np.concatenate([[0], *map(np.diff, each)])) for each in counts)
    return index_polygons(np.concatenate([part.xy for part in parts]), *ptrs)


def _open_ring(ring: FloatArray) -> FloatArray:
    xy = np.asarray(ring, np.float64)[:, :2]
    return xy[:-1] if len(xy) > 1 and (xy[0] == xy[-1]).all() else xy


def _fill_cells(first: IntArray, last: IntArray, shape: IntArray) -> tuple[IntArray, IntArray]:
    """The polygons of every cell, ascending, from the cells (P, 2) that each begins and ends in."""
    wide, high = (last - first + 1).T
    counts = wide * high
    polygon = np.repeat(np.arange(len(counts)), counts)
    entry = np.arange(len(polygon)) - np.repeat(np.cumsum(counts) - counts, counts)
    column, row = np.divmod(entry, high[polygon])
    cell = (first[polygon, 0] + column) * shape[1] + first[polygon, 1] + row
    ptr = np.zeros(shape[0] * shape[1] + 1, np.int64)
    np.cumsum(np.bincount(cell, minlength=len(ptr) - 1), out=ptr[1:])
    return ptr, polygon[np.argsort(cell, kind="stable")]


@kernel
def project_on_line(lines: Polylines, line: int, x: float, y: float) -> float:
    """Arc length of the point of a line nearest to (x, y); the first one on ties [m]."""
    return project_on_polyline(lines.xy, lines.arc, lines.ptr[line], lines.ptr[line + 1], x, y)


@kernel
def containing(polygons: Polygons, x: float, y: float, out: IntArray) -> int:
    """Write the polygons that hold a point in their interior into `out`, ascending; their number.

    Those that do not fit are counted but not written.
    """
    fx = np.floor((x - polygons.grid[0]) / polygons.grid[2])
    fy = np.floor((y - polygons.grid[1]) / polygons.grid[2])
    if not (0.0 <= fx < polygons.shape[0] and 0.0 <= fy < polygons.shape[1]):
        return 0  # also where a coordinate is NaN
    cell = int(fx) * polygons.shape[1] + int(fy)
    xy, ring_ptr, poly_ptr = polygons.xy, polygons.ring_ptr, polygons.poly_ptr
    found = 0
    for entry in range(polygons.cell_ptr[cell], polygons.cell_ptr[cell + 1]):
        poly = polygons.cell_items[entry]
        # not `contains`: each call that passes all arrays of a map counts references to them
        if in_bounds(polygons.bounds, poly, x, y):
            first, last = poly_ptr[poly], poly_ptr[poly + 1]
            if locate_in_polygon(xy, ring_ptr, first, last, x, y) == INTERIOR:
                if found < len(out):
                    out[found] = poly
                found += 1
    return found


@kernel
def in_bounds(bounds: FloatArray, poly: int, x: float, y: float) -> bool:
    """Whether the bounds (M, 4) of polygon `poly` hold a point; touching counts."""
    return bounds[poly, 0] <= x <= bounds[poly, 2] and bounds[poly, 1] <= y <= bounds[poly, 3]


@kernel
def contains(polygons: Polygons, poly: int, x: float, y: float) -> bool:
    """Whether polygon `poly` holds a point in its interior; the boundary does not count."""
    if not in_bounds(polygons.bounds, poly, x, y):
        return False
    first, last = polygons.poly_ptr[poly], polygons.poly_ptr[poly + 1]
    return locate_in_polygon(polygons.xy, polygons.ring_ptr, first, last, x, y) == INTERIOR


@kernel
def in_any(polygons: Polygons, x: float, y: float) -> bool:
    """Whether any polygon holds a point in its interior."""
    return containing(polygons, x, y, np.empty(0, np.int64)) > 0


@kernel
def distance_to(polygons: Polygons, poly: int, x: float, y: float) -> float:
    """Distance from a point to polygon `poly`, 0 inside [m]."""
    first, last = polygons.poly_ptr[poly], polygons.poly_ptr[poly + 1]
    return polygon_distance(polygons.xy, polygons.ring_ptr, first, last, x, y)


@kernel
def nearest(polygons: Polygons, x: float, y: float, limit: float) -> tuple[int, float]:
    """The polygon nearest to a point and its distance [m]; (-1, inf) when none is within `limit`.

    The first one in the order of the layer on ties.
    """
    return nearest_of(polygons, 0, len(polygons.bounds), x, y, limit)


@kernel
def nearest_of(
    polygons: Polygons, first: int, stop: int, x: float, y: float, limit: float
) -> tuple[int, float]:
    """As `nearest`, among the polygons `first` … `stop` - 1."""
    best, found = np.inf, -1
    for poly in range(first, stop):
        dx = max(polygons.bounds[poly, 0] - x, 0.0, x - polygons.bounds[poly, 2])
        dy = max(polygons.bounds[poly, 1] - y, 0.0, y - polygons.bounds[poly, 3])
        reach = min(best, limit)
        if dx * dx + dy * dy > reach * reach:
            continue
        distance = distance_to(polygons, poly, x, y)
        if distance < best and distance <= limit:
            best, found = distance, poly
    return found, best


@kernel
def meets_convex(polygons: Polygons, poly: int, ring: FloatArray) -> bool:
    """Whether polygon `poly` shares a point with a convex ring (V, 2), counter-clockwise [m]."""
    first, last = polygons.poly_ptr[poly], polygons.poly_ptr[poly + 1]
    xy, ring_ptr = polygons.xy, polygons.ring_ptr
    for vertex in range(ring_ptr[first], ring_ptr[last]):
        x, y, is_in = xy[vertex, 0], xy[vertex, 1], True
        for corner in range(len(ring)):
            ax, ay = ring[corner - 1, 0], ring[corner - 1, 1]
            if orientation(ax, ay, ring[corner, 0], ring[corner, 1], x, y) < 0:
                is_in = False
                break
        if is_in:
            return True
    for corner in range(len(ring)):
        x, y = ring[corner, 0], ring[corner, 1]
        if locate_in_polygon(xy, ring_ptr, first, last, x, y) != EXTERIOR:
            return True
    for chain in range(first, last):
        px, py = xy[ring_ptr[chain + 1] - 1, 0], xy[ring_ptr[chain + 1] - 1, 1]
        for vertex in range(ring_ptr[chain], ring_ptr[chain + 1]):
            x, y = xy[vertex, 0], xy[vertex, 1]
            for corner in range(len(ring)):
                ax, ay = ring[corner - 1, 0], ring[corner - 1, 1]
                if segments_meet(px, py, x, y, ax, ay, ring[corner, 0], ring[corner, 1]):
                    return True
            px, py = x, y
    return False


@kernel
def meeting(polygons: Polygons, ring: FloatArray) -> IntArray:
    """Polygons that share a point with a convex ring (V, 2), counter-clockwise, ascending."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for corner in range(len(ring)):
        low_x, high_x = min(low_x, ring[corner, 0]), max(high_x, ring[corner, 0])
        low_y, high_y = min(low_y, ring[corner, 1]), max(high_y, ring[corner, 1])
    bounds = polygons.bounds
    out = np.empty(len(bounds), np.int64)
    found = 0
    for poly in range(len(bounds)):
        if (
            bounds[poly, 0] <= high_x
            and bounds[poly, 2] >= low_x
            and bounds[poly, 1] <= high_y
            and bounds[poly, 3] >= low_y
            and meets_convex(polygons, poly, ring)
        ):
            out[found] = poly
            found += 1
    return out[:found].copy()


@kernel
def square_around(x: float, y: float, half_width: float) -> FloatArray:
    """(4, 2) corners of an axis-parallel square, counter-clockwise [m]."""
    low_x, low_y, high_x, high_y = x - half_width, y - half_width, x + half_width, y + half_width
    out = np.empty((4, 2))
    for corner in range(4):
        out[corner, 0] = low_x if corner == 1 or corner == 2 else high_x
        out[corner, 1] = high_y if corner < 2 else low_y
    return out


@dataclass(frozen=True)
class Layer:
    """Map objects of one kind: their ids and polygons."""

    ids: tuple[str, ...]  # M object ids, in the order of the source
    polygons: Polygons  # their areas
    # position of an id in `ids`
    index: Mapping[str, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        index = MappingProxyType({name: i for i, name in enumerate(self.ids)})
        object.__setattr__(self, "index", index)

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"<Layer: {len(self)} objects>"

    def rings(self, index: int) -> list[FloatArray]:
        """Rings (V, 2) of one polygon, shell first, not closed [m]."""
        flat = self.polygons
        return [
            flat.xy[flat.ring_ptr[r] : flat.ring_ptr[r + 1]]
            for r in range(flat.poly_ptr[index], flat.poly_ptr[index + 1])
        ]

    def shape(self, index: int) -> shapely.Polygon:
        """One polygon as a shapely object, for drawing and for slow exact work."""
        shell, *holes = self.rings(index)
        return shapely.Polygon(shell, holes)

    def containing(self, x: float, y: float) -> IntArray:
        """Indices of the polygons that hold a point in their interior, ascending."""
        out = np.empty(self.most_at_a_point, np.int64)
        return out[: containing(self.polygons, x, y, out)]

    @cached_property
    def most_at_a_point(self) -> int:
        """Upper bound of the number of polygons that hold one point."""
        return int(np.diff(self.polygons.cell_ptr).max(initial=0))

    @cached_property
    def _tree(self) -> "Index":
        """The bounding boxes of the polygons in an R-tree, made when it is first asked for."""
        from rtree.index import Index

        boxes = enumerate(self.polygons.bounds.tolist())
        return Index((number, box, None) for number, box in boxes)

    def __reduce__(self) -> tuple[type["Layer"], tuple[tuple[str, ...], Polygons]]:
        """Pickled without the index and the tree, which are made again."""
        return Layer, (self.ids, self.polygons)

    def nearest(self, x: float, y: float) -> tuple[int, float]:
        """The polygon nearest to a point, the first one on ties, and its distance, 0 inside [m].

        Raises:
            MapError: The layer is empty.
        """
        if not len(self):
            raise MapError("the layer has no polygons, so none is nearest")
        # no polygon can be nearer than its box, and the nearest box gives a first bound
        guess = next(iter(self._tree.nearest((x, y, x, y), 1)))
        reach = distance_to(self.polygons, guess, x, y)
        square = (x - reach, y - reach, x + reach, y + reach)
        return min(
            (
                (number, distance_to(self.polygons, number, x, y))
                for number in {guess, *self._tree.intersection(square)}
            ),
            key=lambda found: (found[1], found[0]),
        )

    def meeting(self, area: shapely.Polygon | Sequence[float]) -> IntArray:
        """Indices, ascending, of the polygons that share a point with an area; touching counts.

        Args:
            area: A polygon, or its bounds min x, min y, max x, max y [m].
        """
        if not len(self):
            return np.zeros(0, np.int64)
        polygon = area if isinstance(area, shapely.Polygon) else shapely.box(*area)
        near = sorted(self._tree.intersection(polygon.bounds))
        meets = [shapely.intersects(self.shape(number), polygon) for number in near]
        return np.array(near, np.int64)[np.array(meets, np.bool_)]

    def within_box(self, x: float, y: float, half_width: float) -> IntArray:
        """Indices of the polygons that share a point with an axis-parallel square around (x, y)."""
        return meeting(self.polygons, square_around(x, y, half_width))


def make_layer(ids: Iterable[str], polygons: Sequence[shapely.Polygon]) -> Layer:
    """A layer from ids and shapely polygons of the same order [m]."""
    rings = [
        [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
        for polygon in polygons
    ]
    return Layer(tuple(ids), make_polygons(rings))
