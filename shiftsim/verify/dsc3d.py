"""Compares DSC3D conversion with known answers: a real sample, and scripted recordings."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj

from shiftsim.arrays import FloatArray
from shiftsim.data.deepplan.recording import convert_recording
from shiftsim.data.deepplan.states import sample_runs
from shiftsim.data.deepplan.windows import EGO, ConversionConfig, find_runs, judge_windows
from shiftsim.data.dsc3d.recording import Annotations, Site, find_map, open_site, read_recording
from shiftsim.data.opendrive.lanes import LaneKey
from shiftsim.errors import DataError
from shiftsim.geometry.frames import wrap_angles
from shiftsim.verify.dsc3d_lanes import LocalMap, keys_at, lane_sequences, load_map, placed_map
from shiftsim.verify.report import Report
from shiftsim.verify.tables import Group, read_groups
from shiftsim.world.state import center_poses

_EXACT = 1e-9  # rad, m in the local frame, degrees: the same formula on both sides
_UTM = 1e-8  # m, spacing of floats at UTM coordinates
_POSITION, _ANGLE = 2e-2, 2e-3  # m, rad: README of the scripted recordings
_SINGLE = 5e-7  # rad, two units in the last place of single-precision headings
_STEP_S = 0.05


def verify_dsc3d_sample(folder: Path, report: Report) -> None:
    """Compare reading and resampling with a folder of `expected_*` files.

    Args:
        folder: Holds `data`, `expected.json`, `expected_rows.parquet`, `expected_20hz.parquet`.
        report: Filled.
    """
    known = {"README.md", "expected.json", "expected_rows.parquet", "expected_20hz.parquet", "data"}
    _name_unknown(folder, known, report)
    site = open_site(folder / "data")
    if len(site.recordings) != 1:
        report.skip("recordings beyond the first", len(site.recordings) - 1)
    recording = read_recording(site, site.recordings[0])
    local = load_map(find_map(site))
    keys = keys_at(local, recording.bottom[:, :2])
    _compare_rows(folder, site, recording, keys, report)
    _compare_20hz(folder, recording, report)
    _compare_summary(folder, site, recording, keys, report)


def verify_dsc3d_synthetic(folder: Path, report: Report, maps: Path | None) -> None:
    """Compare windows, verdicts, lane sequences and 20 Hz poses with scripted recordings.

    Args:
        folder: One recording folder, or one above several.
        report: Filled.
        maps: Where the OpenDRIVE files named by `expected.json` lie; by default the folder `maps`
            beside the one of the references.
    """
    if (folder / "expected.json").is_file():
        _verify_scripted(folder, report, maps)
        return
    for path in sorted(folder.iterdir()):
        if (path / "expected.json").is_file():
            _verify_scripted(path, report, maps)
        elif path.name != "README.md":
            report.skip(f"unknown file {path.name}")


def _verify_scripted(folder: Path, report: Report, maps: Path | None) -> None:
    _name_unknown(folder, {"expected.json", "expected_ego_20hz.parquet", "data"}, report)
    expected = _read_json(folder / "expected.json")
    site = open_site(folder / "data")
    recording = read_recording(site, site.recordings[0])
    config = ConversionConfig()
    runs = find_runs(recording, config.max_hole_s)
    windows = judge_windows(recording, runs, config)
    name = folder.name
    report.compare("rate", name, 1.0 / recording.period, expected.pop("rate_hz"), atol=1e-9)
    report.compare("duration", name, recording.duration, expected.pop("duration_s"), atol=1e-9)
    report.compare("rows", name, len(recording.track), expected.pop("rows"))
    _compare_tracks(name, recording, expected.pop("tracks"), report)
    wanted = expected.pop("windows")
    report.compare(
        "windows", name, [w.start_s for w in windows], [w["start_s"] for w in wanted], atol=1e-9
    )
    for ours, theirs in zip(windows, wanted, strict=False):
        where = f"{name} window {theirs['start_s']:g} s"
        verdicts = {
            int(recording.track_ids[track]): verdict
            if partner < 0
            else f"{verdict} with {recording.track_ids[partner]}"
            for track, verdict, partner in zip(
                ours.tracks, ours.verdicts, ours.partners, strict=True
            )
        }
        given = {int(track): verdict for track, verdict in theirs.pop("verdict").items()}
        report.compare("tracks seen", where, sorted(verdicts), sorted(given))
        for track in sorted(set(verdicts) & set(given)):
            report.compare("verdict", f"{where} track {track}", verdicts[track], given[track])
        egos = sorted(track for track, verdict in verdicts.items() if verdict == EGO)
        report.compare("egos", where, egos, sorted(theirs.pop("egos")))
    map_name = str(expected.pop("map"))
    expected.pop("note", None)
    for key in expected:
        report.skip(f"unknown key {key!r} of expected.json")
    path = _find_map_file(folder, maps, map_name)
    poses = read_groups(folder / "expected_ego_20hz.parquet", ("window_start_s", "track_id"))
    if path is None:
        report.skip(f"lane sequences and poses: map {map_name} not found (--maps)", len(poses))
        return
    _compare_scenarios(name, site, recording, load_map(path), wanted, poses, report)


def _compare_scenarios(
    name: str,
    site: Site,
    recording: Annotations,
    local: LocalMap,
    wanted: list[dict[str, Any]],
    poses: dict[tuple[str, ...], Group],
    report: Report,
) -> None:
    """Poses and lanes of the converted scenarios, brought back to the local frame."""
    made = convert_recording(
        recording, placed_map(local, site), site.offset[:2], ConversionConfig()
    )
    egos = {ego.name: ego for ego in made.egos}
    lanes_wanted: dict[tuple[str, ...], Any] = {
        (f"{float(window['start_s'])}", str(int(track))): lanes
        for window in wanted
        for track, lanes in window.pop("lanes_from_t0").items()
    }
    for rest in wanted:
        for name_of in set(rest) - {"start_s"}:
            report.skip(f"unknown key {name_of!r} of a window")
    seen: set[tuple[str, ...]] = set()
    for window in made.windows:
        key = (f"{float(str(window.metadata['window_start_s']))}", str(window.metadata["track_id"]))
        where = f"{name} window {key[0]} track {key[1]}"
        ego = egos[window.ego]
        rows = slice(window.first_row - ego.first_row, window.last_row - ego.first_row)
        centers = center_poses(ego.states[rows, :3])
        centers[:, :2] -= site.offset[:2]
        seen.add(key)
        if key not in poses:
            report.fail("20 Hz pose", where, "a scenario that is not expected")
            continue
        table = dict(poses[key])
        frame = table.pop("frame")
        report.compare("20 Hz frames", where, np.arange(len(centers)), frame)
        if len(frame) == len(centers):
            xy = np.column_stack([table["x_local"], table["y_local"]])
            error = np.linalg.norm(centers[:, :2] - xy, axis=1)
            report.compare("20 Hz position", where, error, np.zeros(len(error)), atol=_POSITION)
            turn = wrap_angles(centers[:, 2] - table["yaw"])
            report.compare("20 Hz yaw", where, turn, np.zeros(len(turn)), atol=_ANGLE)
        _name_columns(table, {"x_local", "y_local", "yaw", "window_start_s", "track_id"}, report)
        start = int(window.iteration_rows[0]) - window.first_row
        given = json.dumps(lanes_wanted.get(key))
        ways = [json.dumps(way) for way in lane_sequences(local, centers[start:])]
        report.compare("lanes", where, given if given in ways else ways[0], given)
    for lost in sorted(set(poses) - seen):
        report.fail("20 Hz pose", f"{name} window {lost[0]} track {lost[1]}", "no such scenario")
    for lost in sorted(set(lanes_wanted) - seen):
        report.fail("lanes", f"{name} window {lost[0]} track {lost[1]}", "no such scenario")


def _compare_rows(
    folder: Path, site: Site, recording: Annotations, keys: list[list[LaneKey]], report: Report
) -> None:
    groups = read_groups(folder / "expected_rows.parquet", ("track_id",))
    names = [str(number) for number in recording.track_ids]
    report.compare("tracks", "expected_rows", names, sorted((k[0] for k in groups), key=int))
    to_degrees = pyproj.Transformer.from_crs(site.epsg, 4326, always_xy=True)
    for number, name in enumerate(names):
        if (name,) not in groups:
            continue
        table = groups[(name,)]
        rows = np.flatnonzero(recording.track == number)
        where = f"track {name}"
        frames = recording.frame[rows] * site.frame_distance
        if not report.compare("frame ids", where, frames, table["frame_id"].astype(np.int64)):
            continue
        utm = recording.bottom[rows, :2] + site.offset[:2]
        degrees = np.column_stack(to_degrees.transform(utm[:, 0], utm[:, 1]))
        lanes = [keys[row] for row in rows.tolist()]
        one = [k[0] if len(k) == 1 else LaneKey("", 0, 0) for k in lanes]
        ours: dict[str, tuple[Any, float]] = {
            "yaw": (recording.angles[rows, 0], _EXACT),
            "pitch": (recording.angles[rows, 1], _EXACT),
            "roll": (recording.angles[rows, 2], _EXACT),
            "centre_x": (recording.centers[rows, 0], _EXACT),
            "centre_y": (recording.centers[rows, 1], _EXACT),
            "centre_z": (recording.centers[rows, 2], _EXACT),
            "utm_x": (utm[:, 0], _UTM),
            "utm_y": (utm[:, 1], _UTM),
            "lon": (degrees[:, 0], _EXACT),
            "lat": (degrees[:, 1], _EXACT),
            "road": (np.array([k.road for k in one]), 0.0),
            "lane": (np.array([k.lane for k in one]), 0.0),
        }
        for column, (values, tolerance) in ours.items():
            _compare_column(f"row {column}", where, values, table, column, tolerance, report)
        _name_columns(table, {*ours, "frame_id", "track_id"}, report)


def _compare_20hz(folder: Path, recording: Annotations, report: Report) -> None:
    groups = read_groups(folder / "expected_20hz.parquet", ("track_id",))
    runs = find_runs(recording, ConversionConfig().max_hole_s)
    for run, track in enumerate(runs.track.tolist()):
        name = str(recording.track_ids[track])
        where = f"track {name}"
        if (name,) not in groups:
            report.fail("20 Hz sample", where, "no expected samples")
            continue
        table = groups[(name,)]
        first, last = recording.time[runs.first[run]], recording.time[runs.last[run]]
        steps = np.arange(np.ceil(first / _STEP_S - 1e-9), np.floor(last / _STEP_S + 1e-9) + 1)
        if not report.compare("20 Hz steps", where, steps.astype(np.int64), table["step"]):
            continue
        samples = sample_runs(recording, runs, np.full(len(steps), run, np.int64), steps * _STEP_S)
        origin = _sample_bottoms(recording, runs.first[run], runs.last[run], steps * _STEP_S)
        turn = wrap_angles(samples.poses[:, 2] - np.asarray(table["yaw"], np.float64))
        ours = {
            "t": steps * _STEP_S,
            "x": origin[:, 0],
            "y": origin[:, 1],
            "vx": samples.velocities[:, 0],
            "vy": samples.velocities[:, 1],
        }
        for column, values in ours.items():
            _compare_column(f"20 Hz {column}", where, values, table, column, _EXACT, report)
        report.compare("20 Hz yaw", where, turn, np.zeros(len(turn)), atol=_EXACT)
        _name_columns(table, {*ours, "yaw", "step", "track_id"}, report)
    for key in sorted(set(groups) - {(str(n),) for n in recording.track_ids}):
        report.fail("20 Hz sample", f"track {key[0]}", "no such track in the recording")


def _compare_summary(
    folder: Path, site: Site, recording: Annotations, keys: list[list[LaneKey]], report: Report
) -> None:
    expected = _read_json(folder / "expected.json")
    raw = _raw_columns(site, recording.name)
    duration = recording.duration
    order = np.lexsort((raw["frame_id"], raw["track_id"]))
    yaw = recording.angles[:, 0]
    moving = np.arctan2(raw["velocity_y"], raw["velocity_x"])[order]
    stamps = raw["time"]
    ours: dict[str, tuple[Any, float]] = {
        "rows": (len(recording.track), 0.0),
        "frames": (len(recording.clock), 0.0),
        "dt_s": (recording.period, 1e-12),
        "rate_hz": (1.0 / recording.period, 1e-9),
        "duration_s": (duration, 1e-9),
        "first_time": (_stamp(stamps[0]), 0.0),
        "last_time": (_stamp(stamps[-1]), 0.0),
        "max_abs_time_minus_frameid_over_rate_s": (
            float(np.abs((stamps - stamps[0]) * 1e-6 - recording.clock).max()),
            1e-9,
        ),
        "max_yaw_minus_velocity_heading_rad": (
            float(np.abs(wrap_angles(yaw - moving)).max()),
            _SINGLE,
        ),
        "max_yaw_minus_rotation_z_rad": (
            float(np.abs(yaw - raw["rotation_z"][order]).max()),
            _EXACT,
        ),
        "boxes_in_exactly_one_driving_lane": (sum(len(k) == 1 for k in keys), 0.0),
        "steps_20hz": (int(np.floor(duration / _STEP_S + 1e-9)) + 1, 0.0),
    }
    for key, (value, tolerance) in ours.items():
        if key in expected:
            report.compare(f"summary {key}", "recording", value, expected.pop(key), atol=tolerance)
    speed = np.sqrt(sum(raw[f"velocity_{axis}"] ** 2 for axis in "xyz"))[order]
    flat = np.hypot(raw["velocity_x"], raw["velocity_y"])[order]
    tracks = expected.pop("tracks", {})
    names = [str(number) for number in recording.track_ids]
    report.compare("tracks", "expected.json", names, sorted(tracks, key=int))
    for number, name in enumerate(names):
        given = dict(tracks.get(name, {}))
        rows = recording.track == number
        path = np.linalg.norm(np.diff(recording.bottom[rows, :2], axis=0), axis=1).sum()
        lanes = sorted({(k.road, k.lane) for row in np.flatnonzero(rows) for k in keys[row]})
        which = speed if abs(speed[rows].min() - given.get("speed_min", 0)) < 1e-5 else flat
        values: dict[str, tuple[Any, float]] = {
            "category": (recording.categories[number], 0.0),
            "rows": (int(rows.sum()), 0.0),
            "length": (recording.sizes[number, 0], _EXACT),
            "width": (recording.sizes[number, 1], _EXACT),
            "height": (recording.sizes[number, 2], _EXACT),
            "speed_min": (which[rows].min(), 1e-5),
            "speed_max": (which[rows].max(), 1e-5),
            "path_length_xy": (path, 1e-6),
            "road_lane": (json.dumps(lanes), 0.0),
        }
        if "road_lane" in given:
            given["road_lane"] = json.dumps(sorted(map(tuple, given["road_lane"])))
        for key, (value, tolerance) in values.items():
            if key in given:
                report.compare(
                    f"track {key}", f"track {name}", value, given.pop(key), atol=tolerance
                )
        for key in given:
            report.skip(f"unknown key {key!r} of a track")
    for key in expected:
        report.skip(f"unknown key {key!r} of expected.json")


def _compare_tracks(
    name: str, recording: Annotations, expected: dict[str, Any], report: Report
) -> None:
    ids = [int(number) for number in recording.track_ids]
    report.compare("track ids", name, ids, sorted(int(track) for track in expected))
    for number, track in enumerate(ids):
        given = dict(expected.get(str(track), {}))
        where = f"{name} track {track}"
        if "category" in given:
            report.compare("category", where, recording.categories[number], given.pop("category"))
        if "dim" in given:  # stored as float32
            report.compare("size", where, recording.sizes[number], given.pop("dim"), atol=1e-6)
        for key in given:
            report.skip(f"unknown key {key!r} of a track")


def _compare_column(
    quantity: str,
    where: str,
    values: Any,
    table: Group,
    column: str,
    tolerance: float,
    report: Report,
) -> None:
    if column not in table:
        report.skip(f"{quantity}: column {column!r} is not in the file")
        return
    expected = table[column]
    kind = np.asarray(values).dtype
    if kind.kind == "U":
        expected = expected.astype(str)
    report.compare(quantity, where, values, expected, atol=tolerance)


def _sample_bottoms(recording: Annotations, first: int, last: int, time: FloatArray) -> FloatArray:
    rows = slice(int(first), int(last) + 1)
    clock = recording.time[rows]
    return np.column_stack([np.interp(time, clock, recording.bottom[rows, k]) for k in (0, 1)])


def _raw_columns(site: Site, name: str) -> dict[str, Any]:
    folder = site.folder / "annotations" / name
    table = pq.read_table(folder / "annotations.parquet").drop_columns(["category"])
    time = pq.read_table(folder / "frames.parquet")["time"].cast(pa.timestamp("us", "UTC"))
    raw = {key: table[key].to_numpy() for key in table.column_names}
    return {**raw, "time": time.cast(pa.int64()).to_numpy()}


def _stamp(time_us: int) -> str:
    text = str(np.datetime64(int(time_us), "us")).replace("T", " ")
    return f"{text}+00:00"


def _find_map_file(folder: Path, maps: Path | None, name: str) -> Path | None:
    places = [folder / "data/map/map.xodr"]
    if maps is not None:
        places.insert(0, maps / name)
    places += [parent / "maps" / name for parent in folder.resolve().parents[:4]]
    return next((place for place in places if place.is_file()), None)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON ({error})") from error


def _name_unknown(folder: Path, known: set[str], report: Report) -> None:
    for path in sorted(folder.iterdir()):
        if path.name not in known:
            report.skip(f"unknown file {path.name}")
    report.note("derived columns of annotations.parquet: acceleration and angular velocity")


def _name_columns(table: Group, known: set[str], report: Report) -> None:
    for column in table:
        if column not in known:
            report.skip(f"unknown column {column!r}")
