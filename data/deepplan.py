"""DSC3D recordings and an OpenDRIVE map to scenarios (deepplan-conversion.md).

One pass per recording: windows and verdicts on the source frames, everything at 20 Hz once, then an
ego trace per accepted track and a scenario per accepted (window, track). Nothing is dropped without
being counted in the report.
"""

import hashlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyproj

from shiftsim.arrays import FloatArray
from shiftsim.data.deepplan_route import find_route, nearest_lane, place_on_map
from shiftsim.data.deepplan_states import ego_trace, resample, run_token, sample_runs
from shiftsim.data.deepplan_windows import (
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
from shiftsim.data.dsc3d import Annotations, Site, find_map, open_site, read_recording
from shiftsim.data.opendrive import read_opendrive
from shiftsim.data.opendrive_map import build_road_map
from shiftsim.data.opendrive_records import OpenDrive
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store import StoreWriter
from shiftsim.errors import ConversionError
from shiftsim.map import VectorMap
from shiftsim.state import AgentKind, rear_poses

SCENARIO_TYPE = "deepplan"
_MAX_FRAME_SHIFT = 0.5  # m between the map's own georeference and that of the annotations
_MOVING = 1.0  # m/s
_MAP_MARGIN = 200.0  # m around the map in which objects are expected

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class RecordingSummary:
    """What became of one recording.

    Attributes:
        name: Name of the recording.
        duration_s: Its length [s].
        tracks: Tracks in it.
        windows: Windows that fit.
        seen: (window, track) pairs looked at.
        candidates: Pairs that pass category, presence, speed and overlap.
        accepted: Scenarios.
        rejected: Count of the other pairs by the rule they failed.
        warnings: Count by kind of what was mended.
    """

    name: str
    duration_s: float
    tracks: int
    windows: int
    seen: int
    candidates: int
    accepted: int
    rejected: dict[str, int]
    warnings: dict[str, int]


@dataclass(frozen=True)
class ConversionReport:
    """What became of one site.

    Attributes:
        site: Name of the site, which is the name of its map.
        lanes: Lanes and lane connectors of the map.
        drivable_share: Share of moving vehicles on drivable area.
        recordings: Summary of every recording.
        map_warnings: Count by kind of what was mended in the map.
    """

    site: str
    lanes: int
    drivable_share: float
    recordings: tuple[RecordingSummary, ...]
    map_warnings: dict[str, int] = field(default_factory=dict)

    @property
    def accepted(self) -> int:
        """Number of scenarios."""
        return sum(summary.accepted for summary in self.recordings)


@dataclass(frozen=True)
class Converted:
    """One recording, ready for the store."""

    recording: Recording
    egos: tuple[EgoTrace, ...]
    windows: tuple[Window, ...]
    summary: RecordingSummary


def convert_dsc3d(
    src: Path,
    store: Path,
    *,
    site: str | None = None,
    map_path: Path | None = None,
    options: ConversionConfig | None = None,
    progress: Progress | None = None,
) -> ConversionReport:
    """Convert a DSC3D download to scenarios in a store.

    Args:
        src: Folder with `data_meta.json`, `annotations/` and `map/`.
        store: The store, made or extended.
        site: Name of the site in the store; the name of the folder by default.
        map_path: OpenDRIVE file, where it is not in the download.
        options: Thresholds.
        progress: Called with recordings done, recordings in all and the name of the next one.

    Raises:
        ConversionError: The download cannot be converted; nothing is left out silently.
    """
    config = options or ConversionConfig()
    source = open_site(src)
    city = site or src.resolve().name
    drive = read_opendrive(find_map(source, map_path))
    _check_georeference(drive, source)
    road, map_report = build_road_map(
        drive,
        name=city,
        offset=_map_offset(drive, source),
        epsg=source.epsg,
        country=config.country,
    )
    if road.num_lanes == 0:
        raise ConversionError(f"{drive.source} has no drivable lane", "give a map with roads")
    annotations = []
    for number, name in enumerate(source.recordings):
        if progress:
            progress(number, len(source.recordings), name)
        annotations.append(read_recording(source, name, config.category_map))
    share = check_placement(road, source, annotations, config)
    summaries = []
    with StoreWriter(store) as writer:
        writer.add_map(road)
        for recording in annotations:
            result = convert_recording(recording, road, source.offset[:2], config)
            writer.add_recording(result.recording)
            for ego in result.egos:
                writer.add_ego(ego)
            for window in result.windows:
                writer.add_window(window)
            summaries.append(result.summary)
    if progress:
        progress(len(source.recordings), len(source.recordings), "")
    return ConversionReport(
        city, len(road.edges), share, tuple(summaries), dict(map_report.warnings)
    )


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
        kept = 0
        for number, window in accepted[run]:
            made = _scenario(source, runs, run, number, window, trace, road, offset, config)
            if isinstance(made, Window):
                scenarios.append(made)
                kept += 1
            else:
                verdicts[made] += 1
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


def check_placement(
    road: VectorMap, site: Site, recordings: list[Annotations], config: ConversionConfig
) -> float:
    """Share of moving vehicles on drivable area.

    Raises:
        ConversionError: It is too small: map and tracks do not lie on each other.
    """
    points = np.concatenate(
        [
            recording.centers[
                (recording.kinds == AgentKind.VEHICLE)[recording.track]
                & (np.hypot(*recording.velocities.T) > _MOVING),
                :2,
            ]
            for recording in recordings
        ]
    )
    found = place_on_map(road, points + site.offset[:2], config.min_drivable_share)
    if found.share < config.min_drivable_share:
        x, y = found.shift
        raise ConversionError(
            f"{site.folder}: only {found.share:.0%} of the moving vehicles are on drivable area of"
            f" the map, need {config.min_drivable_share:.0%}",
            f"the annotations fit best ({found.best_share:.0%}) when shifted by"
            f" ({x:+.1f}, {y:+.1f}) m: check that map and reference_utm.offset belong together",
        )
    return found.share


def _map_offset(drive: OpenDrive, site: Site) -> tuple[float, float]:
    """What brings the map, whose header offset the reader applies, to UTM."""
    x, y, *_ = drive.offset or (0.0, 0.0)
    return float(site.offset[0]) - x, float(site.offset[1]) - y


def _check_georeference(drive: OpenDrive, site: Site) -> None:
    """Refuse a map whose own georeference contradicts that of the annotations."""
    offset = drive.offset or (0.0, 0.0, 0.0, 0.0)
    if drive.geo_reference is None:
        own = offset[:2]
        if own == (0.0, 0.0):
            return
    else:
        try:
            crs = pyproj.CRS.from_user_input(drive.geo_reference)
            to_utm = pyproj.Transformer.from_crs(crs, site.epsg, always_xy=True)
            own = to_utm.transform(offset[0], offset[1])
        except pyproj.exceptions.ProjError:
            return  # not a projection (opendrive.md §5): the map counts as local
    if not np.hypot(own[0] - site.offset[0], own[1] - site.offset[1]) <= _MAX_FRAME_SHIFT:
        raise ConversionError(
            f"{drive.source} places its origin at UTM ({own[0]:.2f}, {own[1]:.2f}),"
            f" reference_utm.offset at ({site.offset[0]:.2f}, {site.offset[1]:.2f})",
            "correct the one that is wrong; they must agree to 0.5 m",
        )


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
) -> Window | str:
    """One scenario, or the rule it fails."""
    padding = rows_of(config.padding_s)
    first = rows_of(window.start_s)  # with the padding, one padding earlier than the window
    start = first + padding + rows_of(config.history_s)
    end = first + padding + rows_of(config.window_s)
    states = trace.states[start - trace.first_row : end - trace.first_row]
    track = int(runs.track[run])
    at_start = sample_runs(
        source, runs, np.array([run]), np.array([window.start_s + config.history_s])
    ).poses[0]
    at_start[:2] += offset
    if nearest_lane(road, at_start, config) is None:
        return LANE
    route = find_route(road, states[:, :3], config)
    if route is None:
        return ROUTE
    goal = states[-1, :3].copy()
    last = int(np.searchsorted(source.track, track, side="right")) - 1
    if source.time[last] > window.start_s + config.window_s:
        center = np.array([*source.centers[last, :2] + offset, source.headings[last]])
        goal = rear_poses(center)
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
