"""What planners make of a map, once for all scenarios on it."""

from collections.abc import Callable
from typing import Generic, TypeVar

from shiftsim.world.map import VectorMap

MAPS_KEPT = 4  # per kind of arrays; a run rarely visits more maps at a time
Arrays = TypeVar("Arrays")


class PerMap(Generic[Arrays]):
    """Arrays that depend on the map only: built once per map, kept for the latest few maps."""

    def __init__(self, build: Callable[[VectorMap], Arrays]) -> None:
        self._build = build
        self._kept: list[tuple[VectorMap, Arrays]] = []

    def __call__(self, road: VectorMap) -> Arrays:
        """The arrays of a map; maps are told apart by identity."""
        found = [item for item in self._kept if item[0] is road] or [(road, self._build(road))]
        others = [item for item in self._kept if item[0] is not road]
        self._kept = [*found, *others][:MAPS_KEPT]
        return found[0][1]
