"""Headings, velocities and reference points that contradict how objects move, and the remedy."""

import numpy as np

from shiftsim.data.readers.motion import contradiction, fitted_velocities, track_medians
from shiftsim.data.readers.tracks.columns import UNITS
from shiftsim.data.readers.tracks.map_fit import Fit
from shiftsim.data.readers.tracks.statistics import (
    FAST,
    LEAST_CONTRADICTING,
    MAX_CONTRADICTING,
    Diagnostics,
    TrackStatistics,
)
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray

_MAX_HEADING = 0.2  # rad, median angle between heading and motion
_MAX_BACKWARDS = 0.1  # share of the rows
_TURNING, _LEAST_TURN = 0.1, 0.5  # rad/s; rad over a track
_REFERENCE = (-0.15, 0.45)  # of the length, of the point that turns without sliding


def check_headings(stats: TrackStatistics, fit: Fit, out: Diagnostics) -> None:
    """Whether headings are the directions of stats."""
    rows = stats.rows(FAST)
    if stats.table.headings is None or not len(rows):
        return
    column = stats.table.columns.found["heading"]
    way = fit.turned(stats.derived[rows])
    along = np.arctan2(way[:, 1], way[:, 0])
    heading = stats.table.headings[rows]
    given = np.pi / 2 - heading if column.unit == "compass" else heading
    degrees = np.deg2rad(given) if column.unit == "rad" else given
    leave_out = "leave the column out, and the direction of motion is taken: heading = ''"
    tries = {
        "": heading,
        "they look like degrees: [units] heading = 'deg'": degrees,
        "they look like degrees clockwise from north: [units] heading = 'compass'": np.pi / 2
        - degrees,
        f"they look clockwise: [columns] heading = '-{column.name}'": -heading,
        f"they look clockwise and in degrees: [columns] heading = '-{column.name}', [units] heading"
        " = 'deg'": -degrees,
        "they look like radians: [units] heading = 'rad'": np.rad2deg(heading),
        f"they point backwards; {leave_out}": heading + np.pi,
        f"they are a quarter turn too large; {leave_out}": heading - np.pi / 2,
        f"they are a quarter turn too small; {leave_out}": heading + np.pi / 2,
        f"they are taken from the x axis towards -y, a quarter turn off; {leave_out}": -heading
        + np.pi / 2,
    }
    errors = {name: _median(np.abs(wrap_angles(h - along))) for name, h in tries.items()}
    out.figures["heading_error_rad"] = errors[""]
    if errors[""] > _MAX_HEADING:
        best = min(errors, key=lambda name: errors[name])
        fits = best and errors[best] < _MAX_HEADING
        out.error(
            f"headings differ from the direction of motion by {errors['']:.2f} rad in the middle of"
            f" {len(rows)} rows, at most {_MAX_HEADING:g} rad",
            best if fits else f"no other unit or axis fits; {leave_out}",
        )
        return
    backwards = float((np.abs(wrap_angles(heading - along)) > np.pi / 2).mean())
    out.figures["backwards_share"] = backwards
    if backwards > _MAX_BACKWARDS:
        out.error(
            f"in {backwards:.0%} of the rows the heading points against the motion, at most"
            f" {_MAX_BACKWARDS:.0%}",
            f"some objects are turned by half a turn; {leave_out}",
        )


def check_velocities(stats: TrackStatistics, fit: Fit, out: Diagnostics) -> None:
    """Whether velocities are those of the positions."""
    stored, table = stats.table.velocities, stats.table
    rows = stats.rows(FAST)
    if stored is None or not len(rows):
        return
    moving = np.unique(table.track[rows])
    derived = fit.turned(stats.derived)
    wrong = contradiction(stored, derived, stats.time, table.track)[0][moving]
    out.figures["contradicting_share"] = float(wrong.mean())
    rows = rows[np.isfinite(stored[rows]).all(axis=1)]
    rows = rows[np.isin(table.track[rows], moving[wrong])]
    if not len(rows) or wrong.mean() <= LEAST_CONTRADICTING:
        return  # these few velocities are derived
    way, given = derived[rows], stored[rows]
    ratio = _median(np.hypot(*given.T) / np.hypot(*way.T))
    columns = table.columns
    speed_only = "vx" not in columns.found
    names = [columns.found[n].name for n in (("speed",) if speed_only else ("vx", "vy"))]
    leave_out = " and ".join(f"{n} = ''" for n in (("speed",) if speed_only else ("vx", "vy")))
    leave_out = f"leave them out, and they follow from the positions: [columns] {leave_out}"
    tries = {"": given}
    units = UNITS["velocity"]
    unit_now = columns.found["speed" if speed_only else "vx"].unit
    for unit, factor in units.items():
        if unit != unit_now:
            guess = f"they look like {unit}: [units] velocity = {unit!r}"
            tries[guess] = given * factor / units[unit_now]
    if not speed_only:
        x, y = names
        tries |= {
            f"they look swapped: [columns] vx = {y!r}, vy = {x!r}": given[:, ::-1],
            f"the second looks mirrored: [columns] vy = '-{y}'": given * [1, -1],
            f"the first looks mirrored: [columns] vx = '-{x}'": given * [-1, 1],
        }
        if table.headings is not None:
            cos, sin = np.cos(table.headings[rows]), np.sin(table.headings[rows])
            tries[f"they look like those along and across the vehicle; {leave_out}"] = (
                np.column_stack(
                    [given[:, 0] * cos - given[:, 1] * sin, given[:, 0] * sin + given[:, 1] * cos]
                )
            )
    errors = {n: _median(np.hypot(*(v - way).T) / np.hypot(*way.T)) for n, v in tries.items()}
    best = min(errors, key=lambda name: errors[name])
    is_known = best != "" and errors[best] < 0.1
    scaled = given / max(ratio, 1e-9)
    is_uniform = _median(np.hypot(*(scaled - way).T) / np.hypot(*way.T)) < 0.1
    remedy = best if is_known else leave_out
    if not (is_known or is_uniform) and wrong.mean() <= MAX_CONTRADICTING:
        return
    if is_uniform and not is_known and table.hz is not None:
        remedy = (
            f"--hz looks too {'small' if ratio > 1 else 'large'} by {ratio:.3g}; or {leave_out}"
        )
    out.error(
        f"velocities ({', '.join(names)}) contradict the positions in {wrong.mean():.0%} of the"
        f" moving vehicles: the speeds are {ratio:.3g} times those of the positions",
        remedy,
    )


def check_reference(stats: TrackStatistics, out: Diagnostics) -> None:
    """Which point of a vehicle the positions are: it slides sideways in turns, unless at the axle.

    A point d ahead of the rear axle moves sideways with d times the yaw rate.
    """
    table = stats.table
    if table.headings is None or table.sizes is None or table.columns.reference:
        return
    number = len(table.track_ids)
    fast = stats.is_vehicle & (stats.speed > FAST)
    rows = np.flatnonzero(fast)
    turns = _turns(table.track, table.headings, rows)
    turned = np.bincount(table.track[rows], np.abs(turns), number)
    rows = np.flatnonzero(stats.is_vehicle & (turned > _LEAST_TURN)[table.track])
    if not len(rows):
        return
    track, fast = table.track[rows], fast[rows]
    angle = np.column_stack(
        [np.cumsum(_turns(table.track, table.headings, rows)), np.zeros(len(rows))]
    )
    numbers = np.unique(track, return_inverse=True)[1]
    rate = fitted_velocities(angle, stats.time[rows], numbers, stats.period)[:, 0]
    cos, sin = np.cos(table.headings[rows]), np.sin(table.headings[rows])
    sideways = stats.derived[rows, 1] * cos - stats.derived[rows, 0] * sin
    used = fast & (np.abs(rate) > _TURNING)
    weight = np.bincount(track[used], rate[used] ** 2, number)
    moment = np.bincount(track[used], (sideways * rate)[used], number)
    turn = np.bincount(track[used], np.abs(rate[used]) * stats.period, number)
    length = track_medians(table.sizes[:, 0], table.track)
    enough = (turn > _LEAST_TURN) & (length > 0)
    if enough.sum() < 3:
        return
    place = _median(moment[enough] / weight[enough] / length[enough])
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


def _turns(track: IntArray, headings: FloatArray, rows: IntArray) -> FloatArray:
    """(n,) by how much the heading of a row differs from the one before of its object [rad]."""
    before = np.maximum(rows - 1, 0)
    before = np.where(track[before] == track[rows], before, rows)
    return wrap_angles(headings[rows] - headings[before])


def _median(values: FloatArray) -> float:
    return float(np.median(values))
