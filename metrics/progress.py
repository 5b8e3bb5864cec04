"""Progress along the route the expert drove, and making progress at all."""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import MapError
from shiftsim.metrics import kernels_progress
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Statistic
from shiftsim.metrics.route import EdgeLists, driven_route
from shiftsim.metrics.thresholds import Thresholds
from shiftsim.world.map import NONE, VectorMap

NAME = "ego_progress_along_expert_route"
MAKING_NAME = "ego_is_making_progress"


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress along the expert's route. The expert has one sample more (nuplan-metrics.md §13 Q1).

    Attributes:
        ego: (K,) progress of each sample over the one before [m].
        expert: (T,) the same of the expert [m].
        has_route: Whether the expert drove on any lane; without, both are all zero.
    """

    ego: FloatArray
    expert: FloatArray
    has_route: bool


def measure(road: VectorMap, centers: FloatArray, expert_centers: FloatArray) -> Progress:
    """Progress of ego centres (K, 3) and expert centres (T, 3) along the expert's route."""
    out = Progress(np.zeros(len(centers)), np.zeros(len(expert_centers)), False)
    chain = expert_chain(road, driven_route(road, expert_centers))
    if len(chain) == 0:
        return out
    blocks = road.block_of[chain]
    for poses, values in ((centers, out.ego), (expert_centers, out.expert)):
        kernels_progress.progress_along(
            road.blocks.polygons, road.baselines, blocks, chain, poses, values
        )
    return Progress(out.ego, out.expert, True)


def expert_chain(road: VectorMap, route: EdgeLists) -> IntArray:
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
        block = road.block_of[edges[0]]
        if block == NONE:
            raise MapError(
                f"map {road.name!r}: {road.edges.ids[edges[0]]!r} on the expert's route belongs to "
                "no roadblock, so progress cannot be measured"
            )
        if not chain or block != road.block_of[chain[-1]]:
            chain.append(edges[0])
    return np.array(chain, np.int64)


def _changes(route: EdgeLists) -> np.ndarray:
    """(K,) samples whose first edge or number of edges differs from the sample before."""
    changed = np.ones(len(route.counts), np.bool_)
    same_count = route.counts[1:] == route.counts[:-1]
    changed[1:] = ~(same_count & (route.edges[1:, 0] == route.edges[:-1, 0]))
    return changed | (route.counts > 1)


def judge(progress: Progress, thresholds: Thresholds) -> tuple[MetricPart, MetricPart]:
    """Score of the progress ratio, and of making progress."""
    floor = thresholds.score_progress
    ego, expert = float(np.sum(progress.ego)), float(np.sum(progress.expert))
    ratio = 1.0
    if progress.has_route:
        ratio = 0.0 if ego < -floor else min(1.0, max(ego, floor) / max(expert, floor))
    statistics = [
        Statistic(NAME, "expert_total_progress_along_route", "meters", "VALUE", expert),
        Statistic(NAME, "ego_total_progress_along_route", "meters", "VALUE", ego),
        Statistic(NAME, "ego_expert_progress_along_route_ratio", "ratio", "RATIO", ratio),
    ]
    if not progress.has_route:
        del statistics[1]
    series = Series("meters", progress.ego) if progress.has_route else None
    along = MetricPart(
        MetricRow(NAME, ratio, ratio, "ratio", None, None), tuple(statistics), series
    )
    score = float(ratio >= thresholds.min_progress)
    making = MetricPart(
        MetricRow(MAKING_NAME, score, ratio, "ratio", thresholds.min_progress, None),
        (Statistic(MAKING_NAME, MAKING_NAME, "boolean", "BOOLEAN", score),),
    )
    return along, making
