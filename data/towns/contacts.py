"""Who of simulated traffic touches somebody, and is to be left out."""

import numpy as np
import shapely

from shiftsim.data.demo.agents import SIZES, Driver
from shiftsim.data.demo.traffic import Box
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import FloatArray

_MARGIN = 0.1  # m, added to length and width, so that nobody brushes anybody
_EVERY = 3  # frames
_PARKED = -1  # number of what nobody drives
_ON_FOOT = 1.0  # m, who is shorter walks


def touching(boxes: list[Box], parked: FloatArray, drivers: list[Driver]) -> set[int]:
    """Numbers of agents to leave out, so that nobody touches anybody.

    Agents are numbered from 0 on, drivers first, in the order of their tracks; cars are parked at
    `parked` (n, 3).
    """
    rows = np.array([(x[0], x[1] - 1, *x[3:6], *SIZES[x[2]][:2]) for x in boxes]).reshape(-1, 7)
    out: set[int] = set()
    size = np.array(SIZES["car"][:2])
    numbers = np.full((len(parked), 2), float(_PARKED))
    still = np.column_stack([numbers, parked, np.tile(size, (len(parked), 1))])
    for frame in range(0, round(rows[:, 0].max(initial=-1.0)) + 1, _EVERY):
        low, high = np.searchsorted(rows[:, 0], (frame, frame + 1))
        now = np.concatenate([rows[low:high], still])
        for i, j in _pairs(now, high - low):
            one, two = (int(now[k, 1]) for k in (i, j))
            if not out & {one, two}:
                out.add(_blamed(one, two, drivers))
    return out


def _pairs(now: FloatArray, moving: int) -> list[tuple[int, int]]:
    """Pairs of rows i < j that touch, of which the first is one of those that may move."""
    gap = np.hypot(*np.moveaxis(now[:moving, None, 2:4] - now[None, :, 2:4], -1, 0))
    reach = 0.5 * np.hypot(now[:, 5], now[:, 6])
    i, j = np.nonzero(gap < reach[:moving, None] + reach + 2.0 * _MARGIN)
    kept = (j > i) & ((now[i, 5] >= _ON_FOOT) | (now[j, 5] >= _ON_FOOT))
    i, j = i[kept], j[kept]
    sizes = now[:, 5:7] + np.where(now[:, 1:2] == _PARKED, 0.0, _MARGIN)
    shapes = shapely.polygons(boxes_to_corners(now[:, 2:5], sizes))
    meet = shapely.intersects(shapes[i], shapes[j])
    return list(zip(i[meet].tolist(), j[meet].tolist(), strict=True))


def _blamed(one: int, two: int, drivers: list[Driver]) -> int:
    """Which of two to leave out: a pedestrian, else the much longer vehicle, else the later one."""
    low, high = sorted((one, two))
    if low == _PARKED or high >= len(drivers):
        return high
    longer = drivers[low].length - drivers[high].length
    return low if longer > 2.0 else high
