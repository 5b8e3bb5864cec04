"""Self-checks of a finished map."""

from collections.abc import Sequence

import numpy as np
import shapely

from shiftsim.data.maps.builder import line_faults
from shiftsim.data.maps.opendrive.areas import linked_groups
from shiftsim.data.polygons import shared_areas
from shiftsim.kernels import FloatArray
from shiftsim.world.layers import Layer
from shiftsim.world.map import VectorMap

OVERLAP = 1e-6  # m², less counts as a shared border
END_GAP = 0.3  # m
JOINT_TURN = 0.2  # rad
SPACING = (0.2, 0.3)  # m, on baselines of at least SPACED_LENGTH
SPACED_LENGTH = 0.7  # m


def check_map(
    road: VectorMap, stacked: set[tuple[str, str]]
) -> tuple[dict[str, bool], dict[str, float]]:
    """Checks by name, and the figures behind them.

    Pairs of lanes or roadblocks in `stacked` lie over each other on different levels.
    """
    lines = [road.baselines.at(edge) for edge in range(len(road.edges))]
    polygons = [road.edges.shape(edge) for edge in range(len(road.edges))]
    blocks = [road.blocks.shape(block) for block in range(len(road.blocks))]
    gaps, turns = _joints(road, lines)
    low, high = _spacing(lines)
    lane_overlap = _largest_overlap(polygons[: road.num_lanes], road.edges.ids, stacked)
    block_overlap = _largest_overlap(blocks[: road.num_roadblocks], road.blocks.ids, stacked)
    lanes = polygons[: road.num_lanes]
    lane_area = float(shapely.union_all(lanes).area if stacked else sum(p.area for p in lanes))
    tiles = [road.drivable_areas.shape(i) for i in range(len(road.drivable_areas))]
    drivable = shapely.union_all(tiles).area
    layers: list[Layer] = [road.edges, road.blocks, road.intersections, road.stop_polygons]
    layers += [road.crosswalks, road.walkways, road.car_parks, road.drivable_areas]
    ids = [i for layer in layers for i in layer.ids]
    figures = {
        "baseline gap at joints [m]": gaps,
        "heading jump at joints [rad]": turns,
        "smallest baseline spacing [m]": low,
        "largest baseline spacing [m]": high,
        "largest overlap of lanes [m2]": lane_overlap,
        "largest overlap of roadblocks [m2]": block_overlap,
        "lane area [m2]": lane_area,
        "drivable area [m2]": float(drivable),
        "largest weakly connected part": _largest_component(road),
    }
    connectors = range(road.num_lanes, len(road.edges))
    checks = {
        "has lanes": road.num_lanes > 0,
        "connectors have both ends": all(
            len(road.incoming.at(e)) == 1 and len(road.outgoing.at(e)) == 1 for e in connectors
        ),
        "links agree both ways": _links_agree(road),
        "lanes and connectors alternate": _links_alternate(road),
        "baseline ends meet": gaps <= END_GAP,
        "no heading jump at joints": turns < JOINT_TURN,
        "lines do not turn back": line_faults(road) == {},
        "polygons are valid": all(p.is_valid and p.area > 0 for p in [*polygons, *blocks]),
        "lanes do not overlap": lane_overlap <= OVERLAP,
        "roadblocks do not overlap": block_overlap <= OVERLAP,
        "baseline spacing": SPACING[0] <= low and high <= SPACING[1],
        "lanes lie in the drivable area": lane_area <= drivable + 0.01 * lane_area + 1e-6,
        "ids are disjoint": len(ids) == len(set(ids)),
    }
    return checks, figures


def _joints(road: VectorMap, lines: Sequence[FloatArray]) -> tuple[float, float]:
    """Largest gap [m] and turn [rad] from the end of an edge to the start of the next."""
    gap, turn = 0.0, 0.0
    for edge in range(len(road.edges)):
        for onward in road.outgoing.at(edge):
            before, after = lines[edge], lines[onward]
            gap = max(gap, float(np.hypot(*(before[-1] - after[0]))))
            headings = [np.arctan2(*(b - a)[::-1]) for a, b in (before[-2:], after[:2])]
            turn = max(turn, abs((headings[1] - headings[0] + np.pi) % (2 * np.pi) - np.pi))
    return gap, float(turn)


def _spacing(lines: Sequence[FloatArray]) -> tuple[float, float]:
    steps = [np.hypot(*np.diff(line, axis=0).T) for line in lines]
    long = [step for step in steps if step.sum() >= SPACED_LENGTH]
    if not long:
        return 0.25, 0.25
    return min(float(s.min()) for s in long), max(float(s.max()) for s in long)


def _largest_overlap(
    polygons: Sequence[shapely.Polygon], ids: Sequence[str], stacked: set[tuple[str, str]]
) -> float:
    shared = shared_areas(polygons)
    free = [area for (i, j), area in shared.items() if (ids[i], ids[j]) not in stacked]
    return max(free, default=0.0)


def _links_agree(road: VectorMap) -> bool:
    onward = {(e, int(t)) for e in range(len(road.edges)) for t in road.outgoing.at(e)}
    back = {(int(s), e) for e in range(len(road.edges)) for s in road.incoming.at(e)}
    blocks = range(len(road.blocks))
    block_onward = {(b, int(t)) for b in blocks for t in road.block_outgoing.at(b)}
    block_back = {(int(s), b) for b in blocks for s in road.block_incoming.at(b)}
    return onward == back and block_onward == block_back


def _links_alternate(road: VectorMap) -> bool:
    return all(
        road.is_connector(edge) != road.is_connector(int(onward))
        for edge in range(len(road.edges))
        for onward in road.outgoing.at(edge)
    )


def _largest_component(road: VectorMap) -> float:
    """Share of the edges in the largest part that hangs together, ignoring direction."""
    links = [(e, int(onward)) for e in range(len(road.edges)) for onward in road.outgoing.at(e)]
    labels = linked_groups(links, len(road.edges))
    return float(np.bincount(labels).max() / len(labels)) if len(labels) else 0.0
