"""Footprints of everything that can be in an agent's way.

The footprint of an agent is its box and the buffer of the piece of its path just ahead.
"""

from shiftsim.arrays import FloatArray, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.paths import clamp_progress, first_after, pose_on_path
from shiftsim.sim.traffic.idm.scene import PROGRESS, Fleet, Footprints, Scene
from shiftsim.sim.traffic.idm.shapes import bound_ring


@lean_kernel
def set_box(
    footprints: Footprints,
    index: int,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
) -> None:
    """Put something where its box is, without a path ahead."""
    box, bounds = footprints.box[index], footprints.bounds[index]
    box_corners(x, y, heading, length, width, box)
    footprints.present[index] = True
    bounds[0], bounds[1], bounds[2], bounds[3] = x, y, x, y
    bound_ring(box, len(box), bounds)


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
        # nuPlan rule 127: at an end of the path two vertices are left
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
def move_agent(scene: Scene, agent: int) -> int:
    """Pose and footprint of an agent from its progress; returns -1 where a curve is too long."""
    fleet, footprints, scratch = scene.fleet, scene.footprints, scene.scratch
    path, size = fleet.path[agent], fleet.path_size[agent]
    progress = fleet.progress[agent]
    x, y, heading = pose_on_path(path, size, clamp_progress(path, size, progress))
    fleet.pose[agent, 0], fleet.pose[agent, 1], fleet.pose[agent, 2] = x, y, heading
    length, width = fleet.size[agent, 0], fleet.size[agent, 1]
    set_box(footprints, agent, x, y, heading, length, width)
    front = progress + 0.5 * length + fleet.speed[agent] * scene.parameters.headway
    points = _cut(path, size, progress - 0.5 * length, front, scratch.line)
    curve = footprints.curve[agent]
    made = buffer_curve(scratch.line, points, 0.5 * width, scratch.keep, curve)
    footprints.curve_size[agent] = max(made, 0)
    bound_ring(curve, footprints.curve_size[agent], footprints.bounds[agent])
    return made
