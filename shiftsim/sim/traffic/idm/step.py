"""One step of all reactive agents, one after the other (nuplan-simulation.md §10.2)."""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, lean_kernel
from shiftsim.geometry.frames import wrap_angle
from shiftsim.sim.dynamics.idm import idm_step
from shiftsim.sim.traffic.idm.footprints import (
    Obstacles,
    Scratch,
    move_agent,
    place_replayed,
    set_box,
    set_speeds,
)
from shiftsim.sim.traffic.idm.grid import enter, fill_grid
from shiftsim.sim.traffic.idm.lead import LOST, find_lead
from shiftsim.sim.traffic.idm.paths import PROGRESS, Fleet, Roads, extend_route
from shiftsim.world.layers import Polygons
from shiftsim.world.state import HEADING as EGO_HEADING
from shiftsim.world.state import PACIFICA, VX, VY

DONE, LONGER_PATHS, LONGER_CURVES, STRAYED = 0, 1, 2, 3  # how a step ends
_EGO_LENGTH, _EGO_WIDTH, _EGO_CENTER = PACIFICA.length, PACIFICA.width, PACIFICA.rear_axle_to_center


class Driving(NamedTuple):
    """How agents drive, see `idm_policy` and `IdmParameters`; numbers are all floats.

    Attributes:
        min_gap: Gap kept at standstill [m].
        headway: Time gap kept [s].
        accel_max: Largest acceleration [m/s^2].
        decel_max: Comfortable deceleration [m/s^2].
        min_path_length: Path kept ahead at standstill [m].
        radius: Agents farther from the ego are removed [m].
        mended: Whether agents know the speed of replayed tracks, and brake where nuPlan fails.
    """

    min_gap: float
    headway: float
    accel_max: float
    decel_max: float
    min_path_length: float
    radius: float
    mended: bool


class Row(NamedTuple):
    """One row of tracks, as in `Tracks`: (N,), (N, 3), (N, 2), (N, 2)."""

    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray


@lean_kernel
def advance(
    fleet: Fleet,
    agents: IntArray,
    replayed: IntArray,
    obstacles: Obstacles,
    roads: Roads,
    stops: Polygons,
    status: IntArray,
    driving: Driving,
    ego: FloatArray,
    row: Row,
    span: float,
    scratch: Scratch,
    first: int,
) -> tuple[int, int]:
    """Move every agent by one step and write where it is.

    Args:
        fleet: The agents.
        agents: (A,) their tracks.
        replayed: (R,) tracks that are replayed from the log.
        obstacles: Agents, ego and replayed objects.
        roads: The map.
        stops: Its stop polygons.
        status: (E,) LightStatus codes.
        driving: Parameters.
        ego: (11,) ego state.
        row: Holds the replayed tracks at the end of the step.
        span: Length of the step [s].
        scratch: Room.
        first: Agent to begin with; 0, or where an interrupted step goes on.

    Returns:
        DONE; LONGER_PATHS and how many vertices a path needs, to be called again; LONGER_CURVES and
        the agent whose footprint needs more, to be moved and gone on behind; STRAYED and the agent
        that is outside of its own corridor.
    """
    count = _place(fleet, replayed, obstacles, driving, ego, row)
    if first == 0:
        for agent in range(len(agents)):
            if fleet.alive[agent]:
                needed = extend_route(
                    fleet, agent, roads, status, driving.min_path_length, driving.headway
                )
                if needed > 0:
                    return LONGER_PATHS, needed
    fill_grid(scratch.grid, obstacles, count)
    for agent in range(first, len(agents)):
        if not fleet.alive[agent]:
            continue
        lead, gap = find_lead(fleet, agent, obstacles, count, roads, stops, status, scratch)
        if lead == LOST and not driving.mended:
            return STRAYED, agent
        _drive(fleet, agent, obstacles, count, roads, driving, span, lead, gap)
        if move_agent(fleet, agent, obstacles, scratch, driving.headway) < 0:
            return LONGER_CURVES, agent
        enter(scratch.grid, obstacles.bounds, agent)
    write_agents(fleet, agents, row)
    return DONE, 0


@lean_kernel
def _place(
    fleet: Fleet,
    replayed: IntArray,
    obstacles: Obstacles,
    driving: Driving,
    ego: FloatArray,
    row: Row,
) -> int:
    """Put ego and replayed tracks among the obstacles, remove agents far from the ego, for good.

    Returns:
        How many obstacles count.
    """
    place, heading = len(fleet.alive), ego[EGO_HEADING]
    x = ego[0] + _EGO_CENTER * np.cos(heading)
    y = ego[1] + _EGO_CENTER * np.sin(heading)
    set_box(obstacles, place, x, y, heading, _EGO_LENGTH, _EGO_WIDTH)
    obstacles.speed[place] = np.hypot(ego[VX], ego[VY])
    for agent in range(place):
        dx, dy = fleet.pose[agent, 0] - x, fleet.pose[agent, 1] - y
        if fleet.alive[agent] and np.sqrt(dx * dx + dy * dy) > driving.radius:
            fleet.alive[agent] = False
            obstacles.present[agent] = False
    count = place_replayed(obstacles, place + 1, replayed, row.valid, row.poses, row.sizes)
    if driving.mended:
        set_speeds(obstacles, place + 1, replayed, row.valid, row.velocities)
    return count


@lean_kernel
def _drive(
    fleet: Fleet,
    agent: int,
    obstacles: Obstacles,
    count: int,
    roads: Roads,
    driving: Driving,
    span: float,
    lead: int,
    gap: float,
) -> None:
    """Progress and speed of an agent after the step, behind the lead that `find_lead` gave."""
    path_end = fleet.path[agent, fleet.path_size[agent] - 1, PROGRESS]
    lead_speed, lead_heading = 0.0, fleet.pose[agent, 2]
    if lead < 0:
        # nuPlan: on a free road the agent brakes for the end of its path (§10.2)
        gap = path_end - fleet.progress[agent] - 0.5 * fleet.size[agent, 0]
    elif lead < len(fleet.alive):
        lead_speed, lead_heading = fleet.speed[lead], fleet.pose[lead, 2]
    elif lead < count:
        lead_speed, lead_heading = obstacles.speed[lead], obstacles.heading[lead]
    limit = roads.speed_limits[fleet.route[agent, fleet.route_size[agent] - 1]]
    if limit > 0.0:
        fleet.target[agent] = limit
    distance, speed = idm_step(
        fleet.speed[agent],
        gap,
        lead_speed * np.cos(wrap_angle(lead_heading - fleet.pose[agent, 2])),
        fleet.target[agent],
        driving.min_gap,
        driving.headway,
        driving.accel_max,
        driving.decel_max,
        span,
    )
    fleet.progress[agent] += distance
    fleet.speed[agent] = max(speed, 0.0)


@lean_kernel
def write_agents(fleet: Fleet, tracks: IntArray, row: Row) -> None:
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
