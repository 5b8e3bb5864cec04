"""The raster CaRL sees: nine channels of 256 x 256 pixels around the ego.

Columns grow forward and rows to the left, two pixels a metre; the origin of the raster's middle is
14 m ahead of the centre of the ego. What depends on the map only is laid out once per map, with the
roads in the order in which nuPlan's spatial index yields them.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import box_corners
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned.carl.raster import Raster, draw_line, fill
from shiftsim.planners.learned.carl.roads import MAX_SPEED, YES, Roads, level
from shiftsim.world.layers import Polygons, meeting
from shiftsim.world.map import NONE
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind

SIZE = 256  # pixels along each side
PIXELS_PER_METRE = 2.0
HALF_SIDE = 64.0  # m
AHEAD = 14.0  # m, the middle of the raster lies so far before the centre of the ego
CHANNELS = (
    *("drivable_area", "route", "boundaries", "traffic_lights", "stop_signs", "speed_limits"),
    *("vehicles", "pedestrians_and_static", "ego"),
)
DRIVABLE, ROUTE, BOUNDARIES, LIGHTS, _STOPS, LIMITS, VEHICLES, PEDESTRIANS, EGO = range(9)
STANDING = 127
MAX_WALK = 4.0  # m/s
LIGHT_VALUES = np.array([80, 170, 255, 0, 0], np.uint8)  # by LightStatus; 0 is not drawn

_PEDESTRIAN = AgentKind.PEDESTRIAN
_LAST_AGENT = LAST_AGENT_KIND


class Boxes(NamedTuple):
    """Objects of one moment. N objects."""

    poses: FloatArray  # (N, 3) box centre x [m], y [m], heading [rad]
    sizes: FloatArray  # (N, 2) length, width [m]
    velocities: FloatArray  # (N, 2) in the map frame [m/s]
    kinds: IntArray  # (N,) AgentKind codes


@kernel
def picture_frame(center: FloatArray) -> FloatArray:
    """(4,) x [m], y [m], cosine and sine of the heading of the raster's middle."""
    cos, sin = np.cos(center[2]), np.sin(center[2])
    return np.array([center[0] + AHEAD * cos, center[1] + AHEAD * sin, cos, sin])


def find_areas(roads: Roads, frame: FloatArray) -> IntArray:
    """Areas that touch the raster, in the order of the spatial index."""
    ahead, left = HALF_SIDE * np.array([[1, -1, -1, 1], [1, 1, -1, -1]])
    cos, sin = frame[2:]
    corners = frame[:2] + np.column_stack([ahead * cos - left * sin, ahead * sin + left * cos])
    touches = np.zeros(len(roads.areas.bounds), np.bool_)
    touches[meeting(roads.areas, corners)] = True
    return roads.order[touches[roads.order]]


@kernel
def in_picture(frame: FloatArray, x: float, y: float) -> bool:
    """Whether a point lies strictly within the raster."""
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
    rasters: Raster,
    roads: Roads,
    frame: FloatArray,
    found: IntArray,
    on_route: BoolArray,
    lights: IntArray,
) -> None:
    """Draw what the map has, and the lights, into `rasters` (9, 256, 256) of zeros.

    `found` are the areas in the raster, `on_route` (B,) the blocks of the route, `lights` (E,) the
    LightStatus by edge, ABSENT where there is none.
    """
    filled = np.zeros(len(roads.areas.bounds), np.bool_)
    drawn = np.zeros(len(roads.lines.ptr), np.bool_)
    for area in found:
        shape = roads.drivable[area]
        if shape != NONE and not filled[shape]:
            filled[shape] = True
            _fill_shell(rasters[DRIVABLE], roads.areas, shape, frame)
        if area < roads.num_blocks and on_route[area]:
            _fill_shell(rasters[ROUTE], roads.areas, area, frame)
    for connectors in (False, True):  # lanes first
        for area in found:
            if area >= roads.num_blocks or (area >= roads.num_roadblocks) != connectors:
                continue
            for entry in range(roads.block_edges.ptr[area], roads.block_edges.ptr[area + 1]):
                edge = roads.block_edges.items[entry]
                light = LIGHT_VALUES[lights[edge]] if connectors else 0
                _draw_edge(rasters, roads, drawn, frame, edge, light)


@kernel
def _draw_edge(
    rasters: Raster, roads: Roads, drawn: BoolArray, frame: FloatArray, edge: int, light: int
) -> None:
    """Draw the lines of an edge: its speed limit, boundaries that are not drawn yet, its light."""
    for slot in range(4):
        line = roads.lines_of[edge, slot]
        channel, value = BOUNDARIES, YES
        if slot == 0:
            channel, value = LIMITS, int(roads.limits[edge])
        elif slot == 3:
            channel, value = LIGHTS, int(light)
        elif line != NONE:
            if drawn[line]:
                continue
            drawn[line] = True
        if line == NONE or value == 0:
            continue
        raster, xy = rasters[channel], roads.lines.xy
        start, stop = roads.lines.ptr[line], roads.lines.ptr[line + 1]
        x0, y0 = _to_pixel(frame, xy[start, 0], xy[start, 1])
        for vertex in range(start + 1, stop):
            x1, y1 = _to_pixel(frame, xy[vertex, 0], xy[vertex, 1])
            draw_line(raster, x0, y0, x1, y1, value)
            x0, y0 = x1, y1


@kernel
def _fill_shell(raster: Raster, polygons: Polygons, poly: int, frame: FloatArray) -> None:
    """Fill a polygon; its holes are filled, too."""
    shell = polygons.poly_ptr[poly]
    start, stop = polygons.ring_ptr[shell], polygons.ring_ptr[shell + 1]
    ring = np.empty((stop - start, 2), np.int64)
    for vertex in range(start, stop):
        x, y = _to_pixel(frame, polygons.xy[vertex, 0], polygons.xy[vertex, 1])
        ring[vertex - start, 0], ring[vertex - start, 1] = x, y
    fill(raster, ring, YES, False)


@kernel
def draw_objects(rasters: Raster, frame: FloatArray, boxes: Boxes) -> None:
    """Draw the objects whose centre is in the raster."""
    for is_static in (False, True):
        for index in range(len(boxes.kinds)):
            kind = boxes.kinds[index]
            x, y, heading = boxes.poses[index, 0], boxes.poses[index, 1], boxes.poses[index, 2]
            if (kind > _LAST_AGENT) != is_static or not in_picture(frame, x, y):
                continue
            speed = np.hypot(boxes.velocities[index, 0], boxes.velocities[index, 1])
            channel, value = VEHICLES, level(speed, MAX_SPEED)
            if is_static:
                channel, value = PEDESTRIANS, STANDING
            elif kind == _PEDESTRIAN:
                channel, value = PEDESTRIANS, level(speed, MAX_WALK)
            length, width = boxes.sizes[index, 0], boxes.sizes[index, 1]
            draw_box(rasters[channel], frame, x, y, heading, length, width, value)


@kernel
def draw_box(
    raster: Raster,
    frame: FloatArray,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
    value: int,
) -> None:
    """Draw a box."""
    corners, pixels = np.empty((4, 2)), np.empty((4, 2), np.int64)
    box_corners(x, y, heading, length, width, corners)
    for corner in range(4):
        column, row = _to_pixel(frame, corners[corner, 0], corners[corner, 1])
        pixels[corner, 0], pixels[corner, 1] = column, row
    fill(raster, pixels, value, True)
