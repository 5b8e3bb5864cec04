"""Areas of the map: intersections, drivable area, walkways, car parks, crosswalks."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import shapely

from shiftsim.data.maps.opendrive import records
from shiftsim.data.maps.opendrive.curves import ReferenceLine
from shiftsim.data.maps.opendrive.graph import Connector
from shiftsim.data.maps.opendrive.shapes import Shapes, lane_polygon
from shiftsim.data.polygons import largest_part, shared_areas
from shiftsim.kernels import FloatArray, IntArray

_SEAM_WIDTH = 0.5  # m
_MIN_OVERLAP = 1.0  # m²
_CLOSING = 0.5  # m
_SLIVER = 0.05  # m, cracks between lanes that are closed in the drivable area
_TILE, _TILE_OVERLAP = 50.0, 0.5  # m
_USED = records.PAVED | records.WALKED | records.SEAMS
_CROSSWALK_WORDS = ("crosswalk", "zebra", "pedestrian")


def group_connectors(
    connectors: Sequence[Connector],
    polygons: Sequence[shapely.Polygon],  # of the connectors
    blocks: Sequence[tuple[int, int]],  # their (from, to) roadblocks
    are_stacked: Callable[[int, int], bool],  # whether two of them lie on different levels
) -> IntArray:
    """Number of the intersection of each connector.

    Connectors belong together when they lie in one junction, belong to one roadblock connector, or
    overlap by more than 1 m² without sharing the lane they start or end at.
    """
    first: dict[object, int] = {}
    links = [
        (number, first.setdefault(label, number))
        for number, connector in enumerate(connectors)
        for label in (*sorted(connector.junctions), blocks[number])
    ]
    group = linked_groups(links, len(connectors))
    for (i, j), overlap in shared_areas(polygons).items():
        one, two = connectors[i], connectors[j]
        if group[i] == group[j] or one.source == two.source or one.target == two.target:
            continue
        if overlap > _MIN_OVERLAP and not are_stacked(i, j):
            links.append((i, j))
    return linked_groups(links, len(connectors))


def linked_groups(links: Sequence[tuple[int, int]], count: int) -> IntArray:
    """(count,) a label for each item, 0 and up by first appearance; linked ones share it."""
    from scipy.sparse import coo_array, csgraph  # take long to import

    one, two = np.array(links, np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(links)), (one, two)), shape=(count, count))
    labels = csgraph.connected_components(graph, directed=False)[1]
    return np.asarray(labels, np.int64)


def merge_closed(polygons: Iterable[shapely.Polygon], radius: float) -> shapely.Polygon:
    """One polygon that covers all: their union closed by `radius` [m], else their convex hull."""
    union = shapely.union_all(list(polygons))
    closed = union.buffer(radius, join_style="mitre").buffer(-radius, join_style="mitre")
    closed = shapely.union(closed, union)
    return closed if isinstance(closed, shapely.Polygon) else largest_part(union.convex_hull)


def lane_areas(od: records.OpenDrive, shapes: Shapes) -> dict[str, list[shapely.Polygon]]:
    """Areas of all lanes that cars do not follow: those `paved`, `walked` and for `parking`."""
    areas: dict[str, list[shapely.Polygon]] = {"paved": [], "walked": [], "parking": []}
    for road in od.roads.values():
        for index, section in enumerate(road.sections):
            kinds = {number: lane.type for number, lane in section.lanes.items()}
            if road.section_end(index) - section.s < 0.01 or not _USED & set(kinds.values()):
                continue
            _, shape = shapes.section(road.id, index)
            for number, kind in kinds.items():
                inner, outer = shape.inner[number], shape.outer[number]
                width = float(np.hypot(*(outer - inner).T).max())
                if width < 1e-3 or kind not in _USED:
                    continue
                area = lane_polygon(inner, outer)
                is_seam = kind in records.SEAMS and width < _SEAM_WIDTH
                beside = {kinds.get(number - 1), kinds.get(number + 1)}
                if kind in records.PAVED:
                    areas["paved"].append(area)
                elif kind in records.WALKED or (is_seam and beside & records.WALKED):
                    areas["walked"].append(area)
                if kind == "parking":
                    areas["parking"].append(area)
    return areas


def merge_areas(polygons: Sequence[shapely.Polygon], radius: float) -> list[shapely.Polygon]:
    """Separate polygons whose union is the closed union of all, by position."""
    if not polygons:
        return []
    union = shapely.union_all([p.buffer(radius, join_style="mitre") for p in polygons])
    return _parts(union.buffer(-radius, join_style="mitre"))


def drivable_tiles(polygons: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Small overlapping polygons whose union is that of all, with cracks closed.

    One polygon for a town would have thousands of edges to test against for each corner of a car.
    """
    waiting = merge_areas(polygons, _SLIVER)
    tiles = []
    while waiting:
        part = waiting.pop()
        left, bottom, right, top = part.bounds
        if max(right - left, top - bottom) <= _TILE:
            tiles.append(part)
            continue
        x, y, lap = 0.5 * (left + right), 0.5 * (bottom + top), 0.5 * _TILE_OVERLAP
        if right - left > top - bottom:
            halves = (left, bottom, x + lap, top), (x - lap, bottom, right, top)
        else:
            halves = (left, bottom, right, y + lap), (left, y - lap, right, top)
        for half in halves:
            waiting += _parts(shapely.intersection(part, shapely.box(*half)))
    return sorted(tiles, key=lambda tile: tile.bounds)


def _parts(shape: shapely.Geometry) -> list[shapely.Polygon]:
    if not shape.is_valid:
        shape = shapely.make_valid(shape)
    parts = [p for p in shapely.get_parts(shape) if isinstance(p, shapely.Polygon)]
    return sorted((p for p in parts if p.area > 1e-4), key=lambda p: p.bounds)


def is_crosswalk(thing: records.RoadObject) -> bool:
    """Whether an object marks a crosswalk, by type or by name (nuPlan rule 515)."""
    if thing.type == "crosswalk":
        return True
    if thing.type not in ("roadMark", "-1", "none", "") and "crosswalk" not in thing.type.lower():
        return False
    words = f"{thing.type} {thing.name} {thing.subtype}".lower()
    return any(word in words for word in _CROSSWALK_WORDS)


def is_stop_line(thing: records.RoadObject) -> bool:
    """Whether an object is a stop line, by any of its names."""
    return any("stopline" in text.lower() for text in (thing.type, thing.name, thing.subtype))


def object_rings(line: ReferenceLine, thing: records.RoadObject) -> list[FloatArray]:
    """Outlines (V, 2) of an object and its copies, as the file draws them [m]."""
    places = _repeated(thing.repeats[-1]) if thing.repeats else [(thing.s, thing.t)]
    length, width = (thing.length or 0.0) / 2, (thing.width or 0.0) / 2
    corners = [[length, width], [-length, width], [-length, -width], [length, -width]]
    outlines = thing.outlines or (records.Outline(on_road=False, corners=np.array(corners)),)
    return [_place_ring(line, thing, outline, s, t) for s, t in places for outline in outlines]


def rings_of(
    roads: Iterable[records.Road],
    shapes: Shapes,
    is_wanted: Callable[[records.RoadObject], bool],
    least: int = 3,
) -> list[FloatArray]:
    """Outlines of all objects of a kind that are finite and have at least some corners [m]."""
    return [
        ring
        for road in roads
        for thing in road.objects
        if is_wanted(thing)
        for ring in object_rings(shapes.lines[road.id], thing)
        if len(ring) >= least and np.isfinite(ring).all()
    ]


def _repeated(repeat: records.Repeat) -> list[tuple[float, float]]:
    count = int(min(repeat.length / repeat.distance, 1000)) + 1 if repeat.distance > 0 else 1
    share = np.arange(count) * repeat.distance / repeat.length if repeat.length > 0 else np.zeros(1)
    s = repeat.s + share * repeat.length
    t = repeat.t_start + share * (repeat.t_end - repeat.t_start)
    return list(zip(s.tolist(), t.tolist(), strict=True))


def _place_ring(
    line: ReferenceLine, thing: records.RoadObject, outline: records.Outline, s: float, t: float
) -> FloatArray:
    if outline.on_road:
        return line.evaluate(outline.corners[:, 0] + (s - thing.s)).offset(outline.corners[:, 1])
    pose = line.evaluate(np.array([s]))
    origin = pose.offset(np.array([t]))[0]
    angle = float(pose.heading[0]) + thing.heading
    cos, sin = np.cos(angle), np.sin(angle)
    return origin + outline.corners @ np.array([[cos, sin], [-sin, cos]])


def crosswalk_polygons(od: records.OpenDrive, shapes: Shapes) -> list[shapely.Polygon]:
    """All crosswalks that enclose an area."""
    rings = rings_of(od.roads.values(), shapes, is_crosswalk)
    signals = [(road.id, signal) for road in od.roads.values() for signal in road.signals]
    rings += [_signal_ring(*pair, shapes) for pair in signals if _is_crosswalk_signal(pair[1])]
    polygons = [largest_part(shapely.Polygon(ring)) for ring in rings if np.isfinite(ring).all()]
    return [polygon for polygon in polygons if polygon.area > 0.1]


def _is_crosswalk_signal(signal: records.Signal) -> bool:
    is_static = not signal.reference and not signal.dynamic and signal.width is not None
    return is_static and (signal.type == "293" or "crosswalk" in signal.name.lower())


def _signal_ring(road: str, signal: records.Signal, shapes: Shapes) -> FloatArray:
    """A crosswalk given as a signal: its width lies across the road, its value along it."""
    half_width = (signal.width or 0.0) / 2
    half_depth = (signal.value if signal.value and signal.value > 0 else 4.0) / 2
    s = signal.s + half_depth * np.array([-1.0, -1.0, 1.0, 1.0])
    return shapes.lines[road].evaluate(s).offset(signal.t + half_width * np.array([-1, 1, 1, -1]))


def parking_spaces(od: records.OpenDrive, shapes: Shapes) -> list[shapely.Polygon]:
    """Areas of parkingSpace objects."""
    rings = rings_of(od.roads.values(), shapes, lambda thing: thing.type == "parkingSpace")
    return [largest_part(shapely.Polygon(ring)) for ring in rings]
