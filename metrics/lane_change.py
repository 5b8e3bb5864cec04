"""Lane changes: counted and timed, never scored; and whether all corners share lanes."""

from dataclasses import dataclass

import numpy as np

from shiftsim.kernels import BoolArray, IntArray, kernel
from shiftsim.metrics.result import MetricPart, MetricRow, Thresholds
from shiftsim.metrics.route import EdgeLists, has
from shiftsim.world.layers import Lists
from shiftsim.world.map import VectorMap

NAME = "ego_lane_change"


@dataclass(frozen=True, slots=True)
class LaneChanges:
    """Lane changes of one rollout."""

    # (K,) number of edges that hold all corners, connected ones included; 0 when the ego is
    # entirely outside lanes, -1 when its corners have none in common
    states: IntArray
    start: IntArray  # (L,) opening sample of each change
    end: IntArray  # (L,) closing sample
    failed: BoolArray  # (L,) whether the ego came back, left the road, or did not finish

    @property
    def is_common(self) -> BoolArray:
        """(K,) whether all corners are in the same or in connected lanes."""
        return self.states > 0


def lane_changes(map: VectorMap, corners: EdgeLists) -> LaneChanges:
    """The lane-change helper on the (K, 4, C) lists of the corners."""
    num_samples = len(corners.counts)
    widest = int(np.diff(map.outgoing.ptr).max(initial=0))
    most = corners.edges.shape[2] * (1 + widest)
    states = np.empty(num_samples, np.int64)
    changes = np.empty((num_samples, 3), np.int64)
    count = _lane_states(corners, map.incoming, map.outgoing, most, states, changes)
    start, end, failed = changes[:count].T
    return LaneChanges(states, start, end, failed > 0)


def evaluate(lanes: LaneChanges, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Number and duration of the lane changes, and the share that failed."""
    count, ratio, bound = len(lanes.start), 0.0, thresholds.max_lane_change_fail_rate
    statistics = [(f"number_of_{NAME}", "count", "COUNT", float(count))]
    if count:
        durations = (time_us[lanes.end] - time_us[lanes.start]) * 1e-6
        ratio = float(lanes.failed.sum()) / count
        statistics += [
            (f"max_{NAME}_duration", "seconds", "MAX", durations.max()),
            (f"avg_{NAME}_duration", "seconds", "MEAN", float(np.mean(durations))),
            (f"ratio_of_failed_{NAME}", "ratio", "RATIO", ratio),
        ]
    statistics.append((f"{NAME}_fail_rate_below_threshold", "boolean", "BOOLEAN", ratio <= bound))
    return MetricPart.of(MetricRow(NAME, None, ratio, "ratio", bound, None), *statistics)


@kernel
def _in_extended(items: IntArray, count: int, neighbours: Lists, value: int) -> bool:
    """Whether an edge is among the first `count` items or the neighbours of one of them."""
    if has(items, count, value):
        return True
    for index in range(count):
        edge = items[index]
        for item in range(neighbours.ptr[edge], neighbours.ptr[edge + 1]):
            if neighbours.items[item] == value:
                return True
    return False


@kernel
def _common(
    lists: IntArray, size: IntArray, incoming: Lists, outgoing: Lists, out: IntArray
) -> int:
    """Write the edges common to the corners, else connecting them; 0 outside lanes, -1 for none."""
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
    if found > 0:
        return found
    connected = False
    for index in range(size[1]):
        connected = connected or _in_extended(rr, size[2], outgoing, rl[index])
    for index in range(size[2]):
        connected = connected or _in_extended(rl, size[1], outgoing, rr[index])
    if not connected:
        return -1
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


@kernel
def _lane_states(
    corners: EdgeLists,  # (K, 4, C) edges of each corner
    incoming: Lists,  # edges that lead into an edge
    outgoing: Lists,  # edges an edge leads to
    most: int,  # upper bound on the number of edges common to the corners
    # (K,) written: number of common or connected edges; 0 entirely outside lanes, -1 none
    states: IntArray,
    changes: IntArray,  # (K, 3) written: opening sample, closing sample, 1 if it failed
) -> int:
    """Which samples have all corners in the same or connected lanes, and the lane changes.

    Returns:
        Number of lane changes.
    """
    current, previous = np.empty(most, np.int64), np.empty(most, np.int64)
    initial = np.empty(most, np.int64)
    is_open, num, initial_size = False, 0, 0
    for i in range(len(corners.counts)):
        state = _common(corners.edges[i], corners.counts[i], incoming, outgoing, current)
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
        changes[num, 1], changes[num, 2] = len(corners.counts) - 1, 1
        num += 1
    return num
