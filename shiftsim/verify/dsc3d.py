"""Compares DSC3D conversion with known answers: a real sample, and scripted recordings."""

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.deepplan.recording import convert_recording
from shiftsim.data.deepplan.states import sample_runs
from shiftsim.data.deepplan.windows import EGO, ConversionConfig, find_runs, judge_windows
from shiftsim.data.dsc3d.recording import Annotations, Site, find_map, open_site, read_recording
from shiftsim.data.opendrive.curves import ReferenceLine
from shiftsim.data.opendrive.lanes import LaneKey, section_borders
from shiftsim.data.opendrive.map import build_road_map
from shiftsim.data.opendrive.reading import read_opendrive
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.verify.files import Groups, Source, read_fields, read_table, verify_files
from shiftsim.verify.report import Report
from shiftsim.world.map import VectorMap
from shiftsim.world.state import center_poses

_EXACT = 1e-9  # rad, m in the local frame, degrees: the same formula on both sides
_UTM = 1e-8  # m, spacing of floats at UTM coordinates
_POSITION, _ANGLE = 2e-2, 2e-3  # m, rad: README of the scripted recordings
_SIZE = 1e-6  # m, stored as 32 bit floats
_SPEED = 1e-5  # m/s
_SINGLE = 5e-7  # rad, two units in the last place of single-precision headings
_STEP_S = 0.05
# of columns and fields; `_EXACT` where none is named
_COLUMNS = {"utm_x": _UTM, "utm_y": _UTM, "": _EXACT}
_SUMMARY = {"dt_s": 1e-12, "max_yaw_minus_velocity_heading_rad": _SINGLE, "": _EXACT}
_TRACK = {"speed_min": _SPEED, "speed_max": _SPEED, "path_length_xy": _SIZE, "": _EXACT}
_MIN_PIECE = 10  # samples; shorter pieces at the ends of a lane sequence may be missing
_SWITCH, _JUMP = 1.0, 10.0  # costs of a lane sequence: to a linked lane, to any other
_DERIVED = "derived columns of annotations.parquet: acceleration and angular velocity"


class LocalMap:
    """A map in its own frame, with the OpenDRIVE lanes behind the lanes of ours."""

    def __init__(self, path: Path) -> None:
        """Read and convert a map file."""
        self._drive = read_opendrive(path)
        self._map, made = build_road_map(self._drive, name=path.stem)
        self._pieces: dict[int, list[tuple[LaneKey, shapely.Polygon]]] = defaultdict(list)
        for origin in made.origins:
            lane = self._map.edges.index.get(origin.id)
            if lane is not None:
                low, high = sorted((origin.begin, origin.end))
                self._pieces[lane].append((origin.key, self._area(origin.key, low, high)))

    def _area(self, key: LaneKey, low: float, high: float) -> shapely.Polygon:
        road = self._drive.roads[key.road]
        s = np.linspace(low, high, max(2, round((high - low) / 0.5) + 1))
        borders = section_borders(road, key.section, s, repair=True)
        poses = ReferenceLine(road.geometries).evaluate(s)
        inner, outer = (poses.offset(side[key.lane]) for side in (borders.inner, borders.outer))
        return shapely.Polygon(np.concatenate([inner, outer[::-1]]))

    def placed(self, site: Site) -> VectorMap:
        """The same map in UTM."""
        offset = float(site.offset[0]), float(site.offset[1])
        return build_road_map(self._drive, name=self._map.name, offset=offset, epsg=site.epsg)[0]

    def keys_at(self, x: float, y: float) -> dict[int, LaneKey]:
        """By the lanes of ours that hold a point the OpenDRIVE lane, or the nearest of several."""
        point = shapely.Point(x, y)
        return {
            lane: min(self._pieces[lane], key=lambda piece: shapely.distance(piece[1], point))[0]
            for lane in self._map.edges.containing(x, y).tolist()
            if lane in self._pieces
        }

    def sequences(self, centers: FloatArray) -> list[list[LaneKey]]:
        """OpenDRIVE lanes passed by points (n, 2) at 20 Hz, without and with short end pieces."""
        best: dict[int, tuple[float, list[LaneKey]]] = {-1: (0.0, [])}
        for x, y in centers.tolist():  # by the last lane: cost of changes, lanes so far
            if here := self.keys_at(x, y):
                options = {
                    lane: [
                        (cost + self._change(before, lane), [*way, key])
                        for before, (cost, way) in best.items()
                    ]
                    for lane, key in here.items()
                }
                best = {lane: min(ways, key=itemgetter(0)) for lane, ways in options.items()}
        likeliest = min(best.values(), key=itemgetter(0))[1]
        pieces = [(key, len(list(group))) for key, group in groupby(likeliest)]
        lanes = [key for key, _ in pieces]
        long = [i for i, (_, samples) in enumerate(pieces) if samples >= _MIN_PIECE]
        if not long:
            return [lanes]
        ends = range(long[-1], len(lanes))
        return [lanes[first : last + 1] for first in range(long[0], -1, -1) for last in ends]

    def _change(self, before: int, after: int) -> float:
        if before in (after, -1):
            return 0.0
        return _SWITCH if after in self._map.outgoing.at(before) else _JUMP


class Sample(NamedTuple):
    """The recording of the sample."""

    site: Site
    recording: Annotations
    keys: list[list[LaneKey]]  # OpenDRIVE lanes at every row


def verify_dsc3d_sample(folder: Path, report: Report) -> None:
    """Compare reading and resampling with `expected*` files beside the folder `data`."""
    site = open_site(folder / "data")
    if len(site.recordings) != 1:
        report.skip("recordings beyond the first", len(site.recordings) - 1)
    recording, local = read_recording(site, site.recordings[0]), LocalMap(find_map(site))
    keys = [list(local.keys_at(x, y).values()) for x, y in recording.bottom[:, :2].tolist()]
    sample = Sample(site, recording, keys)

    def table(columns: Callable[[int, Sample], dict[str, Any]], path: Path) -> None:
        groups, names = Groups(path, report, ("track_id",)), recording.track_ids.astype(str)
        report.compare("tracks", path.stem, sorted(names), sorted(name for (name,) in groups))
        for number, name in enumerate(names.tolist()):
            groups.match((name,), columns(number, sample), _COLUMNS, angles={"yaw"})
        groups.finish()

    parts: dict[str, Callable[[Path], object]] = {
        "data": lambda path: report.note(_DERIVED),
        "expected_rows.parquet": partial(table, _rows),
        "expected_20hz.parquet": partial(table, _samples),
        "expected.json": lambda path: _verify_summary(read_fields(path, report), sample),
    }
    verify_files(folder, report, parts)


def _rows(number: int, sample: Sample) -> dict[str, Any]:
    """The rows of a track as recorded."""
    site, recording, keys = sample
    rows = np.flatnonzero(recording.track == number)
    utm = recording.bottom[rows, :2] + site.offset[:2]
    to_degrees = pyproj.Transformer.from_crs(site.epsg, 4326, always_xy=True)
    lanes = [keys[row][0] if len(keys[row]) == 1 else LaneKey("", 0, 0) for row in rows.tolist()]
    return {
        "frame_id": recording.frame[rows] * site.frame_distance,
        "road": [key.road for key in lanes],
        "lane": [key.lane for key in lanes],
        **_named("yaw pitch roll", recording.angles[rows]),
        **_named("centre_x centre_y centre_z", recording.centers[rows]),
        **_named("utm_x utm_y", utm),
        **_named("lon lat", np.column_stack(to_degrees.transform(*utm.T))),
    }


def _samples(number: int, sample: Sample) -> dict[str, Any]:
    """A track resampled at 20 Hz."""
    recording = sample.recording
    runs = find_runs(recording, ConversionConfig().max_hole_s)
    (run,) = np.flatnonzero(runs.track == number)  # of one piece
    rows = slice(runs.first[run], runs.last[run] + 1)
    clock = recording.time[rows]
    ends = np.ceil(clock[0] / _STEP_S - _EXACT), np.floor(clock[-1] / _STEP_S + _EXACT)
    steps = np.arange(ends[0], ends[1] + 1)
    times = steps * _STEP_S
    samples = sample_runs(recording, runs, np.full(len(steps), run, np.int64), times)
    return {
        "step": steps.astype(np.int64),
        "t": times,
        "x": np.interp(times, clock, recording.bottom[rows, 0]),
        "y": np.interp(times, clock, recording.bottom[rows, 1]),
        "yaw": samples.poses[:, 2],
        **_named("vx vy", samples.velocities),
    }


def _named(names: str, columns: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names.split(), columns.T, strict=True))


def _verify_summary(expected: Source, sample: Sample) -> None:
    site, recording, keys = sample
    report, folder = expected.report, site.folder / "annotations" / recording.name
    raw = read_table(folder / "annotations.parquet", report)
    order = np.lexsort((raw["frame_id"], raw["track_id"]))
    velocity = np.column_stack([raw[f"velocity_{axis}"] for axis in "xyz"])[order]
    stamps, yaw = read_table(folder / "frames.parquet", report)["time"], recording.angles[:, 0]
    stamps = stamps.astype("datetime64[us]")
    lag = (stamps - stamps[0]).astype(np.int64) * 1e-6 - recording.clock
    moving = np.arctan2(velocity[:, 1], velocity[:, 0])
    ours = {
        "rows": len(recording.track),
        "frames": len(recording.clock),
        "dt_s": recording.period,
        "rate_hz": 1.0 / recording.period,
        "duration_s": recording.duration,
        "first_time": str(stamps[0]).replace("T", " ") + "+00:00",
        "last_time": str(stamps[-1]).replace("T", " ") + "+00:00",
        "max_abs_time_minus_frameid_over_rate_s": np.abs(lag).max(),
        "max_yaw_minus_velocity_heading_rad": np.abs(wrap_angles(yaw - moving)).max(),
        "max_yaw_minus_rotation_z_rad": np.abs(yaw - raw["rotation_z"][order]).max(),
        "boxes_in_exactly_one_driving_lane": sum(len(key) == 1 for key in keys),
        "steps_20hz": int(np.floor(recording.duration / _STEP_S + _EXACT)) + 1,
    }
    expected.match("recording", ours, _SUMMARY, quantity="summary")
    speed = np.linalg.norm(velocity, axis=1)
    tracks, names = expected.each("tracks")[0], recording.track_ids.astype(str).tolist()
    report.compare("tracks", expected.name, names, sorted(tracks, key=int))
    for number, name in enumerate(names):
        rows = np.flatnonzero(recording.track == number)
        path = np.diff(recording.bottom[rows, :2], axis=0)
        ours = {
            "category": recording.categories[number],
            "rows": len(rows),
            **_named("length width height", recording.sizes[number]),
            "speed_min": speed[rows].min(),
            "speed_max": speed[rows].max(),
            "path_length_xy": np.linalg.norm(path, axis=1).sum(),
            "road_lane": [
                [*lane] for lane in {(k.road, k.lane) for row in rows for k in keys[row]}
            ],
        }
        track = tracks.each(name)[0]
        track.match(f"track {name}", ours, _TRACK, quantity="track", unordered={"road_lane"})
    expected.finish()


def verify_dsc3d_synthetic(folder: Path, report: Report, maps: Path | None) -> None:
    """Compare windows, verdicts, lane sequences and 20 Hz poses with scripted recordings.

    `folder` is one recording or holds several. Its maps lie in `maps`, or in a folder of that name
    beside the one of the references.
    """
    if not (folder / "expected.json").is_file():
        part = partial(verify_dsc3d_synthetic, report=report, maps=maps)
        verify_files(folder, report, {p.parent.name: part for p in folder.glob("*/expected.json")})
        return
    parts = {
        "data": lambda path: report.note(_DERIVED),
        "expected.json": lambda path: _verify_scripted(read_fields(path, report), folder, maps),
        "expected_ego_20hz.parquet": lambda path: None,  # with `expected.json`
    }
    verify_files(folder, report, parts)


def _verify_scripted(expected: Source, folder: Path, maps: Path | None) -> None:
    report, name, config = expected.report, folder.name, ConversionConfig()
    site = open_site(folder / "data")
    recording = read_recording(site, site.recordings[0])
    rate, rows = 1.0 / recording.period, len(recording.track)
    facts = {"rate_hz": rate, "duration_s": recording.duration, "rows": rows}
    expected.match(name, facts, _EXACT, quantity="recording")
    tracks, ids = expected.each("tracks")[0], recording.track_ids.tolist()
    report.compare("track ids", name, ids, sorted(map(int, tracks)))
    for number, track in enumerate(ids):
        own = {"category": recording.categories[number], "dim": recording.sizes[number]}
        where = f"{name} track {track}"
        tracks.each(str(track))[0].match(where, own, {"dim": _SIZE}, quantity="track")
    windows = judge_windows(recording, find_runs(recording, config.max_hole_s), config)
    wanted, lanes = expected.each("windows"), dict[tuple[str, str], Any]()
    report.compare("windows", name, len(windows), len(wanted))
    for window, theirs in zip(windows, wanted, strict=False):
        judged = zip(window.tracks.tolist(), window.verdicts, window.partners, strict=True)
        verdicts = {
            ids[track]: verdict if partner < 0 else f"{verdict} with {ids[partner]}"
            for track, verdict, partner in judged
        }
        egos = [track for track, verdict in verdicts.items() if verdict == EGO]
        where, own = (
            f"{name} window {window.span.start_s:g} s",
            {"start_s": window.span.start_s, "egos": egos},
        )
        theirs.match(where, own, _EXACT, quantity="window", unordered={"egos"})
        given = {int(track): verdict for track, verdict in theirs["verdict"].items()}
        report.compare("tracks seen", where, sorted(verdicts), sorted(given))
        for track in sorted(set(verdicts) & set(given)):
            report.compare("verdict", f"{where} track {track}", verdicts[track], given[track])
        begin = f"{theirs['start_s']:.1f}"
        lanes |= {(begin, track): way for track, way in theirs["lanes_from_t0"].items()}
    expected.used.add("note")
    places = [maps / expected["map"]] if maps is not None else []
    places += [folder / "data/map/map.xodr"]
    places += [parent / "maps" / expected["map"] for parent in folder.resolve().parents[:4]]
    if found := next(filter(Path.is_file, places), None):
        _verify_scenarios(folder, site, recording, LocalMap(found), lanes, report)
    else:
        report.skip(f"lane sequences and poses: map {expected['map']} not found (--maps)")
    expected.finish()


def _verify_scenarios(
    folder: Path,
    site: Site,
    recording: Annotations,
    local: LocalMap,
    lanes: dict[tuple[str, str], Any],
    report: Report,
) -> None:
    """Poses and lanes of the converted scenarios, brought back to the local frame."""
    poses = Groups(folder / "expected_ego_20hz.parquet", report, ("window_start_s", "track_id"))
    made = convert_recording(recording, local.placed(site), site.offset[:2], ConversionConfig())
    egos, seen = {ego.name: ego for ego in made.egos}, set()
    for window in made.windows:
        begin = float(str(window.metadata["window_start_s"]))
        key = (f"{begin:.1f}", str(window.metadata["track_id"]))
        seen.add(key)
        where, ego = f"{folder.name} window {key[0]} track {key[1]}", egos[window.ego]
        rows = slice(window.first_row - ego.first_row, window.last_row - ego.first_row)
        centers = center_poses(ego.states[rows, :3])
        centers[:, :2] -= site.offset[:2]
        if poses.match(key, {"frame": np.arange(len(centers))}, quantity="20 Hz"):
            yaw = {"yaw": centers[:, 2]}
            poses.match(key, yaw, _ANGLE, quantity="20 Hz", angles={"yaw"})
            xy = np.column_stack([poses[key]["x_local"], poses[key]["y_local"]])
            error = np.linalg.norm(centers[:, :2] - xy, axis=1)
            report.compare("20 Hz position", where, error, 0.0 * error, atol=_POSITION)
        first = int(window.iteration_rows[0]) - window.first_row
        given = repr([tuple(lane) for lane in lanes.get(key, ())])
        ways = [repr([tuple(lane) for lane in way]) for way in local.sequences(centers[first:, :2])]
        report.compare("lanes", where, given if given in ways else ways[0], given)
    for start, track in sorted((set(poses) | set(lanes)) - seen):
        report.fail("lanes", f"{folder.name} window {start} track {track}", "no such scenario")
    poses.finish()
