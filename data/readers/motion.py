"""How recorded objects move: angles, velocities that can be believed or are derived, headings.

Rows are sorted by track, then time, as in `TrackSamples`.
"""

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import ndimage

from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import BoolArray, FloatArray, IntArray

_HALF_WINDOW = 0.25  # s on each side of a fit
_EPS = 1e-6  # s
_SLOW = 0.3  # m/s, below which there is no direction of motion
_END = 1.0  # s at both ends of a track, where trackers settle
MAX_SHARE, _LEAST_ERROR = 0.1, 0.3  # of the speed; m/s that noise of positions may cause
_MAX_STANDING_TURN = 0.5  # rad/s
_TURN = 2.0 * np.pi + 0.01  # rad
FAST = 2.0  # m/s, above which a direction of motion is sure
MAX_HEADING = 0.2  # rad, median angle between heading and motion


def track_ends(track: IntArray) -> IntArray:
    """(N + 1,) first row of every track (A,), and the number of rows."""
    return np.searchsorted(track, np.arange(int(track[-1]) + 2))


def track_medians(values: FloatArray, track: IntArray, num_tracks: int = 0) -> FloatArray:
    """(N,) or (N, D) median of the rows of each track: values (A,) or (A, D), track (A,).

    NaN for a track without rows; a NaN among the values counts as larger than all numbers. There
    are `num_tracks` tracks, or as many as have rows.
    """
    if values.ndim == 2:
        return np.column_stack([track_medians(part, track, num_tracks) for part in values.T])
    present = np.unique(track)
    medians = np.full(num_tracks or int(present[-1]) + 1, np.nan)
    if len(present):
        medians[present] = ndimage.median(values, track, present)
    return medians


def unit_vectors(headings: FloatArray) -> FloatArray:
    """(A, 2) vectors of length 1 in the directions (A,) [rad]."""
    return np.column_stack([np.cos(headings), np.sin(headings)])


def beyond_turn(
    headings: FloatArray, velocities: FloatArray, time: FloatArray, track: IntArray, ids: Any
) -> str:
    """What is wrong with headings (A,) beyond a whole turn [rad], as degrees are.

    Nothing where those of them that move, (A, 2), point ahead: radians that were unwrapped.
    """
    rows = np.flatnonzero(np.abs(headings) > _TURN)
    speed, ahead = np.hypot(*velocities[rows].T), unit_vectors(headings[rows])
    cos = ((velocities[rows] * ahead).sum(axis=1) / np.maximum(speed, FAST))[speed > FAST]
    if not len(rows) or (len(cos) and np.median(cos) > np.cos(MAX_HEADING)):
        return ""
    first = f"{headings[rows[0]]:g} of object {ids[track[rows[0]]].item()!r} at {time[rows[0]]:g} s"
    return f"{len(rows)} headings are beyond 2 pi rad, such as {first}"


def fitted_velocities(
    xy: FloatArray, time: FloatArray, track: IntArray, period: float
) -> FloatArray:
    """(A, 2) slopes of parabolas through the places (A, 2) within 0.25 s of each row [m/s].

    Where frames are farther apart, through the neighbours. A row without one has velocity 0.
    """
    half = max(_HALF_WINDOW, 1.5 * period) + _EPS
    low, high = np.empty_like(track), np.empty_like(track)  # the rows of each fit
    for first, stop in pairwise(track_ends(track).tolist()):
        times = time[first:stop]
        low[first:stop] = first + np.searchsorted(times, times - half)
        high[first:stop] = first + np.searchsorted(times, times + half, side="right")
    count = high - low
    s, y = np.zeros((5, len(time))), np.zeros((3, 2, len(time)))  # sums of t^i, and of t^i (dx, dy)
    rows = np.flatnonzero(count > 1)
    other = low[rows]
    while len(rows):
        t, way = (time[other] - time[rows]) / half, (xy[other] - xy[rows]).T
        power = np.ones_like(t)
        for degree in range(5):
            s[degree, rows] += power
            if degree < 3:
                y[degree][:, rows] += power * way
            power = power * t
        is_more = other + 1 < high[rows]
        rows, other = rows[is_more], other[is_more] + 1
    a, b, c = y
    with np.errstate(divide="ignore", invalid="ignore"):  # rows without neighbours, or at one time
        line = (b * s[0] - a * s[1]) / (s[2] * s[0] - s[1] * s[1]) / half
        # second of three normal equations, by Cramer's rule
        determinant = s[0] * (s[2] * s[4] - s[3] * s[3])
        determinant -= s[1] * (s[1] * s[4] - s[3] * s[2])
        determinant += s[2] * (s[1] * s[3] - s[2] * s[2])
        part = s[0] * (b * s[4] - s[3] * c) - a * (s[1] * s[4] - s[3] * s[2])
        part += s[2] * (s[1] * c - b * s[2])
        parabola = part / determinant / half
    return np.ascontiguousarray(np.where(count < 2, 0.0, np.where(count == 2, line, parabola)).T)


def contradiction(
    stored: FloatArray, derived: FloatArray, time: FloatArray, track: IntArray
) -> tuple[BoolArray, FloatArray]:
    """(N,) whether the stored velocities of a track contradict its positions; (N,) by what share.

    They do where the median over the track differs by more than 10 % of the median speed and 0.3
    m/s; the first and the last second are left out of tracks that are longer.
    """
    ends, num_tracks = track_ends(track), int(track[-1]) + 1
    begin, end = time[ends[track]], time[ends[track + 1] - 1]
    inner = (time >= begin + _END) & (time <= end - _END) | (end - begin <= 3.0 * _END)
    which = track[inner]
    error = track_medians(np.hypot(*(stored - derived)[inner].T), which, num_tracks)
    speed = track_medians(np.hypot(*derived[inner].T), which, num_tracks)
    is_known = np.bincount(which, minlength=num_tracks) > 0
    wrong = is_known & ~(error <= np.maximum(_LEAST_ERROR, MAX_SHARE * speed))
    return wrong, np.where(is_known, error / np.maximum(speed, _SLOW), 0.0)


def believed_velocities(
    stored: FloatArray,
    derived: FloatArray,
    contradicts: BoolArray,
    track: IntArray,
    warnings: Counter[str],
) -> FloatArray:
    """Stored velocities (A, 2) of tracks that have them and do not contradict, else the derived.

    `contradicts` (N,) marks the tracks whose stored velocities contradict their positions.
    """
    lacking = np.zeros(int(track[-1]) + 1, np.bool_)
    lacking[track[~np.isfinite(stored).all(axis=1)]] = True
    warnings["tracks without stored velocity (derived)"] += int(lacking.sum())
    wrong = contradicts & ~lacking
    warnings["tracks whose stored velocity does not fit (derived)"] += int(wrong.sum())
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
    stands = np.hypot(*velocities.T) < _SLOW
    same = np.r_[False, track[1:] == track[:-1]]
    rest = np.cumsum(~(same & stands & np.r_[False, stands[:-1]]))  # number of its standstill
    turn = np.abs(wrap_angles(np.diff(yaw, prepend=yaw[0])))
    spins = same & stands & (turn > _MAX_STANDING_TURN * np.diff(time, prepend=time[0]))
    number, first = np.unique(rest[spins], return_index=True)
    since = np.full(rest[-1] + 1, len(yaw))  # the row from which on its heading is held
    since[number] = np.flatnonzero(spins)[first]
    is_held = np.arange(len(yaw)) >= since[rest]
    warnings["rows with a heading that spins at standstill (held)"] += int(is_held.sum())
    return yaw[np.where(is_held, since[rest] - 1, np.arange(len(yaw)))]
