"""What the learned planners share of features and plans.

Plans are poses every 0.1 s, with the velocities that nuPlan gives them: the LQR tracker reads the
poses only, perfect tracking the rest too.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.sim.planner import History
from shiftsim.world import state

STEP = 0.1  # s, between poses of a plan
SAMPLES = 21  # of a history of 2 s
PLAN_POSES = 80
_WINDOW = np.arange(-2, 3)  # samples of the derivative filter, a parabola through five
_SLOPE = _WINDOW / 10.0
_BEND = (_WINDOW**2 - 2.0) / 7.0
_LENGTH, _WIDTH = state.PACIFICA.length, state.PACIFICA.width
_LAST_KIND = int(state.LAST_AGENT_KIND)

NO_ROUTE = "the scenario has no route on the map"


def short_history(count: int) -> str:
    """What is wrong with a history of `count` samples; empty where it is 2 s long."""
    return f"the history has {count} samples, not {SAMPLES}" if count < SAMPLES else ""


class AgentFeatures(NamedTuple):
    """The ego and the agents nearest to it in the ego frame, float32. A rows, the ego first."""

    tracks: IntArray  # (A - 1,) track of every row but the first
    position: np.ndarray  # (A, 21, 2) rear axle of the ego, centres of the others [m]
    heading: np.ndarray  # (A, 21) not wrapped [rad]
    velocity: np.ndarray  # (A, 21, 2) [m/s]
    shape: np.ndarray  # (A, 21, 2) width, length [m]
    valid: BoolArray  # (A, 21) whether the sample is there; all else is 0 where not
    category: IntArray  # (A,) 0 ego, 1 vehicle, 2 pedestrian, 3 bicycle


def agent_features(history: History, center: FloatArray, max_agents: int) -> AgentFeatures:
    """Histories of the ego and of the present agents nearest to `center`, its box's centre [m].

    A history shorter than 2 s leaves its oldest samples invalid, the ego's included.
    """
    tracks = history.tracks
    ego = history.ego[-min(SAMPLES, len(tracks.valid)) :]
    nearest = nearest_agents(tracks, center, max_agents)
    cos, sin, vx, vy = np.cos(ego[:, 2]), np.sin(ego[:, 2]), ego[:, 3], ego[:, 4]
    own = np.column_stack([cos * vx - sin * vy, sin * vx + cos * vy])
    rows = tracks.poses, tracks.velocities, tracks.sizes, tracks.valid, tracks.kinds
    return AgentFeatures(nearest, *_histories(ego, own, rows, nearest, frame_of(ego[-1])))


def frame_of(pose: FloatArray) -> tuple[float, ...]:
    """x, y, heading, its cosine and its sine of a pose: kernels would round these two otherwise."""
    return (*pose[:3].tolist(), float(np.cos(pose[2])), float(np.sin(pose[2])))


@kernel
def _histories(ego: FloatArray, own: FloatArray, rows: Any, nearest: IntArray, frame: Any) -> Any:
    """Fields of `AgentFeatures`: of the ego and its velocities `own`, and of rows of tracks."""
    (x0, y0, heading, cos, sin), (poses, velocities, sizes, valid, kinds) = frame, rows
    shape, first = (len(nearest) + 1, SAMPLES), SAMPLES - len(ego)
    angle, seen = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    position, velocity, size = np.zeros((3, *shape, 2), np.float32)
    category = np.append(np.zeros(1, np.int64), kinds[nearest] + 1)
    for row in range(len(seen)):
        for step in range(len(ego)):
            at = first + step
            (x, y, turn), (vx, vy) = ego[step, :3], own[step]
            length, width = _LENGTH, _WIDTH
            if row > 0:
                here = len(valid) - len(ego) + step, nearest[row - 1]
                if not valid[here]:
                    continue
                x, y, turn = poses[here]
                (vx, vy), (length, width) = velocities[here], sizes[here]
            x, y = x - x0, y - y0
            position[row, at, 0], position[row, at, 1] = cos * x + sin * y, cos * y - sin * x
            velocity[row, at, 0], velocity[row, at, 1] = cos * vx + sin * vy, cos * vy - sin * vx
            size[row, at, 0], size[row, at, 1] = width, length
            angle[row, at], seen[row, at] = turn - heading, True
    return position, angle, velocity, size, seen, category


def nearest_agents(tracks: state.Tracks, center: FloatArray, count: int) -> IntArray:
    """Present agents, nearest first."""
    # nuPlan rule 300: sorted from a list by kind, by a method that does not keep the order of ties
    present = np.flatnonzero(tracks.valid[-1] & (tracks.kinds <= _LAST_KIND))
    by_kind = present[np.argsort(tracks.kinds[present], kind="stable")]
    dx, dy = (tracks.poses[-1, by_kind, :2] - center[:2]).T
    return by_kind[np.argsort(np.sqrt(dx * dx + dy * dy))[:count]]


def poses_of(plan: np.ndarray) -> FloatArray:
    """(H, 3) poses of (H, 4) x, y, cosine and sine of the heading."""
    exact = plan.astype(np.float64)
    return np.column_stack([exact[:, :2], np.arctan2(exact[:, 3], exact[:, 2])])


def map_poses(poses: FloatArray, ego: FloatArray) -> FloatArray:
    """Poses (..., 3) of the ego frame in that of the map."""
    # nuPlan rule 303: headings are not wrapped
    cos, sin = np.cos(ego[state.HEADING]), np.sin(ego[state.HEADING])
    x, y, heading = poses[..., 0], poses[..., 1], poses[..., 2]
    return np.stack(
        [ego[0] + cos * x - sin * y, ego[1] + sin * x + cos * y, ego[state.HEADING] + heading],
        axis=-1,
    )


def straight_on(history: History) -> state.Trajectory:
    """A fallback where a planner has no plan: heading and speed are kept for 8 s."""
    present = history.ego[-1]
    times = STEP * np.arange(1, PLAN_POSES + 1)
    heading = present[state.HEADING]
    speed = present[state.VX] * np.array([np.cos(heading), np.sin(heading)])
    poses = np.tile(present[:3], (PLAN_POSES, 1))
    poses[:, :2] += times[:, None] * speed
    return plan_of_poses(poses, history)


def plan_of_poses(poses: FloatArray, history: History) -> state.Trajectory:
    """The present state followed by a plan.

    Velocities and accelerations are derivatives of history and plan together, taken on the uneven
    past and on the plan resampled at the last interval of the past (nuPlan rule 390).

    Args:
        poses: (H, 3) rear axle x [m], y [m], heading [rad] in the map frame, 0.1 s apart, from
            0.1 s after the present on; at least 4.
        history: The last samples, the present one included.

    Returns:
        (H + 1) states with log time stamps.
    """
    past_s = np.asarray(history.time_us * 1e-6, np.float64)
    times = np.arange(0.0, len(poses) * STEP - STEP / 2.0, STEP) + STEP + past_s[-1]
    states = np.zeros((len(poses) + 1, state.NUM_STATE))
    states[0] = history.ego[-1]
    states[1:, :3] = poses
    states[1:, state.VX : state.AY + 1] = _motion(history.ego[:, :3], past_s, states[:, :3], times)
    time_us = np.empty(len(states), np.int64)
    time_us[0] = history.time_us[-1]
    time_us[1:] = times * 1e6  # nuPlan rule 391: truncated, a microsecond may be lost
    return state.Trajectory(time_us, states)


def _motion(
    past: FloatArray, past_s: FloatArray, planned: FloatArray, times: FloatArray
) -> FloatArray:
    """(H, 4) velocity and acceleration of a plan, each forward and to the right (not left).

    Of poses (N, 3) at times (N,) in the past, and (H + 1, 3) planned, the present one first, at
    times (H,) behind it [s].
    """
    now = past_s[-1]
    step = now - past_s[-2] if len(past) > 1 else STEP
    count = int(np.ceil((times[-1] + 1e-6 - now) / step)) - 1
    if count < len(_WINDOW):  # after a gap in the recording
        step, count = STEP, len(times)
    grid = now + step * np.arange(1, count + 1)
    even = _interpolate(grid, np.concatenate([[now], times]), planned)
    samples = np.concatenate([past[:, :2], even[:, :2]])
    spacing = (grid[-1] - past_s[0]) / (len(samples) - 1)
    index = np.arange(len(past), len(samples))
    center = np.clip(index, 2, len(samples) - 3)  # the first and last window serve their ends
    window = samples[center[:, None] + _WINDOW] - samples[center, None]
    bend = np.einsum("k,nkc->nc", _BEND, window) / spacing**2
    ahead = (index - center)[:, None] * spacing
    slope = np.einsum("k,nkc->nc", _SLOPE, window) / spacing + bend * ahead
    cos, sin = np.cos(even[:, state.HEADING]), np.sin(even[:, state.HEADING])
    parts = []
    for x, y in (slope.T, bend.T):
        parts += [x * cos + y * sin, x * sin - y * cos]  # nuPlan rule 392
    return _interpolate(times, grid, np.stack(parts, axis=1))


def _interpolate(at: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Rows of `values` between the knots; the outer steps go on beyond their ends."""
    after = np.clip(np.searchsorted(knots, at), 1, len(knots) - 1)
    before = after - 1
    along = (at - knots[before]) / (knots[after] - knots[before])
    return values[before] + along[:, None] * (values[after] - values[before])


def stack_scenes(scenes: Sequence[Sequence[np.ndarray]], device: str) -> list[Any]:
    """Tensors (B, …) of the arrays of B scenes; where one has fewer rows, zeros follow."""
    import torch

    out: list[Any] = []
    for arrays in zip(*scenes, strict=True):
        shape = np.max([array.shape for array in arrays], axis=0)
        batch = np.zeros((len(arrays), *shape), arrays[0].dtype)
        for row, array in zip(batch, arrays, strict=True):
            row[tuple(slice(size) for size in array.shape)] = array
        out.append(torch.from_numpy(batch).to(device))
    return out
