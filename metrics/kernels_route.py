"""Lane association of points, corner routes, and the lane-change helper (nuplan-metrics.md §3, §4).

Every sample has a short list of edges, stored as a row of a (…, C) index array with its length; C
is the largest number of edges that can hold one point. Lanes come before connectors.

A length handed on starts as np.int64(0): for a literal the callee would be compiled once more.
"""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.rings import boundary_distance_below
from shiftsim.world.layers import Lists, Polygons, containing, contains, distance_to, in_any

_KEEP_DISTANCE = 5.0  # m, how far a connector is kept for inside an intersection
_OVERLAP = -1  # several lanes hold the point


@lean_kernel
def has(items: IntArray, count: int, value: int) -> bool:
    """Whether `value` is among the first `count` items."""
    for index in range(count):
        if items[index] == value:
            return True
    return False


@lean_kernel
def _search(polygons: Polygons, num_lanes: int, x: float, y: float, out: IntArray) -> int:
    found = containing(polygons, x, y, out)
    if found > 1 and out[1] < num_lanes:
        return _OVERLAP
    if found > 0 and out[0] < num_lanes:
        return 1
    return found


@lean_kernel
def _narrow(
    polygons: Polygons,
    outgoing: Lists,
    x: float,
    y: float,
    candidates: IntArray,
    count: int,
    out: IntArray,
) -> int:
    found = 0
    for index in range(count):
        if contains(polygons, candidates[index], x, y):
            out[found] = candidates[index]
            found += 1
    if found == 0 and count == 1:
        edge = candidates[0]
        for item in range(outgoing.ptr[edge], outgoing.ptr[edge + 1]):
            after = outgoing.items[item]
            if not has(out, found, after) and contains(polygons, after, x, y):
                out[found] = after
                found += 1
    return found


@lean_kernel
def driven_route(
    polygons: Polygons,
    num_lanes: int,
    incoming: Lists,
    outgoing: Lists,
    intersections: Polygons,
    poses: FloatArray,
    lists: IntArray,
    counts: IntArray,
) -> int:
    """Write the edges that hold each of a sequence of points, after nuPlan's disambiguation.

    Args:
        polygons: Areas of the edges.
        num_lanes: How many of the edges are lanes.
        incoming: Edges that lead into an edge.
        outgoing: Edges an edge leads to.
        intersections: The layer.
        poses: (K, 3) points x [m], y [m]; the third column is not read.
        lists: (K, C) edges of each point.
        counts: (K,) their number.

    Returns:
        -1, or the first sample that several lanes hold.
    """
    for i in range(len(poses)):
        x, y = poses[i, 0], poses[i, 1]
        count = 0
        if i > 0 and counts[i - 1] > 0:
            count = _narrow(polygons, outgoing, x, y, lists[i - 1], counts[i - 1], lists[i])
        if count == 0:
            count = _search(polygons, num_lanes, x, y, lists[i])
            if count == _OVERLAP:
                return i
            if i > 1 and counts[i - 1] > 0 and lists[i - 1, 0] >= num_lanes:
                in_crossing = count > 0 and lists[i, 0] >= num_lanes
                if in_crossing or (count == 0 and in_any(intersections, x, y)):
                    kept = 0
                    for index in range(counts[i - 1]):
                        edge = lists[i - 1, index]
                        if distance_to(polygons, edge, x, y) < _KEEP_DISTANCE:
                            lists[i, kept] = edge
                            kept += 1
                    # an empty selection leaves the list as it was found
                    count = kept if kept > 0 else count
        counts[i] = count
    _clean_up(num_lanes, incoming, lists, counts)
    return -1


@kernel
def _clean_up(num_lanes: int, incoming: Lists, lists: IntArray, counts: IntArray) -> None:
    for i in range(len(counts) - 2, -1, -1):
        if counts[i] < 2:
            continue
        after, size = lists[i + 1], counts[i + 1]
        count = counts[i]
        original = np.empty(count, np.int64)
        for index in range(count):
            original[index] = lists[i, index]
        subset = count > size
        for index in range(size):
            subset = subset and has(original, count, after[index])
        if subset:
            # nuPlan: also when the next list is empty, nuplan-metrics.md §13 Q4
            for index in range(size):
                lists[i, index] = after[index]
            counts[i] = size
        if size > 0 and after[0] < num_lanes:
            leading = incoming.items[incoming.ptr[after[0]] : incoming.ptr[after[0] + 1]]
            kept = 0
            for index in range(count):
                if has(leading, len(leading), original[index]):
                    lists[i, kept] = original[index]
                    kept += 1
            counts[i] = kept if kept > 0 else counts[i]


@kernel
def corner_routes(
    polygons: Polygons,
    num_lanes: int,
    outgoing: Lists,
    corners: FloatArray,
    lists: IntArray,
    counts: IntArray,
) -> int:
    """Write the edges that hold each corner; no disambiguation.

    Args:
        polygons: Areas of the edges.
        num_lanes: How many of the edges are lanes.
        outgoing: Edges an edge leads to.
        corners: (K, 4, 2) front-left, rear-left, rear-right, front-right [m].
        lists: (K, 4, C) edges of each corner.
        counts: (K, 4) their number.

    Returns:
        -1, or the first sample with a corner that several lanes hold.
    """
    candidates = np.empty(8 * lists.shape[2], np.int64)
    for i in range(len(corners)):
        size = np.int64(0)
        if i > 0:
            for corner in range(4):
                size = _add(candidates, size, lists[i - 1, corner], counts[i - 1, corner])
        for corner in range(4):
            x, y = corners[i, corner, 0], corners[i, corner, 1]
            out = lists[i, corner]
            count = _narrow(polygons, outgoing, x, y, candidates, size, out)
            if count == 0:
                count = _search(polygons, num_lanes, x, y, out)
                if count == _OVERLAP:
                    return i
                if i == 1:  # nuPlan: only here, nuplan-metrics.md §13 Q4
                    size = _add(candidates, size, out, count)
            counts[i, corner] = count
    return -1


@lean_kernel
def _add(items: IntArray, size: int, more: IntArray, count: int) -> int:
    for index in range(count):
        if not has(items, size, more[index]):
            items[size] = more[index]
            size += 1
    return size


@lean_kernel
def _in_extended(items: IntArray, count: int, neighbours: Lists, value: int) -> bool:
    if has(items, count, value):
        return True
    for index in range(count):
        edge = items[index]
        for item in range(neighbours.ptr[edge], neighbours.ptr[edge + 1]):
            if neighbours.items[item] == value:
                return True
    return False


@lean_kernel
def _linked(
    fl: IntArray,
    rl: IntArray,
    rr: IntArray,
    fr: IntArray,
    size: IntArray,
    incoming: Lists,
    outgoing: Lists,
    out: IntArray,
) -> int:
    connected = False
    for index in range(size[1]):
        connected = connected or _in_extended(rr, size[2], outgoing, rl[index])
    for index in range(size[2]):
        connected = connected or _in_extended(rl, size[1], outgoing, rr[index])
    if not connected:
        return -1
    found = 0
    for index in range(size[2]):
        first, last = outgoing.ptr[rr[index]], outgoing.ptr[rr[index] + 1]
        for item in range(first - 1, last):
            edge = rr[index] if item < first else outgoing.items[item]
            if (
                not has(out, found, edge)
                and _in_extended(fl, size[0], incoming, edge)
                and _in_extended(fr, size[3], incoming, edge)
                and _in_extended(rl, size[1], outgoing, edge)
            ):
                out[found] = edge
                found += 1
    return found if found > 0 else -1


@lean_kernel
def _common(
    lists: IntArray, size: IntArray, incoming: Lists, outgoing: Lists, out: IntArray
) -> int:
    fl, rl, rr, fr = lists[0], lists[1], lists[2], lists[3]
    empty = 0
    for corner in range(4):
        empty += size[corner] == 0
    if empty > 0:
        return 0 if empty == 4 else -1
    found = 0
    for index in range(size[0]):
        edge = fl[index]
        if has(rl, size[1], edge) and has(rr, size[2], edge) and has(fr, size[3], edge):
            out[found] = edge
            found += 1
    return found if found > 0 else _linked(fl, rl, rr, fr, size, incoming, outgoing, out)


@kernel
def lane_states(
    lists: IntArray,
    counts: IntArray,
    incoming: Lists,
    outgoing: Lists,
    room: int,
    states: IntArray,
    changes: IntArray,
) -> int:
    """Which samples have all corners in the same or connected lanes, and the lane changes.

    Args:
        lists: (K, 4, C) edges of each corner.
        counts: (K, 4) their number.
        incoming: Edges that lead into an edge.
        outgoing: Edges an edge leads to.
        room: Upper bound on the number of edges common to the corners.
        states: (K,) written: number of common or connected edges; 0 entirely outside lanes,
            -1 none.
        changes: (K, 3) written: opening sample, closing sample, 1 if it failed.

    Returns:
        Number of lane changes.
    """
    current, previous, initial = (
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
    )
    is_open, num, initial_size = False, 0, np.int64(0)
    for i in range(len(counts)):
        state = _common(lists[i], counts[i], incoming, outgoing, current)
        states[i] = state
        if is_open and state >= 0:
            failed = state == 0
            for index in range(state):
                failed = failed or _in_extended(initial, initial_size, outgoing, current[index])
            changes[num, 1], changes[num, 2] = i, failed
            num, is_open = num + 1, False
        elif not is_open and i > 0 and state < 0 and states[i - 1] > 0:
            initial_size = states[i - 1]
            for index in range(initial_size):
                initial[index] = previous[index]
            changes[num, 0], is_open = i, True
        current, previous = previous, current
    if is_open:
        changes[num, 1], changes[num, 2] = len(counts) - 1, 1
        num += 1
    return num


@kernel
def corner_violations(
    drivable: Polygons,
    edges: Polygons,
    corners: FloatArray,
    corner_counts: IntArray,
    lists: IntArray,
    counts: IntArray,
    outside: BoolArray,
    distances: FloatArray,
) -> None:
    """How far each corner is from where it may be (nuplan-metrics.md §5).

    Args:
        drivable: Areas whose union is drivable.
        edges: Areas of lanes and connectors.
        corners: (K, 4, 2) [m].
        corner_counts: (K, 4) number of edges that hold each corner.
        lists: (K, C) edges of the ego centre.
        counts: (K,) their number.
        outside: (K, 4) written: in no edge and in no drivable area.
        distances: (K, 4) written: distance of an outside corner to the nearest drivable area or
            edge of the centre, 0 for the others [m].
    """
    found = np.full(4, -1)  # nearest drivable area of each corner in the sample before
    for i in range(len(corners)):
        for corner in range(4):
            x, y = corners[i, corner, 0], corners[i, corner, 1]
            outside[i, corner] = corner_counts[i, corner] == 0 and not in_any(drivable, x, y)
            distances[i, corner] = 0.0
            if outside[i, corner]:
                best = np.inf
                for index in range(counts[i]):
                    best = _distance_below(edges, lists[i, index], x, y, best)
                if found[corner] >= 0:
                    best = _distance_below(drivable, found[corner], x, y, best)
                if best == np.inf:
                    distances[i, corner] = _scan(drivable, x, y, found, corner)
                else:
                    distances[i, corner] = _scan_near(drivable, x, y, best, found, corner)


@lean_kernel
def _scan(polygons: Polygons, x: float, y: float, found: IntArray, corner: int) -> float:
    """Distance of a point from the nearest polygon, whose index goes to `found[corner]` [m]."""
    best = np.inf
    for poly in range(len(polygons.bounds)):
        distance = _distance_below(polygons, poly, x, y, best)
        if distance < best:
            best, found[corner] = distance, poly
    return best


@lean_kernel
def _scan_near(
    polygons: Polygons, x: float, y: float, limit: float, found: IntArray, corner: int
) -> float:
    """The same where the nearest polygon is known to be no farther than `limit`: by the grid."""
    best = limit
    x0, y0, cell = polygons.grid[0], polygons.grid[1], polygons.grid[2]
    first = max(int(np.floor((x - limit - x0) / cell)), 0)
    last = min(int(np.floor((x + limit - x0) / cell)), polygons.shape[0] - 1)
    low = max(int(np.floor((y - limit - y0) / cell)), 0)
    high = min(int(np.floor((y + limit - y0) / cell)), polygons.shape[1] - 1)
    for ix in range(first, last + 1):
        for iy in range(low, high + 1):
            at = ix * polygons.shape[1] + iy
            for entry in range(polygons.cell_ptr[at], polygons.cell_ptr[at + 1]):
                poly = polygons.cell_items[entry]
                distance = _distance_below(polygons, poly, x, y, best)
                if distance < best:
                    best, found[corner] = distance, poly
    return best


@lean_kernel
def _distance_below(polygons: Polygons, poly: int, x: float, y: float, limit: float) -> float:
    """Distance of a point outside polygon `poly` from it, or `limit` where it is not below [m]."""
    dx = max(polygons.bounds[poly, 0] - x, 0.0, x - polygons.bounds[poly, 2])
    dy = max(polygons.bounds[poly, 1] - y, 0.0, y - polygons.bounds[poly, 3])
    best = limit
    if dx * dx + dy * dy < best * best:
        for ring in range(polygons.poly_ptr[poly], polygons.poly_ptr[poly + 1]):
            start, stop = polygons.ring_ptr[ring], polygons.ring_ptr[ring + 1]
            best = boundary_distance_below(polygons.xy, start, stop, x, y, best)
    return best
