"""DSC3D conversion against known answers: a real sample, and scripted recordings."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from parity_cases import (
    Cases,
    File,
    change_column,
    change_json,
    name_unknown,
    noticed,
    open_tables,
    read_file,
)

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.opendrive.graph import LaneSegment
from shiftsim.data.maps.opendrive.lanes import LaneKey
from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.readers.dsc3d import (
    POSITION,
    ROTATION,
    Site,
    find_map,
    open_site,
    read_recording,
    rotation_angles,
)
from shiftsim.data.readers.reader import SourceRecording
from shiftsim.data.readers.samples import (
    ROW_S,
    TrackSamples,
    rows_between,
    sample_run,
)
from shiftsim.data.readers.scenarios import Converted, convert_recording
from shiftsim.data.readers.windows import (
    EGO,
    OVERLAP,
    ConversionConfig,
    evaluate_windows,
    overlap_partners,
    window_spans,
)
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.metrics.route import driven_route
from shiftsim.world.state import center_poses

pytestmark = [pytest.mark.golden, pytest.mark.reference("dsc3d_synthetic")]
sample = pytest.mark.reference("dsc3d_sample")

ATOL = 1e-9
POSITION_ATOL = 2e-2  # m: README of the scripted recordings
MIN_SAMPLES = 10  # of a lane; shorter pieces at the ends of a lane sequence may be missing
CONFIG = ConversionConfig()  # as by default
DERIVED = "derived columns of annotations.parquet: acceleration and angular velocity"


class Lanes:
    """A map at its place in UTM, with the OpenDRIVE lanes behind the lanes of ours."""

    def __init__(self, path: Path, site: Site) -> None:
        self.offset, drive = site.offset[:2], read_opendrive(path)
        x, y = self.offset.tolist()
        self.road, built = build_road_map(drive, name=path.stem, offset=(x, y), epsg=site.epsg)
        index = self.road.edges.index
        self._segments: dict[int, Sequence[LaneSegment]] = {  # in the direction of travel
            index[edge]: segments for edge, segments in built.segments.items() if edge in index
        }

    def keys_at(self, x: float, y: float) -> list[LaneKey]:
        """OpenDRIVE lanes behind the lanes of ours that hold a point."""
        lanes = self.road.edges.containing(x, y).tolist()
        return [self._key(lane, x, y) for lane in lanes if lane in self._segments]

    def _key(self, lane: int, x: float, y: float) -> LaneKey:
        segments, share = self._segments[lane], self.road.progress_on(lane, x, y)
        ends = np.cumsum([segment.length for segment in segments])
        share *= ends[-1] / self.road.baselines.length(lane)
        return segments[int(np.searchsorted(ends[:-1], share, "right"))].key

    def sequences(self, centers: np.ndarray) -> list[list[LaneKey]]:
        """OpenDRIVE lanes passed by centres (n, 3), without and with short pieces at the ends."""
        route = driven_route(self.road, centers)
        points = zip(map(route.at, range(len(centers))), *centers[:, :2].T, strict=True)
        keys = [self._key(lanes[0], x, y) for lanes, x, y in points if lanes]
        runs = [(key, len([*same])) for key, same in groupby(keys)]
        lanes = [key for key, _ in runs]
        long = [i for i, (_, samples) in enumerate(runs) if samples >= MIN_SAMPLES]
        if not long:
            return [lanes]
        ends = product(range(long[0], -1, -1), range(long[-1], len(lanes)))
        return [lanes[first : last + 1] for first, last in ends]


@sample
def test_sample(folder: Path, cases: Cases) -> None:
    """Reading and resampling against `expected*` files beside the folder `data`."""
    site = open_site(folder / "data")
    if len(site.recordings) != 1:
        cases.skip("recordings beyond the first", len(site.recordings) - 1)
    recording, lanes = read_recording(site, site.recordings[0]), Lanes(find_map(site), site)
    raw = read_file(site.folder / "annotations" / recording.name / "annotations.parquet", cases)
    raw = raw.at(np.lexsort((raw["frame_id"], raw["track_id"])))
    bottom = np.column_stack([raw[name] for name in POSITION]).astype(np.float64)
    keys = [lanes.keys_at(x, y) for x, y in (bottom[:, :2] + lanes.offset).tolist()]
    rows = read_file(folder / "expected_rows.parquet", cases)
    compare_rows(rows, site, recording, keys, bottom, raw)
    compare_samples(read_file(folder / "expected_20hz.parquet", cases), recording, bottom)
    expected = read_file(folder / "expected.json", cases)
    compare_summary(expected, site, recording, keys, bottom, raw)
    cases.note(DERIVED)
    name_unknown(folder, cases, "data", "expected_rows.parquet", "expected_20hz.parquet", "*.json")


def compare_rows(
    file: File, site: Site, recording: TrackSamples, keys: Any, bottom: np.ndarray, raw: File
) -> None:
    """All boxes as recorded, by track and frame."""
    rows = file.at(np.lexsort((file["frame_id"], file["track_id"])))
    utm = bottom[:, :2] + site.offset[:2]
    lanes = [key[0] if len(key) == 1 else LaneKey("", 0, 0) for key in keys]
    lon, lat = pyproj.Transformer.from_crs(site.epsg, 4326, always_xy=True).transform(*utm.T)
    rotation = np.column_stack([raw[name] for name in ROTATION]).astype(np.float64)
    angles, up = rotation_angles(rotation)
    _, pitch, roll = angles.T
    x, y = recording.xy.T
    height = recording.sizes[recording.track, 2]
    ours = {
        "frame_id": recording.frame * site.frame_distance,
        "track_id": recording.track_ids[recording.track],
        **{"yaw": recording.raw_headings, "pitch": pitch, "roll": roll},
        **{"centre_x": x, "centre_y": y, "centre_z": bottom[:, 2] + 0.5 * height * up[:, 2]},
        **{"utm_x": utm[:, 0], "utm_y": utm[:, 1], "lon": lon, "lat": lat},
        "road": [lane.road for lane in lanes],
        "lane": [lane.lane for lane in lanes],
    }
    # spacing of floats at UTM coordinates
    rows.match("recording", ours, {"": ATOL, "utm_x": 1e-8, "utm_y": 1e-8})
    file.finish()


def compare_samples(file: File, recording: TrackSamples, bottom: np.ndarray) -> None:
    """The bottoms of all boxes at 20 Hz, by track and time."""
    recording = replace(recording, xy=np.ascontiguousarray(bottom[:, :2]))
    runs = recording.runs
    first, last = rows_between(recording.time[runs.first], recording.time[runs.last])
    run = np.repeat(np.arange(len(first)), last - first + 1)
    step = np.concatenate([*map(np.arange, first, last + 1)])
    time = step * ROW_S
    parts = [sample_run(recording, i, time[run == i]) for i in range(len(first))]
    poses, velocities = map(np.concatenate, zip(*parts, strict=True))
    ours = {"track_id": recording.track_ids[runs.track[run]], "step": step, "t": time}
    ours |= dict(zip(("x", "y", "yaw"), poses.T, strict=True))
    ours |= dict(zip(("vx", "vy"), velocities.T, strict=True))
    file.match("recording", ours, ATOL)
    file.finish()


def compare_summary(
    expected: File, site: Site, recording: TrackSamples, keys: Any, bottom: np.ndarray, raw: File
) -> None:
    report, folder = expected.report, site.folder / "annotations" / recording.name
    velocity = np.column_stack([raw[f"velocity_{axis}"] for axis in "xyz"])
    stamps = read_file(folder / "frames.parquet", report)["time"].astype("datetime64[us]")
    lag = (stamps - stamps[0]).astype(np.int64) * 1e-6 - recording.clock
    yaw, moving = recording.raw_headings, np.arctan2(velocity[:, 1], velocity[:, 0])
    first, last = (f"{t:%Y-%m-%d %H:%M:%S.%f}+00:00" for t in stamps[[0, -1]].tolist())
    ours = {
        "rows": len(recording.track),
        "frames": len(recording.clock),
        "dt_s": recording.period,
        "rate_hz": 1.0 / recording.period,
        "duration_s": recording.duration,
        **{"first_time": first, "last_time": last},
        "max_abs_time_minus_frameid_over_rate_s": np.abs(lag).max(),
        "max_yaw_minus_velocity_heading_rad": np.abs(wrap_angles(yaw - moving)).max(),
        "max_yaw_minus_rotation_z_rad": np.abs(yaw - raw["rotation_z"]).max(),
        "boxes_in_exactly_one_driving_lane": sum(len(key) == 1 for key in keys),
        "steps_20hz": int(recording.duration / ROW_S + 1e-9) + 1,
    }
    # two units in the last place of 32 bit
    atol = {"": ATOL, "dt_s": 1e-12, "max_yaw_minus_velocity_heading_rad": 5e-7}
    expected.match("recording", ours, atol, quantity="summary")
    for number, where, track in tracks_of(expected, recording):
        rows = np.flatnonzero(recording.track == number)
        lanes = {(key.road, key.lane) for row in rows for key in keys[row]}
        track.values["road_lane"].sort()
        steps = np.hypot(*np.diff(bottom[rows, :2], axis=0).T)
        speed = np.linalg.norm(velocity[rows], axis=1)
        length, width, height = recording.sizes[number]
        mine = {
            "category": recording.categories[number],
            **{"rows": len(rows), "length": length, "width": width, "height": height},
            **{"speed_min": speed.min(), "speed_max": speed.max(), "path_length_xy": steps.sum()},
            "road_lane": [*map(list, sorted(lanes))],
        }
        # from 32 bit floats
        atol = {"": ATOL, "speed_min": 1e-5, "speed_max": 1e-5, "path_length_xy": 1e-6}
        track.match(where, mine, atol, quantity="track")
    expected.finish()


def tracks_of(expected: File, recording: TrackSamples) -> Iterator[tuple[int, str, File]]:
    """Number, name and answers of every track; compares which there are."""
    tracks, track_ids = expected.each("tracks")[0], recording.track_ids.tolist()
    expected.report.compare("track ids", recording.name, track_ids, sorted(map(int, tracks)))
    for number, track in enumerate(track_ids):
        yield number, f"{recording.name} track {track}", tracks.each(str(track))[0]


def test_scripted_recordings(folder: Path, maps: Path, cases: Cases) -> None:
    """Windows, verdicts, lane sequences and 20 Hz poses of a recording, or of several."""
    inner = sorted(path.parent for path in folder.glob("*/expected.json"))
    for part in inner or [folder]:
        compare_scripted(part, maps, cases)
    parts = ["data", "expected_ego_20hz.parquet", "expected.json"]
    name_unknown(folder, cases, *(path.name for path in inner), *([] if inner else parts))


def compare_scripted(folder: Path, maps: Path, cases: Cases) -> None:
    expected, name, site = read_file(folder / "expected.json", cases), folder.name, folder / "data"
    site = open_site(site)
    recording = read_recording(site, site.recordings[0])
    facts = {"rate_hz": 1.0 / recording.period, "duration_s": recording.duration}
    facts["rows"] = len(recording.track)
    expected.match(name, facts, ATOL, quantity="recording")
    for number, where, track in tracks_of(expected, recording):
        ours = {"category": recording.categories[number], "dim": recording.sizes[number]}
        track.match(where, ours, {"dim": 1e-6}, quantity="track")  # from 32 bit floats
    lanes_from = compare_windows(expected, recording, name)
    expected.used.add("note")
    here = [maps / expected["map"], folder / "data/map/map.xodr"]
    if found := next(filter(Path.is_file, here), None):
        lanes = Lanes(found, site)
        spans = window_spans(recording.duration, CONFIG)
        placed = replace(recording, offset=lanes.offset)
        source = SourceRecording(placed, BuiltMap(lanes.road, {}), config=CONFIG, spans=spans)
        converted = convert_recording(source)
        compare_converted(folder, converted, lanes, lanes_from, cases)
    else:
        cases.skip(f"lane sequences and poses: map {expected['map']} not found (--maps)")
    expected.finish()
    cases.note(DERIVED)
    name_unknown(folder, cases, "data", "expected_ego_20hz.parquet", "expected.json")


def compare_windows(expected: File, recording: TrackSamples, name: str) -> dict[Any, Any]:
    """Windows and verdicts; what the file says of lanes, by window and ego."""
    cases, track_ids, lanes_from = expected.report, recording.track_ids.tolist(), {}
    windows = evaluate_windows(recording, CONFIG, window_spans(recording.duration, CONFIG))
    everybody = np.ones(len(track_ids), np.bool_)
    partners = overlap_partners(recording, everybody, CONFIG.max_overlap)
    wanted = expected.each("windows")
    cases.compare("windows", name, len(windows), len(wanted))
    for window, theirs in zip(windows, wanted, strict=False):
        where, given = f"{name} window {window.span.start_s:g} s", theirs["verdict"]
        verdicts, judged = {}, zip(window.tracks, window.verdicts, strict=True)
        begin_s, end_s = window.span.start_s - ATOL, window.span.start_s + window.span.length_s
        inside = (recording.time >= begin_s) & (recording.time < end_s - ATOL)
        for number, verdict in judged:
            rows = np.flatnonzero(inside & (recording.track == number) & (partners >= 0))
            other = f" with {track_ids[partners[rows[0]]]}" if verdict == OVERLAP else ""
            verdicts[str(track_ids[number])] = f"{verdict}{other}"
        egos = [int(name) for name, verdict in verdicts.items() if verdict == EGO]
        ours = {"start_s": window.span.start_s, "egos": egos}
        theirs.match(where, ours, quantity="window", unordered=("egos",))
        cases.compare("tracks seen", where, sorted(verdicts), sorted(given))
        for seen in sorted(set(verdicts) & set(given)):
            cases.compare("verdict", f"{where} track {seen}", verdicts[seen], given[seen])
        begin = f"{theirs['start_s']:.1f}"
        lanes_from |= {(begin, ego): way for ego, way in theirs["lanes_from_t0"].items()}
    return lanes_from


def compare_converted(
    folder: Path, converted: Converted, lanes: Lanes, lanes_from: Any, cases: Cases
) -> None:
    """Poses and lanes of the converted scenarios, brought back to the local frame."""
    poses = open_tables(folder, cases, "expected_ego_20hz")["expected_ego_20hz"]
    egos, seen = {ego.name: ego for ego in converted.egos}, set()
    for window in converted.windows:
        begin = float(str(window.metadata["window_start_s"]))
        key = (f"{begin:.1f}", str(window.metadata["track_id"]))
        seen.add(key)
        where, ego = f"{folder.name} window {key[0]} track {key[1]}", egos[window.ego]
        rows = slice(window.first_row - ego.first_row, window.last_row - ego.first_row)
        centers = center_poses(ego.states[rows, :3])
        if poses.match(key, {"frame": np.arange(len(centers))}, quantity="20 Hz"):
            poses.match(key, {"yaw": centers[:, 2]}, quantity="20 Hz", angles={"yaw"})
            xy = np.column_stack([poses[key]["x_local"], poses[key]["y_local"]])
            error = np.linalg.norm(centers[:, :2] - lanes.offset - xy, axis=1)
            cases.compare("20 Hz position", where, error, 0.0 * error, atol=POSITION_ATOL)
        first = int(window.iteration_rows[0]) - window.first_row
        given = repr([tuple(lane) for lane in lanes_from.get(key, ())])
        passed = [repr([tuple(lane) for lane in way]) for way in lanes.sequences(centers[first:])]
        cases.compare("lanes", where, given if given in passed else passed[0], given)
    for start, track in sorted((set(poses) | set(lanes_from)) - seen):
        cases.fail("lanes", f"{folder.name} window {start} track {track}", "no such scenario")
    poses.finish()


def copy(source: Path, target: Path) -> Path:
    shutil.copytree(source, target, copy_function=shutil.copyfile)
    for path in [target, *target.rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)
    return target


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("expected_rows.parquet", "lat"),
        ("expected_20hz.parquet", "vx"),
        ("data/annotations/2000-12-31T23-59-59/annotations.parquet", "velocity_y"),
        ("expected.json", "path_length_xy"),
    ],
)
def test_a_changed_value_of_the_sample_is_noticed(
    shared: Path, tmp_path: Path, name: str, column: str
) -> None:
    folder, cases = copy(shared / "reference/dsc3d_sample", tmp_path / "sample"), Cases()
    if name.endswith(".json"):
        change_json(folder / name, folder / name, "tracks", "3", column)
    else:
        change_column(folder / name, folder / name, column)
    assert noticed(test_sample, folder, cases)


def test_changed_answers_of_a_scripted_recording_are_noticed(shared: Path, tmp_path: Path) -> None:
    folder, cases = copy(shared / "reference/dsc3d_synthetic/mona_15hz", tmp_path / "mona"), Cases()
    path = folder / "expected.json"
    change_json(path, path, "windows", 1, "verdict", "10")
    change_json(path, path, "windows", 2, "lanes_from_t0", "1", 0, 2)
    table = folder / "expected_ego_20hz.parquet"
    change_column(table, table, "y_local", row=99)
    test_scripted_recordings(folder, shared / "maps", cases)
    found = {line.partition(":")[0] for line in cases.mismatches}
    assert found == {"verdict", "lanes", "20 Hz position"}
