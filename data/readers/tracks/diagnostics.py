"""What cannot be right about a table of tracks, recognised by what it does, and the remedy.

A wrong unit, axis, order or origin shows in how objects move, in their sizes, and in where they are
on the map. Every explanation that is known is tried; the one that makes the numbers fit is named.
"""

import numpy as np

from shiftsim.data.readers.build import find_pause, find_twice
from shiftsim.data.readers.codes import KINDS
from shiftsim.data.readers.motion import contradiction
from shiftsim.data.readers.tracks.axes import check_headings, check_reference, check_velocities
from shiftsim.data.readers.tracks.columns import UNITS, Columns
from shiftsim.data.readers.tracks.map_fit import MIN_ALONG, Fit, fit_map
from shiftsim.data.readers.tracks.statistics import (
    FAST,
    LEAST_CONTRADICTING,
    Diagnostics,
    TrackStatistics,
)
from shiftsim.data.readers.tracks.table import TrackTable
from shiftsim.kernels import BoolArray
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
_LENGTHS, _WIDTHS = (2.8, 9.0), (1.3, 2.9)  # m, of the median vehicle
_LONGEST, _WIDEST = 60.0, 12.0  # m, of any object
_LONGEST_WALKER = 2.0  # m, median of pedestrians
_WALKING = (0.85, 2.1)  # m/s, of the median pedestrian; about 1.35 m/s everywhere
_LEAST_WALKERS, _LEAST_WALK = 5, 4.0  # pedestrians that walk, and m that each of them must walk
_ACCELERATION_S, _MAX_ACCELERATION = 0.5, 6.0  # s; m/s², of half of the moving vehicles' rows
_MAX_OVERSPEED = 1.6  # of the speed limit, of nine tenths of the rows


def diagnose(table: TrackTable, road: VectorMap, min_share: float) -> Diagnostics:
    """Everything that cannot be right; `min_share` of the moving vehicles must be on the map."""
    out = Diagnostics()
    used = np.unique(table.category).tolist()
    if unknown := [
        name for i, name in enumerate(table.categories) if i in used and name not in KINDS
    ]:
        names = ", ".join(repr(name[:40]) for name in unknown[:8])
        out.error(
            f"kinds {names} are unknown",
            f"say what they are in a TOML file for --columns: [kinds] {unknown[0][:40]!r} = 'car';"
            f" known are {', '.join(sorted(KINDS))}",
        )
        return out
    time = (table.time_us - table.time_us.min()) / 1e6
    same = np.diff(table.track) == 0
    step = np.diff(table.time_us)[same] / 1e6
    stats = TrackStatistics(table, time, float(np.median(step)) if len(step) else 0.0)
    if not stats.is_vehicle.any():
        out.error(
            f"none of the {len(table.track_ids)} objects is a vehicle, so none can be the ego:"
            f" kinds {', '.join(map(repr, table.categories))}",
            "check the column of kinds, or map them: [kinds]",
        )
        return out
    if not _check_times(stats, out):
        return out
    if not (_check_jumps(stats, same, out) and _check_speeds(stats, out)):
        return out
    moving = stats.rows(_MOVING)
    _check_gaps(table, out)
    _check_starts(stats, out)
    # another unit of length would show elsewhere, too
    is_metric = _has_usual_sizes(stats) and _velocities_fit(stats)
    fit = fit_map(road, table.xy[moving], stats.derived[moving], min_share, only_metres=is_metric)
    out.figures.update({"drivable_share": fit.share, "along_share": fit.along})
    _check_fit(fit, table.columns, min_share, out)
    if fit.is_good and fit.overspeed > _MAX_OVERSPEED:
        out.figures["overspeed"] = fit.overspeed
        out.warn(
            f"a tenth of the moving vehicles is {fit.overspeed:.2g} times as fast as the speed"
            f" limit of their lane or faster, usual is less than {_MAX_OVERSPEED:g}",
            "check --hz or the unit of time, unless the limits of the map are wrong",
        )
    _check_accelerations(stats, out)
    _check_walkers(stats, out)
    _check_sizes(stats, out)
    check_headings(stats, fit, out)
    check_velocities(stats, fit, out)
    if not out.errors:
        check_reference(stats, out)
        out.derived = stats.derived
    return out


def _check_times(stats: TrackStatistics, out: Diagnostics) -> bool:
    """Whether the motion of objects can be determined at all."""
    table, period = stats.table, stats.period
    if len(stats.ends) == len(table.track) + 1:
        out.error(
            f"each of the {len(table.track_ids)} objects has one row only",
            "check the column of ids: an object needs the same id in all its rows",
        )
        return False
    if fault := find_twice(table.track_ids, table.track, table.time_us):
        out.error(*fault)
        return False
    slow, fast = _RATES
    if 0.99 / fast <= period <= 1.01 / slow:
        if fault := find_pause(table.time_us):
            out.error(*fault)
        return fault is None
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
    out.error(
        f"rows of an object are {period:g} s apart ({1.0 / period:g} Hz), need"
        f" {slow:g} … {fast:g} Hz",
        remedy,
    )
    return False


def _check_gaps(table: TrackTable, out: Diagnostics) -> None:
    stamps = np.unique(table.time_us) / 1e6
    gaps = np.diff(stamps)
    if gaps.max() > _MAX_GAP:
        begin, end = stamps[gaps.argmax() :][:2] - stamps[0]
        out.warn(
            f"no object has a row between {begin:g} s and {end:g} s"
            f" ({np.count_nonzero(gaps > _MAX_GAP)} such gaps of more than {_MAX_GAP:g} s)",
            "no scenario reaches over it; if two recordings were joined, convert each by itself",
        )


def _check_starts(stats: TrackStatistics, out: Diagnostics) -> None:
    """Objects that all begin at once and end one after another."""
    first, last = stats.time[stats.ends[:-1]], stats.time[stats.ends[1:] - 1]
    vanish = (last < last.max() - 1.0).mean()
    if len(first) >= _LEAST_OBJECTS and first.max() == 0.0 and vanish > 0.5:
        out.warn(
            f"all {len(first)} objects appear at the first time, none later, and {vanish:.0%} of"
            " them are gone before the last second",
            "if time counts from the first sight of each object, give one clock for all",
        )


def _check_jumps(stats: TrackStatistics, same: BoolArray, out: Diagnostics) -> bool:
    """Single rows that are far from their neighbours; whether speeds mean anything beside them."""
    table = stats.table
    way = np.hypot(*np.diff(table.xy, axis=0).T)
    far = same & (way > _JUMP) & (way > _JUMP_SPEED * np.diff(stats.time))
    count = int(far.sum())
    out.figures["jumps"] = float(count)
    if not count:
        return True
    speed = way[same] / np.diff(stats.time)[same]
    if np.median(speed[speed > _MOVING]) > _MAX_SPEED:
        return True  # all do: a matter of units
    row = int(np.flatnonzero(far)[0])
    name = table.track_ids[table.track[row]].item()
    remedy = "one id names two objects, or a row is wrong: give objects ids of their own"
    ends = table.xy[np.flatnonzero(far) + 1]
    for axis, column in enumerate("xy"):
        values, counts = np.unique(ends[:, axis], return_counts=True)
        if counts.max() > 0.2 * count and count > 10:
            common = values[counts.argmax()]
            remedy = (
                f"many of them lead to {column} = {common:g} m, which looks like a place that is"
                " not known: leave these rows out"
            )
    out.error(
        f"object {name!r} jumps {way[row]:.1f} m within"
        f" {stats.time[row + 1] - stats.time[row]:g} s at {stats.time[row]:g} s ({count}"
        f" such jumps; more than {_JUMP_SPEED:g} m/s is no motion)",
        remedy,
    )
    return count < 0.01 * same.sum()


def _check_speeds(stats: TrackStatistics, out: Diagnostics) -> bool:
    speed = stats.speed[stats.is_vehicle]
    high, fastest = float(np.percentile(speed, 95)), float(speed.max())
    out.figures.update({"fastest_vehicle_mps": fastest})
    table = stats.table
    column = table.columns.found["x"]
    if high > _MAX_SPEED:
        units = UNITS["position"]
        fitting = [u for u, f in units.items() if 1 < high * f / units[column.unit] < 40]
        guess = (
            f": they look like {fitting[0]}: [units] position = {fitting[0]!r}" if fitting else ""
        )
        out.error(
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
        out.error(
            f"no vehicle is faster than {fastest:.3g} m/s, and all positions are within"
            f" {spread:.3g} m; an ego must reach {_LEAST_SPEED:g} m/s",
            remedy,
        )
        return False
    return True


def _check_accelerations(stats: TrackStatistics, out: Diagnostics) -> None:
    """Along and across, over half a second: three times too fast they are nine times as large."""
    track, time = stats.table.track, stats.time
    rows = stats.rows(FAST)
    after = np.minimum(rows + max(1, round(_ACCELERATION_S / stats.period)), len(time) - 1)
    used = (track[after] == track[rows]) & (time[after] > time[rows])
    used &= time[after] < time[rows] + 2.0 * max(_ACCELERATION_S, stats.period)
    rows, after = rows[used], after[used]
    if not len(rows):
        return
    change = stats.derived[after] - stats.derived[rows]
    usual = float(np.median(np.hypot(*change.T) / (time[after] - time[rows])))
    out.figures["acceleration_mps2"] = usual
    if usual > _MAX_ACCELERATION:
        out.error(
            f"moving vehicles accelerate, brake and turn with {usual:.2g} m/s² in the middle of"
            f" {len(rows)} rows, at most {_MAX_ACCELERATION:g} m/s²",
            "check --hz or the unit of time; positions that jitter need smoothing",
        )


def _check_walkers(stats: TrackStatistics, out: Diagnostics) -> None:
    """How fast pedestrians walk while they do, the same whatever a clock counts."""
    is_walker = stats.is_of(AgentKind.PEDESTRIAN)[stats.ends[:-1]]
    speeds = []
    for first, stop in zip(stats.ends[:-1][is_walker], stats.ends[1:][is_walker], strict=True):
        way = stats.table.xy[stop - 1] - stats.table.xy[first]
        if np.hypot(*way) > _LEAST_WALK:
            speed = stats.speed[first:stop]
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


def _check_fit(fit: Fit, columns: Columns, min_share: float, out: Diagnostics) -> None:
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
            f" {MIN_ALONG:.0%}"
        )
    if fit.best is None:
        out.error(
            what,
            "no other unit, axis or origin fits better: give the map of this place, and check that"
            " it is of this recording",
        )
        return
    x, y = columns.found["x"].name, columns.found["y"].name
    remedy = ", and ".join(fit.best.remedies(x, y))
    out.error(f"{what}; {fit.best.share:.0%} {fit.best.words}", f"in a TOML file: {remedy}")


def _usual(length: float, width: float) -> bool:
    return _LENGTHS[0] <= length <= _LENGTHS[1] and _WIDTHS[0] <= width <= _WIDTHS[1]


def _has_usual_sizes(stats: TrackStatistics) -> bool:
    return stats.vehicle_size is not None and _usual(*stats.vehicle_size)


def _velocities_fit(stats: TrackStatistics) -> bool:
    stored, rows = stats.table.velocities, stats.rows(FAST)
    if stored is None or not len(rows):
        return False
    wrong, _ = contradiction(stored, stats.derived, stats.time, stats.table.track)
    return bool(wrong[stats.table.track[rows]].mean() <= LEAST_CONTRADICTING)


def _check_sizes(stats: TrackStatistics, out: Diagnostics) -> None:
    sizes = stats.table.sizes
    if sizes is None:
        return
    large = np.flatnonzero((sizes[:, 0] > _LONGEST) | (sizes[:, 1] > _WIDEST))
    if 0 < len(large) < 0.5 * len(sizes):
        row = large[0]
        name = stats.table.track_ids[stats.table.track[row]].item()
        out.error(
            f"object {name!r} is {sizes[row, 0]:.4g} m long and {sizes[row, 1]:.4g} m wide"
            f" ({len(large)} rows), at most {_LONGEST:g} m and {_WIDEST:g} m",
            "correct its size, or leave it empty for the usual one of its kind",
        )
    if (sizes < 0.0).all():
        out.error(
            "all lengths and widths are negative",
            "turn the signs: [columns] length = '-NAME', width = '-NAME'; or leave the columns out",
        )
    lengths = sizes[stats.is_of(AgentKind.PEDESTRIAN), 0]
    lengths = lengths[lengths > 0.0]
    if len(lengths) and np.median(lengths) > _LONGEST_WALKER:
        out.error(
            f"the median pedestrian is {np.median(lengths):.3g} m long, at most"
            f" {_LONGEST_WALKER:g} m",
            "check the column of kinds; or leave sizes that are not known empty",
        )
    if stats.vehicle_size is None:
        return
    length, width = stats.vehicle_size
    out.figures.update({"median_length_m": length, "median_width_m": width})
    columns = stats.table.columns.found
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
    out.error(
        f"the median vehicle is {length:.3g} m long and {width:.3g} m wide, need"
        f" {_LENGTHS[0]:g} … {_LENGTHS[1]:g} m and {_WIDTHS[0]:g} … {_WIDTHS[1]:g} m",
        remedy,
    )
