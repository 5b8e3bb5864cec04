"""Red lights on a route, looked up again only when the lights change."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.map import VectorMap
from shiftsim.world.state import TrafficLights


class RedLights(NamedTuple):
    """Lanes and connectors with a red light, in the order of the lights. L of them."""

    lanes: list[int]  # their indices
    xy: FloatArray  # (V, 2) vertices of their shells, not closed [m]
    ptr: IntArray  # (L + 1,) first vertex of each
    bounds: FloatArray  # (L, 4) min x, min y, max x, max y of each [m]


class LightWatch:
    """Tells which lights are red among some lanes and connectors of a map."""

    def __init__(self, road: VectorMap, lanes: Collection[int]) -> None:
        """Take the map and the lanes and connectors."""
        self._road, self._lanes = road, frozenset(lanes)
        self._lights, self._red = TrafficLights.empty(1), red_lights([], [])

    def at(self, lights: TrafficLights) -> RedLights:
        """The red ones in a row of lights; what cannot be written is not looked at twice."""
        if lights is not self._lights or lights.status.flags.writeable:
            red = [lane for lane in red_lanes(self._road, lights) if lane in self._lanes]
            rings = [self._road.edges.rings(lane)[0] for lane in red]
            self._lights, self._red = lights, red_lights(red, rings)
        return self._red


def red_lanes(road: VectorMap, lights: TrafficLights) -> list[int]:
    """Lanes and connectors of the map whose light is red in one row, in the order of the lights."""
    index = road.edges.index
    return [index[name] for name in lights.red(0) if name in index]


def red_lights(lanes: list[int], rings: Sequence[FloatArray]) -> RedLights:
    """Red lights of some lanes and connectors with the shells (V, 2)."""
    xy = np.concatenate([np.zeros((0, 2)), *rings])
    ptr = np.cumsum([0, *map(len, rings)])
    bounds = [[*ring.min(axis=0), *ring.max(axis=0)] for ring in rings]
    return RedLights(lanes, xy, ptr, np.array(bounds).reshape(-1, 4))
