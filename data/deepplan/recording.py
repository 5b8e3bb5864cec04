"""One DSC3D recording to scenarios.

One pass: windows and verdicts on the source frames, everything at 20 Hz once, then an ego trace per
accepted track and a scenario per accepted (window, track). Whatever is dropped is counted.
"""

import hashlib
from collections import Counter
from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.deepplan.route import find_route, nearest_lane
from shiftsim.data.deepplan.states import ego_trace, resample, run_token, sample_runs
from shiftsim.data.deepplan.windows import (
    EGO,
    LANE,
    ROUTE,
    ConversionConfig,
    Runs,
    WindowVerdicts,
    find_runs,
    judge_windows,
    rows_of,
)
from shiftsim.data.dsc3d.recording import Annotations
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.world.map import VectorMap
from shiftsim.world.state import rear_poses

SCENARIO_TYPE = "deepplan"
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


def convert_recording(
    source: Annotations, road: VectorMap, offset: FloatArray, config: ConversionConfig
) -> Converted:
    """All scenarios of one recording.

    Args:
        source: The recording.
        road: Map of the site, in UTM.
        offset: (2,) UTM of the local origin [m].
        config: Thresholds.
    """
    log_name = f"{road.name}_{source.name}"
    runs = find_runs(source, config.max_hole_s)
    recording = resample(
        source,
        runs,
        log_name=log_name,
        city=road.name,
        offset=offset,
        padding_s=config.padding_s,
    )
    windows = judge_windows(source, runs, config)
    verdicts: Counter[str] = Counter()
    accepted: dict[int, list[tuple[int, WindowVerdicts]]] = {}
    for number, window in enumerate(windows):
        num_egos = 0
        for run, verdict in zip(window.runs.tolist(), window.verdicts, strict=True):
            if verdict == EGO and num_egos != config.max_per_window:
                accepted.setdefault(run, []).append((number, window))
                num_egos += 1
            else:
                verdicts[verdict if verdict != EGO else "beyond max_per_window"] += 1
    egos, scenarios = [], []
    candidates = sum(map(len, accepted.values()))
    for run in sorted(accepted):
        trace = _trace(source, runs, run, accepted[run], log_name, offset, config)
        starts = np.array([window.start_s + config.history_s for _, window in accepted[run]])
        at_start = sample_runs(source, runs, np.full(len(starts), run), starts).poses
        at_start[:, :2] += offset
        kept = 0
        for (number, window), pose in zip(accepted[run], at_start, strict=True):
            if nearest_lane(road, pose, config) is None:
                verdicts[LANE] += 1
                continue
            made = _scenario(source, runs, run, number, window, trace, road, offset, config)
            if made is None:
                verdicts[ROUTE] += 1
            else:
                scenarios.append(made)
                kept += 1
        if kept:
            egos.append(trace)
    outside = _outside_map(source, road, offset)
    warnings = {**source.warnings, **({"rows far outside the map": outside} if outside else {})}
    summary = RecordingSummary(
        name=source.name,
        duration_s=source.duration,
        tracks=len(source.track_ids),
        windows=len(windows),
        seen=sum(len(window.tracks) for window in windows),
        candidates=candidates,
        accepted=len(scenarios),
        rejected=dict(sorted(verdicts.items())),
        warnings=warnings,
    )
    order = sorted(scenarios, key=lambda w: (w.first_row, len(w.ego), w.ego))
    return Converted(recording, tuple(egos), tuple(order), summary)


def _trace(
    source: Annotations,
    runs: Runs,
    run: int,
    accepted: list[tuple[int, WindowVerdicts]],
    log_name: str,
    offset: FloatArray,
    config: ConversionConfig,
) -> EgoTrace:
    starts = [rows_of(window.start_s) for _, window in accepted]
    padding = rows_of(config.padding_s)
    return ego_trace(
        source,
        runs,
        run,
        log_name=log_name,
        offset=offset,
        first_row=min(starts),
        last_row=max(starts) + padding + rows_of(config.window_s),
        padding=padding,
    )


def _scenario(
    source: Annotations,
    runs: Runs,
    run: int,
    number: int,
    window: WindowVerdicts,
    trace: EgoTrace,
    road: VectorMap,
    offset: FloatArray,
    config: ConversionConfig,
) -> Window | None:
    """One scenario, or None where the ego touches no roadblock."""
    padding = rows_of(config.padding_s)
    first = rows_of(window.start_s)  # with the padding, one padding earlier than the window
    start = first + padding + rows_of(config.history_s)
    end = first + padding + rows_of(config.window_s)
    states = trace.states[start - trace.first_row : end - trace.first_row]
    track = int(runs.track[run])
    route = find_route(road, states[:, :3], config)
    if route is None:
        return None
    goal = states[-1, :3].copy()
    last = int(np.searchsorted(source.track, track, side="right")) - 1
    if source.time[last] > window.start_s + config.window_s:
        center = np.array([*source.centers[last, :2] + offset, source.headings[last]])
        goal = rear_poses(center)  # nuPlan rule 457
    key = f"{road.name}|{source.name}|{window.start_s}|{source.track_ids[track]}|{config.window_s}"
    return Window(
        token=hashlib.blake2b(key.encode(), digest_size=8).hexdigest(),
        scenario_type=SCENARIO_TYPE,
        log_name=trace.log_name,
        ego=run_token(source, runs, run),
        first_row=first,
        last_row=end,
        iteration_rows=np.arange(start, end, 2),
        row_step=2,
        route=route.ids,
        mission_goal=goal,
        mapping=(config.window_s - config.history_s, 0.0, 0.5),
        is_short=config.is_short,
        metadata={
            "recording": source.name,
            "window": number,
            "window_start_s": window.start_s,
            "track_id": int(source.track_ids[track]),
            "category": source.categories[track],
            "size_m": source.sizes[track].tolist(),
            "driven_blocks": route.num_driven,
            "padded_history_s": max(0.0, config.padding_s - window.start_s),
        },
    )


def _outside_map(source: Annotations, road: VectorMap, offset: FloatArray) -> int:
    bounds = road.edges.polygons.bounds
    low, high = bounds[:, :2].min(axis=0) - _MAP_MARGIN, bounds[:, 2:].max(axis=0) + _MAP_MARGIN
    xy = source.centers[:, :2] + offset
    return int(((xy < low) | (xy > high)).any(axis=1).sum())
