"""What vehicles and pedestrians of generated towns follow: smooth lines with places to wait."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shiftsim.kernels import FloatArray

STEP = 0.5  # m between the points of a path
_SMOOTHING = 2.5  # m, how far a driver rounds off the corners of the lane centres
_LATERAL_ACCEL = 1.8  # m/s^2, comfortable in curves
_BRAKING = 1.0  # m/s^2, comfortable before curves
_CYCLING = 4.5  # m/s


class _Line:
    points: FloatArray

    @cached_property
    def _rows(self) -> list[list[float]]:
        return self.points.tolist()

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return STEP * (len(self.points) - 1)

    def bend(self, s: float) -> float:
        """Curvature at an arc length [1/m]."""
        index = min(max(int(s / STEP), 1), len(self._rows) - 2)
        return (self._rows[index + 1][2] - self._rows[index - 1][2]) / (2.0 * STEP)

    def at(self, s: float) -> tuple[float, float, float]:
        """X [m], y [m] and heading [rad] at an arc length."""
        index = min(max(int(s / STEP), 0), len(self._rows) - 2)
        (x, y, heading), (bx, by, bh) = self._rows[index], self._rows[index + 1]
        share = s / STEP - index
        return x + share * (bx - x), y + share * (by - y), heading + share * (bh - heading)


@dataclass(frozen=True)
class Zone:
    """A stretch of a path that must be entered one after the other: a junction, a narrow place."""

    id: int  # of the connecting road; negative for narrow places
    entry: float  # where it begins [m]
    exit: float  # where it ends [m]
    stop: float  # where a vehicle that must wait stops [m]
    rank: int  # order of priority, 0 first
    origin: str  # lane it is entered from
    crosswalk: str = ""  # name of the crosswalk between stop and entry, empty without one


@dataclass(frozen=True)
class Path(_Line):
    """What one vehicle can follow. n points, `STEP` apart."""

    points: FloatArray  # (n, 3) x [m], y [m], heading, unwrapped [rad]
    speed: FloatArray  # (n,) desired speed of an ordinary driver [m/s]
    zones: tuple[Zone, ...] = ()  # on the way, in order
    # name, first and last arc length of the places where pedestrians cross [m]
    crossings: tuple[tuple[str, float, float], ...] = ()
    is_parking: bool = False  # whether vehicles stay at its end


@dataclass(frozen=True)
class Walk(_Line):
    """A way of a pedestrian. n points, `STEP` apart."""

    points: FloatArray  # (n, 3) x [m], y [m], heading [rad]
    crossing: str = ""  # name of the place where it crosses a road, empty for none
    kerb: float = np.inf  # where the pedestrian waits to cross [m]
    across: float = np.inf  # where the other side is reached [m]


def path_along(parts: Sequence[FloatArray], limits_kmh: Sequence[float]) -> Path:
    """A path along lane centres (n, 2) [m], with comfortable speeds and no zones yet."""
    points = resample(np.concatenate(parts), _SMOOTHING)
    arc = STEP * np.arange(len(points))
    edges = np.cumsum([STEP * len(part) for part in parts])
    limit = np.array(limits_kmh)[np.minimum(np.searchsorted(edges, arc), len(parts) - 1)] / 3.6
    bending = np.abs(np.gradient(points[:, 2], STEP))
    speed = np.minimum(0.94 * limit, np.sqrt(_LATERAL_ACCEL / np.maximum(bending, 1e-4)))
    return Path(points, brake_in_time(speed))


def brake_in_time(speed: FloatArray) -> FloatArray:
    """(n,) speeds no higher than those given, that fall gently enough along a path."""
    out = speed.copy()
    for index in range(len(out) - 2, -1, -1):
        out[index] = min(out[index], np.sqrt(out[index + 1] ** 2 + 2 * _BRAKING * STEP))
    return out


def shifted(path: Path, aside: FloatArray | float) -> Path:
    """The same path, further to the left by `aside` [m]."""
    points = path.points.copy()
    points[:, 0] -= aside * np.sin(points[:, 2])
    points[:, 1] += aside * np.cos(points[:, 2])
    points[:, 2] = points[:, 2] + np.arctan(np.gradient(aside + np.zeros(len(points)), STEP))
    return replace(path, points=points)


def for_bicycles(path: Path) -> Path:
    """The same path near the right border of the lane, slow enough for a bicycle."""
    return replace(shifted(path, -0.9), speed=np.minimum(path.speed, _CYCLING))


def resample(xy: FloatArray, smoothing: float) -> FloatArray:
    """(n, 3) points `STEP` apart along a smoothed polyline, with headings."""
    step = np.hypot(*np.diff(xy, axis=0).T)
    xy = xy[np.r_[True, step > 1e-6]]
    arc = np.r_[0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T))]
    fine = 0.1
    dense = np.column_stack([np.interp(np.arange(0, arc[-1], fine), arc, xy[:, k]) for k in (0, 1)])
    reach = round(3 * smoothing / fine)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * fine / smoothing) ** 2)
    weights /= weights.sum()
    head = dense[0] + np.arange(-reach, 0)[:, None] * (dense[1] - dense[0])
    tail = dense[-1] + np.arange(1, reach + 1)[:, None] * (dense[-1] - dense[-2])
    padded = np.concatenate([head, dense, tail])
    smooth = np.column_stack([np.convolve(padded[:, k], weights, "valid") for k in (0, 1)])
    arc = np.r_[0.0, np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))]
    at = np.arange(0.0, arc[-1], STEP)
    tangent = np.gradient(smooth, fine, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return np.column_stack([np.interp(at, arc, column) for column in (*smooth.T, heading)])


def arc_at(points: FloatArray, xy: FloatArray) -> float:
    """Arc length of the point of a line nearest to `xy` [m]."""
    return STEP * float(np.argmin(np.hypot(*(points[:, :2] - xy).T)))
