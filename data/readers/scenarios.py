"""Scenarios of a recording, whatever its source.

Windows and verdicts are found on the source's frames; everything is sampled at 20 Hz once; then
there is an ego trace per accepted track and a scenario per accepted (window, track).

A recording of 18 s or more is cut into DeepPlan's windows (3 s of history, 15 s simulated); a
shorter one is one window with 2 s of history. Whatever is dropped is counted.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shiftsim.data.maps.lights import light_rows
from shiftsim.data.readers.reader import SourceRecording, site_map
from shiftsim.data.readers.routes import find_route, starts_on_lane
from shiftsim.data.readers.samples import (
    ROW_S,
    ROW_US,
    TrackSamples,
    ego_trace,
    find_runs,
    resample,
    rows_between,
    rows_of,
    sample_run,
)
from shiftsim.data.readers.windows import (
    CATEGORY,
    EGO,
    GAP,
    LANE,
    OVERLAP,
    PRESENCE,
    ROUTE,
    SPEED,
    ConversionConfig,
    Span,
    WindowVerdicts,
    evaluate_windows,
    window_spans,
)
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConfigError, ConversionError, nearest
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import FULL_DURATION, duration_class
from shiftsim.world.state import rear_poses

EGO_CATEGORIES = ("car", "van", "pickup", "vehicle")
SHORT_HISTORY_S = 2.0
_LEAST_S = 0.3  # simulated
_MAP_MARGIN = 200.0  # m around the map in which objects are expected


@dataclass(frozen=True)
class RecordingSummary:
    """What became of one recording."""

    name: str  # name of the recording
    duration_s: float  # its length [s]
    tracks: int  # tracks in it
    windows: int  # windows that fit
    seen: int  # (window, track) pairs looked at
    candidates: int  # pairs that pass category, presence, speed and overlap
    accepted: int  # scenarios
    rejected: dict[str, int]  # count of the other pairs by the rule they failed
    warnings: dict[str, int]  # count by kind of what was repaired


@dataclass(frozen=True)
class Converted:
    """One recording, ready for the store."""

    recording: Recording
    egos: tuple[EgoTrace, ...]
    windows: tuple[Window, ...]
    summary: RecordingSummary


def make_scenarios(
    samples: TrackSamples,
    road: VectorMap,
    *,
    egos: Sequence[str] | None = None,
    config: ConversionConfig | None = None,
    scenario_type: str = "unknown",
    left_out_s: float = 0.0,
) -> Converted:
    """All scenarios of a recording; both it and the map are in the frame of the map.

    Args:
        samples: The recording.
        road: The map.
        egos: Ids of the egos, of any category; by default every car, van, pickup or vehicle that
            is there throughout the window.
        config: Thresholds of DeepPlan's conversion.
        scenario_type: Tag of the scenarios.
        left_out_s: Time at the end of the recording that no window reaches [s].

    Raises:
        ConfigError: No object has the id of an ego.
    """
    return convert_recording(
        SourceRecording(
            samples,
            site_map(road, {}),
            config=config,
            scenario_type=scenario_type,
            egos=egos,
            left_out_s=left_out_s,
        )
    )


def convert_recording(source: SourceRecording) -> Converted:
    """All scenarios of one recording of a source; see `make_scenarios`."""
    samples, road, spans = source.samples, source.map.road, source.spans
    config = source.config or ConversionConfig(ego_categories=EGO_CATEGORIES)
    offset = np.zeros(2) if source.offset is None else source.offset
    if spans is None and source.egos is None:
        rows = int(np.floor((samples.duration - source.left_out_s) / ROW_S + 1e-9)) + 1
        spans = list(_spans(0, rows, -1, config))
    elif spans is None:
        spans = list(_named_spans(samples, source.egos or (), config, source.left_out_s))
    runs = find_runs(samples, config.max_hole_s)
    windows = evaluate_windows(samples, runs, config, spans)
    log_name = f"{road.name}_{samples.name}"
    padding = rows_of(config.padding_s)
    recording = resample(
        samples, runs, log_name=log_name, city=road.name, offset=offset, padding_s=config.padding_s
    )
    rejected: Counter[str] = Counter()
    accepted = _accepted_runs(windows, config, rejected)
    traces: list[EgoTrace] = []
    scenarios: list[Window] = []
    for run, numbers in sorted(accepted.items()):
        own = [windows[number].span for number in numbers]
        trace = ego_trace(
            samples,
            runs,
            run,
            log_name=log_name,
            offset=offset,
            first_row=min(rows_of(span.start_s) for span in own),
            last_row=max(rows_of(s.start_s) + rows_of(s.length_s) for s in own) + padding,
            padding=padding,
        )
        starts = np.array([span.start_s + span.history_s for span in own])
        poses = sample_run(samples, runs, run, starts).poses
        poses[:, :2] += offset
        track, before = int(runs.track[run]), len(scenarios)
        for number, span, pose in zip(numbers, own, poses, strict=True):
            window: Window | str = LANE
            if starts_on_lane(road, pose, config):
                window = _scenario(source, offset, config, track, number, span, trace)
            if isinstance(window, str):
                rejected[window] += 1
            else:
                scenarios.append(window)
        if len(scenarios) > before:
            traces.append(trace)
    if source.lights is not None:
        lights = light_rows(source.lights, source.map.lights, recording.time_us)
        recording = replace(recording, lights=lights)
    warnings = Counter(samples.warnings) + Counter(source.warnings)
    warnings["rows far outside the map"] += _rows_outside_map(samples, road, offset)
    summary = RecordingSummary(
        name=samples.name,
        duration_s=samples.duration,
        tracks=len(samples.track_ids),
        windows=len(windows),
        seen=sum(len(window.tracks) for window in windows),
        candidates=sum(map(len, accepted.values())),
        accepted=len(scenarios),
        rejected=dict(sorted(rejected.items())),
        warnings=dict(+warnings),
    )
    order = sorted(scenarios, key=lambda w: (w.first_row, len(w.ego), w.ego))
    return Converted(recording, tuple(traces), tuple(order), summary)


# what helps against a rule that leaves no ego
_REMEDIES = {
    CATEGORY: "only cars, vans, pickups and vehicles become egos by themselves: name another with"
    " --ego ID",
    PRESENCE: "no vehicle is seen throughout a window: try shorter ones, --window-s 10"
    " --overlap-s 5 --history-s 2, or name an ego whose own time is taken, --ego ID",
    SPEED: "all vehicles stand",
    OVERLAP: "boxes lie on one another: check sizes and headings, and whether an object is in the"
    " file twice",
    LANE: "egos start beside the lanes or against them: look at the picture",
    ROUTE: "egos touch no road of the map: look at the picture",
    GAP: "egos change between roads that the map does not link: add the links to the map",
}


def require_scenarios(summary: RecordingSummary, source: Path) -> None:
    """Raise an error if a recording has no scenario.

    Raises:
        ConversionError: It has none; the rule that dropped most of the egos, and a remedy.
    """
    if summary.accepted:
        return
    if not summary.seen:
        raise ConversionError(
            f"{source}: the recording is {summary.duration_s:.1f} s long, too short for a"
            " scenario: need at least 2.3 s, 2 s of them history",
            "check the unit of time, or --hz",
        )
    counts = ", ".join(f"{rule} {count}" for rule, count in summary.rejected.items())
    others = {rule: count for rule, count in summary.rejected.items() if rule != CATEGORY}
    raise ConversionError(
        f"{source}: no scenario is left of {summary.seen} pairs of window and object; dropped"
        f" by the rules {counts}",
        _REMEDIES[max(others, key=lambda rule: others[rule]) if others else CATEGORY],
    )


def write_converted(writer: StoreWriter, converted: Converted) -> None:
    """Put a recording and its scenarios into a store that has the map, for those it had."""
    writer.forget_recording(converted.recording.log_name)
    writer.add_recording(converted.recording)
    for ego in converted.egos:
        writer.add_ego(ego)
    for window in converted.windows:
        writer.add_window(window)


def _spans(first: int, rows: int, only: int, config: ConversionConfig) -> Iterator[Span]:
    """Windows within some rows of 0.05 s; one shorter window where none fits."""
    full = window_spans(rows * ROW_S, config)
    for span in full:
        start = round((first + rows_of(span.start_s)) * ROW_S, 2)
        yield Span(start, span.length_s, span.history_s, only)
    if not full and rows * ROW_S >= SHORT_HISTORY_S + _LEAST_S:
        history = min(SHORT_HISTORY_S, config.history_s)
        yield Span(round(first * ROW_S, 2), round(rows * ROW_S, 2), history, only)


def _named_spans(
    samples: TrackSamples, egos: Sequence[str], config: ConversionConfig, left_out_s: float
) -> Iterator[Span]:
    """Windows of named egos, which begin where each is first seen."""
    numbers = {str(name): number for number, name in enumerate(samples.track_ids.tolist())}
    runs = find_runs(samples, config.max_hole_s)
    end = samples.duration - left_out_s
    last_s = np.minimum(samples.time[runs.last], end)
    first, last = rows_between(samples.time[runs.first], last_s)
    # beyond its last row an ego is known to exist only where the recording ends, too
    rows = last - first + (samples.frame[runs.last] == len(samples.clock) - 1)
    for ego in egos:
        if ego not in numbers:
            near = nearest(ego, numbers)
            hint = f"did you mean {near!r}? " if near else ""
            raise ConfigError(
                f"{samples.name}: no object has the id {ego!r}",
                f"{hint}there are {len(numbers)}, such as {', '.join(list(numbers)[:5])}",
            )
        for run in np.flatnonzero(runs.track == numbers[ego]).tolist():
            yield from _spans(int(first[run]), int(rows[run]), numbers[ego], config)


def _accepted_runs(
    windows: Sequence[WindowVerdicts], config: ConversionConfig, rejected: Counter[str]
) -> dict[int, list[int]]:
    """Numbers of the windows in which each run may serve as ego; the others are counted."""
    accepted: dict[int, list[int]] = {}
    for number, window in enumerate(windows):
        num_egos = 0
        for run, verdict in zip(window.runs.tolist(), window.verdicts, strict=True):
            if verdict == EGO and num_egos != config.max_per_window:
                accepted.setdefault(run, []).append(number)
                num_egos += 1
            else:
                rejected[verdict if verdict != EGO else "beyond max_per_window"] += 1
    return accepted


def _scenario(
    source: SourceRecording,
    offset: FloatArray,
    config: ConversionConfig,
    track: int,
    number: int,
    span: Span,
    trace: EgoTrace,
) -> Window | str:
    """The scenario of an ego in a window, or the rule that its route fails."""
    samples, road = source.samples, source.map.road
    padding = rows_of(config.padding_s)
    first = rows_of(span.start_s)  # with the padding, one padding earlier than the window
    start = first + padding + rows_of(span.history_s)
    end = first + padding + rows_of(span.length_s)
    states = trace.states[start - trace.first_row : end - trace.first_row]
    route = find_route(road, states[:, :3], config)
    if route is None or not route.is_linked:
        return ROUTE if route is None else GAP
    goal = states[-1, :3].copy()
    last = int(np.searchsorted(samples.track, track, side="right")) - 1
    if samples.time[last] > span.start_s + span.length_s:
        center = np.array([*samples.centers[last, :2] + offset, samples.headings[last]])
        goal = rear_poses(center)  # nuPlan rule 457
    name = samples.track_ids[track]
    key = f"{road.name}|{samples.name}|{span.start_s}|{name}|{span.length_s}"
    metadata: dict[str, object] = {
        "recording": samples.name,
        "window": number,
        "window_start_s": span.start_s,
        "track_id": name.item(),
        "category": samples.categories[track],
        "size_m": samples.sizes[track].tolist(),
        "driven_blocks": route.num_driven,
        "padded_history_s": max(0.0, config.padding_s - span.start_s),
    }
    duration = duration_class(np.arange(0, end - start, 2) * ROW_US)
    if duration != FULL_DURATION:
        metadata["duration_class"] = duration
    return Window(
        token=hashlib.blake2b(key.encode(), digest_size=8).hexdigest(),
        scenario_type=source.scenario_type,
        log_name=trace.log_name,
        ego=trace.name,
        first_row=first,
        last_row=end,
        iteration_rows=np.arange(start, end, 2),
        row_step=2,
        route=route.ids,
        mission_goal=goal,
        mapping=(span.length_s - span.history_s, 0.0, 0.5),
        is_short=span.is_short,
        metadata={**metadata, **source.metadata},
    )


def _rows_outside_map(samples: TrackSamples, road: VectorMap, offset: FloatArray) -> int:
    bounds = road.edges.polygons.bounds
    low, high = bounds[:, :2].min(axis=0) - _MAP_MARGIN, bounds[:, 2:].max(axis=0) + _MAP_MARGIN
    outside = np.zeros(len(samples.centers), np.bool_)
    for axis in (0, 1):
        place = samples.centers[:, axis] + offset[axis]
        outside |= (place < low[axis]) | (place > high[axis])
    return int(outside.sum())
