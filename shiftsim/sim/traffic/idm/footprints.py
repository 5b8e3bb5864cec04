"""Footprints of everything that can be in an agent's way (nuplan-simulation.md §10.2).

Those are the *obstacles*: first the agents, then the ego, then the replayed objects. The footprint
of an agent is its box and the buffer of the piece of its path just ahead.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.paths import (
    PROGRESS,
    Fleet,
    clamp_progress,
    first_after,
    pose_on_path,
)
from shiftsim.sim.traffic.idm.shapes import ring_bounds


class Obstacles(NamedTuple):
    """What agents must not run into. M obstacles: A agents, the ego, the replayed objects.

    Attributes:
        present: (M,) whether it is there.
        bounds: (M, 4) min x, min y, max x, max y [m].
        box: (M, 4, 2) corners [m].
        speed: (M,) along its heading [m/s]; agents' are in the fleet.
        heading: (M,) [rad]; agents' are in the fleet.
        curve: (A, V, 2) buffers of the path pieces just ahead of the agents [m].
        curve_size: (A,) how many vertices of them count; 0 before the first step.
    """

    present: BoolArray
    bounds: FloatArray
    box: FloatArray
    speed: FloatArray
    heading: FloatArray
    curve: FloatArray
    curve_size: IntArray


class Grid(NamedTuple):
    """Obstacles by the square cells that their bounding boxes touch, see `idm_grid`.

    Attributes:
        first: (H + 1,) first entry of each bucket of cells, -1 if none; the last bucket is for
            obstacles too large to be entered everywhere.
        entries: (E, 2) an obstacle and the next entry of its bucket, -1 if none.
        used: (1,) how many entries there are.
        seen: (M,) the agent for which an obstacle was last looked at.
    """

    first: IntArray
    entries: IntArray
    used: IntArray
    seen: IntArray


class Scratch(NamedTuple):
    """Room for intermediate results of one agent.

    Attributes:
        line: (K, 2) a piece of a path [m].
        keep: (K,) flags of its vertices.
        pieces: (C, 4) bounding boxes of the line's pieces [m].
        corridor: (W, 2) outline of the buffer of the path ahead [m].
        hits: (M,) obstacles that may be in the corridor.
        apart: (M,) lower bounds of the gaps to them [m].
        stop: (S, 2) a stop polygon [m].
        stop_bounds: (4,) its bounding box [m].
        grid: Where to look for obstacles.
    """

    line: FloatArray
    keep: BoolArray
    pieces: FloatArray
    corridor: FloatArray
    hits: IntArray
    apart: FloatArray
    stop: FloatArray
    stop_bounds: FloatArray
    grid: Grid


@lean_kernel
def set_box(
    obstacles: Obstacles,
    index: int,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
) -> None:
    """Put an obstacle without a path where its box is."""
    box_corners(x, y, heading, length, width, obstacles.box[index])
    obstacles.present[index] = True
    obstacles.heading[index] = heading
    bounds = obstacles.bounds[index]
    bounds[0], bounds[1], bounds[2], bounds[3] = np.inf, np.inf, -np.inf, -np.inf
    ring_bounds(obstacles.box[index], len(obstacles.box[index]), bounds)


@lean_kernel
def place_replayed(
    obstacles: Obstacles,
    first: int,
    replayed: IntArray,
    valid: BoolArray,
    poses: FloatArray,
    sizes: FloatArray,
) -> int:
    """Put the replayed tracks that are present among the obstacles.

    Args:
        obstacles: The obstacles.
        first: Place of the first one.
        replayed: (R,) which tracks are replayed.
        valid: (N,) whether a track is present.
        poses: (N, 3) x [m], y [m], heading [rad].
        sizes: (N, 2) length, width [m].

    Returns:
        How many obstacles count now.
    """
    count = first
    for track in replayed:
        if valid[track]:
            x, y, heading = poses[track, 0], poses[track, 1], poses[track, 2]
            set_box(obstacles, count, x, y, heading, sizes[track, 0], sizes[track, 1])
            count += 1
    return count


@lean_kernel
def set_speeds(
    obstacles: Obstacles, first: int, replayed: IntArray, valid: BoolArray, velocities: FloatArray
) -> None:
    """Give the replayed tracks, placed from `first` on, the speed they really have."""
    index = first
    for track in replayed:
        if valid[track]:
            vx, vy = velocities[track, 0], velocities[track, 1]
            speed = np.hypot(vx, vy)  # NaN for static objects
            obstacles.speed[index] = speed if speed > 0.0 else 0.0
            obstacles.heading[index] = np.arctan2(vy, vx) if speed > 0.0 else 0.0
            index += 1


@lean_kernel
def remaining_path(fleet: Fleet, agent: int, line: FloatArray) -> int:
    """Write the path ahead of an agent into `line` (K, 2); returns its number of vertices."""
    path, size = fleet.path[agent], fleet.path_size[agent]
    return _cut(path, size, fleet.progress[agent], path[size - 1, PROGRESS], line)


@lean_kernel
def _cut(path: FloatArray, size: int, start: float, stop: float, line: FloatArray) -> int:
    """Write a path between two progresses, clamped to it, into `line` (K, 2); returns its size."""
    first, last = clamp_progress(path, size, start), clamp_progress(path, size, stop)
    after = first_after(path, size, first)
    if after == size or not path[0, PROGRESS] < last:
        # nuPlan: at an end of the path two vertices are left (§12 Q13)
        head = size - 2 if after == size else 0
        for vertex in range(2):
            line[vertex, 0] = path[head + vertex, 0]
            line[vertex, 1] = path[head + vertex, 1]
        return 2
    x, y, _ = pose_on_path(path, size, first)
    line[0, 0], line[0, 1] = x, y
    count = 1
    while after < size and path[after, PROGRESS] < last:
        line[count, 0], line[count, 1] = path[after, 0], path[after, 1]
        count += 1
        after += 1
    x, y, _ = pose_on_path(path, size, last)
    line[count, 0], line[count, 1] = x, y
    return count + 1


@lean_kernel
def move_agent(
    fleet: Fleet,
    agent: int,
    obstacles: Obstacles,
    scratch: Scratch,
    headway: float,
) -> int:
    """Pose and footprint of an agent from its progress; returns -1 where a curve is too long."""
    path, size = fleet.path[agent], fleet.path_size[agent]
    progress = fleet.progress[agent]
    x, y, heading = pose_on_path(path, size, clamp_progress(path, size, progress))
    fleet.pose[agent, 0], fleet.pose[agent, 1], fleet.pose[agent, 2] = x, y, heading
    length, width = fleet.size[agent, 0], fleet.size[agent, 1]
    set_box(obstacles, agent, x, y, heading, length, width)
    front = progress + 0.5 * length + fleet.speed[agent] * headway
    points = _cut(path, size, progress - 0.5 * length, front, scratch.line)
    curve = obstacles.curve[agent]
    made = buffer_curve(scratch.line, points, 0.5 * width, scratch.keep, curve)
    obstacles.curve_size[agent] = max(made, 0)
    ring_bounds(curve, obstacles.curve_size[agent], obstacles.bounds[agent])
    return made
