"""Progress: along the route the expert drove, making any at all, and along the driving direction.

The driving direction is complied with where the ego goes back along its lane no more than a little
within a short window.
"""

from dataclasses import dataclass

import numpy as np

from shiftsim.errors import MapError
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Thresholds, first_violation
from shiftsim.metrics.route import EdgeLists, driven_route
from shiftsim.world.layers import Polygons, Polylines, contains, project_on_line
from shiftsim.world.map import NONE, VectorMap

NAME = "ego_progress_along_expert_route"
MAKING_NAME = "ego_is_making_progress"
DIRECTION_NAME = "driving_direction_compliance"


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress along the expert's route.

    nuPlan rule 71: the expert has one sample more than the ego.
    """

    ego: FloatArray  # (K,) progress of each sample over the one before [m]
    expert: FloatArray  # (T,) the same of the expert [m]
    has_route: bool  # whether the expert drove on any lane; without, both are all zero


def measure(map: VectorMap, centers: FloatArray, expert_centers: FloatArray) -> Progress:
    """Progress of ego centres (K, 3) and expert centres (T, 3) along the expert's route."""
    out = Progress(np.zeros(len(centers)), np.zeros(len(expert_centers)), False)
    chain = expert_chain(map, driven_route(map, expert_centers))
    if len(chain) == 0:
        return out
    blocks = map.block_of[chain]
    for poses, values in ((centers, out.ego), (expert_centers, out.expert)):
        _progress_along(map.blocks.polygons, map.baselines, blocks, chain, poses, values)
    return Progress(out.ego, out.expert, True)


def expert_chain(map: VectorMap, route: EdgeLists) -> IntArray:
    """Edges whose baselines measure progress, one per roadblock passed.

    Raises:
        MapError: One of them belongs to no roadblock.
    """
    chain: list[int] = []
    last: list[int] = []
    for sample in np.flatnonzero(_changes(route)).tolist():
        edges = route.at(sample)
        if not edges or not set(edges).isdisjoint(last):
            continue
        last = edges
        block = map.block_of[edges[0]]
        if block == NONE:
            raise MapError(
                f"map {map.name!r}: {map.edges.ids[edges[0]]!r} on the expert's route belongs to "
                "no roadblock, so progress cannot be measured"
            )
        if not chain or block != map.block_of[chain[-1]]:
            chain.append(edges[0])
    return np.array(chain, np.int64)


def _changes(route: EdgeLists) -> BoolArray:
    """(K,) samples whose first edge or number of edges differs from the sample before."""
    changed = np.ones(len(route.counts), np.bool_)
    same_count = route.counts[1:] == route.counts[:-1]
    changed[1:] = ~(same_count & (route.edges[1:, 0] == route.edges[:-1, 0]))
    return changed | (route.counts > 1)


def evaluate(progress: Progress, thresholds: Thresholds) -> tuple[MetricPart, MetricPart]:
    """Score of the progress ratio, and of making progress."""
    floor = thresholds.score_progress
    ego, expert = float(np.sum(progress.ego)), float(np.sum(progress.expert))
    ratio = 1.0
    if progress.has_route:
        ratio = 0.0 if ego < -floor else min(1.0, max(ego, floor) / max(expert, floor))
    own = [("ego_total_progress_along_route", "meters", "VALUE", ego)]
    along = MetricPart.of(
        MetricRow(NAME, ratio, ratio, "ratio", None, None),
        ("expert_total_progress_along_route", "meters", "VALUE", expert),
        *(own if progress.has_route else []),
        ("ego_expert_progress_along_route_ratio", "ratio", "RATIO", ratio),
        series=Series("meters", progress.ego) if progress.has_route else None,
    )
    score = float(ratio >= thresholds.min_progress)
    row = MetricRow(MAKING_NAME, score, ratio, "ratio", thresholds.min_progress, None)
    return along, MetricPart.of(row, (MAKING_NAME, "boolean", "BOOLEAN", score))


def lane_progress(map: VectorMap, route: EdgeLists, centers: FloatArray) -> FloatArray:
    """(K,) progress of the centres (K, 3) along the baseline of their edge since the last [m]."""
    out = np.empty(len(centers))
    _progress_in_lane(map.baselines, route, centers, out)
    return out


def windowed(progress: FloatArray, time_us: IntArray, horizon: float) -> FloatArray:
    """(K,) sum of the progress over the samples of the last `horizon` seconds [m]."""
    # nuPlan rule 73: truncated division, then one sample more than that
    steps = int(horizon * 1e6 / float(np.mean(np.diff(time_us))))
    padded = np.concatenate([np.zeros(steps), progress])
    windows = np.ndarray((len(progress), steps + 1), padded.dtype, padded, 0, 2 * padded.strides)
    sums: FloatArray = windows.sum(axis=1)
    return sums


def evaluate_direction(
    progress: FloatArray, time_us: IntArray, thresholds: Thresholds
) -> MetricPart:
    """Score 1, 0.5 or 0 by the largest regress within a window."""
    horizon = thresholds.driving_direction_horizon
    compliance = thresholds.driving_direction_compliance
    sums = windowed(progress, time_us, horizon)
    regress = abs(float(sums.min()))
    score = 0.5 if regress < thresholds.driving_direction_violation else 0.0
    score = 1.0 if regress < compliance else score
    violation = first_violation(-sums >= compliance, -sums, time_us)
    seconds = f"{horizon:g}"
    lowest_name = f"min_progress_along_driving_direction_in_{seconds}_second_interval"
    return MetricPart.of(
        MetricRow(DIRECTION_NAME, score, regress, "meters", compliance, violation),
        (f"{DIRECTION_NAME}_score", "value", "VALUE", score),
        (lowest_name, "meters", "MIN", -regress),
        series=Series(f"progress_along_driving_direction_in_last_{seconds}_seconds_[m]", sums),
    )


@kernel
def _project_end(lines: Polylines, line: int, other: int) -> float:
    """Arc length on a line of the end of another one [m]."""
    last = lines.ptr[other + 1] - 1
    return project_on_line(lines, line, lines.xy[last, 0], lines.xy[last, 1])


@kernel
def _progress_along(
    blocks: Polygons,  # areas of the roadblocks and roadblock connectors
    lines: Polylines,  # baselines of the edges
    chain_blocks: IntArray,  # (L,) blocks in order, L >= 1
    chain_edges: IntArray,  # (L,) edge of each block whose baseline measures progress
    poses: FloatArray,  # (K, 3) points x [m], y [m]; the third column is not read
    out: FloatArray,  # (K,) progress [m]; 0 at the first point
) -> None:
    """Write the progress of each point over the one before it, along a chain of roadblocks."""
    at, last = 0, len(chain_blocks) - 1
    previous = project_on_line(lines, chain_edges[0], poses[0, 0], poses[0, 1])
    out[0] = 0.0
    for i in range(1, len(poses)):
        x, y = poses[i, 0], poses[i, 1]
        out[i] = 0.0
        # nuPlan rule 72: the search goes forward only, and where nothing is found the memory stays
        ahead = at
        while ahead <= last and not contains(blocks, chain_blocks[ahead], x, y):
            ahead += 1
        if ahead > last:
            continue
        current, edge, extra = chain_edges[at], chain_edges[ahead], 0.0
        along = project_on_line(lines, edge, x, y)
        out[i] = along - previous
        for passed in range(at + 1, ahead):
            over, after = chain_edges[passed], lines.ptr[chain_edges[passed + 1]]
            start = project_on_line(lines, over, lines.xy[after, 0], lines.xy[after, 1])
            extra += start - _project_end(lines, over, chain_edges[passed - 1])
        if ahead > at:
            length = lines.arc[lines.ptr[current + 1] - 1]
            out[i] = (length - previous) + (along - _project_end(lines, edge, current)) + extra
        at, previous = ahead, along


@kernel
def _progress_in_lane(
    lines: Polylines, route: EdgeLists, poses: FloatArray, out: FloatArray
) -> None:
    """Write progress (K,) of centres (K, 3) along the baseline of their edge, by sample [m]."""
    lists, counts = route.edges, route.counts
    edge = lists[0, 0] if counts[0] > 0 else -1
    known, previous = False, 0.0
    for i in range(len(counts)):
        out[i] = 0.0
        if counts[i] == 0:
            continue  # nuPlan rule 74: the memory survives
        if lists[i, 0] != edge:
            edge, known = lists[i, 0], False
            continue
        along = project_on_line(lines, edge, poses[i, 0], poses[i, 1])
        if known and along != 0.0:  # nuPlan rule 75: an arc length of 0 reads as unknown
            out[i] = along - previous
        previous, known = along, True
