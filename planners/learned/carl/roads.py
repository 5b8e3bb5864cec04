"""The map as CaRL sees it: what of its raster depends on the map only."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import IntArray, kernel
from shiftsim.planners.proposals.areas import index_ranks
from shiftsim.world.layers import Lists, Polygons, Polylines, join_polygons, make_polylines
from shiftsim.world.map import NONE, VectorMap

YES = 255
MAX_SPEED = 30.0  # m/s

Values = NDArray[np.uint8]


class Roads(NamedTuple):
    """The map as CaRL sees it. I areas: roadblocks, roadblock connectors, car parks. E edges."""

    areas: Polygons  # polygons: the I areas, then the intersections
    order: IntArray  # (I,) areas in the order of the spatial index
    num_roadblocks: int  # how many of the areas are roadblocks
    num_blocks: int  # how many are roadblocks or roadblock connectors
    # (I,) polygon to fill for an area: itself, for a connector its intersection, or NONE
    drivable: IntArray
    block_edges: Lists  # edges of a block
    lines: Polylines  # baselines of the E edges, then boundaries of lanes, each once
    # (E, 4) lines of an edge: baseline, left and right boundary, baseline; NONE where it has none
    # to draw
    lines_of: IntArray
    limits: Values  # (E,) value of the speed limit


def make_roads(road: VectorMap) -> Roads:
    """What of a map is drawn."""
    areas = join_polygons(
        [road.blocks.polygons, road.car_parks.polygons, road.intersections.polygons]
    )
    num_blocks, num_areas = len(road.blocks), len(road.blocks) + len(road.car_parks)
    drivable = np.arange(num_areas)
    for block in range(road.num_roadblocks, num_blocks):
        crossed = road.intersection_of[road.block_edges.at(block)]
        first = next(iter(crossed[crossed != NONE]), NONE)
        drivable[block] = NONE if first == NONE else num_areas + first
    lines, lines_of = _lines(road)
    return Roads(
        areas,
        np.argsort(index_ranks(areas.bounds[:num_areas])) if num_areas else np.zeros(0, np.int64),
        road.num_roadblocks,
        num_blocks,
        drivable,
        road.block_edges,
        lines,
        lines_of,
        np.array([level(limit, MAX_SPEED) for limit in road.speed_limits.tolist()], np.uint8),
    )


def _lines(road: VectorMap) -> tuple[Polylines, IntArray]:
    """All lines to draw, and which of them an edge has; neighbours share their boundary."""
    lines = [road.baselines.at(edge) for edge in range(len(road.edges))]
    lines_of = np.full((len(lines), 4), NONE)
    lines_of[:, 0] = lines_of[:, 3] = np.arange(len(lines))
    known: dict[bytes, int] = {}
    for side, boundaries in ((1, road.left_boundaries), (2, road.right_boundaries)):
        for lane in range(road.num_lanes):
            line = boundaries.at(lane)
            if len(line) < 2:
                continue
            lines_of[lane, side] = known.setdefault(line.tobytes(), len(lines))
            if lines_of[lane, side] == len(lines):
                lines.append(line)
    return make_polylines(lines), lines_of


@kernel
def level(value: float, highest: float) -> int:
    """127 for zero, 255 for `highest` and more, and for NaN."""
    if np.isnan(value):
        return YES
    return int(127.5 * min(max(value / highest, 0.0), 1.0) + 127.5)
