"""Places beside the recorded path of the ego, so that one edit fits many scenarios."""

from dataclasses import dataclass

import numpy as np

from shiftsim.edits.spec import At
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

_SPACING = 0.2  # m, of the vertices of the path; nearer ones say nothing of its heading
_BEYOND = 300.0  # m, how far the path goes on along the lanes
_BEHIND = 100.0  # m, how far it begins behind the ego, straight where the recording does not
_OFF_MAP = 20.0  # m, from any lane


@dataclass(frozen=True, slots=True)
class EgoPath:
    """The recorded path of the ego's centre, gone on along its lanes. K vertices."""

    xy: FloatArray  # (K, 2) [m]
    progress: FloatArray  # (K,) arc length; 0 where the ego is at the first iteration [m]

    def pose(self, at: At) -> FloatArray:
        """(3,) pose of a place: x [m], y [m], heading [rad]."""
        index = int(np.searchsorted(self.progress, at.ahead_m, side="right"))
        index = min(max(index, 1), len(self.progress) - 1)
        step = self.xy[index] - self.xy[index - 1]
        heading = float(np.arctan2(step[1], step[0]))
        along = at.ahead_m - self.progress[index - 1]
        x = self.xy[index - 1, 0] + along * np.cos(heading) - at.left_m * np.sin(heading)
        y = self.xy[index - 1, 1] + along * np.sin(heading) + at.left_m * np.cos(heading)
        return np.array([x, y, wrap_angle(heading + at.turn)])


def ego_path(scenario: Scenario) -> EgoPath:
    """The path that places of a scenario are counted along."""
    now = int(scenario.iteration_rows[0])
    centers = center_poses(scenario.ego[:, :3])
    here, heading = centers[now, :2], centers[now, 2]
    ahead = _spaced(centers[now:, :2])
    if len(ahead) < 2:
        ahead = np.stack([here, here + _SPACING * np.array([np.cos(heading), np.sin(heading)])])
    ahead = np.concatenate([ahead, _lanes_ahead(scenario, ahead)])
    past = _spaced(centers[now::-1, :2])[:0:-1]
    whole = np.concatenate([past, ahead])
    turn = np.arctan2(*(whole[1] - whole[0])[::-1])
    start = whole[0] - _BEHIND * np.array([np.cos(turn), np.sin(turn)])
    xy = np.concatenate([start[None], whole])
    steps = np.hypot(*np.diff(xy, axis=0).T)
    progress = np.concatenate([[0.0], np.cumsum(steps)])
    return EgoPath(xy, progress - progress[1 + len(past)])


def _spaced(xy: FloatArray) -> FloatArray:
    """The first of the points (N, 2), and those that are far enough from the one before."""
    chosen = [0]
    for index in range(1, len(xy)):
        if np.hypot(*(xy[index] - xy[chosen[-1]])) >= _SPACING:
            chosen.append(index)
    return xy[chosen]


def _lanes_ahead(scenario: Scenario, path: FloatArray) -> FloatArray:
    """(K, 2) centre lines from the end of a path on, along the route where there is a choice."""
    road, end = scenario.map, path[-1]
    step = path[-1] - path[-2]
    heading = np.arctan2(step[1], step[0])
    straight = end + _BEYOND * np.array([np.cos(heading), np.sin(heading)])
    edge = nearest_edge(road, end[0], end[1], float(heading))
    if edge is None:
        return straight[None]
    route = {road.blocks.index[name] for name in scenario.route if name in road.blocks.index}
    line = road.baselines.at(edge)
    arc = road.baselines.arc[road.baselines.ptr[edge] : road.baselines.ptr[edge + 1]]
    parts = [line[arc > road.progress_on(edge, end[0], end[1]) + 1.0]]
    length = float(arc[-1])
    while length < _BEYOND:
        following = road.outgoing.at(edge).tolist()
        if not following:
            break
        edge = next((e for e in following if int(road.block_of[e]) in route), following[0])
        parts.append(road.baselines.at(edge)[1:])
        length += road.baselines.length(edge)
    points = np.concatenate(parts)
    if not len(points):
        return straight[None]
    return _spaced(np.concatenate([end[None], points]))[1:]


def nearest_edge(road: VectorMap, x: float, y: float, heading: float) -> int | None:
    """The lane, else the connector, that holds a point and whose heading is nearest; or None."""
    turns: list[tuple[float, int]] = []
    for edge in road.lanes_at(x, y) or road.connectors_at(x, y):
        arc = road.baselines.arc[road.baselines.ptr[edge] : road.baselines.ptr[edge + 1]]
        along = np.array([road.progress_on(edge, x, y)])
        there = float(poses_along(road.baselines.at(edge), arc, along)[0, 2])
        turns.append((abs(wrap_angle(there - heading)), edge))
    return min(turns, default=(0.0, None))[1]


def require_on_map(road: VectorMap, pose: FloatArray, what: str) -> None:
    """Refuse a place that is far from every lane, with a ConfigError."""
    _, distance = road.edges.nearest(float(pose[0]), float(pose[1]))
    if not distance <= _OFF_MAP:
        raise ConfigError(
            f"{what} at ({pose[0]:.1f}, {pose[1]:.1f}) is {distance:.0f} m from any lane",
            hint="check the frame of the place: metres of the map, or at = {ahead_m, left_m}",
        )


def poses_along(xy: FloatArray, arc: FloatArray, along: FloatArray) -> FloatArray:
    """(N, 3) poses at arc lengths (N,) of a line with vertices (K, 2) and arc lengths (K,) [m]."""
    steps = np.diff(xy, axis=0)
    segment = np.clip(np.searchsorted(arc, along, side="right") - 1, 0, len(steps) - 1)
    x, y = (np.interp(along, arc, xy[:, column]) for column in (0, 1))
    return np.column_stack([x, y, np.arctan2(steps[segment, 1], steps[segment, 0])])
