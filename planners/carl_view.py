"""The picture CaRL sees: nine channels of 256 x 256 pixels around the ego (planner-carl.md §2).

Columns grow forward and rows to the left, two pixels a metre; the origin of the picture's middle is
14 m ahead of the centre of the ego. What depends on the map only is laid out once per map, with the
roads in the order in which nuPlan's spatial index yields them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry import box_corners
from shiftsim.layers import (
    Lists,
    Polygons,
    Polylines,
    index_polygons,
    make_polylines,
    meets_convex,
)
from shiftsim.map import NONE, VectorMap
from shiftsim.planners.carl_raster import (
    Crossings,
    Picture,
    draw_line,
    fill_area,
    fill_box,
    make_crossings,
)
from shiftsim.planners.pdm_areas import index_ranks
from shiftsim.state import LAST_AGENT_KIND, AgentKind

SIZE = 256  # pixels along each side
PIXELS_PER_METRE = 2.0
HALF_SIDE = 64.0  # m
AHEAD = 14.0  # m, the middle of the picture lies so far before the centre of the ego
CHANNELS = (
    *("drivable_area", "route", "boundaries", "traffic_lights", "stop_signs", "speed_limits"),
    *("vehicles", "pedestrians_and_static", "ego"),
)
DRIVABLE, ROUTE, BOUNDARIES, LIGHTS, _STOPS, LIMITS, VEHICLES, PEDESTRIANS, EGO = range(9)
YES, STANDING = 255, 127
MAX_SPEED, MAX_WALK = 30.0, 4.0  # m/s
LIGHT_VALUES = np.array([80, 170, 255, 0], np.uint8)  # by LightStatus; 0 is not drawn
_CHUNK = 16  # segments of a line that are left out together where they cannot be seen

_VEHICLE, _PEDESTRIAN, _BICYCLE = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE
_LAST_AGENT = LAST_AGENT_KIND

Values = NDArray[np.uint8]


class Lines(NamedTuple):
    """Polylines in chunks that are left out together where they cannot be seen.

    Attributes:
        xy: (V, 2) vertices [m].
        ptr: (M + 1,) first vertex of each line.
        chunk_ptr: (M + 1,) first chunk of each line.
        circles: (C, 3) a circle around each chunk: x, y, radius [m].
    """

    xy: FloatArray
    ptr: IntArray
    chunk_ptr: IntArray
    circles: FloatArray


class Roads(NamedTuple):
    """The map as CaRL sees it. I areas: roadblocks, roadblock connectors, car parks. E edges.

    Attributes:
        areas: I polygons.
        order: (I,) areas in the order of the spatial index.
        num_roadblocks: How many of the areas are roadblocks.
        num_blocks: How many are roadblocks or roadblock connectors.
        block_edges: Edges of a block.
        intersection_of: (B,) intersection of a block, or NONE.
        intersections: Polygons.
        baselines: E lines.
        limits: (E,) value of the speed limit.
        border_of: (E, 2) left and right boundary of an edge among `borders`, or NONE.
        borders: Boundary lines of lanes, each once.
    """

    areas: Polygons
    order: IntArray
    num_roadblocks: int
    num_blocks: int
    block_edges: Lists
    intersection_of: IntArray
    intersections: Polygons
    baselines: Lines
    limits: Values
    border_of: IntArray
    borders: Lines


class Room(NamedTuple):
    """Scratch of `draw_roads`, as large as the map needs.

    Attributes:
        ring: (V, 2) pixels of one ring.
        crossings: Of its outline.
    """

    ring: IntArray
    crossings: Crossings


class Boxes(NamedTuple):
    """Objects of one moment. N objects.

    Attributes:
        poses: (N, 3) box centre x [m], y [m], heading [rad].
        sizes: (N, 2) length, width [m].
        velocities: (N, 2) in the map frame [m/s].
        kinds: (N,) AgentKind codes.
    """

    poses: FloatArray
    sizes: FloatArray
    velocities: FloatArray
    kinds: IntArray


def make_roads(road: VectorMap) -> Roads:
    """Lay out a map."""
    first, second = road.blocks.polygons, road.car_parks.polygons
    areas = index_polygons(
        np.concatenate([first.xy, second.xy]),
        np.concatenate([first.ring_ptr, second.ring_ptr[1:] + len(first.xy)]),
        np.concatenate([first.poly_ptr, second.poly_ptr[1:] + len(first.ring_ptr) - 1]),
    )
    order = np.argsort(index_ranks(areas.bounds)) if len(areas.bounds) else np.zeros(0, np.int64)
    intersection_of = np.full(len(road.blocks), NONE)
    for block in range(road.num_roadblocks, len(road.blocks)):
        crossed = road.intersection_of[road.block_edges.at(block)]
        intersection_of[block] = next(iter(crossed[crossed != NONE]), NONE)
    border_of, borders = _borders(road)
    return Roads(
        areas,
        order,
        road.num_roadblocks,
        len(road.blocks),
        road.block_edges,
        intersection_of,
        road.intersections.polygons,
        _in_chunks(road.baselines),
        np.array([level(limit, MAX_SPEED) for limit in road.speed_limits.tolist()], np.uint8),
        border_of,
        borders,
    )


def _borders(road: VectorMap) -> tuple[IntArray, Lines]:
    """The boundaries of lanes; neighbours share theirs."""
    known: dict[bytes, int] = {}
    lines: list[FloatArray] = []
    border_of = np.full((len(road.edges), 2), NONE)
    for side, boundaries in enumerate((road.left_boundaries, road.right_boundaries)):
        for edge in range(road.num_lanes):
            line = boundaries.at(edge)
            if len(line) < 2:
                continue
            number = known.setdefault(line.tobytes(), len(lines))
            if number == len(lines):
                lines.append(line)
            border_of[edge, side] = number
    return border_of, _in_chunks(make_polylines(lines))


def _in_chunks(lines: Polylines) -> Lines:
    segments = np.maximum(np.diff(lines.ptr) - 1, 0)
    chunk_ptr = np.concatenate([[0], np.cumsum(-(-segments // _CHUNK))])
    circles = np.empty((chunk_ptr[-1], 3))
    _surround(lines.xy, lines.ptr, chunk_ptr, circles)
    return Lines(lines.xy, lines.ptr, chunk_ptr, circles)


@kernel
def _surround(xy: FloatArray, ptr: IntArray, chunk_ptr: IntArray, circles: FloatArray) -> None:
    """Write a circle around every chunk into `circles` (C, 3)."""
    for line in range(len(ptr) - 1):
        for chunk in range(chunk_ptr[line], chunk_ptr[line + 1]):
            start = ptr[line] + (chunk - chunk_ptr[line]) * _CHUNK
            stop = min(start + _CHUNK + 1, ptr[line + 1])
            x = 0.5 * (xy[start:stop, 0].min() + xy[start:stop, 0].max())
            y = 0.5 * (xy[start:stop, 1].min() + xy[start:stop, 1].max())
            radius = 0.0
            for vertex in range(start, stop):
                radius = max(radius, np.hypot(xy[vertex, 0] - x, xy[vertex, 1] - y))
            circles[chunk, 0], circles[chunk, 1], circles[chunk, 2] = x, y, radius


def make_room(roads: Roads) -> Room:
    """Scratch for a map."""
    longest = 4
    for polygons in (roads.areas, roads.intersections):
        shells = polygons.poly_ptr[:-1]
        sizes = polygons.ring_ptr[shells + 1] - polygons.ring_ptr[shells]
        longest = max(longest, *sizes.tolist(), 0)
    return Room(np.empty((longest, 2), np.int64), make_crossings(SIZE, longest))


@kernel
def level(value: float, highest: float) -> int:
    """127 for zero, 255 for `highest` and more, and for NaN."""
    if np.isnan(value):
        return YES
    return int(127.5 * min(max(value / highest, 0.0), 1.0) + 127.5)


@kernel
def picture_frame(center: FloatArray) -> FloatArray:
    """(4,) x [m], y [m], cosine and sine of the heading of the picture's middle.

    Args:
        center: (3,) centre of the ego x [m], y [m], heading [rad].
    """
    cos, sin = np.cos(center[2]), np.sin(center[2])
    return np.array([center[0] + AHEAD * cos, center[1] + AHEAD * sin, cos, sin])


@kernel
def find_areas(roads: Roads, frame: FloatArray) -> IntArray:
    """Areas that touch the picture, in the order of the spatial index."""
    corners = np.empty((4, 2))
    for corner in range(4):
        ahead = HALF_SIDE if corner == 0 or corner == 3 else -HALF_SIDE
        left = HALF_SIDE if corner < 2 else -HALF_SIDE
        corners[corner, 0] = frame[0] + (ahead * frame[2] - left * frame[3])
        corners[corner, 1] = frame[1] + (ahead * frame[3] + left * frame[2])
    reach = HALF_SIDE * (abs(frame[2]) + abs(frame[3])) + 1e-6
    bounds = roads.areas.bounds
    out = np.empty(len(roads.order), np.int64)
    found = 0
    for area in roads.order:
        if (
            bounds[area, 0] <= frame[0] + reach
            and bounds[area, 2] >= frame[0] - reach
            and bounds[area, 1] <= frame[1] + reach
            and bounds[area, 3] >= frame[1] - reach
            and meets_convex(roads.areas, area, corners)
        ):
            out[found] = area
            found += 1
    return out[:found].copy()


@kernel
def in_picture(frame: FloatArray, x: float, y: float) -> bool:
    """Whether a point lies strictly within the picture."""
    dx, dy = x - frame[0], y - frame[1]
    ahead, left = frame[2] * dx + frame[3] * dy, frame[2] * dy - frame[3] * dx
    return abs(ahead) < HALF_SIDE and abs(left) < HALF_SIDE


@kernel
def _to_pixel(frame: FloatArray, x: float, y: float) -> tuple[int, int]:
    """Column and row of a point; numbers are cut, also those below zero."""
    dx, dy = x - frame[0], y - frame[1]
    ahead, left = frame[2] * dx + frame[3] * dy, frame[2] * dy - frame[3] * dx
    middle = 0.5 * SIZE
    return int(PIXELS_PER_METRE * ahead + middle), int(PIXELS_PER_METRE * left + middle)


@kernel
def draw_roads(
    pictures: Picture,
    roads: Roads,
    room: Room,
    frame: FloatArray,
    found: IntArray,
    on_route: BoolArray,
    lights: Values,
) -> None:
    """Draw what the map has, and the lights.

    Args:
        pictures: (9, 256, 256) of zeros.
        roads: The map.
        room: Scratch of the map.
        frame: (4,) of the picture.
        found: Areas in it.
        on_route: (B,) blocks of the route.
        lights: (E,) value of the light of every connector, 0 where it has none.
    """
    drawn = np.zeros(len(roads.intersections.bounds), np.bool_)
    bordered = np.zeros(len(roads.borders.ptr), np.bool_)
    for area in found:
        is_block = area < roads.num_blocks
        if is_block and on_route[area]:
            _fill_shell(pictures[ROUTE], roads.areas, area, frame, room)
        if area < roads.num_roadblocks or not is_block:
            _fill_shell(pictures[DRIVABLE], roads.areas, area, frame, room)
            continue
        crossed = roads.intersection_of[area]
        if crossed != NONE and not drawn[crossed]:
            drawn[crossed] = True
            _fill_shell(pictures[DRIVABLE], roads.intersections, crossed, frame, room)
    for area in found:
        if area >= roads.num_roadblocks:
            continue
        for entry in range(roads.block_edges.ptr[area], roads.block_edges.ptr[area + 1]):
            edge = roads.block_edges.items[entry]
            _draw_line_of(pictures[LIMITS], roads.baselines, edge, frame, roads.limits[edge])
            for side in range(2):
                border = roads.border_of[edge, side]
                if border != NONE and not bordered[border]:
                    bordered[border] = True
                    _draw_line_of(pictures[BOUNDARIES], roads.borders, border, frame, YES)
    for area in found:
        if not roads.num_roadblocks <= area < roads.num_blocks:
            continue
        for entry in range(roads.block_edges.ptr[area], roads.block_edges.ptr[area + 1]):
            edge = roads.block_edges.items[entry]
            _draw_line_of(pictures[LIMITS], roads.baselines, edge, frame, roads.limits[edge])
            if lights[edge] > 0:
                _draw_line_of(pictures[LIGHTS], roads.baselines, edge, frame, lights[edge])


@kernel
def _fill_shell(
    picture: Picture, polygons: Polygons, poly: int, frame: FloatArray, room: Room
) -> None:
    """Fill a polygon; its holes are filled, too."""
    shell = polygons.poly_ptr[poly]
    start, stop = polygons.ring_ptr[shell], polygons.ring_ptr[shell + 1]
    for vertex in range(start, stop):
        x, y = _to_pixel(frame, polygons.xy[vertex, 0], polygons.xy[vertex, 1])
        room.ring[vertex - start, 0], room.ring[vertex - start, 1] = x, y
    fill_area(picture, room.ring[: stop - start], YES, room.crossings)


@kernel
def _draw_line_of(picture: Picture, lines: Lines, line: int, frame: FloatArray, value: int) -> None:
    """Draw a line, chunk by chunk."""
    first, last = lines.ptr[line], lines.ptr[line + 1] - 1
    for chunk in range(lines.chunk_ptr[line], lines.chunk_ptr[line + 1]):
        start = first + (chunk - lines.chunk_ptr[line]) * _CHUNK
        dx, dy = lines.circles[chunk, 0] - frame[0], lines.circles[chunk, 1] - frame[1]
        reach = HALF_SIDE + lines.circles[chunk, 2] + 1.0  # a pixel more than needed
        if abs(frame[2] * dx + frame[3] * dy) > reach or abs(frame[2] * dy - frame[3] * dx) > reach:
            continue
        px, py = _to_pixel(frame, lines.xy[start, 0], lines.xy[start, 1])
        for vertex in range(start + 1, min(start + _CHUNK, last) + 1):
            x, y = _to_pixel(frame, lines.xy[vertex, 0], lines.xy[vertex, 1])
            if x != px or y != py or vertex == start + 1:
                draw_line(picture, px, py, x, y, value)
            px, py = x, y


@kernel
def draw_objects(pictures: Picture, frame: FloatArray, boxes: Boxes, room: Room) -> None:
    """Draw the objects whose centre is in the picture."""
    for is_static in (False, True):
        for index in range(len(boxes.kinds)):
            kind = boxes.kinds[index]
            x, y, heading = boxes.poses[index, 0], boxes.poses[index, 1], boxes.poses[index, 2]
            if (kind > _LAST_AGENT) != is_static or not in_picture(frame, x, y):
                continue
            speed = np.hypot(boxes.velocities[index, 0], boxes.velocities[index, 1])
            length, width = boxes.sizes[index, 0], boxes.sizes[index, 1]
            if is_static:
                _draw_box(
                    pictures[PEDESTRIANS], frame, x, y, heading, length, width, STANDING, room
                )
            elif kind == _PEDESTRIAN:
                value = level(speed, MAX_WALK)
                _draw_box(pictures[PEDESTRIANS], frame, x, y, heading, length, width, value, room)
            else:
                value = level(speed, MAX_SPEED)
                _draw_box(pictures[VEHICLES], frame, x, y, heading, length, width, value, room)


@kernel
def draw_ego(
    pictures: Picture,
    frame: FloatArray,
    center: FloatArray,
    length: float,
    width: float,
    speed: float,
    room: Room,
) -> None:
    """Draw the ego; `center` is (3,), `speed` that of its centre."""
    value = level(speed, MAX_SPEED)
    _draw_box(pictures[EGO], frame, center[0], center[1], center[2], length, width, value, room)


@kernel
def _draw_box(
    picture: Picture,
    frame: FloatArray,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
    value: int,
    room: Room,
) -> None:
    corners, pixels = np.empty((4, 2)), room.ring[:4]
    box_corners(x, y, heading, length, width, corners)
    for corner in range(4):
        column, row = _to_pixel(frame, corners[corner, 0], corners[corner, 1])
        pixels[corner, 0], pixels[corner, 1] = column, row
    fill_box(picture, pixels, value, room.crossings)
