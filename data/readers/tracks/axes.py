"""What contradicts how objects move: headings, velocities, points, and the map they drive on.

Do moving vehicles lie on a map and drive along its lanes; if not, in which units and axes?
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shiftsim.data.readers import motion, placement
from shiftsim.data.readers.tracks.columns import UNITS
from shiftsim.data.readers.tracks.table import TrackTable
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
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
# share of the moving vehicles whose velocities contradict their positions; more than the first is
# wrong if one explanation fits all of them
LEAST_CONTRADICTING, _MAX_CONTRADICTING = 0.1, 0.5
_MAX_BACKWARDS = 0.1  # share of the rows
_MAX_VELOCITY = 0.1  # of the speed, median error of velocities that fit
_TURNING, _LEAST_TURN = 0.1, 0.5  # rad/s; rad over a track
_REFERENCE = (-0.15, 0.45)  # of the length, of the point that turns without sliding


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
            rows = _AXES[self.axes].tolist()
            named = ["-" * (sum(row) < 0) + (x, y)[row[1] != 0] for row in rows]
            x, y = (name.replace("--", "") for name in named)
            also = "heading and velocities too, where they have these axes"
            out.append(f"[columns] x = '{x}', y = '{y}' ({also})")
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


class Finding(NamedTuple):
    """Something that is wrong, or unusual, with a table."""

    what: str  # value and limit
    remedy: str


@dataclass
class Diagnostics:
    """What was found out about a table."""

    errors: list[Finding] = field(default_factory=list)  # what cannot be right
    warnings: list[Finding] = field(default_factory=list)  # what is unusual
    figures: dict[str, float] = field(default_factory=dict)  # numbers behind it

    def error(self, what: str, remedy: str) -> None:
        """Add something that cannot be right."""
        self.errors.append(Finding(what, remedy))

    def warn(self, what: str, remedy: str) -> None:
        """Add something that is unusual."""
        self.warnings.append(Finding(what, remedy))


def check_headings(table: TrackTable, fit: Fit, out: Diagnostics) -> None:
    """Whether headings are the directions of motion."""
    rows = table.moving_rows(motion.FAST)
    rows = rows[np.isfinite(table.headings[rows])]
    if not len(rows):
        return
    column = table.columns.found["heading"]
    driven = fit.turned(table.derived[rows])
    direction = np.arctan2(driven[:, 1], driven[:, 0])
    heading, quarter = table.headings[rows], np.pi / 2
    given = quarter - heading if column.unit == "compass" else heading
    degrees = np.deg2rad(given) if column.unit == "rad" else given
    clockwise = f"[columns] heading = '-{column.name}'"
    leave_out = "leave the column out, and the direction of motion is taken: heading = ''"
    guesses = {
        "": heading,
        "they look like degrees: [units] heading = 'deg'": degrees,
        "they look like degrees clockwise from north: [units] heading = 'compass'": (
            quarter - degrees
        ),
        f"they look clockwise: {clockwise}": -heading,
        f"they look clockwise and in degrees: {clockwise}, [units] heading = 'deg'": -degrees,
        "they look like radians: [units] heading = 'rad'": np.rad2deg(heading),
        f"they point backwards; {leave_out}": heading + np.pi,
        f"they are a quarter turn too large; {leave_out}": heading - quarter,
        f"they are a quarter turn too small; {leave_out}": heading + quarter,
        f"they are taken from the x axis towards -y, a quarter turn off; {leave_out}": (
            quarter - heading
        ),
    }
    best, errors = _best_guess(guesses, lambda angles: np.abs(wrap_angles(angles - direction)))
    out.figures["heading_error_rad"] = errors[""]
    if errors[""] > motion.MAX_HEADING:
        fits = best and errors[best] < motion.MAX_HEADING
        out.error(
            f"headings differ from the direction of motion by {errors['']:.2f} rad in the middle of"
            f" {len(rows)} rows, at most {motion.MAX_HEADING:g} rad",
            best if fits else f"no other unit or axis fits; {leave_out}",
        )
        return
    velocities, when = fit.turned(table.derived), (table.time, table.track, table.track_ids)
    if what := motion.beyond_turn(table.headings, velocities, *when):
        usual = f"write angles within a turn; or {leave_out}"
        out.error(what, [*guesses][1] if column.unit == "rad" else usual)
    backwards = float((np.abs(wrap_angles(heading - direction)) > quarter).mean())
    out.figures["backwards_share"] = backwards
    if backwards > _MAX_BACKWARDS:
        out.error(
            f"in {backwards:.0%} of the rows the heading points against the motion, at most"
            f" {_MAX_BACKWARDS:.0%}",
            f"some objects are turned by half a turn; {leave_out}",
        )


def check_velocities(table: TrackTable, fit: Fit, out: Diagnostics) -> None:
    """Whether velocities are those of the positions."""
    stored, rows = table.velocities, table.moving_rows(motion.FAST)
    if not len(rows) or np.isnan(stored).all():
        return
    moving = np.unique(table.track[rows])
    derived = fit.turned(table.derived)
    wrong = motion.contradiction(stored, derived, table.time, table.track)[0][moving]
    share = out.figures["contradicting_share"] = float(wrong.mean())
    rows = rows[np.isfinite(stored[rows]).all(axis=1)]
    rows = rows[np.isin(table.track[rows], moving[wrong])]
    if not len(rows) or share <= LEAST_CONTRADICTING:
        return  # these few velocities are derived
    given, driven = stored[rows], derived[rows]
    speed = np.hypot(*driven.T)
    ratio = float(np.median(np.hypot(*given.T) / speed))
    roles = ("vx", "vy") if "vx" in table.columns.found else ("speed",)
    names = [table.columns.found[role].name for role in roles]
    leave_out = " and ".join(f"{role} = ''" for role in roles)
    leave_out = f"leave them out, and they follow from the positions: [columns] {leave_out}"
    guesses = {"": given}
    for unit, factor in table.columns.unit_factors(roles[0]).items():
        if factor != 1.0:
            guesses[f"they look like {unit}: [units] velocity = {unit!r}"] = given * factor
    if len(roles) == 2:
        x, y = names
        guesses |= {
            f"they look swapped: [columns] vx = {y!r}, vy = {x!r}": given[:, ::-1],
            f"the second looks mirrored: [columns] vy = '-{y}'": given * [1, -1],
            f"the first looks mirrored: [columns] vx = '-{x}'": given * [-1, 1],
        }
        if np.isfinite(table.headings[rows]).all():
            cos, sin = motion.unit_vectors(table.headings[rows]).T
            along, across = given.T
            in_map = np.column_stack([along * cos - across * sin, along * sin + across * cos])
            guesses[f"they look like those along and across the vehicle; {leave_out}"] = in_map
    guesses["scaled"] = given / max(ratio, 1e-9)
    _, errors = _best_guess(guesses, lambda velocities: np.hypot(*(velocities - driven).T) / speed)
    is_uniform = errors.pop("scaled") < _MAX_VELOCITY
    best = min(errors, key=lambda guess: errors[guess])
    is_known = best != "" and errors[best] < _MAX_VELOCITY
    if not (is_known or is_uniform) and share <= _MAX_CONTRADICTING:
        return
    remedy = best if is_known else leave_out
    if is_uniform and not is_known and table.hz is not None:
        size = "small" if ratio > 1 else "large"
        remedy = f"--hz looks too {size} by {ratio:.3g}; or {leave_out}"
    out.error(
        f"velocities ({', '.join(names)}) contradict the positions in {share:.0%} of the"
        f" moving vehicles: the speeds are {ratio:.3g} times those of the positions",
        remedy,
    )


def check_reference(table: TrackTable, out: Diagnostics) -> None:
    """Which point of a vehicle the positions are: it slides sideways in turns, unless at the axle.

    A point d ahead of the rear axle moves sideways with d times the yaw rate.
    """
    if table.columns.reference:
        return
    number = len(table.track_ids)
    known = table.is_vehicle & np.isfinite(table.headings)
    fast = known & (table.speed > motion.FAST)
    rows = np.flatnonzero(fast)
    turned = np.bincount(table.track[rows], np.abs(_turns(table, rows)), number)
    rows = np.flatnonzero(known & (turned > _LEAST_TURN)[table.track])
    if not len(rows):
        return
    track, fast = table.track[rows], fast[rows]
    angle = np.column_stack([np.cumsum(_turns(table, rows)), np.zeros(len(rows))])
    numbers = np.unique(track, return_inverse=True)[1]
    rate = motion.fitted_velocities(angle, table.time[rows], numbers, table.period)[:, 0]
    cos, sin = motion.unit_vectors(table.headings[rows]).T
    sideways = table.derived[rows, 1] * cos - table.derived[rows, 0] * sin
    used = fast & (np.abs(rate) > _TURNING)
    weight = np.bincount(track[used], rate[used] ** 2, number)
    moment = np.bincount(track[used], (sideways * rate)[used], number)
    turn = np.bincount(track[used], np.abs(rate[used]) * table.period, number)
    length = motion.track_medians(table.sizes[:, 0], table.track)
    enough = (turn > _LEAST_TURN) & (length > 0)
    if enough.sum() < 3:
        return
    place = float(np.median(moment[enough] / weight[enough] / length[enough]))
    out.figures["reference_share"] = place
    low, high = _REFERENCE
    if low <= place <= high:
        return
    name = "front" if place > high else "rear"
    out.error(
        f"in turns the positions move like a point {place:+.2f} lengths ahead of the rear axle; the"
        f" middle of a box is at {low:+.2f} … {high:+.2f}",
        f"they look like the {name} of the vehicles: reference = {name!r} in a TOML file; if they"
        " are the middle: reference = 'center'",
    )


def _turns(table: TrackTable, rows: IntArray) -> FloatArray:
    """(n,) by how much the heading of a row differs from the one before of its object [rad]."""
    before = np.maximum(rows - 1, 0)
    before = np.where(table.track[before] == table.track[rows], before, rows)
    return np.nan_to_num(wrap_angles(table.headings[rows] - table.headings[before]))


def _best_guess(
    guesses: Mapping[str, FloatArray], errors_of: Callable[[FloatArray], FloatArray]
) -> tuple[str, dict[str, float]]:
    """The guess whose values have the least median error, and that error of every guess."""
    errors = {guess: float(np.median(errors_of(values))) for guess, values in guesses.items()}
    return min(errors, key=lambda guess: errors[guess]), errors
