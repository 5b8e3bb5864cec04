"""The route that follows from where the expert drove."""

from shiftsim.map import VectorMap
from shiftsim.scenario import Scenario


def expert_route(scene: Scenario) -> list[str]:
    """Ids of the blocks the recorded rear axle passes through, in order.

    nuPlan prefers the successors of the last block; only where none of them holds the point does
    it look at the whole map, roadblocks before connectors.
    """
    road = scene.map
    route: list[int] = []
    candidates: list[int] = []
    for x, y in scene.expert[:, :2].tolist():
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
