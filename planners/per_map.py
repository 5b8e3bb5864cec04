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
        for index, (known, arrays) in enumerate(self._kept):
            if known is road:
                if index:
                    self._kept.insert(0, self._kept.pop(index))
                return arrays
        arrays = self._build(road)
        self._kept.insert(0, (road, arrays))
        del self._kept[MAPS_KEPT:]
        return arrays
