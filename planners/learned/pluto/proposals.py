"""What PLUTO's network proposes, in the map frame."""

from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray
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
    return np.concatenate(
        [trajectory[..., :2], np.arctan2(trajectory[..., 3:4], trajectory[..., 2:3])], -1
    )


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
    """Poses (P, 81, 3) and scores (P,) of what competes, best logit first, the reference-free last.

    There must be at least one reference line; `rear` (3,) is the rear axle.
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
    """Poses (A, 81, 3) in the map frame and speeds (A, 81) of agents from now on, every 0.1 s.

    Now they are at `local` (A, 3) in the ego frame, which is `present` in that of the map, with a
    velocity (A, 2) [m/s]; `rear` (3,) is the rear axle.
    """
    motion = output.prediction
    poses, speeds = np.empty((len(present), STEPS + 1, 3)), np.empty((len(present), STEPS + 1))
    poses[:, 0] = present
    poses[:, 1:] = to_map(headings_of(motion) + local[:, None], rear)
    speeds[:, 0] = np.hypot(velocity[:, 0], velocity[:, 1])
    speeds[:, 1:] = np.hypot(motion[..., 4], motion[..., 5])
    return poses, speeds
