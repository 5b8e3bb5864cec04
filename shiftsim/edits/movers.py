"""Vehicles that an edit puts on a lane and that drive from there on."""

import numpy as np

from shiftsim.edits.draft import ScenarioBuilder
from shiftsim.errors import ConfigError
from shiftsim.kernels import FloatArray
from shiftsim.world.lanes import find_start
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind


def add_mover(
    draft: ScenarioBuilder,
    name: str,
    pose: FloatArray,
    size: FloatArray,
    speed: float,
    behavior: int,
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
    draft.require_free(start.pose[None], size, "spawned vehicle")
    seconds = draft.seconds
    past = seconds <= 0.0
    lanes = [edge]
    while sum(road.baselines.length(e) for e in lanes[1:]) + along < -seconds[0] * speed:
        before = road.incoming.at(lanes[-1]).tolist()
        if not before or before[0] in lanes:
            break
        lanes.append(before[0])
    poses = poses_on_edges(road, lanes, along + np.minimum(seconds, 0.0) * speed)
    headings = poses[:, 2]
    velocities = speed * np.stack([np.cos(headings), np.sin(headings)], -1)
    draft.add(
        name,
        AgentKind.VEHICLE,
        size,
        poses,
        valid=past,
        velocities=velocities,
        behavior=behavior,
    )


def poses_on_edges(road: VectorMap, lanes: list[int], along: FloatArray) -> FloatArray:
    """(N, 3) poses on an edge, or, where `along` (N,) is negative, on those that lead to it [m]."""
    lines = [road.baselines.at(edge) for edge in reversed(lanes)]
    xy = np.concatenate([lines[0], *(line[1:] for line in lines[1:])])
    steps = np.diff(xy, axis=0)
    progress = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    at = along + progress[-1] - road.baselines.length(lanes[0])
    segment = np.clip(np.searchsorted(progress, at, side="right") - 1, 0, len(steps) - 1)
    x, y = (np.interp(at, progress, xy[:, column]) for column in (0, 1))
    return np.column_stack([x, y, np.arctan2(steps[segment, 1], steps[segment, 0])])
