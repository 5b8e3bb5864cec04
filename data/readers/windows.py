"""Windows of a recording, and which tracks may serve as ego.

A window is a span of time, whatever the frame rate (nuPlan rule 450). Each track seen in it gets a
verdict: `ego`, or the first rule it fails: category, presence, speed, overlap (later stages add
lane and route).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from shiftsim.data.readers.samples import ROW_S, TrackSamples, rows_of
from shiftsim.errors import ConfigError, one_of
from shiftsim.geometry.boxes import box_corners
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.world.ranges import SETTINGS

EGO, CATEGORY, PRESENCE, SPEED, OVERLAP = "ego", "category", "presence", "speed", "overlap"
LANE, ROUTE, GAP = "lane", "route", "route with a gap"
_EPS = 1e-9  # s


@dataclass(frozen=True)
class Span:
    """Where a window lies in a recording."""

    start_s: float  # start since the first frame [s]
    length_s: float  # length with the history [s]
    history_s: float  # part before iteration 0 [s]
    only: int = -1  # the one track that is asked for, whatever its category; -1 for all

    @property
    def is_short(self) -> bool:
        """Whether it is shorter than the benchmark's, so that scores do not compare."""
        return self.length_s < 18.0 or self.history_s < 3.0


@dataclass(frozen=True)
class ConversionConfig:
    """Every threshold of the conversion."""

    window_s: float = 18.0  # length of a window [s]
    overlap_s: float = 6.0  # overlap of consecutive windows [s]
    history_s: float = 3.0  # part of a window before iteration 0 [s]
    # history of constant velocity before the first frame of a recording, for recordings
    # too short to spare any [s]
    padding_s: float = 0.0
    ego_categories: tuple[str, ...] = ("car", "van", "pickup")  # categories that may serve as ego
    min_peak_speed: float = 1.0  # an ego must be faster than this at some frame [m/s]
    max_overlap: float = 0.01  # boxes may share this much area [m^2]
    max_hole_s: float = 0.5  # longest hole of a track that is filled [s]
    max_lane_distance: float = 3.0  # farthest lane an ego may start from [m]
    # largest angle between the ego and that lane at the start [rad]
    max_lane_angle: float = np.pi / 2
    route_extension: float = 100.0  # how far the route reaches beyond the last ego position [m]
    route_extension_blocks: int = 3  # how many blocks that may add
    min_drivable_share: float = 0.95  # share of moving vehicles that must be on drivable area
    # at most so many egos per window, in the order of track ids; None for all
    max_per_window: int | None = None
    country: str = "DE"  # whose default speed limits hold where the map has none
    # known category by category of the data set
    category_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for item in fields(self):
            _check_type(item.name, getattr(self, item.name))
        for name in ("window_s", "overlap_s", "history_s", "padding_s"):
            value = getattr(self, name)
            if not np.isfinite(value) or value < 0 or abs(rows_of(value) * ROW_S - value) > _EPS:
                raise ConfigError(f"{name} = {value!r} is not a multiple of {ROW_S} s, 0 or more")
        if self.overlap_s >= self.window_s:
            raise ConfigError(f"overlap_s {self.overlap_s!r} must be below window_s")
        if self.window_s - self.history_s < 0.3:
            less = f"leaves less than 0.3 s after history_s {self.history_s!r}"
            raise ConfigError(f"window_s {self.window_s!r} {less}")

    @property
    def is_short(self) -> bool:
        """Whether scenarios are shorter than the benchmark's, so that scores do not compare."""
        return Span(0.0, self.window_s, self.history_s).is_short


def make_config(values: Mapping[str, Any]) -> ConversionConfig:
    """Thresholds from plain values, such as those of a TOML file.

    Raises:
        ConfigError: A name is unknown, or a value is wrong.
    """
    for name in values:
        one_of("setting", name, [item.name for item in fields(ConversionConfig)])
    plain: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()}
    return ConversionConfig(**plain)


def _check_type(name: str, value: Any) -> None:
    """Types are checked strictly: TOML and Python callers get the same message."""
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    special: dict[str, tuple[bool, str]] = {
        "ego_categories": (isinstance(value, tuple) and _are_texts(*value), "a list of names"),
        "category_map": (
            isinstance(value, dict) and _are_texts(*value, *value.values()),
            "a table of names",
        ),
        "country": (_are_texts(value), "a name"),
        "route_extension_blocks": (is_integer and value >= 0, "an integer from 0 on"),
        "max_per_window": (value is None or (is_integer and value > 0), "an integer from 1 on"),
    }
    is_number = (is_integer or isinstance(value, float)) and 0 <= value < np.inf
    is_good, wanted = special.get(name, (is_number, "a number from 0 on"))
    if not is_good:
        raise ConfigError(f"{name} is {value!r}; it must be {wanted}")
    if name in SETTINGS and value is not None and not SETTINGS[name].holds(float(value)):
        raise ConfigError(f"{name} is {value!r}; it must be within {SETTINGS[name]}")


def _are_texts(*values: object) -> bool:
    return all(isinstance(value, str) for value in values)


@dataclass(frozen=True)
class WindowVerdicts:
    """What became of every track seen in one window. n tracks."""

    span: Span  # the window
    tracks: IntArray  # (n,) tracks, ascending
    runs: IntArray  # (n,) run that covers the whole window, -1 where none does
    verdicts: tuple[str, ...]  # n names of a rule, or `ego`


def window_spans(duration: float, config: ConversionConfig) -> list[Span]:
    """Every window that fits into a recording [s]."""
    stride = config.window_s - config.overlap_s
    count = int(np.floor((duration - config.window_s) / stride + _EPS)) + 1
    return [
        Span(float(number) * stride, config.window_s, config.history_s)
        for number in range(max(count, 0))
    ]


def evaluate_windows(
    recording: TrackSamples, config: ConversionConfig, spans: Sequence[Span]
) -> list[WindowVerdicts]:
    """The verdict on every track in every window, rules of category to overlap."""
    clock, runs, num_tracks = recording.clock, recording.runs, len(recording.track_ids)
    is_ego_kind = np.array([name in config.ego_categories for name in recording.categories])
    speed = _median_of_three(  # nuPlan rule 452
        np.hypot(recording.velocities[:, 0], recording.velocities[:, 1]), recording.track
    )
    asked = is_ego_kind & any(span.only < 0 for span in spans)
    asked[[span.only for span in spans if span.only >= 0]] = True
    is_overlapping = overlap_partners(recording, asked, config.max_overlap) >= 0
    # where frames are missing at an end of the window, nobody is known to be there
    longest = config.max_hole_s + recording.period + _EPS
    out = []
    for span in spans:
        stop_s = span.start_s + span.length_s
        first, stop = np.searchsorted(clock, [span.start_s - _EPS, stop_s - _EPS]).tolist()
        rows = recording.by_frame[recording.frame_ptr[first] : recording.frame_ptr[stop]]
        allowed = is_ego_kind
        if span.only >= 0:
            allowed = np.arange(num_tracks) == span.only
            rows = rows[recording.track[rows] == span.only]
        track = recording.track[rows]
        tracks = np.unique(track)
        peak, is_hit = np.zeros(num_tracks), np.zeros(num_tracks, np.bool_)
        np.maximum.at(peak, track, speed[rows])
        is_hit[track[is_overlapping[rows]]] = True
        begin, end = clock[[min(first, len(clock) - 1), max(stop - 1, 0)]].tolist()
        is_known = begin - span.start_s <= longest and stop_s - end <= longest
        covering = (recording.frame[runs.first] <= first) & is_known
        covering &= recording.frame[runs.last] >= stop - 1
        run = np.full(num_tracks, -1, np.int64)
        run[runs.track[covering]] = np.flatnonzero(covering)
        verdict = np.select(
            [~allowed, run < 0, peak <= config.min_peak_speed, is_hit],
            [CATEGORY, PRESENCE, SPEED, OVERLAP],
            EGO,
        )
        out.append(WindowVerdicts(span, tracks, run[tracks], tuple(verdict[tracks].tolist())))
    return out


def overlap_partners(
    recording: TrackSamples, candidates: BoolArray, max_overlap: float
) -> IntArray:
    """(A,) a track whose box shares more than `max_overlap` [m^2] with the row's, -1 without one.

    nuPlan rule 451: with the recorded sizes, and tracks of all categories. Only rows of the
    `candidates` (N,) are looked at.
    """
    return _first_overlaps(
        recording.xy,
        recording.raw_headings,
        np.ascontiguousarray(recording.sizes[:, :2]),
        recording.track,
        recording.by_frame,
        recording.frame_ptr,
        candidates,
        max_overlap,
    )


def _median_of_three(values: FloatArray, track: IntArray) -> FloatArray:
    """Median of each row and its neighbours of the same track; the ends keep their value."""
    out = values.copy()
    inner = np.flatnonzero(track[2:] == track[:-2]) + 1
    before, here, after = values[inner - 1], values[inner], values[inner + 1]
    low, high = np.minimum(before, here), np.maximum(before, here)
    out[inner] = np.maximum(low, np.minimum(high, after))
    return out


@kernel
def _first_overlaps(
    centers: FloatArray,
    headings: FloatArray,
    sizes: FloatArray,
    track: IntArray,
    by_frame: IntArray,
    frame_ptr: IntArray,
    asked: BoolArray,
    max_overlap: float,
) -> IntArray:
    """(A,) first track in the same frame whose box shares more than `max_overlap` with the row's.

    Boxes are centers (A, 2 or 3), headings (A,) and the sizes (N, 2) of their tracks (A,);
    `by_frame` (A,) are the rows sorted by frame, `asked` (N,) the tracks looked at.
    """
    out = np.full(len(track), -1, np.int64)
    radius = 0.5 * np.hypot(sizes[:, 0], sizes[:, 1])
    ring, other = np.empty((4, 2)), np.empty((4, 2))
    for frame in range(len(frame_ptr) - 1):
        for first in range(frame_ptr[frame], frame_ptr[frame + 1]):
            i = by_frame[first]
            a = track[i]
            if not asked[a]:
                continue
            for second in range(frame_ptr[frame], frame_ptr[frame + 1]):
                j = by_frame[second]
                b = track[j]
                dx, dy = centers[j, 0] - centers[i, 0], centers[j, 1] - centers[i, 1]
                reach = radius[a] + radius[b]
                if j == i or dx * dx + dy * dy > reach * reach:
                    continue
                box_corners(0.0, 0.0, headings[i], sizes[a, 0], sizes[a, 1], ring)
                box_corners(dx, dy, headings[j], sizes[b, 0], sizes[b, 1], other)
                if shared_area(ring, other) > max_overlap:
                    out[i] = b
                    break
    return out


@kernel
def shared_area(a: FloatArray, b: FloatArray) -> float:
    """Area of the intersection of two convex rings (V, 2), both counter-clockwise [m^2]."""
    ring = np.empty((len(a) + len(b), 2))
    clipped = np.empty((len(a) + len(b), 2))
    count = len(a)
    ring[:count] = a
    for edge in range(len(b)):
        x, y = b[edge]
        nx, ny = y - b[(edge + 1) % len(b), 1], b[(edge + 1) % len(b), 0] - x  # to the left
        num_left = 0
        for index in range(count):
            px, py = ring[index]
            qx, qy = ring[(index + 1) % count]
            p, q = (px - x) * nx + (py - y) * ny, (qx - x) * nx + (qy - y) * ny
            if p >= 0.0:
                clipped[num_left, 0], clipped[num_left, 1] = px, py
                num_left += 1
            if p * q < 0.0:
                share = p / (p - q)
                clipped[num_left, 0], clipped[num_left, 1] = (
                    px + share * (qx - px),
                    py + share * (qy - py),
                )
                num_left += 1
        ring, clipped, count = clipped, ring, num_left
        if count < 3:
            return 0.0
    area = 0.0
    for index in range(count):
        following = (index + 1) % count
        area += ring[index, 0] * ring[following, 1] - ring[following, 0] * ring[index, 1]
    return 0.5 * area
