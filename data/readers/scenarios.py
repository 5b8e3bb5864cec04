"""Scenarios of a recording, whatever its source.

Windows and verdicts are found on the source's frames; everything is sampled at 20 Hz once; then
there is an ego trace per accepted track and a scenario per accepted (window, track).

A recording of 18 s or more is cut into DeepPlan's windows (3 s of history, 15 s simulated); a
shorter one is one window with 2 s of history. Whatever is dropped is counted.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.lights import light_rows
from shiftsim.data.readers import windows
from shiftsim.data.readers.placement import extent_of
from shiftsim.data.readers.reader import SourceRecording
from shiftsim.data.readers.routes import find_route, starts_on_lane, with_known_blocks
from shiftsim.data.readers.samples import (
    ROW_S,
    ROW_US,
    TrackSamples,
    ego_trace,
    resample,
    rows_between,
    rows_of,
    sample_run,
)
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConfigError, ConversionError, nearest
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


def make_scenarios(samples: TrackSamples, road: VectorMap, **how: Any) -> Converted:
    """All scenarios of a recording and a map in one frame; `how` as in `SourceRecording`."""
    return convert_recording(SourceRecording(samples, BuiltMap(road, {}), **how))


def convert_recording(source: SourceRecording) -> Converted:
    """All scenarios of one recording of a source; see `make_scenarios`."""
    config = source.config or windows.ConversionConfig(ego_categories=EGO_CATEGORIES)
    samples, road = replace(source.samples, max_hole_s=config.max_hole_s), source.map.road
    spans = source.spans
    if spans is None:
        spans = list(_usable_spans(samples, source.egos, config, source.left_out_s))
    verdicts = windows.evaluate_windows(samples, config, spans)
    padding = rows_of(config.padding_s)
    recording = resample(samples, f"{road.name}_{samples.name}", road.name, padding)
    rejected: Counter[str] = Counter()
    accepted = _accepted_runs(verdicts, config, rejected)
    traces: list[EgoTrace] = []
    scenarios: list[Window] = []
    for run, numbers in sorted(accepted.items()):
        spans = [verdicts[number].span for number in numbers]
        first = min(rows_of(span.start_s) for span in spans)
        last = max(rows_of(span.start_s) + rows_of(span.length_s) for span in spans) + padding
        rows = {"first_row": first, "last_row": last, "padding": padding}
        trace = ego_trace(samples, run, recording.log_name, **rows)
        made = [
            _scenario(source, samples, config, run, number, span, trace)
            for number, span in zip(numbers, spans, strict=True)
        ]
        rejected.update(rule for rule in made if isinstance(rule, str))
        usable = [window for window in made if isinstance(window, Window)]
        scenarios += usable
        traces += [trace] * bool(usable)
    if source.lights is not None:
        lights = light_rows(source.lights, source.map.lights, recording.time_us)
        recording = replace(recording, lights=lights)
    warnings = Counter(samples.warnings) + Counter(source.warnings)
    low, high = extent_of(road)
    places = samples.xy + samples.offset
    is_far = (places < low - _MAP_MARGIN) | (places > high + _MAP_MARGIN)
    warnings["rows far outside the map"] += int(is_far.any(axis=1).sum())
    summary = RecordingSummary(
        name=samples.name,
        duration_s=samples.duration,
        tracks=len(samples.track_ids),
        windows=len(verdicts),
        seen=sum(len(window.tracks) for window in verdicts),
        candidates=sum(map(len, accepted.values())),
        accepted=len(scenarios),
        rejected=dict(sorted(rejected.items())),
        warnings=dict(+warnings),
    )
    order = sorted(scenarios, key=lambda w: (w.first_row, len(w.ego), w.ego))
    return Converted(recording, tuple(traces), tuple(order), summary)


# what helps against a rule that leaves no ego
_REMEDIES = {
    windows.CATEGORY: "only cars, vans, pickups and vehicles become egos by themselves: name"
    " another with --ego ID",
    windows.PRESENCE: "no vehicle is seen throughout a window: try shorter ones, --window-s 10"
    " --overlap-s 5 --history-s 2, or name an ego whose own time is taken, --ego ID",
    windows.SPEED: "all vehicles stand",
    windows.OVERLAP: "boxes lie on one another: check sizes and headings, and whether an object is"
    " in the file twice",
    windows.LANE: "egos start beside the lanes or against them: look at the picture",
    windows.ROUTE: "egos touch no road of the map: look at the picture",
    windows.GAP: "egos change between roads that the map does not link: add the links to the map",
}


def require_scenarios(summary: RecordingSummary, source: Path) -> None:
    """A ConversionError if a recording has no scenario, with the rule that dropped most egos."""
    if summary.accepted:
        return
    if not summary.seen:
        raise ConversionError(
            f"{source}: the recording is {summary.duration_s:.1f} s long, too short for a"
            " scenario: need at least 2.3 s, 2 s of them history",
            "check the unit of time, or --hz",
        )
    counts = ", ".join(f"{rule} {count}" for rule, count in summary.rejected.items())
    raise ConversionError(
        f"{source}: no scenario is left of {summary.seen} pairs of window and object; dropped"
        f" by the rules {counts}",
        _REMEDIES[_worst_rule(summary.rejected)],
    )


def why_none(summaries: Sequence[RecordingSummary]) -> tuple[str, bool]:
    """Why recordings have no scenario, in words, and whether shorter windows may help."""
    rejected: Counter[str] = Counter()
    for summary in summaries:
        rejected.update(summary.rejected)
    if not rejected:
        longest = max((summary.duration_s for summary in summaries), default=0.0)
        return f"no window fits, the longest recording has {longest:.1f} s", True
    rule = _worst_rule(rejected)
    return _REMEDIES[rule].partition(":")[0], rule == windows.PRESENCE


def _worst_rule(rejected: Mapping[str, int]) -> str:
    """The rule that dropped most, categories last."""
    known = [rule for rule in rejected if rule in _REMEDIES]  # not what is beyond max_per_window
    return max(known, key=lambda rule: (rule != windows.CATEGORY, rejected[rule]))


def write_converted(writer: StoreWriter, converted: Converted) -> None:
    """Put a recording and its scenarios into a store that has the map, for those it had."""
    writer.forget_recording(converted.recording.log_name)
    writer.add_recording(converted.recording)
    for ego in converted.egos:
        writer.add_ego(ego)
    for window in converted.windows:
        writer.add_window(window)


def _usable_spans(
    samples: TrackSamples,
    egos: Sequence[str] | None,
    config: windows.ConversionConfig,
    left_out_s: float,
) -> Iterator[windows.Span]:
    """Windows of a recording; those of named egos begin where each is first seen."""
    runs, end = samples.runs, samples.duration - left_out_s
    if egos is None:
        yield from _spans(0, int(np.floor(end / ROW_S + 1e-9)) + 1, -1, config)
        return
    numbers = {str(name): number for number, name in enumerate(samples.track_ids.tolist())}
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


def _spans(
    first: int, rows: int, only: int, config: windows.ConversionConfig
) -> Iterator[windows.Span]:
    """Windows within some rows of 0.05 s; one shorter window where none fits."""
    full = windows.window_spans(rows * ROW_S, config)
    for span in full:
        start = round((first + rows_of(span.start_s)) * ROW_S, 2)
        yield windows.Span(start, span.length_s, span.history_s, only)
    if not full and rows * ROW_S >= SHORT_HISTORY_S + _LEAST_S:
        history = min(SHORT_HISTORY_S, config.history_s)
        yield windows.Span(round(first * ROW_S, 2), round(rows * ROW_S, 2), history, only)


def _accepted_runs(
    verdicts: Sequence[windows.WindowVerdicts],
    config: windows.ConversionConfig,
    rejected: Counter[str],
) -> dict[int, list[int]]:
    """Numbers of the windows in which each run may serve as ego; the others are counted."""
    accepted: dict[int, list[int]] = {}
    for number, window in enumerate(verdicts):
        num_egos = 0
        for run, verdict in zip(window.runs.tolist(), window.verdicts, strict=True):
            if verdict == windows.EGO and num_egos != config.max_per_window:
                accepted.setdefault(run, []).append(number)
                num_egos += 1
            else:
                rejected[verdict if verdict != windows.EGO else "beyond max_per_window"] += 1
    return accepted


def _scenario(
    source: SourceRecording,
    samples: TrackSamples,
    config: windows.ConversionConfig,
    run: int,
    number: int,
    span: windows.Span,
    trace: EgoTrace,
) -> Window | str:
    """The scenario of an ego in a window, or the rule that its start or its route fails."""
    road, track, padding = source.map.road, int(samples.runs.track[run]), rows_of(config.padding_s)
    (pose,), _ = sample_run(samples, run, np.array([span.start_s + span.history_s]))
    pose[:2] += samples.offset
    if not starts_on_lane(road, pose, config):
        return windows.LANE
    first = rows_of(span.start_s)  # with the padding, one padding earlier than the window
    start = first + padding + rows_of(span.history_s)
    end = first + padding + rows_of(span.length_s)
    states = trace.states[start - trace.first_row : end - trace.first_row]
    route = find_route(road, states[:, :3], config)
    if route is None or not route.is_linked:
        return windows.ROUTE if route is None else windows.GAP
    begun = [lanes for from_s, lanes in source.routes if from_s <= span.start_s + span.history_s]
    if begun:
        known = [lane for block in begun[-1] for lane in block]
        route = with_known_blocks(route, road, source.map.segments, known)
    goal = states[-1, :3].copy()
    last = int(np.searchsorted(samples.track, track, side="right")) - 1
    if samples.time[last] > span.start_s + span.length_s:
        center = np.array([*samples.xy[last] + samples.offset, samples.headings[last]])
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
