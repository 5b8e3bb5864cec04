"""Velocities and headings of tracks that lack them, and velocities that contradict positions.

Rows are sorted by track, then time, as in `TrackSamples`.
"""

from collections import Counter
from itertools import pairwise

import numpy as np

from shiftsim.data.readers.dsc3d.motion import median
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel

_HALF_WINDOW = 0.25  # s on each side of a fit
_EPS = 1e-6  # s
_SLOW = 0.3  # m/s, below which a direction of motion tells nothing
_END = 1.0  # s at both ends of a track, where trackers settle
MAX_SHARE, _LEAST_ERROR = 0.1, 0.3  # of the speed; m/s that noise of positions may cause


def fitted_velocities(
    xy: FloatArray, time: FloatArray, track: IntArray, period: float
) -> FloatArray:
    """(A, 2) slopes of parabolas through the places (A, 2) within 0.25 s of each row [m/s].

    Where frames are farther apart, through the neighbours. A row without one has velocity 0.
    """
    ends = np.searchsorted(track, np.arange(int(track[-1]) + 2))
    half = max(_HALF_WINDOW, 1.5 * period) + _EPS
    return _fit(np.ascontiguousarray(xy), time, ends, half)


def contradiction(
    stored: FloatArray, derived: FloatArray, time: FloatArray, track: IntArray
) -> tuple[BoolArray, FloatArray]:
    """(N,) whether the stored velocities of a track contradict its positions; (N,) by what share.

    They do where the median over the track differs by more than 10 % of the median speed and 0.3
    m/s; the first and the last second are left out of tracks that are longer.
    """
    ends = np.searchsorted(track, np.arange(int(track[-1]) + 2)).tolist()
    wrong, share = np.zeros(len(ends) - 1, np.bool_), np.zeros(len(ends) - 1)
    for one, (low, high) in enumerate(pairwise(ends)):
        times = time[low:high]
        if len(times) and times[-1] - times[0] > 3.0 * _END:
            high = low + int(np.searchsorted(times, times[-1] - _END, side="right"))
            low += int(np.searchsorted(times, times[0] + _END))
        if low >= high:  # nothing to compare
            continue
        error = median(np.hypot(*(stored[low:high] - derived[low:high]).T))
        speed = median(np.hypot(*derived[low:high].T))
        wrong[one] = not error <= max(_LEAST_ERROR, MAX_SHARE * speed)
        share[one] = error / max(speed, _SLOW)
    return wrong, share


def believed(
    stored: FloatArray | None,
    derived: FloatArray,
    time: FloatArray,
    track: IntArray,
    warnings: Counter[str],
) -> FloatArray:
    """Stored velocities (A, 2) of the tracks where they fit the positions, else the derived."""
    num_tracks = int(track[-1]) + 1
    if stored is None:
        warnings["tracks without stored velocity (derived)"] += num_tracks
        return derived
    lacking = np.zeros(num_tracks, np.bool_)
    lacking[track[~np.isfinite(stored).all(axis=1)]] = True
    warnings["tracks without stored velocity (derived)"] += int(lacking.sum())
    wrong = contradiction(stored, derived, time, track)[0] & ~lacking
    warnings["tracks whose stored velocity does not fit (derived)"] += int(wrong.sum())
    if not (lacking | wrong).any():
        return stored
    return np.where((lacking | wrong)[track][:, None], derived, stored)


def unit_vectors(headings: FloatArray) -> FloatArray:
    """(A, 2) vectors of length 1 in the directions (A,) [rad]."""
    return np.column_stack([np.cos(headings), np.sin(headings)])


def headings_of_motion(
    velocities: FloatArray, track: IntArray, warnings: Counter[str]
) -> FloatArray:
    """(A,) directions of velocities (A, 2); a standing object keeps the last, or gets the next."""
    known = np.hypot(velocities[:, 0], velocities[:, 1]) > _SLOW
    index = np.arange(len(track))
    ends = np.searchsorted(track, np.arange(int(track[-1]) + 2))
    before = np.maximum.accumulate(np.where(known, index, -1))
    after = np.minimum.accumulate(np.where(known, index, len(track))[::-1])[::-1]
    source = np.where(before >= ends[track], before, np.minimum(after, len(track) - 1))
    moves: BoolArray = known[source] & (track[source] == track)
    still = int((~moves)[ends[:-1]].sum())
    warnings["tracks without heading that never move (heading 0)"] += still
    angle = np.arctan2(velocities[source, 1], velocities[source, 0])
    return np.where(moves, angle, 0.0)


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
            whole = (
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
                out[row, axis] = part / whole / half
    return out
