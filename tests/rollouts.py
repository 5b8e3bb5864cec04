"""Rollouts to score: a scripted ego, boxes beside it, and worlds in plain JSON moved about."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.sim.log import SimulationLog
from shiftsim.world.state import AX, NUM_STATE, VX, AgentKind, Tracks, TrafficLights

START_US = 1_600_000_000_000_000
WORLDS = sorted((Path(__file__).parent / "golden" / "metric_worlds").glob("metric_world_*.json"))


def states_of(poses: np.ndarray, speed: np.ndarray | float, accel: float = 0.0) -> np.ndarray:
    """(K, 11) states from rear-axle poses (K, 3) and forward speed."""
    states = np.zeros((len(poses), NUM_STATE))
    states[:, :3] = poses
    states[:, VX] = speed
    states[:, AX] = accel
    return states


def straight_poses(
    count: int, *, speed: float = 10.0, x: float = 20.0, y: float = 0.0, heading: float = 0.0
) -> np.ndarray:
    """(count, 3) rear-axle poses along +x at 10 Hz; `heading` turns the box, not the motion."""
    time = 0.1 * np.arange(count)
    return np.column_stack([x + speed * time, np.full(count, y), np.full(count, heading)])


def rollout(
    states: np.ndarray, *, expert: np.ndarray | None = None, tracks: Tracks | None = None
) -> SimulationLog:
    """A rollout of K states; the expert drives the same unless given, one sample longer."""
    count = len(states)
    if expert is None:
        step = states[-1:] - states[-2:-1]
        expert = np.concatenate([states, states[-1:] + step])
    return SimulationLog(
        token="toy",
        time_us=START_US + 100_000 * np.arange(count, dtype=np.int64),
        ego=states,
        tracks=Tracks.empty(count) if tracks is None else tracks,
        traffic_lights=TrafficLights.empty(count),
        expert_time_us=START_US + 100_000 * np.arange(count + 1, dtype=np.int64),
        expert_ego=expert,
        route=(),
        commands=np.full((count, 2), np.nan),
        noise=np.zeros((count, 2)),
        plans=np.full((count, 11, 3), np.nan),
        planning_seconds=np.zeros(count),
        degraded=np.zeros(count, np.bool_),
    )


def boxes(
    count: int,
    *placed: tuple[float, float, float],
    velocity: tuple[float, float] = (0.0, 0.0),
    kind: AgentKind = AgentKind.VEHICLE,
    size: tuple[float, float] = (4.0, 2.0),
) -> Tracks:
    """Tracks that start at the given poses and keep one velocity."""
    drift = 0.1 * np.arange(count)[:, None] * np.array([*velocity, 0.0])
    poses = np.array(placed)[None] + drift[:, None]
    shape = (count, len(placed))
    return Tracks(
        np.ones(shape, np.bool_),
        np.ascontiguousarray(poses),
        np.broadcast_to(velocity, (*shape, 2)).copy(),
        np.broadcast_to(size, (*shape, 2)).copy(),
        np.full(len(placed), int(kind), np.int64),
        tuple(f"t{index}" for index in range(len(placed))),
    )


def load_world(path: Path) -> dict[str, Any]:
    """One golden world."""
    world: dict[str, Any] = json.loads(path.read_text())
    return world


def move_world(
    world: dict[str, Any], angle: float, dx: float, dy: float, *, mirror: bool = False
) -> dict[str, Any]:
    """The same world mirrored at y = 0 (if asked), rotated and shifted."""
    out = copy.deepcopy(world)
    sign = -1.0 if mirror else 1.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    side = np.diag([1.0, sign])

    def place(points: Any) -> Any:
        return (np.array(points) @ side @ turn + [dx, dy]).tolist()

    for edge in out["map"]["edges"]:
        edge["polygon"], edge["baseline"] = place(edge["polygon"]), place(edge["baseline"])
    for block in out["map"]["roadblocks"].values():
        block["polygon"] = place(block["polygon"])
    for layer in ("intersections", "drivable_area"):
        out["map"][layer] = [place(ring) for ring in out["map"][layer]]
    for name in ("ego", "expert"):
        rows = np.array(out[name])
        rows[:, :2] = place(rows[:, :2])
        rows[:, [2, 4, 6, 7, 8]] *= sign
        rows[:, 2] += angle
        out[name] = rows.tolist()
    for thing in out["objects"]:
        rows = np.array(thing["frames"])
        rows[:, :2] = place(rows[:, :2])
        rows[:, 2] = sign * rows[:, 2] + angle
        rows[:, 3:] = rows[:, 3:] @ side @ turn
        thing["frames"] = rows.tolist()
    return out


def with_tracks(log: SimulationLog, tracks: Tracks) -> SimulationLog:
    """The same rollout among other tracks."""
    return replace(log, tracks=tracks)


def with_count(log: SimulationLog, road: object) -> int:
    """An own metric: the number of samples."""
    return len(log.time_us)
