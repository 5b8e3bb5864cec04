"""One step of all reactive agents, one after the other."""

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.corridor import Corridor
from shiftsim.geometry.polylines import RUN, bound_runs
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.sim.dynamics.idm import idm_step
from shiftsim.sim.traffic.idm.lead import (
    FREE,
    find_lead,
    footprint_at,
    in_corridor,
    stop_line_ahead,
)
from shiftsim.sim.traffic.idm.paths import (
    add_curve,
    clamp_progress,
    cut_path,
    extend_route,
    needs_longer_path,
    pose_on_path,
    set_box,
)
from shiftsim.sim.traffic.idm.scene import PROGRESS, Ahead, Fleet, Scene
from shiftsim.sim.traffic.idm.yielding import ignores_ego_ahead, place_ego_ahead
from shiftsim.sim.traffic.lanes import RED
from shiftsim.world.state import HEADING as EGO_HEADING
from shiftsim.world.state import PACIFICA, VX, VY, YAW_RATE, TrackArrays

DONE, LONGER_PATHS, LEFT_PATH = 0, 1, 2  # how a step ends
_EGO_LENGTH, _EGO_WIDTH, _EGO_CENTER = PACIFICA.length, PACIFICA.width, PACIFICA.rear_axle_to_center


@kernel
def advance_steps(
    scene: Scene,
    tracks: TrackArrays,  # all rows of them
    row: int,  # the one in which the first step ends
    egos: FloatArray,  # (S, 11) ego states at the beginnings of the steps
    iteration: int,  # at which the first step begins
    spans: FloatArray,  # (T - 1,) how long each step is [s]
    edges: IntArray,  # (L,) with a light
    lights: IntArray,  # (T, L) which lights are listed at each iteration
) -> tuple[int, int, int]:
    """`advance` for several steps: how many were done, and how the last one ended."""
    # nuPlan rule 130: the ego is one step old, lights and replayed tracks are one step ahead
    valid, poses, velocities, sizes = tracks
    for step in range(len(egos)):
        for index in range(len(edges)):
            scene.graph.lights[edges[index]] = lights[iteration + step + 1, index]
        at = row + step
        now = TrackArrays(valid[at], poses[at], velocities[at], sizes[at])
        end, what = advance(scene, now, egos[step], spans[iteration + step])
        if end != DONE:
            return step, end, what
    return len(egos), DONE, 0


@kernel
def advance(scene: Scene, row: TrackArrays, ego: FloatArray, span: float) -> tuple[int, int]:
    """Move every agent by one step, `span` [s] long, and write where it is.

    The scene has the lights of the end of the step, and the row of tracks is that of the end of the
    step; `ego` (11,) is of its beginning.

    Returns:
        DONE; LONGER_PATHS and how many vertices a path needs, to begin again; LEFT_PATH and the
        agent that is outside of its own corridor.
    """
    fleet, footprints, num_agents = scene.fleet, scene.footprints, len(scene.agents)
    parameters, graph, scratch = scene.parameters, scene.graph, scene.scratch
    bounds, heading = footprints.bounds, ego[EGO_HEADING]
    x = ego[0] + _EGO_CENTER * np.cos(heading)
    y = ego[1] + _EGO_CENTER * np.sin(heading)
    set_box(footprints, num_agents, x, y, heading, _EGO_LENGTH, _EGO_WIDTH)
    lateral = ego[VY] + _EGO_CENTER * ego[YAW_RATE]
    place_ego_ahead(scene, x, y, heading, ego[VX], lateral)
    poses, sizes = row.poses, row.sizes
    for index, track in enumerate(scene.replayed):
        place = num_agents + 2 + index
        footprints.present[place] = row.valid[track]
        if row.valid[track]:
            pose_x, pose_y, turn = poses[track, 0], poses[track, 1], poses[track, 2]
            set_box(footprints, place, pose_x, pose_y, turn, sizes[track, 0], sizes[track, 1])
    for agent in range(num_agents):
        dx, dy = fleet.pose[agent, 0] - x, fleet.pose[agent, 1] - y
        if fleet.alive[agent] and np.sqrt(dx * dx + dy * dy) > parameters.radius:
            fleet.alive[agent] = footprints.present[agent] = False  # for good
        if fleet.alive[agent] and needs_longer_path(fleet, agent, parameters):
            needed = extend_route(fleet, agent, graph, parameters)
            if needed > 0:
                return LONGER_PATHS, needed
    for agent in range(num_agents):
        if not fleet.alive[agent]:
            continue
        # nuPlan rule 123: agents move one after the other, and see where those before them went
        path, size, progress = fleet.path[agent], fleet.path_size[agent], fleet.progress[agent]
        length, width = fleet.size[agent, 0], fleet.size[agent, 1]
        path_end = path[size - 1, PROGRESS]
        points = cut_path(path, size, progress, path_end, scratch.line)
        line, runs = scratch.line[:points], scratch.runs[: (points - 2) // RUN + 1]
        bound_runs(line, runs)
        corridor = Corridor(line, runs, 0, points, 0.5 * width)
        ahead = Ahead(corridor, scratch.outline, scratch.outline_size)
        ahead.outline_size[0] = -1
        own = footprint_at(footprints, agent)
        if not progress < path_end and not in_corridor(own, bounds[agent], ahead):
            return LEFT_PATH, agent  # nuPlan rule 128
        ignored, later = FREE, num_agents + 1  # where the ego will be
        if (
            footprints.present[later]
            and in_corridor(footprint_at(footprints, later), bounds[later], ahead)
            and ignores_ego_ahead(scene, agent)
        ):
            ignored = later
        lead, gap, lead_y = find_lead(footprints, agent, ignored, ahead)
        for segment in range(fleet.route_size[agent]):
            edge = fleet.route[agent, segment]
            if graph.lights[edge] & RED:
                is_first, gap, lead_y = stop_line_ahead(graph, edge, own, ahead, gap, lead_y)
                if is_first:
                    lead = len(footprints.present)
        heading = fleet.pose[agent, 2]
        lead_speed, lead_heading = 0.0, heading
        if lead == FREE:
            # nuPlan rule 124: on a free road the agent brakes for the end of its path
            gap = path_end - progress - 0.5 * length
        elif lead < num_agents:
            lead_speed, lead_heading = fleet.speed[lead], fleet.pose[lead, 2]
        elif lead <= num_agents + 1 and not scene.yielding.cautious[agent]:
            lead_speed, lead_heading = np.hypot(ego[VX], ego[VY]), ego[EGO_HEADING]
        # nuPlan rule 125: replayed tracks stand still, whatever their velocity
        limit = graph.speed_limits[fleet.route[agent, fleet.route_size[agent] - 1]]
        if limit > 0.0:
            fleet.target[agent] = limit
        distance, speed = idm_step(
            fleet.speed[agent],
            gap,
            lead_speed * np.cos(wrap_angle(lead_heading - heading)),
            fleet.target[agent],
            parameters.min_gap,
            parameters.headway,
            parameters.accel_max,
            parameters.decel_max,
            span,
        )
        progress += distance
        speed = max(speed, 0.0)
        x, y, heading = pose_on_path(path, size, clamp_progress(path, size, progress))
        set_box(footprints, agent, x, y, heading, length, width)
        front = progress + 0.5 * length + speed * parameters.headway
        points = cut_path(path, size, progress - 0.5 * length, front, scratch.line)
        line, curve = scratch.line[:points], footprints.curve[agent]
        footprints.curve_size[agent] = add_curve(line, 0.5 * width, curve, bounds[agent])
        fleet.pose[agent, 0], fleet.pose[agent, 1], fleet.pose[agent, 2] = x, y, heading
        fleet.progress[agent], fleet.speed[agent] = progress, speed
    write_agents(fleet, scene.agents, row)
    return DONE, 0


@kernel
def write_agents(fleet: Fleet, tracks: IntArray, row: TrackArrays) -> None:
    """Write the agents, whose tracks are given (A,), into a row; the gone as absent."""
    for agent in range(len(tracks)):
        track = tracks[agent]
        alive = fleet.alive[agent]
        heading, speed = fleet.pose[agent, 2], fleet.speed[agent]
        row.valid[track] = alive
        for column in range(3):
            row.poses[track, column] = fleet.pose[agent, column] if alive else np.nan
        row.velocities[track, 0] = speed * np.cos(heading) if alive else np.nan
        row.velocities[track, 1] = speed * np.sin(heading) if alive else np.nan
        for column in range(2):
            row.sizes[track, column] = fleet.size[agent, column] if alive else np.nan
