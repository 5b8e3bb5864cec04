"""From columns of a source to `TrackSamples`: sorted, checked, with velocities and headings.

Rows may come in any order and at any rate, and every object may have times of its own. What cannot
be is an error; what can be repaired is repaired and counted.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from shiftsim.data.readers import motion
from shiftsim.data.readers.codes import CATEGORIES, KIND_NAMES, LARGE, SIZES
from shiftsim.data.readers.samples import ROW_S, ROW_US, TrackSamples, rows_between, sample_run
from shiftsim.errors import ConversionError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.state import AgentKind

MAX_PAUSE_S = 3600.0  # s without a row of any object within one recording
MAX_SPAN_S = 1e5  # s from the first row to the last one
_MAX_SPEED = 200.0  # m/s along an axis; a track with a faster row is not believed


class Frames(NamedTuple):
    """The frames of a recording, where its source lists them, those without objects included."""

    time_us: IntArray  # (F,) time stamps, ascending [us]
    clock: FloatArray  # (F,) time since the first one [s]
    period: float  # nominal time between frames [s]


# (A, 2) velocities by the positions and (N,) whether the stored ones of a track contradict them,
# from stored velocities, places, times, tracks and the period of the rows
VelocityRule = Callable[
    [FloatArray, FloatArray, FloatArray, IntArray, float], tuple[FloatArray, BoolArray]
]


def by_share_of_speed(
    stored: FloatArray, xy: FloatArray, time: FloatArray, track: IntArray, period: float
) -> tuple[FloatArray, BoolArray]:
    """The rule for tables: slopes of parabolas; errors of 10 % of the speed contradict."""
    derived = motion.fitted_velocities(xy, time, track, period)
    return derived, motion.contradiction(stored, derived, time, track)[0]


def make_samples(
    name: str,
    *,
    time_us: IntArray,  # (A,) time stamps [us]
    ids: Any,  # (A,) integers or texts that name the objects
    category: IntArray,  # (A,) index into `categories`
    categories: Sequence[str] = tuple(KIND_NAMES),  # by default `category` holds AgentKind codes
    xy: FloatArray,  # (A, 2) box centre [m]
    headings: FloatArray | None = None,  # (A,) [rad]; that of motion where not given, or NaN
    # (A, 2) in the frame of `xy` [m/s], NaN where unknown; derived from the positions where they
    # are not given, and for tracks where they contradict the positions
    velocities: FloatArray | None = None,
    # (A, 2 or 3) length, width, height [m], of which a track gets the median; the usual size of a
    # kind (`SIZES`) where it is not given, NaN or 0
    sizes: FloatArray | None = None,
    kind_of: Mapping[str, AgentKind] = CATEGORIES | KIND_NAMES,  # by name of a category
    frames: Frames | None = None,  # those of the rows; by default those at which there is one
    velocity_rule: VelocityRule = by_share_of_speed,  # which velocities are believed
    where: str = "",  # the file, for messages; the name of the recording by default
    remedy: str = "map it to one of",  # of an unknown category, before the list of those known
) -> TrackSamples:
    """A recording from its columns. A rows, one per object and time, in any order.

    Raises ConversionError: a value is not finite, a size negative, a category is unknown, an object
    has two rows at one time, nothing is seen for an hour, or the rows span more than a day.
    """
    where, warnings = where or name, Counter[str]()
    headings = np.full(len(xy), np.nan) if headings is None else headings
    velocities = np.full((len(xy), 2), np.nan) if velocities is None else velocities
    sizes = np.zeros((len(xy), 2)) if sizes is None else sizes
    wrong = {"position are not finite": ~np.isfinite(xy), "size are negative": sizes < 0.0}
    for what, is_bad in (wrong | {"heading are not finite": np.isinf(headings)}).items():
        if is_bad.any():
            first = f"the first in row {np.argwhere(is_bad)[0, 0]}"
            hint = "leave those rows out, or give NaN for a heading or size that is not known"
            raise ConversionError(f"{where}: {is_bad.sum()} values of {what}, {first}", hint)
    if frames is None and (len(time_us) < 2 or time_us.min() == time_us.max()):
        words = f"{where}: {len(time_us)} rows at one time"
        raise ConversionError(words, "give rows at two times or more")
    track_ids, track = index_ids(ids)
    order = np.lexsort((time_us, track))
    time_us, track, category, xy = time_us[order], track[order], category[order], xy[order]
    headings, velocities, sizes = headings[order], velocities[order], sizes[order]
    first_us = int(time_us.min() if frames is None else frames.time_us[0])
    fault = find_twice(track_ids, track, (time_us - first_us) / 1e6)
    if fault := fault or (find_pause(time_us) if frames is None else None):
        raise ConversionError(f"{where}: {fault[0]}", fault[1])
    if frames is None:
        stamps, step = np.unique(time_us), np.diff(time_us)[np.diff(track) == 0]
        period = float(np.median(step / 1e6)) if len(step) else ROW_S
        frames = Frames(stamps, (stamps - stamps[0]) / 1e6, period)
    frame = np.searchsorted(frames.time_us, time_us)
    time = frames.clock[frame]
    names = _track_categories(where, category, categories, track, kind_of, warnings, remedy)
    kinds = np.array([kind_of[category] for category in names], np.int64)
    derived, contradicts = velocity_rule(velocities, xy, time, track, frames.period)
    contradicts[track[(np.abs(velocities) > _MAX_SPEED).any(axis=1)]] = True
    velocities = motion.believed_velocities(velocities, derived, contradicts, track, warnings)
    if words := motion.beyond_turn(headings, velocities, time, track, track_ids):
        raise ConversionError(f"{where}: {words}", "give radians within ±pi: np.deg2rad(degrees)")
    raw = full_headings(headings, velocities, track, warnings)
    samples = TrackSamples(
        name=name,
        start_us=first_us,
        period=frames.period,
        clock=frames.clock,
        frame=frame,
        track=track,
        xy=xy,
        raw_headings=raw,
        headings=motion.held_headings(raw, velocities, time, track, warnings),
        velocities=velocities,
        track_ids=track_ids,
        categories=names,
        kinds=kinds,
        sizes=full_sizes(sizes, names, kinds, track, warnings),
        warnings=dict(+warnings),
    )
    if float(np.median(np.diff(frames.clock))) < 0.5 * frames.period:
        return _on_common_clock(samples)
    return samples


Fault = tuple[str, str] | None  # what is wrong, and the remedy


def find_pause(time_us: NDArray[Any]) -> Fault:
    """Times (A,) [us] that span too long, or with too long a pause: every row takes memory."""
    stamps = np.unique(time_us)
    first = int(np.diff(stamps).argmax())
    begin, end, span = ((stamps[[first, first + 1, -1]] - stamps[0]) / 1e6).tolist()
    if end - begin > MAX_PAUSE_S:
        return (
            f"no object has a row between {begin:g} s and {end:g} s, at most {MAX_PAUSE_S:g} s",
            "leave out rows with a wrong time; if the clock begins anew at midnight, add a day to"
            " the times after it; if two recordings were joined, convert each by itself",
        )
    if span > MAX_SPAN_S:
        return (
            f"the rows span {span:g} s, more than {MAX_SPAN_S:g} s",
            "leave out rows with a wrong time, check its unit, or convert parts by themselves",
        )
    return None


def find_twice(ids: NDArray[Any], track: IntArray, time: FloatArray) -> Fault:
    """Two rows of one object at one time [s]; rows (A,) are sorted by track and time."""
    twice = np.flatnonzero((np.diff(track) == 0) & (np.diff(time) == 0))
    if not len(twice):
        return None
    name, when = ids[track[twice[0]]].item(), time[twice[0]]
    return (
        f"object {name!r} has two rows at {when:g} s ({len(twice)} such rows): rows are repeated,"
        " or one id names two objects",
        "leave repeated rows out, give objects ids of their own, and check the unit of time",
    )


def _on_common_clock(samples: TrackSamples) -> TrackSamples:
    """The same recording with a row every 0.05 s, where objects have times of their own."""
    runs = samples.runs
    first, last = rows_between(samples.time[runs.first], samples.time[runs.last])
    # what is seen at an end of the recording is seen at its first or last row, too
    first[samples.time[runs.first] < samples.period] = 0
    at_end = samples.time[runs.last] > samples.duration - samples.period
    last[at_end] = int(samples.duration / ROW_S + 1e-9)
    long = np.flatnonzero(last >= first).tolist()
    rows = [np.arange(first[run], last[run] + 1) for run in long]
    parts = [sample_run(samples, run, row * ROW_S) for run, row in zip(long, rows, strict=True)]
    poses, velocities = map(np.concatenate, zip(*parts, strict=True))
    frame = np.concatenate(rows)
    track_of_row = np.repeat(runs.track[long], [len(row) for row in rows])
    present, track = np.unique(track_of_row, return_inverse=True)
    warnings = Counter(samples.warnings)
    lost = len(samples.track_ids) - len(present)
    warnings["tracks too short for a row every 0.05 s (left out)"] += lost
    return replace(
        samples,
        period=ROW_S,
        clock=np.arange(int(frame.max()) + 1) * ROW_US / 1e6,
        frame=frame,
        track=track,
        xy=np.ascontiguousarray(poses[:, :2]),
        raw_headings=poses[:, 2],
        headings=poses[:, 2],
        velocities=velocities,
        track_ids=samples.track_ids[present],
        categories=tuple(samples.categories[i] for i in present.tolist()),
        kinds=samples.kinds[present],
        sizes=samples.sizes[present],
        warnings=dict(+warnings),
    )


def index_ids(ids: Any) -> tuple[NDArray[Any], IntArray]:
    """Distinct ids, ascending, and (A,) the index of each row's among them.

    `ids` (A,) are integers or texts, as an array of numpy or a column of pyarrow.
    """
    column = ids if isinstance(ids, pa.ChunkedArray) else pa.chunked_array([pa.array(ids)])
    names, number = dictionary_codes(column)  # far faster than sorting texts
    distinct, rank = np.unique(names.to_numpy(zero_copy_only=False), return_inverse=True)
    return distinct.astype(str) if distinct.dtype == object else distinct, rank[number]


def dictionary_codes(column: pa.ChunkedArray) -> tuple[pa.Array, IntArray]:
    """The distinct values of a column, and (A,) the index of each row's; nulls get the last."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    encoded = column.unify_dictionaries().combine_chunks()
    encoded = encoded.chunk(0) if isinstance(encoded, pa.ChunkedArray) else encoded
    codes = encoded.indices.fill_null(len(encoded.dictionary))
    return encoded.dictionary, codes.to_numpy().astype(np.int64, copy=False)


def _track_categories(
    where: str,
    category: IntArray,
    names: Sequence[str],
    track: IntArray,
    known: Collection[str],
    warnings: Counter[str],
    remedy: str,
) -> tuple[str, ...]:
    """N most frequent category of every track, by (A,) indices of `names`; or a ConversionError."""
    pairs, votes = np.unique(track * len(names) + category, return_counts=True)
    voted_track, voted = np.divmod(pairs, len(names))
    first, num_voted = np.unique(voted_track, return_index=True, return_counts=True)[1:]
    warnings["tracks of changing category (most frequent taken)"] += int((num_voted > 1).sum())
    most = voted[np.lexsort((voted, -votes, voted_track))[first]]
    found = tuple(names[code] for code in most.tolist())
    if unknown := sorted(set(found) - set(known)):
        what = f"{where}: category {unknown[0]!r} is unknown"
        raise ConversionError(what, f"{remedy} {', '.join(sorted(known))}")
    return found


def full_headings(
    headings: FloatArray, velocities: FloatArray, track: IntArray, warnings: Counter[str]
) -> FloatArray:
    """(A,) headings; where not given the direction of motion, at standstill the last or next."""
    given = np.isfinite(headings)
    if given.all():
        return headings
    if given.any():
        warnings["rows without heading (direction of motion)"] += int((~given).sum())
    ways = np.where(given[:, None], motion.unit_vectors(headings), velocities)
    return np.where(given, headings, motion.headings_of_motion(ways, track, warnings))


def full_sizes(
    sizes: FloatArray,
    categories: Sequence[str],
    kinds: IntArray,
    track: IntArray,
    warnings: Counter[str],
) -> FloatArray:
    """(N, 2 or 3) median of the sizes of every track; where it has none, that of its category."""
    each = zip(categories, kinds.tolist(), strict=True)
    usual = np.array([LARGE.get(name) or SIZES[AgentKind(kind)] for name, kind in each])
    known = (sizes > 0.0).all(axis=1)  # rows without a size say nothing of it
    medians = motion.track_medians(sizes[known], track[known], len(usual))
    lacking = ~(medians > 0.0).all(axis=1)
    warnings["tracks without size (that of their kind)"] += int(lacking.sum())
    medians[lacking, :2] = usual[lacking]
    return medians
