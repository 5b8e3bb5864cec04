"""Findings about a table; headings, velocities and points that contradict how objects move."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shiftsim.data.readers import motion
from shiftsim.data.readers.tracks.map_fit import Fit
from shiftsim.data.readers.tracks.table import TrackTable
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray

FAST = 2.0  # m/s, above which a direction of motion is sure
# share of the moving vehicles whose velocities contradict their positions; more than the first is
# wrong if one explanation fits all of them
LEAST_CONTRADICTING, _MAX_CONTRADICTING = 0.1, 0.5
_MAX_HEADING = 0.2  # rad, median angle between heading and motion
_MAX_BACKWARDS = 0.1  # share of the rows
_MAX_VELOCITY = 0.1  # of the speed, median error of velocities that fit
_TURNING, _LEAST_TURN = 0.1, 0.5  # rad/s; rad over a track
_REFERENCE = (-0.15, 0.45)  # of the length, of the point that turns without sliding


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
    rows = table.moving_rows(FAST)
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
    if errors[""] > _MAX_HEADING:
        fits = best and errors[best] < _MAX_HEADING
        out.error(
            f"headings differ from the direction of motion by {errors['']:.2f} rad in the middle of"
            f" {len(rows)} rows, at most {_MAX_HEADING:g} rad",
            best if fits else f"no other unit or axis fits; {leave_out}",
        )
        return
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
    stored, rows = table.velocities, table.moving_rows(FAST)
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
    fast = known & (table.speed > FAST)
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
