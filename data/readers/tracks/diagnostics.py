"""What cannot be right about a table of tracks, recognised by what it does, and the remedy.

A wrong unit, axis, order or origin shows in how objects move, in their sizes, and in where they are
on the map. Every explanation that is known is tried; the one that makes the numbers fit is named.
"""

import numpy as np

from shiftsim.data.readers.build import find_pause, find_twice
from shiftsim.data.readers.codes import KINDS
from shiftsim.data.readers.motion import FAST, contradiction
from shiftsim.data.readers.tracks import axes
from shiftsim.data.readers.tracks.axes import MIN_ALONG, Fit, fit_map
from shiftsim.data.readers.tracks.table import TrackTable
from shiftsim.errors import listed
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind

_RATES = (2.0, 100.0)  # Hz
_MAX_SPEED = 60.0  # m/s, of 95 % of the vehicles' rows
_LEAST_SPEED = 1.0  # m/s, of the fastest vehicle
_MOVING = 1.0  # m/s
_MAX_GAP = 1.0  # s without a row of any object
_LEAST_OBJECTS = 5  # that begin at once
_DEGREE = 1e5  # m, about
_JUMP_SPEED, _JUMP = 100.0, 5.0  # m/s and m between two rows of an object
# m, m/s²: how much farther than by its speed before or after an object may get; 1.9 m in real logs
_LEAP, _GAIN = 2.5, 10.0
_LENGTHS, _WIDTHS = (2.8, 9.0), (1.3, 2.9)  # m, of the median vehicle
_LONGEST, _WIDEST = 60.0, 12.0  # m, of any object
_LONGEST_WALKER = 2.0  # m, median of pedestrians
_WALKING = (0.85, 2.1)  # m/s, of the median pedestrian; about 1.35 m/s everywhere
_LEAST_WALKERS, _LEAST_WALK = 5, 4.0  # pedestrians that walk, and m that each of them must walk
_ACCELERATION_S, _MAX_ACCELERATION = 0.5, 6.0  # s; m/s², of half of the moving vehicles' rows
_MAX_OVERSPEED = 1.6  # of the speed limit, of nine tenths of the rows


def diagnose(table: TrackTable, road: VectorMap, min_share: float) -> axes.Diagnostics:
    """Everything that cannot be right; `min_share` of the moving vehicles must be on the map."""
    out = axes.Diagnostics()
    for check in (_check_kinds, _check_times, _check_jumps, _check_speeds):
        if not check(table, out):  # what follows would mean nothing
            return out
    _check_gaps(table, out)
    _check_starts(table, out)
    fit = _check_map(table, road, min_share, out)
    _check_accelerations(table, out)
    _check_walkers(table, out)
    _check_sizes(table, out)
    axes.check_headings(table, fit, out)
    axes.check_velocities(table, fit, out)
    if not out.errors:
        axes.check_reference(table, out)
    return out


def _check_kinds(table: TrackTable, out: axes.Diagnostics) -> bool:
    """Whether all kinds are known, and one is a vehicle."""
    used = [table.categories[code] for code in np.unique(table.category).tolist()]
    if unknown := [name[:40] for name in used if name not in KINDS]:
        out.error(
            f"kinds {listed([*map(repr, unknown)])} are unknown",
            f"say what they are in a TOML file for --columns: [kinds] {unknown[0]!r} = 'car';"
            f" known are {', '.join(sorted(KINDS))}",
        )
    elif not table.is_vehicle.any():
        out.error(
            f"none of the {len(table.track_ids)} objects is a vehicle, so none can be the ego:"
            f" kinds {', '.join(map(repr, used))}",
            "check the column of kinds, or map them: [kinds]",
        )
    return not out.errors


def _check_times(table: TrackTable, out: axes.Diagnostics) -> bool:
    """Whether the motion of objects can be determined at all."""
    slow, fast = _RATES
    period, column = table.period, table.columns.found.get("time")

    def is_usual(period: float) -> bool:
        return 0.99 / fast <= period <= 1.01 / slow

    if len(table.ends) == len(table.track) + 1:
        out.error(
            f"each of the {len(table.track_ids)} objects has one row only",
            "check the column of ids: an object needs the same id in all its rows",
        )
    elif fault := find_twice(table.track_ids, table.track, table.time):
        out.error(*fault)
    elif is_usual(period):
        if fault := find_pause(table.time_us):
            out.error(*fault)
    else:
        remedy = "check --hz, the number of frames per second"
        if column is not None and table.hz is None:
            remedy = "check the unit of time: [units] time = 's', 'ms', 'us' or 'ns'"
            for unit, factor in table.columns.unit_factors("time").items():
                if is_usual(period * factor):
                    remedy = f"{column.name!r} looks like {unit}: [units] time = {unit!r}"
            if abs(period * 1e6 / column.factor("time") - 1.0) < 1e-9:
                remedy += f"; if it counts frames: [columns] frame = {column.name!r}, and --hz"
        out.error(
            f"rows of an object are {period:g} s apart ({1.0 / period:g} Hz), need"
            f" {slow:g} … {fast:g} Hz",
            remedy,
        )
    return not out.errors


def _check_jumps(table: TrackTable, out: axes.Diagnostics) -> bool:
    """Steps that no motion explains, or not that beside them; whether speeds mean anything then."""
    same = np.diff(table.track) == 0
    step, way = np.diff(table.time), np.hypot(*np.diff(table.xy, axis=0).T)
    far = np.flatnonzero(same & (way > _JUMP) & (way > _JUMP_SPEED * step))
    out.figures["jumps"] = float(len(far))
    speed = np.divide(way, step, out=np.full(len(way), np.inf), where=same)
    if not len(far):
        own = np.minimum(np.r_[np.inf, speed[:-1]], np.r_[speed[1:], np.inf])[same]
        usual = own * step[same] + _GAIN * step[same] ** 2
        rows = np.flatnonzero(same)[way[same] - usual > _LEAP]
        for row in rows[:1].tolist():
            out.warn(
                f"object {table.name_of(row)} moves {way[row]:.1f} m within {step[row]:g} s at"
                f" {table.time[row]:g} s, farther than its speed before and after explains"
                f" ({len(rows)} such steps)",
                "swapped ids, or a wrong row: give objects ids of their own, or leave the row out",
            )
        return True
    if np.median(speed[same & (speed > _MOVING)]) > _MAX_SPEED:
        return True  # all do: a matter of units
    remedy = "one id names two objects, or a row is wrong: give objects ids of their own"
    for axis, places in zip("xy", table.xy[far + 1].T, strict=True):
        values, counts = np.unique(places, return_counts=True)
        if counts.max() > 0.2 * len(far) and len(far) > 10:
            remedy = (
                f"many of them lead to {axis} = {values[counts.argmax()]:g} m, which looks like a"
                " place that is not known: leave these rows out"
            )
    row = far[0]
    out.error(
        f"object {table.name_of(row)} jumps {way[row]:.1f} m within {step[row]:g} s at"
        f" {table.time[row]:g} s ({len(far)} such jumps; more than {_JUMP_SPEED:g} m/s is no"
        " motion)",
        remedy,
    )
    return len(far) < 0.01 * int(same.sum())


def _check_speeds(table: TrackTable, out: axes.Diagnostics) -> bool:
    speed = table.speed[table.is_vehicle]
    high, fastest = float(np.percentile(speed, 95)), float(speed.max())
    out.figures["fastest_vehicle_mps"] = fastest
    if high > _MAX_SPEED:
        factors = table.columns.unit_factors("x")
        fitting = [unit for unit, factor in factors.items() if 1 < high * factor < 40]
        guess = "".join(f": they look like {u}: [units] position = {u!r}" for u in fitting[:1])
        out.error(
            f"vehicles move at {high:.4g} m/s (95 % of the rows are slower), at most {_MAX_SPEED:g}"
            " m/s is possible",
            f"check the units of positions and time{guess}",
        )
        return False
    if fastest >= _LEAST_SPEED:
        return True
    remedy = "check the units of positions and time; an ego must move"
    if _LEAST_SPEED < fastest * 1000.0 < _MAX_SPEED:
        remedy = "positions look like kilometres: [units] position = 'km'"
    elif _LEAST_SPEED < fastest * _DEGREE < _MAX_SPEED and np.abs(table.xy).max() <= 360.0:
        remedy = (
            "positions look like degrees of longitude and latitude: project them to the metric"
            " frame of the map (pyproj)"
        )
    out.error(
        f"no vehicle is faster than {fastest:.3g} m/s, and all positions are within"
        f" {np.ptp(table.xy, axis=0).max():.3g} m; an ego must reach {_LEAST_SPEED:g} m/s",
        remedy,
    )
    return False


def _check_gaps(table: TrackTable, out: axes.Diagnostics) -> None:
    stamps = np.unique(table.time_us) / 1e6
    gaps = np.diff(stamps)
    if gaps.max() > _MAX_GAP:
        begin, end = stamps[gaps.argmax() :][:2] - stamps[0]
        out.warn(
            f"no object has a row between {begin:g} s and {end:g} s"
            f" ({np.count_nonzero(gaps > _MAX_GAP)} such gaps of more than {_MAX_GAP:g} s)",
            "no scenario reaches over it; if two recordings were joined, convert each by itself",
        )


def _check_starts(table: TrackTable, out: axes.Diagnostics) -> None:
    """Objects that all begin at once and end one after another."""
    first, last = table.time[table.ends[:-1]], table.time[table.ends[1:] - 1]
    vanish = (last < last.max() - 1.0).mean()
    if len(first) >= _LEAST_OBJECTS and first.max() == 0.0 and vanish > 0.5:
        out.warn(
            f"all {len(first)} objects appear at the first time, none later, and {vanish:.0%} of"
            " them are gone before the last second",
            "if time counts from the first sight of each object, give one clock for all",
        )


def _check_map(table: TrackTable, road: VectorMap, min_share: float, out: axes.Diagnostics) -> Fit:
    """Whether vehicles are on the map, and as fast as its limits allow."""
    stored, moving = table.velocities, table.moving_rows(_MOVING)
    fast = table.moving_rows(FAST)
    # another unit of length would show elsewhere, too
    is_metric = table.vehicle_size is not None and _is_usual(*table.vehicle_size)
    if is_metric := is_metric and len(fast) > 0 and bool(np.isfinite(stored).any()):
        wrong, _ = contradiction(stored, table.derived, table.time, table.track)
        is_metric = bool(wrong[table.track[fast]].mean() <= axes.LEAST_CONTRADICTING)
    fit = fit_map(road, table.xy[moving], table.derived[moving], min_share, only_metres=is_metric)
    out.figures |= {"drivable_share": fit.share, "along_share": fit.along}
    if fit.is_good:
        if fit.overspeed > _MAX_OVERSPEED:
            out.figures["overspeed"] = fit.overspeed
            out.warn(
                f"a tenth of the moving vehicles is {fit.overspeed:.2g} times as fast as the speed"
                f" limit of their lane or faster, usual is less than {_MAX_OVERSPEED:g}",
                "check --hz or the unit of time, unless the limits of the map are wrong",
            )
        return fit
    what, share, least = "drive along the lane they are on", fit.along, MIN_ALONG
    if fit.share < min_share:
        what, share, least = "are on drivable area", fit.share, min_share
    what = f"only {share:.0%} of the moving vehicles {what}, need {least:.0%}"
    remedy = (
        "no other unit, axis or origin fits better: give the map of this place, and check that it"
        " is of this recording"
    )
    if fit.best is not None:
        what += f"; {fit.best.share:.0%} {fit.best.words}"
        names = (table.columns.found[axis].words for axis in "xy")
        remedy = f"in a TOML file: {', and '.join(fit.best.remedies(*names))}"
    out.error(what, remedy)
    return fit


def _check_accelerations(table: TrackTable, out: axes.Diagnostics) -> None:
    """Along and across, over half a second: three times too fast they are nine times as large."""
    time, rows = table.time, table.moving_rows(FAST)
    after = np.minimum(rows + max(1, round(_ACCELERATION_S / table.period)), len(time) - 1)
    used = (table.track[after] == table.track[rows]) & (time[after] > time[rows])
    used &= time[after] < time[rows] + 2.0 * max(_ACCELERATION_S, table.period)
    rows, after = rows[used], after[used]
    if not len(rows):
        return
    change = table.derived[after] - table.derived[rows]
    usual = float(np.median(np.hypot(*change.T) / (time[after] - time[rows])))
    out.figures["acceleration_mps2"] = usual
    if usual > _MAX_ACCELERATION:
        out.error(
            f"moving vehicles accelerate, brake and turn with {usual:.2g} m/s² in the middle of"
            f" {len(rows)} rows, at most {_MAX_ACCELERATION:g} m/s²",
            "check --hz or the unit of time; positions that jitter need smoothing",
        )


def _check_walkers(table: TrackTable, out: axes.Diagnostics) -> None:
    """How fast pedestrians walk while they do, the same whatever a clock counts."""
    is_walker = table.is_of(AgentKind.PEDESTRIAN)[table.ends[:-1]]
    speeds = []
    for first, stop in zip(table.ends[:-1][is_walker], table.ends[1:][is_walker], strict=True):
        if np.hypot(*(table.xy[stop - 1] - table.xy[first])) > _LEAST_WALK:
            speed = table.speed[first:stop]
            speeds.append(np.median(speed[speed > 0.5 * np.percentile(speed, 90)]))
    if len(speeds) < _LEAST_WALKERS:
        return
    walking = out.figures["walking_mps"] = float(np.median(speeds))
    if not _WALKING[0] <= walking <= _WALKING[1]:
        out.warn(
            f"the median pedestrian walks with {walking:.2g} m/s, usual is {_WALKING[0]:g} …"
            f" {_WALKING[1]:g} m/s",
            "check --hz or the unit of time, and the column of kinds",
        )


def _is_usual(length: float, width: float) -> bool:
    return _LENGTHS[0] <= length <= _LENGTHS[1] and _WIDTHS[0] <= width <= _WIDTHS[1]


def _check_sizes(table: TrackTable, out: axes.Diagnostics) -> None:
    sizes = table.sizes
    large = np.flatnonzero((sizes[:, 0] > _LONGEST) | (sizes[:, 1] > _WIDEST))
    if 0 < len(large) < 0.5 * len(sizes):
        row = large[0]
        out.error(
            f"object {table.name_of(row)} is {sizes[row, 0]:.4g} m long and {sizes[row, 1]:.4g} m"
            f" wide ({len(large)} rows), at most {_LONGEST:g} m and {_WIDEST:g} m",
            "correct its size, or leave it empty for the usual one of its kind",
        )
    if len(rows := np.flatnonzero((sizes < 0.0).any(axis=1))):
        row, count = rows[0], "all" if len(rows) == len(sizes) else len(rows)
        out.error(
            f"{count} lengths and widths are negative, the first {np.nanmin(sizes[row]):g} m, of"
            f" object {table.name_of(row)} at {table.time[row]:g} s",
            "turn the signs: [columns] length = '-NAME', width = '-NAME'; or leave the columns out,"
            " or cells that are not known empty",
        )
    lengths = sizes[table.is_of(AgentKind.PEDESTRIAN), 0]
    lengths = lengths[lengths > 0.0]
    if len(lengths) and np.median(lengths) > _LONGEST_WALKER:
        out.error(
            f"the median pedestrian is {np.median(lengths):.3g} m long, at most"
            f" {_LONGEST_WALKER:g} m",
            "check the column of kinds; or leave sizes that are not known empty",
        )
    if table.vehicle_size is None:
        return
    length, width = table.vehicle_size
    out.figures |= {"median_length_m": length, "median_width_m": width}
    if _is_usual(length, width):
        return
    remedy = "check the unit and the columns of length and width"
    for unit, scale in table.columns.unit_factors("length").items():
        if _is_usual(length * scale, width * scale):
            remedy = f"they look like {unit}: [units] size = {unit!r}"
        elif _is_usual(width * scale, length * scale):
            names = [table.columns.found[role].name for role in ("width", "length")]
            remedy = "length and width look swapped: [columns] length = {!r}, width = {!r}"
            remedy = remedy.format(*names) + f", [units] size = {unit!r}" * (scale != 1.0)
            remedy += "; where x and y are a corner of the box, reference = 'corner' too"
    if _is_usual(2.0 * length, 2.0 * width):
        remedy = "these look like halves (extents from the middle): write whole lengths and widths"
    out.error(
        f"the median vehicle is {length:.3g} m long and {width:.3g} m wide, need"
        f" {_LENGTHS[0]:g} … {_LENGTHS[1]:g} m and {_WIDTHS[0]:g} … {_WIDTHS[1]:g} m",
        remedy,
    )
