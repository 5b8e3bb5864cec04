"""Windows of a recording, and which tracks may serve as ego.

A window is a span of time, whatever the frame rate (nuPlan rule 450). Each track seen in it gets a
verdict: `ego`, or the first rule it fails: category, presence, speed, overlap (later stages add
lane and route).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import shapely

from shiftsim.data.readers.samples import ROW_S, TrackSamples, rows_of
from shiftsim.errors import ConfigError, one_of
from shiftsim.files import make_table
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import BoolArray, FloatArray, IntArray
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
        for name in SETTINGS.keys() & {item.name for item in fields(self)}:
            value = getattr(self, name)
            if value is not None and not SETTINGS[name].holds(value):
                raise ConfigError(f"{name} is {value!r}; it must be within {SETTINGS[name]}")
        for name in ("window_s", "overlap_s", "history_s", "padding_s"):
            value = getattr(self, name)
            if abs(rows_of(value) * ROW_S - value) > _EPS:
                raise ConfigError(f"{name} = {value!r} is not a multiple of {ROW_S} s")
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
    """Thresholds from plain values, as of a TOML file; a ConfigError where one is wrong."""
    for name in values:
        one_of("setting", name, [item.name for item in fields(ConversionConfig)])
    return make_table(ConversionConfig, values, "settings")


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
    track, none = recording.track, len(recording.track_ids)
    poses = np.column_stack([recording.xy, recording.raw_headings])
    corners = boxes_to_corners(poses, recording.sizes[track, :2])
    partner = np.full(len(track), none)
    for rows in np.split(recording.by_frame, recording.frame_ptr[1:-1]):
        boxes, asked = shapely.polygons(corners[rows]), np.flatnonzero(candidates[track[rows]])
        one, other = shapely.STRtree(boxes).query(boxes[asked], predicate="intersects")
        one = asked[one]
        one, other = one[one != other], other[one != other]
        much = shapely.area(shapely.intersection(boxes[one], boxes[other])) > max_overlap
        np.minimum.at(partner, rows[one[much]], track[rows[other[much]]])
    return np.where(partner == none, -1, partner)


def _median_of_three(values: FloatArray, track: IntArray) -> FloatArray:
    """Median of each row and its neighbours of the same track; the ends keep their value."""
    out, inner = values.copy(), np.flatnonzero(track[2:] == track[:-2]) + 1
    out[inner] = np.median([values[inner - 1], values[inner], values[inner + 1]], axis=0)
    return out
