"""Obstacles near a path, from a uniform grid of cells.

Cells are hashed into buckets, so that the grid has no edges. An agent that moves is entered again
and its old entries stay: what a bucket names is a candidate, whose bounding box is looked at.
"""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.sim.traffic.idm.footprints import Grid, Obstacles, Scratch
from shiftsim.sim.traffic.idm.shapes import num_pieces

CELL = 16.0  # m
_SPAN = 4  # cells along an axis, above which an obstacle is looked at by everyone
_ENTRIES = 2 * _SPAN * _SPAN  # of one obstacle in one step: before it moves and after
_SPREAD_X, _SPREAD_Y = 73_856_093, 19_349_663  # primes that scatter neighbouring cells
_MARGIN = 1.1  # corridors lie within this many half widths of their line


def make_grid(num_obstacles: int) -> Grid:
    """A grid for so many obstacles, empty."""
    buckets = 64
    while buckets < 4 * num_obstacles:
        buckets *= 2
    return Grid(
        first=np.full(buckets + 1, -1),
        entries=np.zeros((_ENTRIES * num_obstacles, 2), np.int64),
        used=np.zeros(1, np.int64),
        seen=np.full(num_obstacles, -1),
    )


@lean_kernel
def fill_grid(grid: Grid, obstacles: Obstacles, count: int) -> None:
    """Enter the first `count` obstacles, those that are there, into an emptied grid."""
    grid.used[0] = 0
    for bucket in range(len(grid.first)):
        grid.first[bucket] = -1
    for index in range(count):
        grid.seen[index] = -1
        if obstacles.present[index]:
            enter(grid, obstacles.bounds, index)


@lean_kernel
def enter(grid: Grid, bounds: FloatArray, index: int) -> None:
    """Enter an obstacle into the cells that its bounding box touches."""
    low_x, low_y = np.floor(bounds[index, 0] / CELL), np.floor(bounds[index, 1] / CELL)
    high_x, high_y = np.floor(bounds[index, 2] / CELL), np.floor(bounds[index, 3] / CELL)
    common = len(grid.first) - 1
    is_large = not (high_x - low_x < _SPAN and high_y - low_y < _SPAN)  # or has no numbers
    ix, last_x = (0, 0) if is_large else (int(low_x), int(high_x))
    first_y, last_y = (0, 0) if is_large else (int(low_y), int(high_y))
    while ix <= last_x:
        for iy in range(first_y, last_y + 1):
            bucket = common if is_large else _bucket(ix, iy, common)
            entry = grid.used[0]
            grid.entries[entry, 0], grid.entries[entry, 1] = index, grid.first[bucket]
            grid.first[bucket] = entry
            grid.used[0] = entry + 1
        ix += 1


@lean_kernel
def _bucket(ix: int, iy: int, num_buckets: int) -> int:
    return ((ix * _SPREAD_X) ^ (iy * _SPREAD_Y)) & (num_buckets - 1)


@lean_kernel
def list_near(
    obstacles: Obstacles, agent: int, half_width: float, size: int, scratch: Scratch
) -> int:
    """List obstacles whose bounding box comes near a piece of the corridor; returns how many.

    They are written into `scratch.hits`, in any order, with lower bounds of their gaps.
    """
    bounds, pieces, hits = obstacles.bounds, scratch.pieces, scratch.hits
    margin, count = _MARGIN * half_width, num_pieces(size)
    known = _list_cells(scratch.grid, agent, pieces, count, margin, hits)
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for piece in range(count):
        low_x, low_y = min(low_x, pieces[piece, 0]), min(low_y, pieces[piece, 1])
        high_x, high_y = max(high_x, pieces[piece, 2]), max(high_y, pieces[piece, 3])
    low_x, low_y, high_x, high_y = low_x - margin, low_y - margin, high_x + margin, high_y + margin
    found = 0
    for candidate in range(known):
        other = hits[candidate]
        if (
            other != agent
            and bounds[other, 0] <= high_x
            and bounds[other, 1] <= high_y
            and bounds[other, 2] >= low_x
            and bounds[other, 3] >= low_y
        ):
            apart_x = max(bounds[agent, 0] - bounds[other, 2], bounds[other, 0] - bounds[agent, 2])
            apart_y = max(bounds[agent, 1] - bounds[other, 3], bounds[other, 1] - bounds[agent, 3])
            hits[found] = other
            scratch.apart[found] = max(apart_x, apart_y)
            found += 1
    return found


@lean_kernel
def _list_cells(
    grid: Grid, agent: int, pieces: FloatArray, num_pieces: int, margin: float, out: IntArray
) -> int:
    """Write what is in the cells near the pieces, each once, into `out`; returns how many."""
    first, entries, seen = grid.first, grid.entries, grid.seen
    common, found = len(first) - 1, 0
    low_x = low_y = high_x = high_y = 0
    for piece in range(-1, num_pieces):
        before_x, before_y, until_x, until_y = low_x, low_y, high_x, high_y
        if piece >= 0:  # before the first piece what is too large for cells
            low_x = int(np.floor((pieces[piece, 0] - margin) / CELL))
            low_y = int(np.floor((pieces[piece, 1] - margin) / CELL))
            high_x = int(np.floor((pieces[piece, 2] + margin) / CELL))
            high_y = int(np.floor((pieces[piece, 3] + margin) / CELL))
        for ix in range(low_x, high_x + 1):
            for iy in range(low_y, high_y + 1):
                if piece > 0 and before_x <= ix <= until_x and before_y <= iy <= until_y:
                    continue
                entry = first[common if piece < 0 else _bucket(ix, iy, common)]
                while entry >= 0:
                    other, entry = entries[entry, 0], entries[entry, 1]
                    if seen[other] != agent:
                        seen[other] = agent
                        out[found] = other
                        found += 1
    return found
