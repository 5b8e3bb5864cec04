"""What an agent should do now to go on as recorded, wherever its own drive has brought it."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import BoolArray, FloatArray, kernel
from shiftsim.sim.traffic.learned.network import LIMITS
from shiftsim.world.state import Tracks

HORIZON = 15  # iterations: when an agent should be where it was recorded
LEAST = 5  # iterations that must be recorded for a label
LOOK_AHEAD, NEAREST = 1.0, 3.0  # s and m, whichever is farther: the point that is steered to
FIRM = 1.5  # m/s^2 of braking that another in the way asks for before it counts
_STEP = 0.1  # s


class Labels(NamedTuple):
    """Wanted controls of agents. A agents."""

    known: BoolArray  # (A,) whether there is a label
    accelerations: FloatArray  # (A,) [m/s^2]
    curvatures: FloatArray  # (A,) [rad/m]
    distances: FloatArray  # (A,) to the point that is steered to [m]; 0 where the agent stays


def labels_of(
    recorded: Tracks, row: int, poses: FloatArray, speeds: FloatArray, closing: FloatArray
) -> Labels:
    """Labels at a row of the tracks as recorded, of agents that are elsewhere by now.

    Args:
        recorded: (B, A, …) the agents as recorded.
        row: The row that is now.
        poses: (A, 3) where they are [m], [rad]; NaN where absent.
        speeds: (A,) [m/s].
        closing: (A, 2) gap to who leads [m] and speed at which it shrinks [m/s]; inf and 0.
    """
    known = np.zeros(len(poses), np.bool_)
    out = np.zeros((len(poses), 3))
    _label(recorded.valid, recorded.poses, row, poses, speeds, known, out)
    need = np.where(
        closing[:, 1] > 0.0, closing[:, 1] ** 2 / (2.0 * np.maximum(closing[:, 0] - 1.0, 0.2)), 0.0
    )
    out[:, 0] = np.where(need > FIRM, np.minimum(out[:, 0], -need), out[:, 0])
    out[:, :2] = np.clip(out[:, :2], LIMITS[:, 0], LIMITS[:, 1])
    return Labels(known, *out.T)


@kernel
def _label(
    valid: BoolArray,
    recorded: FloatArray,
    row: int,
    poses: FloatArray,
    speeds: FloatArray,
    known: BoolArray,
    out: FloatArray,
) -> None:
    """Write the labels (A, 3); arguments as in `labels_of`."""
    for agent in range(len(poses)):
        last = row
        while last + 1 < len(valid) and valid[last + 1, agent]:
            last += 1
        x, y, heading = poses[agent]
        if np.isnan(x) or not valid[row, agent] or last - row < LEAST:
            continue
        # the recorded way: where the agent stands on it now, and where it should be
        first = row
        while first > 0 and row - first < 2 * HORIZON and valid[first - 1, agent]:
            first -= 1
        best, here, length = np.inf, 0.0, 0.0
        wanted_row = min(row + HORIZON, last)
        wanted = 0.0
        for knot in range(first, last):
            ax, ay = recorded[knot, agent, 0], recorded[knot, agent, 1]
            dx, dy = recorded[knot + 1, agent, 0] - ax, recorded[knot + 1, agent, 1] - ay
            square = dx * dx + dy * dy
            share = 0.0
            if square > 0.0:
                share = min(max(((x - ax) * dx + (y - ay) * dy) / square, 0.0), 1.0)
            apart = (x - ax - share * dx) ** 2 + (y - ay - share * dy) ** 2
            if apart < best:
                best, here = apart, length + share * np.sqrt(square)
            length += np.sqrt(square)
            if knot + 1 == wanted_row:
                wanted = length
        span = (wanted_row - row) * _STEP
        known[agent] = True
        speed = speeds[agent]
        out[agent, 0] = 2.0 * (wanted - here - speed * span) / (span * span)
        if out[agent, 0] < 0.0:  # do not brake beyond standing
            out[agent, 0] = max(out[agent, 0], -speed / 0.5)
        ahead = max(LOOK_AHEAD * speed, NEAREST)
        goal, passed = min(here + ahead, length), 0.0
        if goal - here < 1.0:
            continue
        for knot in range(first, last):
            ax, ay = recorded[knot, agent, 0], recorded[knot, agent, 1]
            dx, dy = recorded[knot + 1, agent, 0] - ax, recorded[knot + 1, agent, 1] - ay
            size = np.sqrt(dx * dx + dy * dy)
            if passed + size >= goal and size > 0.0:
                share = (goal - passed) / size
                px, py = ax + share * dx - x, ay + share * dy - y
                distance = max(np.hypot(px, py), 0.5)
                angle = wrap_angle(np.arctan2(py, px) - heading)
                out[agent, 1] = 2.0 * np.sin(angle) / distance
                out[agent, 2] = distance
                break
            passed += size
