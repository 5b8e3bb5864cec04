"""Compares DSC3D conversion with known answers: a real sample, and scripted recordings."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from shiftsim.data.maps.opendrive.lanes import LaneKey
from shiftsim.data.maps.opendrive.map import Origin, build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.readers.annotations import Annotations, Site, read_recording
from shiftsim.data.readers.dsc3d import find_map, open_site
from shiftsim.data.readers.reader import SourceRecording, site_map
from shiftsim.data.readers.samples import ROW_S, Boxes, find_runs, rows_between, sample_run
from shiftsim.data.readers.scenarios import Converted, convert_recording
from shiftsim.data.readers.windows import EGO, ConversionConfig, evaluate_windows, window_spans
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.route import driven_route
from shiftsim.verify.files import Compare, Parts, Source, open_tables, read_file, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.world.state import center_poses

_POSITION = 2e-2  # m: README of the scripted recordings
_MIN_PIECE = 10  # samples; shorter pieces at the ends of a lane sequence may be missing
_CONFIG = ConversionConfig()  # as by default
Keys = list[list[LaneKey]]  # OpenDRIVE lanes that every row lies in
Ways = dict[tuple[str, ...], list[list[Any]]]  # lanes that egos pass, by window and track
FACTS = read_tables(__file__)
_DERIVED = "derived columns of annotations.parquet: acceleration and angular velocity"


class Lanes:
    """A map at its place in UTM, with the OpenDRIVE lanes behind the lanes of ours."""

    def __init__(self, path: Path, site: Site) -> None:
        self.offset, drive = site.offset[:2], read_opendrive(path)
        x, y = self.offset.tolist()
        self.road, made = build_road_map(drive, name=path.stem, offset=(x, y), epsg=site.epsg)
        self._pieces: dict[int, list[Origin]] = defaultdict(list)  # in the direction of travel
        for origin in made.origins:
            if (lane := self.road.edges.index.get(origin.id)) is not None:
                self._pieces[lane].append(origin)

    def keys_at(self, x: float, y: float) -> list[LaneKey]:
        """OpenDRIVE lanes behind the lanes of ours that hold a point."""
        lanes = self.road.edges.containing(x, y).tolist()
        return [self._key(lane, x, y) for lane in lanes if lane in self._pieces]

    def _key(self, lane: int, x: float, y: float) -> LaneKey:
        pieces, share = self._pieces[lane], self.road.progress_on(lane, x, y)
        ends = np.cumsum([abs(piece.end - piece.begin) for piece in pieces])
        share *= ends[-1] / self.road.baselines.length(lane)
        return pieces[int(np.searchsorted(ends[:-1], share, "right"))].key

    def sequences(self, centers: FloatArray) -> list[list[LaneKey]]:
        """OpenDRIVE lanes passed by centres (n, 3), without and with short pieces at the ends."""
        route = driven_route(self.road, centers)
        points = zip(map(route.at, range(len(centers))), *centers[:, :2].T, strict=True)
        keys = [self._key(lanes[0], x, y) for lanes, x, y in points if lanes]
        pieces = [(key, len([*same])) for key, same in groupby(keys)]
        lanes = [key for key, _ in pieces]
        long = [i for i, (_, samples) in enumerate(pieces) if samples >= _MIN_PIECE]
        if not long:
            return [lanes]
        ends = product(range(long[0], -1, -1), range(long[-1], len(lanes)))
        return [lanes[first : last + 1] for first, last in ends]


def verify_dsc3d_sample(folder: Path, report: Report) -> None:
    """Compare reading and resampling with `expected*` files beside the folder `data`."""
    site = open_site(folder / "data")
    if len(site.recordings) != 1:
        report.skip("recordings beyond the first", len(site.recordings) - 1)
    recording, lanes = read_recording(site, site.recordings[0]), Lanes(find_map(site), site)
    keys = [lanes.keys_at(x, y) for x, y in (recording.bottom[:, :2] + lanes.offset).tolist()]
    files: dict[str, Compare] = {
        "expected_rows.parquet": lambda file, _: _compare_rows(file, site, recording, keys),
        "expected_20hz.parquet": lambda file, _: _compare_samples(file, recording),
        "expected.json": lambda file, _: _compare_summary(file, site, recording, keys),
    }
    verify_files(folder, report, {"data": lambda path: report.note(_DERIVED)}, files)


def _compare_rows(file: Source, site: Site, recording: Annotations, keys: Keys) -> None:
    """All boxes as recorded, by track and frame."""
    rows = file.at(np.lexsort((file["frame_id"], file["track_id"])))
    utm, frames = recording.bottom[:, :2] + site.offset[:2], recording.frame * site.frame_distance
    names = {"recording": recording, "track": recording.track, "utm": utm, "frames": frames}
    names["lanes"] = [key[0] if len(key) == 1 else LaneKey("", 0, 0) for key in keys]
    degrees = pyproj.Transformer.from_crs(site.epsg, 4326, always_xy=True).transform(*utm.T)
    FACTS["rows"].match(rows, "recording", degrees=degrees, **names)


def _compare_samples(file: Source, recording: Annotations) -> None:
    """The bottoms of all boxes at 20 Hz, by track and time."""
    recording = replace(recording, centers=recording.bottom)
    runs = find_runs(recording, _CONFIG.max_hole_s)
    first, last = rows_between(recording.time[runs.first], recording.time[runs.last])
    steps: list[IntArray] = [*map(np.arange, first, last + 1)]
    boxes = [sample_run(recording, runs, run, row * ROW_S) for run, row in enumerate(steps)]
    run = np.repeat(np.arange(len(first)), last - first + 1)
    step = np.concatenate(steps)
    names = {"recording": recording, "track": runs.track[run], "step": step, "time": step * ROW_S}
    samples = Boxes(*map(np.concatenate, zip(*boxes, strict=True)))
    FACTS["samples"].match(file, "recording", samples=samples, **names)


def _compare_summary(expected: Source, site: Site, recording: Annotations, keys: Keys) -> None:
    report, folder = expected.report, site.folder / "annotations" / recording.name
    raw = read_file(folder / "annotations.parquet", report)
    order = np.lexsort((raw["frame_id"], raw["track_id"]))
    velocity = np.column_stack([raw[f"velocity_{axis}"] for axis in "xyz"])[order]
    stamps = read_file(folder / "frames.parquet", report)["time"].astype("datetime64[us]")
    lag = (stamps - stamps[0]).astype(np.int64) * 1e-6 - recording.clock
    yaw, moving = recording.angles[:, 0], np.arctan2(velocity[:, 1], velocity[:, 0])
    facts = {"recording": recording, "rate": 1.0 / recording.period, "lag": np.abs(lag)}
    facts |= dict(zip(("first", "last"), stamps[[0, -1]].tolist(), strict=True))
    facts["to_velocity"] = np.abs(wrap_angles(yaw - moving))
    facts["to_rotation"] = np.abs(yaw - raw["rotation_z"][order])
    facts["alone"] = [key for key in keys if len(key) == 1]
    facts["steps"] = int(recording.duration / ROW_S + 1e-9) + 1
    FACTS["summary"].match(expected, "recording", **facts)
    for number, where, track in _tracks(expected, recording):
        rows = np.flatnonzero(recording.track == number)
        lanes = {(key.road, key.lane) for row in rows for key in keys[row]}
        track.values["road_lane"].sort()
        facts = {"recording": recording, "number": number, "lanes": [*map(list, sorted(lanes))]}
        steps = np.hypot(*np.diff(recording.bottom[rows, :2], axis=0).T)
        speed = np.linalg.norm(velocity[rows], axis=1)
        FACTS["track"].match(track, where, speed=speed, steps=steps, **facts)


def _tracks(expected: Source, recording: Annotations) -> Iterator[tuple[int, str, Source]]:
    """Number, name and answers of every track; compares which there are."""
    tracks, ids = expected.each("tracks")[0], recording.track_ids.tolist()
    expected.report.compare("track ids", recording.name, ids, sorted(map(int, tracks)))
    for number, track in enumerate(ids):
        yield number, f"{recording.name} track {track}", tracks.each(str(track))[0]


def verify_dsc3d_synthetic(folder: Path, report: Report, maps: Path | None) -> None:
    """Compare windows, verdicts, lane sequences and 20 Hz poses with scripted recordings.

    `folder` is one recording or holds several. Its maps lie in `maps`, or in a folder of that name
    beside the one of the references.
    """
    inner = partial(verify_dsc3d_synthetic, report=report, maps=maps)
    parts: Parts = {path.parent.name: inner for path in folder.glob("*/expected.json")}
    if (folder / "expected.json").is_file():
        poses = {"expected_ego_20hz.parquet": lambda path: None}  # read with `expected.json`
        parts = {"data": lambda path: report.note(_DERIVED), **poses}
    scripted = partial(_compare_scripted, folder=folder, maps=maps)
    verify_files(folder, report, parts, {"expected.json": scripted})


def _compare_scripted(expected: Source, where: str, folder: Path, maps: Path | None) -> None:
    report, name, site = expected.report, folder.name, open_site(folder / "data")
    recording = read_recording(site, site.recordings[0])
    FACTS["recording"].match(expected, name, recording=recording, rate=1.0 / recording.period)
    for number, where, track in _tracks(expected, recording):
        FACTS["scripted"].match(track, where, recording=recording, number=number)
    ways = _compare_windows(expected, recording, name)
    expected.used.add("note")
    places = [maps / expected["map"]] if maps is not None else []
    places += [folder / "data/map/map.xodr"]
    places += [parent / "maps" / expected["map"] for parent in folder.resolve().parents[:4]]
    if found := next(filter(Path.is_file, places), None):
        lanes = Lanes(found, site)
        spans = window_spans(recording.duration, _CONFIG)
        source = SourceRecording(
            recording, site_map(lanes.road, {}), config=_CONFIG, offset=lanes.offset, spans=spans
        )
        made = convert_recording(source)
        _compare_made(folder, made, lanes, ways, report)
    else:
        report.skip(f"lane sequences and poses: map {expected['map']} not found (--maps)")


def _compare_windows(expected: Source, recording: Annotations, name: str) -> Ways:
    """Compare windows and verdicts; what the file says of lanes, by window and ego."""
    report, ids, ways = expected.report, recording.track_ids.tolist(), Ways()
    runs, spans = (
        find_runs(recording, _CONFIG.max_hole_s),
        window_spans(recording.duration, _CONFIG),
    )
    windows = evaluate_windows(recording, runs, _CONFIG, spans)
    wanted = expected.each("windows")
    report.compare("windows", name, len(windows), len(wanted))
    for window, theirs in zip(windows, wanted, strict=False):
        where, given = f"{name} window {window.span.start_s:g} s", theirs["verdict"]
        verdicts, judged = {}, zip(window.tracks, window.verdicts, window.partners, strict=True)
        for number, verdict, partner in judged:
            other = f" with {ids[partner]}" if partner >= 0 else ""
            verdicts[str(ids[number])] = f"{verdict}{other}"
        egos = [int(name) for name, verdict in verdicts.items() if verdict == EGO]
        FACTS["window"].match(theirs, where, window=window, egos=egos)
        report.compare("tracks seen", where, sorted(verdicts), sorted(given))
        for seen in sorted(set(verdicts) & set(given)):
            report.compare("verdict", f"{where} track {seen}", verdicts[seen], given[seen])
        begin = f"{theirs['start_s']:.1f}"
        ways |= {(begin, ego): way for ego, way in theirs["lanes_from_t0"].items()}
    return ways


def _compare_made(folder: Path, made: Converted, lanes: Lanes, ways: Ways, report: Report) -> None:
    """Poses and lanes of the converted scenarios, brought back to the local frame."""
    poses = open_tables(folder, report, "expected_ego_20hz")["expected_ego_20hz"]
    egos, seen = {ego.name: ego for ego in made.egos}, set()
    for window in made.windows:
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
            report.compare("20 Hz position", where, error, 0.0 * error, atol=_POSITION)
        first = int(window.iteration_rows[0]) - window.first_row
        given = repr([tuple(lane) for lane in ways.get(key, ())])
        passed = [repr([tuple(lane) for lane in way]) for way in lanes.sequences(centers[first:])]
        report.compare("lanes", where, given if given in passed else passed[0], given)
    for start, track in sorted((set(poses) | set(ways)) - seen):
        report.fail("lanes", f"{folder.name} window {start} track {track}", "no such scenario")
    poses.finish()
