"""Do moving vehicles lie on a map and drive along its lanes; if not, in which units and axes?"""

from dataclasses import dataclass

import numpy as np

from shiftsim.data.readers import placement
from shiftsim.data.readers.tracks.columns import UNITS
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap

MIN_ALONG = 0.7  # share of the vehicles on a lane that drive along one
_MAX_POINTS = 2000
_MAX_EDGES = 16  # lanes looked at per point
_ENOUGH = 0.85  # of both shares, for another unit, axis or origin to be believed
_GAIN = 0.03  # in the product of the shares, by which a later guess must be better
_SPEEDS = (1.5, 45.0)  # m/s, of the median moving vehicle in the right unit

# signs and order of the axes, and what makes them ours
_AXES = {
    "": np.eye(2),
    "with y mirrored": np.diag([1.0, -1.0]),
    "with x mirrored": np.diag([-1.0, 1.0]),
    "with x and y swapped": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "turned by half a turn": np.diag([-1.0, -1.0]),
    "turned by a quarter turn to the left": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "turned by a quarter turn to the right": np.array([[0.0, 1.0], [-1.0, 0.0]]),
    "with x and y swapped and mirrored": np.array([[0.0, -1.0], [-1.0, 0.0]]),
}


@dataclass(frozen=True)
class Guess:
    """Another unit, axis or origin, with which tracks fit the map."""

    axes: str  # name of the axes
    unit: str  # of the positions, if what was taken for metres is another one
    shift: FloatArray  # (2,) what is added then [m]
    share: float  # on drivable area
    along: float  # along the lanes

    @property
    def words(self) -> str:
        """How it fits."""
        parts = [self.axes] if self.axes else []
        parts += [f"in {self.unit}"] if self.unit != "m" else []
        if self.shift.any():
            parts.append(f"when shifted by ({self.shift[0]:+.1f}, {self.shift[1]:+.1f}) m")
        return " ".join(parts)

    def remedies(self, x: str, y: str) -> list[str]:
        """What to write into the TOML file, by the names of the columns."""
        out = []
        if self.axes:
            rows = [
                f"{axis} = '{'-' if row.sum() < 0 else ''}{(x, y)[int(row[1] != 0)]}'".replace(
                    "--", ""
                )
                for axis, row in zip("xy", _AXES[self.axes], strict=True)
            ]
            out.append(
                f"[columns] {', '.join(rows)} (heading and velocities too, where they have these"
                " axes)"
            )
        if self.unit != "m":
            out.append(f"[units] position = {self.unit!r}")
        if self.shift.any():
            out.append(
                f"shift_m = [{self.shift[0]:.1f}, {self.shift[1]:.1f}] (approximate, found by"
                " search: a lane beside looks the same), or, exact, the difference between the"
                " origins of map and tracks"
            )
        return out


@dataclass(frozen=True)
class Fit:
    """How well vehicles and map lie on each other."""

    share: float  # of the moving vehicles on drivable area
    along: float  # of those on lanes that drive along one; 1 where hardly any is on a lane
    is_good: bool
    best: Guess | None = None  # what fits, where the tracks as they are do not
    overspeed: float = 0.0  # speed by the limit of the lane, which a tenth of the vehicles exceeds

    def turned(self, vectors: FloatArray) -> FloatArray:
        """Vectors (n, 2) in the axes and units of the map, as far as these are known."""
        if self.best is None:
            return vectors
        scale = UNITS["position"][self.best.unit]
        return scale * vectors @ _AXES[self.best.axes].T


def fit_map(
    road: VectorMap,
    places: FloatArray,
    velocities: FloatArray,
    min_share: float,
    *,
    only_metres: bool = False,
) -> Fit:
    """Compare moving vehicles, (n, 2) box centres [m] and (n, 2) velocities [m/s], with a map.

    Where fewer than `min_share` are on drivable area, or many do not drive along their lanes, other
    axes and origins are tried, and other units than metres unless `only_metres`.
    """
    every = max(1, len(places) // _MAX_POINTS)
    points = np.ascontiguousarray(places[::every])
    ways = np.ascontiguousarray(velocities[::every])
    share, along, limits = _shares(road, points, ways)
    if share >= min_share and along >= MIN_ALONG:
        limited = limits > 0.0
        speeds = np.hypot(*ways[limited].T) / limits[limited]
        over = float(np.percentile(speeds, 90)) if limited.any() else 0.0
        return Fit(share, along, True, overspeed=over)
    best, value = None, share * along
    speed = float(np.median(np.hypot(*ways.T)))
    for unit, scale in UNITS["position"].items():
        if not _SPEEDS[0] <= scale * speed <= _SPEEDS[1] or (only_metres and unit != "m"):
            continue
        for shifted in (False, True):
            for name, axes in _AXES.items():
                placed = points @ (scale * axes).T
                shift = placement.place_on_map(road, placed, 1.1).shift if shifted else np.zeros(2)
                shares = _shares(road, placed + shift, ways @ axes.T)[:2]
                guess = Guess(name, unit, shift, *shares)
                found = guess.share * guess.along
                if min(guess.share, guess.along) >= _ENOUGH and found > value + _GAIN:
                    best, value = guess, found
        if best is not None:
            break
    return Fit(share, along, False, best)


def _shares(
    road: VectorMap, points: FloatArray, ways: FloatArray
) -> tuple[float, float, FloatArray]:
    """Shares of points on drivable area, and of those on lanes that move along one; (n,) limits.

    Speed limits [m/s] are 0 where there is none.
    """
    points = np.ascontiguousarray(points)
    edges = placement.containing_polygons(road.edges.polygons, points, _MAX_EDGES)
    limits, is_along = np.zeros(len(points)), np.zeros(len(points), np.bool_)
    for index, place in np.argwhere(edges >= 0).tolist():
        edge = int(edges[index, place])
        dx, dy = placement.direction_at(road.baselines, edge, *points[index].tolist())
        if dx * ways[index, 0] + dy * ways[index, 1] > 0.0:
            is_along[index] = True
            limits[index] = max(limits[index], np.nan_to_num(road.speed_limits[edge]))
    on_lane, along = float((edges[:, 0] >= 0).sum()), float(is_along.sum())
    count = max(1, len(points))
    drivable = float(placement.are_drivable(road, points).sum())
    return drivable / count, along / on_lane if on_lane > 0.1 * count else 1.0, limits
