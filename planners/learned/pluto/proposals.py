"""What PLUTO's network proposes, in the map frame."""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.proposals.tracker import STEPS

MAX_PROPOSALS = 20  # that compete by their logits
REFERENCE_FREE_SCORE = 0.25


class Output(NamedTuple):
    """What the network says about one scenario, in the ego frame. All float32."""

    trajectory: np.ndarray  # (R, 12, 80, 6) x, y [m], cos, sin of the heading, velocity [m/s]
    probability: np.ndarray  # (R, 12) logits
    # (A, 80, 6) of the agents, relative to their present poses; columns likewise
    prediction: np.ndarray
    ref_free_trajectory: np.ndarray  # (80, 4) x, y [m], cos, sin of the heading


def headings_of(trajectory: np.ndarray) -> np.ndarray:
    """Poses (..., 3) float32 from columns x, y, cos, sin."""
    poses: np.ndarray = np.concatenate(
        [trajectory[..., :2], np.arctan2(trajectory[..., 3:4], trajectory[..., 2:3])], -1
    )
    return poses


def to_map(poses: np.ndarray, rear: FloatArray) -> FloatArray:
    """Poses (..., 3) of the ego frame in the map frame; headings are not wrapped."""
    cos, sin = np.cos(rear[2]), np.sin(rear[2])
    local = poses.astype(np.float64)
    out = np.empty_like(local)
    out[..., 0] = local[..., 0] * cos - local[..., 1] * sin + rear[0]
    out[..., 1] = local[..., 0] * sin + local[..., 1] * cos + rear[1]
    out[..., 2] = local[..., 2] + rear[2]
    return out


def best_proposals(output: Output, rear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The trajectories that are scored, best logit first and the reference-free one last.

    Args:
        output: Of the network; at least one reference line.
        rear: (3,) rear axle x [m], y [m], heading [rad].

    Returns:
        Poses (P, 81, 3) and scores (P,).
    """
    logits = output.probability.reshape(-1)
    # nuPlan rule 244: NumPy's default sort, and a softmax over what it keeps
    best = np.argsort(-logits)[:MAX_PROPOSALS]
    powers = np.exp(logits[best] - logits[best].max())
    scores = np.append((powers / powers.sum()).astype(np.float64), REFERENCE_FREE_SCORE)
    kept = output.trajectory.reshape(-1, STEPS, output.trajectory.shape[-1])[best]
    free = output.ref_free_trajectory[None]
    local = np.concatenate([headings_of(kept), headings_of(free)])
    poses = to_map(local, rear)
    # nuPlan rule 245: the pose of 0.1 s is also that of 0 s
    return np.concatenate([poses[:, :1], poses], axis=1), scores


def predicted_agents(
    output: Output, local: np.ndarray, present: FloatArray, velocity: FloatArray, rear: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where the agents are now and will be.

    Args:
        output: Of the network.
        local: (A, 3) float32 poses now, in the ego frame.
        present: (A, 3) the same poses in the map frame.
        velocity: (A, 2) velocities now [m/s].
        rear: (3,) rear axle x [m], y [m], heading [rad].

    Returns:
        Poses (A, 81, 3) in the map frame and speeds (A, 81) from now on, every 0.1 s.
    """
    motion = output.prediction
    poses, speeds = np.empty((len(present), STEPS + 1, 3)), np.empty((len(present), STEPS + 1))
    poses[:, 0] = present
    poses[:, 1:] = to_map(headings_of(motion) + local[:, None], rear)
    speeds[:, 0] = np.hypot(velocity[:, 0], velocity[:, 1])
    speeds[:, 1:] = np.hypot(motion[..., 4], motion[..., 5])
    return poses, speeds
