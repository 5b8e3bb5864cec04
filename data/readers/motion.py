"""How recorded objects move: angles, velocities that can be believed or are derived, headings.

Rows are sorted by track, then time, as in `TrackSamples`.
"""

from collections import Counter
from itertools import pairwise

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel

_HALF_WINDOW = 0.25  # s on each side of a fit
_EPS = 1e-6  # s
_SLOW = 0.3  # m/s, below which there is no direction of motion
_END = 1.0  # s at both ends of a track, where trackers settle
MAX_SHARE, _LEAST_ERROR = 0.1, 0.3  # of the speed; m/s that noise of positions may cause
_MAX_STANDING_TURN = 0.5  # rad/s


def track_ends(track: IntArray) -> IntArray:
    """(N + 1,) first row of every track (A,), and the number of rows."""
    return np.searchsorted(track, np.arange(int(track[-1]) + 2))


def track_medians(values: FloatArray, track: IntArray) -> FloatArray:
    """(N,) or (N, D) median of the rows of each track; values (A,) or (A, D), track (A,) sorted."""
    if values.ndim == 2:
        return np.column_stack([track_medians(column, track) for column in values.T])
    return np.array(
        [median(values[low:high]) for low, high in pairwise(track_ends(track).tolist())]
    )


def median(values: FloatArray) -> float:
    """Median of values (n,); NaN of none, and NaN counts as larger than all numbers."""
    if not len(values):
        return float("nan")
    low, high = (len(values) - 1) // 2, len(values) // 2
    ranked = np.partition(values, (low, high))
    return 0.5 * float(ranked[low] + ranked[high])


def unit_vectors(headings: FloatArray) -> FloatArray:
    """(A, 2) vectors of length 1 in the directions (A,) [rad]."""
    return np.column_stack([np.cos(headings), np.sin(headings)])


def fitted_velocities(
    xy: FloatArray, time: FloatArray, track: IntArray, period: float
) -> FloatArray:
    """(A, 2) slopes of parabolas through the places (A, 2) within 0.25 s of each row [m/s].

    Where frames are farther apart, through the neighbours. A row without one has velocity 0.
    """
    half = max(_HALF_WINDOW, 1.5 * period) + _EPS
    return _fit(np.ascontiguousarray(xy), time, track_ends(track), half)


def contradiction(
    stored: FloatArray, derived: FloatArray, time: FloatArray, track: IntArray
) -> tuple[BoolArray, FloatArray]:
    """(N,) whether the stored velocities of a track contradict its positions; (N,) by what share.

    They do where the median over the track differs by more than 10 % of the median speed and 0.3
    m/s; the first and the last second are left out of tracks that are longer.
    """
    ends = track_ends(track).tolist()
    wrong, share = np.zeros(len(ends) - 1, np.bool_), np.zeros(len(ends) - 1)
    for number, (low, high) in enumerate(pairwise(ends)):
        times = time[low:high]
        if len(times) and times[-1] - times[0] > 3.0 * _END:
            high = low + int(np.searchsorted(times, times[-1] - _END, side="right"))
            low += int(np.searchsorted(times, times[0] + _END))
        if low >= high:  # nothing to compare
            continue
        error = median(np.hypot(*(stored[low:high] - derived[low:high]).T))
        speed = median(np.hypot(*derived[low:high].T))
        wrong[number] = not error <= max(_LEAST_ERROR, MAX_SHARE * speed)
        share[number] = error / max(speed, _SLOW)
    return wrong, share


def believed_velocities(
    stored: FloatArray | None,
    derived: FloatArray,
    contradicts: BoolArray | None,
    track: IntArray,
    warnings: Counter[str],
) -> FloatArray:
    """Stored velocities (A, 2) of tracks that have them and do not contradict, else the derived.

    `contradicts` (N,) marks the tracks whose stored velocities contradict their positions.
    """
    num_tracks = int(track[-1]) + 1
    if stored is None or contradicts is None:
        warnings["tracks without stored velocity (derived)"] += num_tracks
        return derived
    lacking = np.zeros(num_tracks, np.bool_)
    lacking[track[~np.isfinite(stored).all(axis=1)]] = True
    warnings["tracks without stored velocity (derived)"] += int(lacking.sum())
    wrong = contradicts & ~lacking
    warnings["tracks whose stored velocity does not fit (derived)"] += int(wrong.sum())
    if not (lacking | wrong).any():
        return stored
    return np.where((lacking | wrong)[track][:, None], derived, stored)


def headings_of_motion(
    velocities: FloatArray, track: IntArray, warnings: Counter[str]
) -> FloatArray:
    """(A,) directions of velocities (A, 2); a standing object keeps the last, or gets the next."""
    known = np.hypot(velocities[:, 0], velocities[:, 1]) > _SLOW
    index = np.arange(len(track))
    ends = track_ends(track)
    before = np.maximum.accumulate(np.where(known, index, -1))
    after = np.minimum.accumulate(np.where(known, index, len(track))[::-1])[::-1]
    source = np.where(before >= ends[track], before, np.minimum(after, len(track) - 1))
    moves: BoolArray = known[source] & (track[source] == track)
    still = int((~moves)[ends[:-1]].sum())
    warnings["tracks without heading that never move (heading 0)"] += still
    angle = np.arctan2(velocities[source, 1], velocities[source, 0])
    return np.where(moves, angle, 0.0)


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
        is_standing = np.hypot(velocities[row, 0], velocities[row, 1]) < _SLOW
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


@kernel
def _fit(xy: FloatArray, time: FloatArray, ends: IntArray, half: float) -> FloatArray:
    out = np.zeros((len(time), 2))
    s, y = np.zeros(5), np.zeros((3, 2))
    for track in range(len(ends) - 1):
        low = high = ends[track]
        for row in range(ends[track], ends[track + 1]):
            while time[low] < time[row] - half:
                low += 1
            while high < ends[track + 1] and time[high] <= time[row] + half:
                high += 1
            if high - low < 2:
                continue
            s[:] = 0.0
            y[:] = 0.0
            for other in range(low, high):
                t = (time[other] - time[row]) / half
                dx, dy = xy[other, 0] - xy[row, 0], xy[other, 1] - xy[row, 1]
                power = 1.0
                for degree in range(5):
                    s[degree] += power
                    if degree < 3:
                        y[degree, 0] += power * dx
                        y[degree, 1] += power * dy
                    power *= t
            if high - low == 2:  # a line
                span = s[2] * s[0] - s[1] * s[1]
                for axis in range(2):
                    out[row, axis] = (y[1, axis] * s[0] - y[0, axis] * s[1]) / span / half
                continue
            # second of three normal equations, by Cramer's rule
            determinant = (
                s[0] * (s[2] * s[4] - s[3] * s[3])
                - s[1] * (s[1] * s[4] - s[3] * s[2])
                + s[2] * (s[1] * s[3] - s[2] * s[2])
            )
            for axis in range(2):
                a, b, c = y[0, axis], y[1, axis], y[2, axis]
                part = (
                    s[0] * (b * s[4] - s[3] * c)
                    - a * (s[1] * s[4] - s[3] * s[2])
                    + s[2] * (s[1] * c - b * s[2])
                )
                out[row, axis] = part / determinant / half
    return out
