"""Reference lines: from the distance along a road to positions and headings.

A record is a curve (u, v) in the frame of its own start pose. Clothoids are integrated by
Gauss-Legendre quadrature over panels that turn by at most 0.25 rad, which is exact to rounding and
does not cancel when both curvatures are nearly equal. The cubic curves are taken by arc length,
whatever their parameter is (nuPlan rule 500).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from shiftsim.data.maps.opendrive.records import ARC, PARAM_POLY3, POLY3, SPIRAL, Geometry
from shiftsim.kernels import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2  # on [0, 1]
_TURN_PER_PANEL = 0.25  # rad
_MAX_PANELS = 4096  # a curve that turns more than 1000 rad is no road; it is evaluated coarsely
_CUBIC_PANELS = 32
_STRAIGHT = 1e-12  # 1/m, below it an arc is a line
_LENGTH_SLACK, _MIN_LENGTH_SLACK = 0.01, 0.05  # 1 %, at least 5 cm


@dataclass(frozen=True)
class Poses:
    """Points of a reference line: x, y [m], heading [rad] (not wrapped)."""

    x: FloatArray
    y: FloatArray
    heading: FloatArray

    def offset(self, t: FloatArray) -> FloatArray:
        """(K, 2) points `t` metres to the left of the line."""
        return np.stack(
            [self.x - t * np.sin(self.heading), self.y + t * np.cos(self.heading)], axis=-1
        )


@dataclass(frozen=True)
class ReferenceLine:
    """The reference line of one road."""

    geometries: tuple[Geometry, ...]  # its records, by s

    def evaluate(self, s: FloatArray) -> Poses:
        """Poses at distances `s` (K,) [m]; beyond the ends the line stays at its ends.

        nuPlan rule 501: the heading at a joint is that of the later record.
        """
        s = np.asarray(s, np.float64)
        starts = np.array([g.s for g in self.geometries])
        index = np.maximum(np.searchsorted(starts, s, side="right") - 1, 0)
        out = np.empty((3, len(s)))
        for number in np.unique(index):
            record = self.geometries[number]
            here = index == number
            d = np.clip(s[here] - record.s, 0.0, record.length)
            u, v, turn = evaluate_local(record, d)
            cos, sin = np.cos(record.heading), np.sin(record.heading)
            out[0, here] = record.x + cos * u - sin * v
            out[1, here] = record.y + sin * u + cos * v
            out[2, here] = record.heading + turn
        return Poses(*out)

    def joints(self) -> tuple[FloatArray, FloatArray]:
        """Gap [m] and turn [rad] from the end of each record to the start of the next, (n - 1,)."""
        gaps, turns = [], []
        for before, after in pairwise(self.geometries):
            end = ReferenceLine((before,)).evaluate(np.array([before.s + before.length]))
            gaps.append(np.hypot(end.x[0] - after.x, end.y[0] - after.y))
            turns.append(abs((end.heading[0] - after.heading + np.pi) % (2 * np.pi) - np.pi))
        return np.array(gaps), np.array(turns)


def evaluate_local(record: Geometry, d: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Local u, v [m] and turn [rad] of a record at distances `d` (K,) from its start [m]."""
    if record.kind == ARC:
        return _arc(record.coefficients[0], d)
    if record.kind == SPIRAL:
        return _clothoid(record, d)
    if len(record.coefficients) == 0:
        return d, np.zeros_like(d), np.zeros_like(d)
    return _by_arc_length(record, d)


def curve_length(record: Geometry) -> float:
    """True length of a cubic curve [m]."""
    return float(_arc_table(record)[1][-1])


def total_turn(record: Geometry) -> float:
    """How far an arc or a spiral turns, to both sides together [rad]; 0 for other curves."""
    if record.kind not in (ARC, SPIRAL):
        return 0.0
    a, b = record.coefficients[0], record.coefficients[-1]
    mean = abs(a + b) / 2 if a * b >= 0 else (a * a + b * b) / (2 * abs(a - b))
    return mean * record.length


def length_error(record: Geometry) -> float:
    """By how much the true length of a paramPoly3 differs from its stated one, as a share.

    0 where the difference is within the rounding of files, 1 % and 5 cm; inf where the curve
    has no finite length.
    """
    if record.kind != PARAM_POLY3:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        true = curve_length(record)
    if not np.isfinite(true):
        return float("inf")
    error = abs(true - record.length)
    allowed = max(_LENGTH_SLACK * record.length, _MIN_LENGTH_SLACK)
    return error / record.length if error > allowed else 0.0


def _arc(curvature: float, d: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    if abs(curvature) < _STRAIGHT:
        return d, 0.5 * curvature * d**2, curvature * d
    turn = curvature * d
    half = np.sin(0.5 * turn)
    return np.sin(turn) / curvature, 2.0 * half * half / curvature, turn


def _clothoid(record: Geometry, d: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    start, end = record.coefficients
    length = record.length
    rate = (end - start) / length

    def turn(tau: FloatArray) -> FloatArray:
        return start * tau + 0.5 * rate * tau * tau

    def integral(low: FloatArray, step: FloatArray) -> FloatArray:
        angle = turn(low[:, None] + step[:, None] * _NODES)
        return np.stack([np.cos(angle) @ _WEIGHTS, np.sin(angle) @ _WEIGHTS]) * step

    steepest = max(abs(start), abs(end)) * length / _TURN_PER_PANEL
    panels = int(np.clip(np.ceil(steepest), 1, _MAX_PANELS))
    knots = np.linspace(0.0, length, panels + 1)
    sums = np.zeros((2, panels + 1))
    np.cumsum(integral(knots[:-1], np.diff(knots)), axis=1, out=sums[:, 1:])
    panel = np.clip((d * (panels / length)).astype(np.int64), 0, panels - 1)
    u, v = sums[:, panel] + integral(knots[panel], d - knots[panel])
    return u, v, turn(d)


def _cubic_parts(record: Geometry) -> tuple[FloatArray, FloatArray, float]:
    """Coefficients of u(p) and v(p), lowest power first, and the last parameter."""
    if record.kind == POLY3:  # the graph v(u); u never exceeds the length
        return np.array([0.0, 1.0, 0.0, 0.0]), np.array(record.coefficients), record.length
    return np.array(record.coefficients[:4]), np.array(record.coefficients[4:]), record.p_end


def _arc_table(record: Geometry) -> tuple[FloatArray, FloatArray]:
    """Parameter knots and the arc length up to each [m]."""
    u, v, p_end = _cubic_parts(record)
    knots = np.linspace(0.0, p_end, _CUBIC_PANELS + 1)
    step = p_end / _CUBIC_PANELS
    nodes = knots[:-1, None] + step * _NODES
    speed = np.hypot(polyval(nodes, polyder(u)), polyval(nodes, polyder(v)))
    arc = np.zeros(_CUBIC_PANELS + 1)
    np.cumsum(speed @ _WEIGHTS * step, out=arc[1:])
    return knots, arc


def _by_arc_length(record: Geometry, d: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    u, v, _ = _cubic_parts(record)
    du, dv = polyder(u), polyder(v)
    knots, arc = _arc_table(record)
    if length_error(record):  # run through evenly from end to end
        d = d * (arc[-1] / record.length)
    target = np.minimum(d, arc[-1])
    panel = np.clip(np.searchsorted(arc, target, side="right") - 1, 0, _CUBIC_PANELS - 1)
    low, high = knots[panel], knots[panel + 1]
    room = arc[panel + 1] - arc[panel]
    share = np.where(room > 0, (target - arc[panel]) / np.where(room > 0, room, 1.0), 0.0)
    p = low + share * (high - low)
    for _ in range(6):  # Newton; quadratic, so six steps reach rounding from a 1/32 panel
        step = p - low
        nodes = low[:, None] + step[:, None] * _NODES
        speeds = np.hypot(polyval(nodes, du), polyval(nodes, dv))
        excess = arc[panel] + (speeds @ _WEIGHTS) * step - target
        speed = np.hypot(polyval(p, du), polyval(p, dv))
        p = np.clip(p - excess / np.maximum(speed, 1e-12), low, high)
    slope_u, slope_v = polyval(p, du), polyval(p, dv)
    turn = np.arctan2(slope_v, slope_u)
    return polyval(p, u), polyval(p, v), turn
