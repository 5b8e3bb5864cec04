"""Small worlds to simulate in: a straight two-lane road and whoever is on it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from shiftsim.geometry.boxes import wrap_angles
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.layers import make_layer, make_polylines
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    AX,
    HEADING,
    NUM_STATE,
    PACIFICA,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    AgentKind,
    Tracks,
    TrafficLights,
    VehicleParameters,
    X,
    Y,
    rear_poses,
)

LANE_WIDTH = 3.5  # m


def straight_road(
    speed_limit: float | None = 15.0, offset: tuple[float, float] = (0, 0)
) -> VectorMap:
    """One direction, two lanes: lane — connector — lane, along +x; the right lane has y = 0."""
    spans = {"1": (0.0, 200.0), "2": (200.0, 220.0), "3": (220.0, 420.0)}
    edges, blocks = [], []
    for name, (start, stop) in spans.items():
        is_connector = name == "2"
        for lane, y in enumerate((LANE_WIDTH, 0.0)):  # left lane first
            x = np.linspace(start, stop, int(stop - start) + 1)
            low, high = y - LANE_WIDTH / 2, y + LANE_WIDTH / 2
            follower = [f"{int(name) + 1}{lane}"] if name != "3" else []
            edges.append(
                EdgeSpec(
                    id=f"{name}{lane}",
                    is_connector=is_connector,
                    polygon=_shift(shapely.box(start, low, stop, high), offset),
                    baseline=np.c_[x, np.full_like(x, y)] + offset,
                    block_id=name,
                    incoming=[f"{int(name) - 1}{lane}"] if name != "1" else [],
                    outgoing=follower,
                    left=np.c_[x, np.full_like(x, high)] + offset,
                    right=np.c_[x, np.full_like(x, low)] + offset,
                    speed_limit=speed_limit,
                    lane_index=None if is_connector else lane,
                    left_lane=f"{name}0" if lane == 1 and not is_connector else None,
                    right_lane=f"{name}1" if lane == 0 and not is_connector else None,
                    intersection_id="9" if is_connector else None,
                )
            )
        blocks.append(
            BlockSpec(
                id=name,
                is_connector=is_connector,
                polygon=_shift(shapely.box(start, -1.75, stop, 5.25), offset),
                incoming=[str(int(name) - 1)] if name != "1" else [],
                outgoing=[str(int(name) + 1)] if name != "3" else [],
            )
        )
    crossing = _shift(shapely.box(200.0, -1.75, 220.0, 5.25), offset)
    return build_map(
        "straight",
        edges=edges,
        blocks=blocks,
        intersections=[AreaSpec("9", crossing)],
        drivable_areas=[AreaSpec("90", _shift(shapely.box(0, -1.75, 420, 5.25), offset))],
    )


def _shift(polygon: shapely.Polygon, offset: tuple[float, float]) -> shapely.Polygon:
    return shapely.transform(polygon, lambda xy: xy + np.array(offset))


def standing_tracks(num_rows: int, poses: np.ndarray, kinds: list[AgentKind]) -> Tracks:
    """Tracks that stand at (N, 3) poses for the whole time, 4.5 m x 2 m."""
    count = len(poses)
    agents = np.array([kind <= AgentKind.BICYCLE for kind in kinds])
    velocities = np.where(agents[None, :, None], 0.0, np.nan) * np.ones((num_rows, count, 2))
    return Tracks(
        np.ones((num_rows, count), np.bool_),
        np.tile(np.asarray(poses, np.float64), (num_rows, 1, 1)),
        velocities,
        np.tile([4.5, 2.0], (num_rows, count, 1)),
        np.array([int(kind) for kind in kinds], np.int64),
        tuple(f"{index:016x}" for index in range(count)),
    )


def cruise_scenario(
    *,
    speed: float = 8.0,
    iterations: int = 151,
    history_rows: int = 60,
    future_rows: int = 160,
    tracks: Tracks | None = None,
    road: VectorMap | None = None,
    start: tuple[float, float, float] = (10.0, 0.0, 0.0),
) -> Scenario:
    """An ego that was recorded driving straight at constant speed, 20 Hz rows, 10 Hz iterations."""
    num_rows = history_rows + 2 * (iterations - 1) + 1 + future_rows
    time = (np.arange(num_rows) - history_rows) * 0.05
    ego = np.zeros((num_rows, NUM_STATE))
    ego[:, X] = start[0] + speed * time * np.cos(start[2])
    ego[:, Y] = start[1] + speed * time * np.sin(start[2])
    ego[:, HEADING] = start[2]
    ego[:, VX] = speed
    return Scenario(
        token="0123456789abcdef",
        scenario_type="unknown",
        log_name="toy",
        city="straight",
        map=road or straight_road(),
        time_us=1_600_000_000_000_000 + np.arange(num_rows, dtype=np.int64) * 50_000,
        ego=ego,
        tracks=tracks if tracks is not None else Tracks.empty(num_rows),
        traffic_lights=TrafficLights.empty(num_rows),
        iteration_rows=history_rows + 2 * np.arange(iterations, dtype=np.int64),
        row_step=2,
        route=("1", "2", "3"),
        mission_goal=np.array([400.0, 0.0, 0.0]),
        mapping=(15.0, 0.0, 0.5),
    )


def moved_points(xy: np.ndarray, angle: float, shift: np.ndarray) -> np.ndarray:
    """Points (..., 2) after a rotation [rad] and a translation [m] of the world."""
    cos, sin = np.cos(angle), np.sin(angle)
    return xy @ np.array([[cos, sin], [-sin, cos]]) + shift


def moved_poses(poses: np.ndarray, angle: float, shift: np.ndarray) -> np.ndarray:
    """Poses (..., 3) after the same."""
    out = poses.copy()
    out[..., :2] = moved_points(poses[..., :2], angle, shift)
    out[..., 2] = wrap_angles(poses[..., 2] + angle)
    return out


def mapped(road: VectorMap, move: Callable[[np.ndarray], np.ndarray]) -> VectorMap:
    """A map whose points (..., 2) all went elsewhere."""
    layers = ("edges", "blocks", "intersections", "crosswalks", "drivable_areas")
    lines = ("baselines", "left_boundaries", "right_boundaries")
    changes: dict[str, Any] = {}
    for name in layers:
        layer = getattr(road, name)
        shapes = [shapely.transform(layer.shape(i), move) for i in range(len(layer))]
        changes[name] = make_layer(layer.ids, shapes)
    for name in lines:
        line = getattr(road, name)
        changes[name] = make_polylines([move(line.at(i)) for i in range(len(line.ptr) - 1)])
    return replace(road, **changes)


def moved_map(road: VectorMap, angle: float, shift: np.ndarray) -> VectorMap:
    """A map after a rotation [rad] and a translation [m] of the world."""
    return mapped(road, lambda xy: moved_points(xy, angle, shift))


def bent_points(xy: np.ndarray, turn: float = 2.0, radius: float = 150.0) -> np.ndarray:
    """Points (..., 2) beside the x axis, which becomes an arc to the left from a heading on."""
    along, beside = xy[..., 0] / radius, radius - xy[..., 1]
    arc = np.stack([beside * np.sin(along), radius - beside * np.cos(along)], axis=-1)
    return moved_points(arc, turn, np.zeros(2))


def moved(scenario: Scenario, angle: float, shift: np.ndarray) -> Scenario:
    """The same scenario in a world that was turned and shifted as a whole."""
    tracks = scenario.tracks
    cos, sin = np.cos(angle), np.sin(angle)
    turned = replace(
        tracks,
        poses=moved_poses(tracks.poses, angle, shift),
        velocities=tracks.velocities @ np.array([[cos, sin], [-sin, cos]]),
    )
    ego = scenario.ego.copy()
    ego[:, :3] = moved_poses(ego[:, :3], angle, shift)
    return replace(scenario, map=moved_map(scenario.map, angle, shift), ego=ego, tracks=turned)


def join_tracks(parts: list[Tracks]) -> Tracks:
    """Several sets of tracks over the same rows as one."""
    return Tracks(
        np.concatenate([part.valid for part in parts], axis=1),
        np.concatenate([part.poses for part in parts], axis=1),
        np.concatenate([part.velocities for part in parts], axis=1),
        np.concatenate([part.sizes for part in parts], axis=1),
        np.concatenate([part.kinds for part in parts]),
        sum((part.tokens for part in parts), ()),
    )


def with_velocities(scenario, columns, velocities):
    """A scenario in which some of the tracks have other velocities [m/s]."""
    every = scenario.tracks.velocities.copy()
    every[:, columns] = velocities
    return replace(scenario, tracks=replace(scenario.tracks, velocities=every))


def rear_states(center_states: np.ndarray, vehicle: VehicleParameters = PACIFICA) -> np.ndarray:
    """States at the rear axle from states at the box centre, both (..., 11) with the same columns.

    The inverse of `center_poses`, `center_velocities` and `center_accelerations`.
    """
    out = np.array(center_states, np.float64)
    distance = vehicle.rear_axle_to_center
    out[..., :3] = rear_poses(center_states[..., :3], vehicle)
    out[..., VY] -= distance * center_states[..., YAW_RATE]
    out[..., AX] -= distance * center_states[..., YAW_RATE] ** 2
    out[..., AX] -= distance * center_states[..., YAW_ACCEL]
    return out
