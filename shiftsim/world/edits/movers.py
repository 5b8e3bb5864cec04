"""Vehicles that an edit puts on a lane and that drive from there on."""

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import ConfigError
from shiftsim.world.edits.draft import Draft
from shiftsim.world.lanes import find_start
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind


def add_mover(
    draft: Draft, name: str, pose: FloatArray, size: FloatArray, speed: float, behavior: int
) -> None:
    """Add a vehicle that drives from the first iteration on, and came along its lane until then.

    Raises:
        ConfigError: It is on no lane, or on something.
    """
    road = draft.scenario.map
    start = find_start(road, pose)
    if start is None:
        raise ConfigError(
            f"spawned vehicle at ({pose[0]:.1f}, {pose[1]:.1f}) is on no lane, so it cannot drive",
            hint='put it on a lane, or give behavior = "stopped"',
        )
    edge, along = start.edge, start.progress
    draft.require_free(start.pose, size, "spawned vehicle")
    seconds = draft.seconds
    past = seconds <= 0.0
    lanes = [edge]
    while sum(road.baselines.length(e) for e in lanes[1:]) + along < -seconds[0] * speed:
        before = road.incoming.at(lanes[-1]).tolist()
        if not before or before[0] in lanes:
            break
        lanes.append(before[0])
    poses = np.full((len(seconds), 3), np.nan)
    for row in np.flatnonzero(past).tolist():
        poses[row] = pose_on_edges(road, lanes, along + seconds[row] * speed)
    headings = poses[:, 2]
    velocities = speed * np.stack([np.cos(headings), np.sin(headings)], -1)
    draft.add(
        name,
        AgentKind.VEHICLE,
        size,
        np.nan_to_num(poses),
        valid=past,
        velocities=np.nan_to_num(velocities),
        behavior=behavior,
    )


def pose_on_edges(road: VectorMap, lanes: list[int], along: float) -> FloatArray:
    """(3,) pose on an edge, or, where `along` is negative, on those that lead to it [m]."""
    baselines = road.baselines
    edge, *before = lanes
    while along < 0.0 and before:
        edge, *before = before
        along += baselines.length(edge)
    line = baselines.at(edge)
    arc = baselines.arc[baselines.ptr[edge] : baselines.ptr[edge + 1]]
    index = min(max(int(np.searchsorted(arc, along, side="right")), 1), len(line) - 1)
    step = line[index] - line[index - 1]
    heading = float(np.arctan2(step[1], step[0]))
    ahead = along - arc[index - 1]
    x, y = line[index - 1] + ahead * np.array([np.cos(heading), np.sin(heading)])
    return np.array([x, y, heading])
