"""Progress along baselines, over-speed and driving direction (nuplan-metrics.md §8 to §10)."""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.geometry.polylines import project_on_polyline
from shiftsim.world.layers import Lists, Polygons, Polylines, contains


@lean_kernel
def _project(lines: Polylines, line: int, x: float, y: float) -> float:
    return project_on_polyline(lines.xy, lines.arc, lines.ptr[line], lines.ptr[line + 1], x, y)


@lean_kernel
def _project_end(lines: Polylines, line: int, other: int) -> float:
    last = lines.ptr[other + 1] - 1
    return _project(lines, line, lines.xy[last, 0], lines.xy[last, 1])


@lean_kernel
def progress_along(
    blocks: Polygons,
    lines: Polylines,
    chain_blocks: IntArray,
    chain_edges: IntArray,
    poses: FloatArray,
    out: FloatArray,
) -> None:
    """Write the progress of each point over the one before it, along a chain of roadblocks.

    Args:
        blocks: Areas of the roadblocks and roadblock connectors.
        lines: Baselines of the edges.
        chain_blocks: (L,) blocks in order, L >= 1.
        chain_edges: (L,) edge of each block whose baseline measures progress.
        poses: (K, 3) points x [m], y [m]; the third column is not read.
        out: (K,) progress [m]; 0 at the first point.
    """
    at, last = 0, len(chain_blocks) - 1
    previous = _project(lines, chain_edges[0], poses[0, 0], poses[0, 1])
    out[0] = 0.0
    for i in range(1, len(poses)):
        x, y = poses[i, 0], poses[i, 1]
        out[i] = 0.0
        if contains(blocks, chain_blocks[at], x, y):
            along = _project(lines, chain_edges[at], x, y)
            out[i] = along - previous
            previous = along
            continue
        # nuPlan: the search goes forward only, and never to the end of the chain in vain: where
        # nothing is found the memory stays as it is (nuplan-metrics.md §9)
        extra, skipped = 0.0, at
        ahead = at + 1
        while ahead <= last:
            edge = chain_edges[ahead]
            if contains(blocks, chain_blocks[ahead], x, y):
                current = chain_edges[at]
                length = lines.arc[lines.ptr[current + 1] - 1]
                along = _project(lines, edge, x, y)
                out[i] = (length - previous) + (along - _project_end(lines, edge, current)) + extra
                at, previous = ahead, along
                break
            if ahead < last:
                after = lines.ptr[chain_edges[ahead + 1]]
                start = _project(lines, edge, lines.xy[after, 0], lines.xy[after, 1])
                extra += start - _project_end(lines, edge, chain_edges[skipped])
            skipped = ahead
            ahead += 1


@lean_kernel
def progress_in_lane(
    lines: Polylines, lists: IntArray, counts: IntArray, poses: FloatArray, out: FloatArray
) -> None:
    """Write the progress of the ego along the baseline of the edge it is in.

    Args:
        lines: Baselines of the edges.
        lists: (K, C) edges of the ego centre.
        counts: (K,) their number.
        poses: (K, 3) ego centres.
        out: (K,) progress since the sample before [m].
    """
    edge = lists[0, 0] if counts[0] > 0 else -1
    known, previous = False, 0.0
    for i in range(len(counts)):
        out[i] = 0.0
        if counts[i] == 0:
            continue  # nuPlan: the memory survives, nuplan-metrics.md §13 Q3
        if lists[i, 0] != edge:
            edge, known = lists[i, 0], False
            continue
        along = _project(lines, edge, poses[i, 0], poses[i, 1])
        if known and along != 0.0:  # nuPlan: an arc length of 0 reads as unknown, §13 Q3
            out[i] = along - previous
        previous, known = along, True


@lean_kernel
def speed_limits_along(
    num_lanes: int,
    incoming: Lists,
    outgoing: Lists,
    limits: FloatArray,
    lists: IntArray,
    counts: IntArray,
    out: FloatArray,
) -> int:
    """Write the speed limit that holds at each sample; NaN where there is none.

    Args:
        num_lanes: How many of the edges are lanes.
        incoming: Edges that lead into an edge.
        outgoing: Edges an edge leads to.
        limits: (E,) limits of the edges, NaN where missing [m/s].
        lists: (K, C) edges of the ego centre.
        counts: (K,) their number.
        out: (K,) [m/s].

    Returns:
        -1, or the first sample on connectors that have no neighbour at all.
    """
    for i in range(len(counts)):
        out[i] = np.nan
        if counts[i] == 0:
            continue
        if lists[i, 0] < num_lanes:
            limit = limits[lists[i, 0]]
            out[i] = limit if limit != 0.0 else np.nan
            continue
        # nuPlan: a connector's own limit is not used (nuplan-metrics.md §10)
        highest, found, missing = -np.inf, 0, False
        for index in range(counts[i]):
            edge = lists[i, index]
            for side in range(2):
                lists_of = incoming if side == 0 else outgoing
                for item in range(lists_of.ptr[edge], lists_of.ptr[edge + 1]):
                    limit = limits[lists_of.items[item]]
                    missing = missing or np.isnan(limit) or limit == 0.0
                    highest = max(highest, limit)
                    found += 1
        if found == 0:
            return i
        out[i] = np.nan if missing else highest
    return -1
