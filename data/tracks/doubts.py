"""What cannot be right about a table of tracks, recognised by what it does, and the remedy.

A wrong unit, axis, order or origin shows in how objects move, in their sizes, and in where they are
on the map. Every explanation that is known is tried; the one that makes the numbers fit is named.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.data.dsc3d.motion import track_medians
from shiftsim.data.tracks.columns import KINDS, UNITS, Columns
from shiftsim.data.tracks.fit import Fit, fit_map
from shiftsim.data.tracks.motion import contradicting, fitted_velocities
from shiftsim.data.tracks.reading import TrackTable
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind

_RATES = (2.0, 100.0)  # Hz
_MAX_SPEED = 60.0  # m/s, of 95 % of the vehicles' rows
_LEAST_SPEED = 1.0  # m/s, of the fastest vehicle
_MAX_GAP = 1.0  # s without a row of any object
_DEGREE = 1e5  # m, about
_JUMP_SPEED, _JUMP = 100.0, 5.0  # m/s and m between two rows of an object
_MOVING, _FAST = 1.0, 2.0  # m/s
_LENGTHS, _WIDTHS = (2.8, 9.0), (1.3, 2.9)  # m, of the median vehicle
_MAX_OVERSPEED = 1.6  # of the speed limit, of nine tenths of the rows
_MAX_HEADING = 0.2  # rad, median angle between heading and motion
_MAX_BACKWARDS = 0.1  # share of the rows
# share of the moving vehicles; more than the first if one explanation fits all of them
_LEAST_CONTRADICTING, _MAX_CONTRADICTING = 0.1, 0.5
_TURNING, _LEAST_TURN = 0.1, 0.5  # rad/s; rad over a track
_REFERENCE = (-0.15, 0.45)  # of the length, of the point that turns without sliding
_MAX_ROWS = 40_000  # that are looked at


@dataclass(frozen=True)
class Doubt:
    """One thing that cannot be right."""

    what: str  # value and limit
    remedy: str


@dataclass(frozen=True)
class Doubts:
    """What was found out about a table."""

    found: list[Doubt] = field(default_factory=list)  # errors
    notes: list[Doubt] = field(default_factory=list)  # what may be right
    figures: dict[str, float] = field(default_factory=dict)  # numbers behind it

    def say(self, what: str, remedy: str) -> None:
        """Say one more error."""
        self.found.append(Doubt(what, remedy))

    def note(self, what: str, remedy: str) -> None:
        """Say what may be right."""
        self.notes.append(Doubt(what, remedy))


@dataclass(frozen=True)
class _Motion:
    """A table and how its objects move. A rows, N objects."""

    table: TrackTable
    is_vehicle: BoolArray  # (A,)
    time: FloatArray  # (A,) [s]
    period: float  # s

    @cached_property
    def ends(self) -> IntArray:
        """(N + 1,) first row of every object, and the number of rows."""
        return np.searchsorted(self.table.track, np.arange(len(self.table.track_ids) + 1))

    @cached_property
    def derived(self) -> FloatArray:
        """(A, 2) velocities by the positions [m/s]."""
        return fitted_velocities(self.table.xy, self.time, self.table.track, self.period)

    @cached_property
    def speed(self) -> FloatArray:
        """(A,) [m/s]."""
        return np.hypot(self.derived[:, 0], self.derived[:, 1])

    @cached_property
    def vehicle_size(self) -> tuple[float, float] | None:
        """Length and width of the median vehicle [m], where vehicles have sizes."""
        sizes, track = self.table.sizes, self.table.track
        if sizes is None:
            return None
        vehicles = np.unique(track[self.is_vehicle])
        medians = np.column_stack([track_medians(sizes[:, axis], track) for axis in (0, 1)])
        known = medians[vehicles][(medians[vehicles] > 0).all(axis=1)]
        if not len(known):
            return None
        length, width = np.median(known, axis=0).tolist()
        return length, width

    def rows(self, faster: float) -> IntArray:
        """Some rows of vehicles that move faster."""
        found = np.flatnonzero(self.is_vehicle & (self.speed > faster))
        return found[:: max(1, len(found) // _MAX_ROWS)]


def find_doubts(table: TrackTable, road: VectorMap, min_share: float) -> Doubts:
    """Everything that cannot be right; `min_share` of the moving vehicles must be on the map."""
    out = Doubts()
    used = np.unique(table.category).tolist()
    if unknown := [
        name for i, name in enumerate(table.categories) if i in used and name not in KINDS
    ]:
        names = ", ".join(map(repr, unknown))
        out.say(
            f"kinds {names} are unknown",
            f"say what they are in a TOML file for --columns: [kinds] {unknown[0]!r} = 'car';"
            f" known are {', '.join(sorted(KINDS))}",
        )
        return out
    vehicles = [KINDS.get(name) == AgentKind.VEHICLE for name in table.categories]
    is_vehicle = np.array(vehicles, np.bool_)[table.category]
    if not is_vehicle.any():
        out.say(
            f"none of the {len(table.track_ids)} objects is a vehicle, so none can be the ego:"
            f" kinds {', '.join(map(repr, table.categories))}",
            "check the column of kinds, or map them: [kinds]",
        )
        return out
    same = np.diff(table.track) == 0
    step = np.diff(table.time_us)[same] / 1e6
    if not _check_times(table, step, out):
        return out
    time = (table.time_us - table.time_us.min()) / 1e6
    motion = _Motion(table, is_vehicle, time, float(np.median(step)))
    _check_jumps(motion, same, out)
    if not _check_speeds(motion, out):
        return out
    moving = motion.rows(_MOVING)
    _check_gaps(table, out)
    # another unit of length would show elsewhere, too
    is_metric = _has_usual_sizes(motion) and _velocities_fit(motion)
    fit = fit_map(road, table.xy[moving], motion.derived[moving], min_share, only_metres=is_metric)
    out.figures.update({"drivable_share": fit.share, "along_share": fit.along})
    _check_fit(fit, table.columns, min_share, out)
    if fit.is_good and fit.overspeed > _MAX_OVERSPEED:
        out.figures["overspeed"] = fit.overspeed
        out.note(
            f"a tenth of the moving vehicles is {fit.overspeed:.2g} times as fast as the speed"
            f" limit of their lane or faster, usual is less than {_MAX_OVERSPEED:g}",
            "check --hz or the unit of time, unless the limits of the map are wrong",
        )
    _check_sizes(motion, out)
    _check_headings(motion, fit, out)
    _check_velocities(motion, fit, out)
    if not out.found:
        _check_reference(motion, out)
    return out


def _check_times(table: TrackTable, step: FloatArray, out: Doubts) -> bool:
    """Whether motion can be told at all."""
    if not len(step):
        out.say(
            f"each of the {len(table.track_ids)} objects has one row only",
            "check the column of ids: an object needs the same id in all its rows",
        )
        return False
    twice = np.flatnonzero((np.diff(table.track) == 0) & (np.diff(table.time_us) == 0))
    if len(twice):
        name = table.track_ids[table.track[twice[0]]].item()
        when = (table.time_us[twice[0]] - table.time_us.min()) / 1e6
        out.say(
            f"object {name!r} has two rows at {when:g} s ({len(twice)} such rows): rows are"
            " repeated, or one id names two objects",
            "leave repeated rows out, give objects ids of their own, and check the unit of time",
        )
        return False
    period = float(np.median(step))
    slow, fast = _RATES
    if 0.99 / fast <= period <= 1.01 / slow:
        return True
    column = table.columns.found.get("time")
    remedy = "check the unit of time: [units] time = 's', 'ms', 'us' or 'ns'"
    if column is not None and table.hz is None:
        units = UNITS["time"]
        for unit, factor in units.items():
            if 1.0 / fast <= period * factor / units[column.unit] <= 1.0 / slow:
                remedy = f"{column.name!r} looks like {unit}: [units] time = {unit!r}"
        if abs(period / (units[column.unit] / 1e6) - 1.0) < 1e-9:
            remedy += f"; if it counts frames: [columns] frame = {column.name!r}, and --hz"
    else:
        remedy = "check --hz, the number of frames per second"
    out.say(
        f"rows of an object are {period:g} s apart ({1.0 / period:g} Hz), need"
        f" {slow:g} … {fast:g} Hz",
        remedy,
    )
    return False


def _check_gaps(table: TrackTable, out: Doubts) -> None:
    stamps = np.unique(table.time_us)
    gaps = np.flatnonzero(np.diff(stamps) > _MAX_GAP * 1e6)
    if len(gaps):
        begin, end = (stamps[gaps[0] : gaps[0] + 2] - stamps[0]) / 1e6
        out.note(
            f"no object has a row between {begin:g} s and {end:g} s ({len(gaps)} such gaps of more"
            f" than {_MAX_GAP:g} s)",
            "no scenario reaches over it; if two recordings were joined, convert each by itself",
        )


def _check_jumps(motion: _Motion, same: BoolArray, out: Doubts) -> None:
    """Single rows that are far from their neighbours."""
    table = motion.table
    way = np.hypot(*np.diff(table.xy, axis=0).T)
    far = same & (way > _JUMP) & (way > _JUMP_SPEED * np.diff(motion.time))
    share = far.sum() / max(1, same.sum())
    out.figures["jumps"] = float(far.sum())
    if 0.0 < share < 0.01:
        row = int(np.flatnonzero(far)[0])
        name = table.track_ids[table.track[row]].item()
        out.say(
            f"object {name!r} jumps {way[row]:.1f} m within"
            f" {motion.time[row + 1] - motion.time[row]:g} s at {motion.time[row]:g} s ({far.sum()}"
            f" such jumps; more than {_JUMP_SPEED:g} m/s is no motion)",
            "one id names two objects, or a row is wrong: give objects ids of their own",
        )


def _check_speeds(motion: _Motion, out: Doubts) -> bool:
    speed = motion.speed[motion.is_vehicle]
    high, fastest = float(np.percentile(speed, 95)), float(speed.max())
    out.figures.update({"fastest_vehicle_mps": fastest})
    table = motion.table
    column = table.columns.found["x"]
    if high > _MAX_SPEED:
        units = UNITS["position"]
        fitting = [u for u, f in units.items() if 1 < high * f / units[column.unit] < 40]
        guess = (
            f": they look like {fitting[0]}: [units] position = {fitting[0]!r}" if fitting else ""
        )
        out.say(
            f"vehicles move at {high:.4g} m/s (95 % of the rows are slower), at most {_MAX_SPEED:g}"
            " m/s is possible",
            f"check the units of positions and time{guess}",
        )
        return False
    if fastest < _LEAST_SPEED:
        spread = float((table.xy.max(axis=0) - table.xy.min(axis=0)).max())
        remedy = "check the units of positions and time; an ego must move"
        if _LEAST_SPEED < fastest * UNITS["position"]["km"] < _MAX_SPEED:
            remedy = "positions look like kilometres: [units] position = 'km'"
        elif _LEAST_SPEED < fastest * _DEGREE < _MAX_SPEED and np.abs(table.xy).max() <= 360.0:
            remedy = (
                "positions look like degrees of longitude and latitude: project them to the metric"
                " frame of the map (pyproj)"
            )
        out.say(
            f"no vehicle is faster than {fastest:.3g} m/s, and all positions are within"
            f" {spread:.3g} m; an ego must reach {_LEAST_SPEED:g} m/s",
            remedy,
        )
        return False
    return True


def _check_fit(fit: Fit, columns: Columns, min_share: float, out: Doubts) -> None:
    if fit.is_good:
        return
    if fit.share < min_share:
        what = (
            f"only {fit.share:.0%} of the moving vehicles are on drivable area, need"
            f" {min_share:.0%}"
        )
    else:
        what = (
            f"only {fit.along:.0%} of the moving vehicles drive along the lane they are on, need"
            f" {fit.min_along:.0%}"
        )
    if fit.best is None:
        out.say(
            what,
            "no other unit, axis or origin fits better: give the map of this place, and check that"
            " it is of this recording",
        )
        return
    x, y = columns.found["x"].name, columns.found["y"].name
    remedy = ", and ".join(fit.best.remedies(x, y))
    out.say(f"{what}; {fit.best.share:.0%} {fit.best.words}", f"in a TOML file: {remedy}")


def _usual(length: float, width: float) -> bool:
    return _LENGTHS[0] <= length <= _LENGTHS[1] and _WIDTHS[0] <= width <= _WIDTHS[1]


def _has_usual_sizes(motion: _Motion) -> bool:
    return motion.vehicle_size is not None and _usual(*motion.vehicle_size)


def _velocities_fit(motion: _Motion) -> bool:
    stored, rows = motion.table.velocities, motion.rows(_FAST)
    if stored is None or not len(rows):
        return False
    wrong = contradicting(stored, motion.derived, motion.time, motion.table.track)
    return bool(wrong[motion.table.track[rows]].mean() <= _LEAST_CONTRADICTING)


def _check_sizes(motion: _Motion, out: Doubts) -> None:
    if motion.vehicle_size is None:
        return
    length, width = motion.vehicle_size
    out.figures.update({"median_length_m": length, "median_width_m": width})
    columns = motion.table.columns.found
    names = columns["length"].name, columns["width"].name

    if _usual(length, width):
        return
    remedy = "check the unit and the columns of length and width"
    units = UNITS["size"]
    for unit, factor in units.items():
        scale = factor / units[columns["length"].unit]
        if _usual(length * scale, width * scale):
            remedy = f"they look like {unit}: [units] size = {unit!r}"
        elif _usual(width * scale, length * scale):
            remedy = (
                f"length and width look swapped: [columns] length = {names[1]!r}, width ="
                f" {names[0]!r}" + ("" if scale == 1 else f", [units] size = {unit!r}")
            )
    if _usual(2.0 * length, 2.0 * width):
        remedy = "these look like halves (extents from the middle): write whole lengths and widths"
    out.say(
        f"the median vehicle is {length:.3g} m long and {width:.3g} m wide, need"
        f" {_LENGTHS[0]:g} … {_LENGTHS[1]:g} m and {_WIDTHS[0]:g} … {_WIDTHS[1]:g} m",
        remedy,
    )


def _check_headings(motion: _Motion, fit: Fit, out: Doubts) -> None:
    rows = motion.rows(_FAST)
    if motion.table.headings is None or not len(rows):
        return
    column = motion.table.columns.found["heading"]
    way = fit.turned(motion.derived[rows])
    along = np.arctan2(way[:, 1], way[:, 0])
    heading = motion.table.headings[rows]
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
        out.say(
            f"headings differ from the direction of motion by {errors['']:.2f} rad in the middle of"
            f" {len(rows)} rows, at most {_MAX_HEADING:g} rad",
            best if fits else f"no other unit or axis fits; {leave_out}",
        )
        return
    backwards = float((np.abs(wrap_angles(heading - along)) > np.pi / 2).mean())
    out.figures["backwards_share"] = backwards
    if backwards > _MAX_BACKWARDS:
        out.say(
            f"in {backwards:.0%} of the rows the heading points against the motion, at most"
            f" {_MAX_BACKWARDS:.0%}",
            f"some objects are turned by half a turn; {leave_out}",
        )


def _check_velocities(motion: _Motion, fit: Fit, out: Doubts) -> None:
    stored, table = motion.table.velocities, motion.table
    rows = motion.rows(_FAST)
    if stored is None or not len(rows):
        return
    moving = np.unique(table.track[rows])
    derived = fit.turned(motion.derived)
    wrong = contradicting(stored, derived, motion.time, table.track)[moving]
    out.figures["contradicting_share"] = float(wrong.mean())
    rows = rows[np.isfinite(stored[rows]).all(axis=1)]
    rows = rows[np.isin(table.track[rows], moving[wrong])]
    if not len(rows) or wrong.mean() <= _LEAST_CONTRADICTING:
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
    if not (is_known or is_uniform) and wrong.mean() <= _MAX_CONTRADICTING:
        return
    if is_uniform and not is_known and table.hz is not None:
        remedy = (
            f"--hz looks too {'small' if ratio > 1 else 'large'} by {ratio:.3g}; or {leave_out}"
        )
    out.say(
        f"velocities ({', '.join(names)}) contradict the positions in {wrong.mean():.0%} of the"
        f" moving vehicles: the speeds are {ratio:.3g} times those of the positions",
        remedy,
    )


def _check_reference(motion: _Motion, out: Doubts) -> None:
    """Which point of a vehicle the positions are: it slides sideways in turns, unless at the axle.

    A point d ahead of the rear axle moves sideways with d times the yaw rate.
    """
    table = motion.table
    if table.headings is None or table.sizes is None or table.columns.reference:
        return
    turning = np.zeros((len(table.track), 2))
    same = np.r_[False, np.diff(table.track) == 0]
    step = np.where(same, wrap_angles(np.r_[0.0, np.diff(table.headings)]), 0.0)
    turning[:, 0] = np.cumsum(step)
    rate = fitted_velocities(turning, motion.time, table.track, motion.period)[:, 0]
    cos, sin = np.cos(table.headings), np.sin(table.headings)
    sideways = motion.derived[:, 1] * cos - motion.derived[:, 0] * sin
    used = motion.is_vehicle & (np.abs(rate) > _TURNING) & (motion.speed > _FAST)
    number = len(table.track_ids)
    weight = np.bincount(table.track[used], rate[used] ** 2, number)
    moment = np.bincount(table.track[used], (sideways * rate)[used], number)
    turn = np.bincount(table.track[used], np.abs(rate[used]) * motion.period, number)
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
    out.say(
        f"in turns the positions move like a point {place:+.2f} lengths ahead of the rear axle; the"
        f" middle of a box is at {low:+.2f} … {high:+.2f}",
        f"they look like the {name} of the vehicles: reference = {name!r} in a TOML file; if they"
        " are the middle: reference = 'center'",
    )


def _median(values: FloatArray) -> float:
    return float(np.median(values))
