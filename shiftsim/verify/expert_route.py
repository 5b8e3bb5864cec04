"""The route that follows from where the expert drove."""

from shiftsim.arrays import FloatArray
from shiftsim.data.nuplan.log import Log, read_ego
from shiftsim.world.map import VectorMap

_MAX_SECONDS = 60.0  # nuPlan looks ahead at most so far
_ROW, _SAMPLE = 0.05, 0.1  # s, nominal distance of log rows and of the samples asked for


def expert_points(log: Log, row: int) -> FloatArray:
    """(K, 2) rear axle positions after a row that nuPlan derives a route from [m]."""
    ahead = min((int(log.time_us[-1]) - int(log.time_us[row])) * 1e-6, _MAX_SECONDS)
    number, available = int(ahead / _SAMPLE), int(ahead / _ROW) + 1
    step = available // number
    last = min(row + step * number + 1, len(log.time_us))
    return read_ego(log, row, last)[step::step, :2]


def expert_route(road: VectorMap, points: FloatArray) -> list[str]:
    """Ids of the blocks that points (K, 2) pass through, in order.

    nuPlan prefers the successors of the last block; only where none of them holds the point does
    it look at the whole map, roadblocks before connectors.
    """
    route: list[int] = []
    candidates: list[int] = []
    for x, y in points.tolist():
        holding = road.blocks.containing(x, y).tolist()
        if route and route[-1] in holding:
            continue
        if route and not candidates:
            candidates = road.block_outgoing.at(route[-1]).tolist()
        candidates = [block for block in candidates if block in holding]
        if not candidates:
            candidates = _prefer_roadblocks(road, holding)
        if len(candidates) == 1:
            route.append(candidates.pop())
    return [road.blocks.ids[block] for block in route]


def _prefer_roadblocks(road: VectorMap, blocks: list[int]) -> list[int]:
    roadblocks = [block for block in blocks if block < road.num_roadblocks]
    return roadblocks or blocks
