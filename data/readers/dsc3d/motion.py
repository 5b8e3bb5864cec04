"""Motion of annotated boxes: angles from rotation vectors, and velocities and headings to believe.

Rows are sorted by track, then time, as in `dsc3d.Annotations`.
"""

from collections import Counter
from itertools import pairwise

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, IntArray, kernel

_MAX_VELOCITY_ERROR = 0.5  # m/s, median of a track; beyond it the stored velocity is not believed
_MAX_SPEED = 200.0  # m/s along an axis
_STANDSTILL = 0.3  # m/s
_MAX_STANDING_TURN = 0.5  # rad/s
_EPS = 1e-9  # s


def rotation_angles(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(A, 3) yaw, pitch, roll [rad] and (A, 3) unit vectors along the height of objects.

    `rotation` is (A, 3) axis times angle, object to local frame [rad].
    """
    angle = np.linalg.norm(rotation, axis=1)
    x, y, z = rotation.T
    sine = np.sinc(angle / np.pi)  # sin(a) / a
    rest = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2  # (1 - cos(a)) / a^2
    cos = np.cos(angle)
    yaw = np.arctan2(z * sine + x * y * rest, cos + x * x * rest)
    pitch = -np.arcsin(np.clip(x * z * rest - y * sine, -1.0, 1.0))
    up = np.stack([y * sine + x * z * rest, y * z * rest - x * sine, cos + z * z * rest], axis=1)
    roll = np.arctan2(x * sine + y * z * rest, up[:, 2])
    return np.stack([yaw, pitch, roll], axis=1), up


def believed_velocities(
    stored: FloatArray | None,  # (A, 2) as recorded, None where the file has none [m/s]
    xy: FloatArray,  # (A, 2) [m]
    time: FloatArray,  # (A,) [s]
    track: IntArray,  # (A,) track of the row
    warnings: Counter[str],
) -> FloatArray:
    """Stored velocities where they fit the positions (nuPlan rule 459), else derived ones."""
    derived = _central_differences(xy, time, track)
    if stored is None:
        warnings["tracks without stored velocity (derived)"] += int(track[-1]) + 1
        return derived
    error = np.hypot(*(derived - stored).T)
    first = np.searchsorted(track, np.arange(track[-1] + 1))
    last = np.searchsorted(track, np.arange(track[-1] + 1), side="right") - 1
    refused = track_medians(error, track) >= _MAX_VELOCITY_ERROR
    refused &= last > first  # a single row has nothing to compare with
    refused[track[np.abs(stored).max(axis=1) > _MAX_SPEED]] = True
    warnings["tracks whose stored velocity does not fit (derived)"] += int(refused.sum())
    return np.where(refused[track][:, None], derived, stored)


def track_medians(values: FloatArray, track: IntArray) -> FloatArray:
    """(N,) median of the rows of each track; values and track: (A,), sorted by track."""
    ends = np.searchsorted(track, np.arange(int(track[-1]) + 2)).tolist()
    return np.array([median(values[low:high]) for low, high in pairwise(ends)])


def median(values: FloatArray) -> float:
    """Median of values (n,); NaN of none, and NaN counts as larger than all numbers."""
    if not len(values):
        return float("nan")
    low, high = (len(values) - 1) // 2, len(values) // 2
    ranked = np.partition(values, (low, high))
    return 0.5 * float(ranked[low] + ranked[high])


def _central_differences(xy: FloatArray, time: FloatArray, track: IntArray) -> FloatArray:
    """(A, 2) difference of the neighbouring rows of the same track, one-sided at its ends."""
    index = np.arange(len(track))
    before = np.where(np.r_[False, track[1:] == track[:-1]], index - 1, index)
    after = np.where(np.r_[track[1:] == track[:-1], False], index + 1, index)
    span = np.maximum(time[after] - time[before], _EPS)
    return (xy[after] - xy[before]) / span[:, None]


def held_headings(
    yaw: FloatArray,
    velocities: FloatArray,
    time: FloatArray,
    track: IntArray,
    warnings: Counter[str],
) -> FloatArray:
    """Headings; where a standing object's spins, the one before (nuPlan rule 460)."""
    source = np.arange(len(yaw))
    held = _hold(yaw, velocities, time, track, source)
    warnings["rows with a heading that spins at standstill (held)"] += held
    return yaw[source]


@kernel
def _hold(
    yaw: FloatArray, velocities: FloatArray, time: FloatArray, track: IntArray, source: IntArray
) -> int:
    """Replace the rows `source` (A,) of headings where they spin; how many these are."""
    held, before = 0, -1  # row before the first that spins
    was_standing = False
    for row in range(len(yaw)):
        is_standing = np.hypot(velocities[row, 0], velocities[row, 1]) < _STANDSTILL
        if row == 0 or track[row] != track[row - 1]:
            before, was_standing = -1, is_standing
            continue
        if not (is_standing and was_standing):
            before = -1
        if is_standing and before < 0:
            turn = abs(wrap_angle(yaw[row] - yaw[row - 1]))
            if turn > _MAX_STANDING_TURN * (time[row] - time[row - 1]):
                before = row - 1
        if before >= 0:
            source[row] = before
            held += 1
        was_standing = is_standing
    return held
