"""Is a store sound? Everything that can be said about it without knowing where it came from."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import shapely

from shiftsim.data.maps.builder import line_faults
from shiftsim.data.readers.motion import MAX_SHARE, contradiction, fitted_velocities
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.recordings import ego_span, ego_states
from shiftsim.data.store.schema import MOTION
from shiftsim.data.store.tables import MANIFEST, REPORTS, column, digest, read_manifest
from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners, wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world import state
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import CHECK
from shiftsim.world.scenario import Scenario

_MAX_SPEED = 100.0  # m/s; anything faster is in the wrong unit
_LAST_STEPS_S = 0.5  # by which the last iteration may come before the end
_MAX_LENGTH = 60.0  # m, of a track
_MAX_ANGLE = 2.0 * np.pi  # rad; larger headings are in degrees
_LEAST_S = 3.0  # s, of a scenario
_MAX_STEP_US = 1_000_000  # us between rows
_BESIDE = ("filter", "splits")  # folders that hold statements about the scenarios
_ROW_S = 0.05
_FAST = 2.0  # m/s
_MAX_TURNED = 0.5  # rad, median angle between heading and motion of a vehicle
_LEAST_ROWS, _MAX_WRONG = 20, 0.2  # of motion that say something; share of tracks, 0.11 by noise
_MAX_OFF = 3.0  # m, how far the ego may be beside lanes and drivable area
_MAX_OFF_SHARE = 0.1  # of the iterations
_MIN_OVERLAP = 0.5  # m^2, of two lanes; less is hardly ever met
# what is checked, and what to do where it is wrong
_REMEDIES = {
    "scenarios": "convert recordings again: the conversion says why it dropped what it dropped",
    "map": CHECK,
    "lines": "repair these roads in the source of the map, and convert it again",
    "lanes overlap": "convert the map again, or repair the polygons of these lanes",
    "repeated rows": "leave repeated rows out, and give every object an id of its own",
    "velocity": "check the unit and the axes of velocities and positions where they came from",
    "heading": "check that headings are radians, 0 along the x axis, counter-clockwise",
    "off the map": "check that map and recording have one origin, or leave the scenario out",
    "range": CHECK,
    "length": "cut longer windows, or leave the scenario out",
    "route": "correct the route in shiftsim inspect, or leave the scenario out",
    "gap": "leave the scenario out",
    "short": "its score does not compare with that of a whole scenario",
}


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong."""

    where: str  # file, map or scenario
    what: str  # what is wrong there: value and limit
    is_error: bool = True  # whether results cannot be trusted; else it is only unusual
    remedy: str = ""  # what to do
    kind: str = ""  # short name of what was checked
    recording: str = ""  # the recording that it belongs to


# kind, of `_REMEDIES`; what is wrong; whether it is an error
_Finding: TypeAlias = tuple[str, str, bool]
# area [m^2] and a point (2,) of the overlap of two lanes, by their numbers
_Overlaps: TypeAlias = dict[tuple[int, int], tuple[float, FloatArray]]


@dataclass(frozen=True)
class RecordingRow:
    """What was found in one recording."""

    recording: str
    city: str
    duration_s: float
    tracks: int
    scenarios: int
    errors: int
    unusual: int
    found: dict[str, int]  # count by kind


@dataclass(frozen=True)
class CheckReport:
    """Everything that was found in a store."""

    problems: list[Problem]
    recordings: list[RecordingRow]

    def __repr__(self) -> str:
        errors = sum(problem.is_error for problem in self.problems)
        return f"<CheckReport: {errors} errors, {len(self.problems) - errors} unusual>"


def survey_store(path: str | Path) -> CheckReport:
    """All problems of a store, and what was found in each recording; a DataError if it is none."""
    path = Path(path)
    manifest = read_manifest(path)
    problems = list(_check_files(path, manifest["files"]))
    if any(problem.is_error for problem in problems):
        return CheckReport(problems, [])
    with _noted(problems, str(path)):
        store = ScenarioStore(path)
    if problems and problems[-1].is_error:
        return CheckReport(problems, [])
    if not len(store):
        what = "the store has no scenarios, need at least 1"
        problems += _problems(str(path), [("scenarios", what, True)])
    overlaps: dict[str, _Overlaps] = {}
    for city in store.cities:
        where = f"map {city}"
        with _noted(problems, where, "map"):
            road = store.map(city)
            overlaps[city] = _find_overlaps(road)
            problems += _problems(where, _check_map(road, overlaps[city]))
    rows = []
    summary = store.summary().select(["token", "recording", "city", "ego"]).to_pylist()
    summary.sort(key=lambda row: (row["recording"], row["token"]))
    for name, group in groupby(summary, lambda row: row["recording"]):
        row, found = _check_recording(store, name, list(group), overlaps)
        rows.append(row)
        problems += found
    return CheckReport(problems, rows)


def _problems(where: str, found: Iterable[_Finding], recording: str = "") -> Iterator[Problem]:
    for kind, what, is_error in found:
        yield Problem(where, what, is_error, _REMEDIES[kind], kind, recording)


@contextmanager
def _noted(
    problems: list[Problem], where: str, kind: str = "", recording: str = ""
) -> Iterator[None]:
    """Note a file that cannot be read among the problems."""
    try:
        yield
    except DataError as error:
        problems.append(Problem(where, error.message, True, error.hint, kind, recording))


def _check_recording(
    store: ScenarioStore, name: str, scenarios: list[dict[str, str]], overlaps: dict[str, _Overlaps]
) -> tuple[RecordingRow, list[Problem]]:
    """One recording with its egos and scenarios."""
    problems: list[Problem] = []
    where, city, duration, tracks = f"recording {name}", scenarios[0]["city"], 0.0, 0
    with _noted(problems, where, "file", name):
        recording = store.recording(name)
        time_us = column(recording.frames.read(columns=["time_us"], validate=False), "time_us")
        duration = float(time_us[-1] - time_us[0]) / 1e6
        boxes = recording.tracks.read(validate=False).sort_by(
            [("track", "ascending"), ("row", "ascending")]
        )
        tracks = len(boxes["track"].unique())
        problems += _problems(where, _check_boxes(boxes, time_us), name)
        for ego in sorted({row["ego"] for row in scenarios}):
            table = store.ego(name, ego)
            first, last = ego_span(table)
            states = ego_states(table, first, last, validate=False)
            found = _check_ego(states, time_us[first:last])
            problems += _problems(f"{where}, ego {ego}", found, name)
    for row in scenarios:
        where = f"scenario {row['token']}"
        with _noted(problems, where, "file", name):
            scene = store.read(row["token"], validate=False)
            found = _check_scenario(scene, overlaps.get(row["city"]))
            problems += _problems(where, found, name)
    errors = sum(problem.is_error for problem in problems)
    kinds = dict(sorted(Counter(problem.kind for problem in problems).items()))
    counts = len(scenarios), errors, len(problems) - errors
    return RecordingRow(name, city, duration, tracks, *counts, kinds), problems


def _check_files(store: Path, files: dict[str, str]) -> Iterator[Problem]:
    for name, expected in files.items():
        path = store / name
        if not os.path.isfile(path):  # a name may be too long to ask for
            yield Problem(name, "the file is missing")
        elif digest(path) != expected:
            yield Problem(name, f"the content is not what {MANIFEST} says")
    known = {MANIFEST, *files}
    for path in sorted(store.rglob("*")):
        name = path.relative_to(store).as_posix()
        top = path.relative_to(store).parts[0]
        is_statement = top in _BESIDE or (top == REPORTS and path.suffix == ".png")
        if path.is_file() and not is_statement and name not in known:
            yield Problem(name, f"the file is not listed in {MANIFEST}", is_error=False)


def _find_overlaps(road: VectorMap) -> _Overlaps:
    shapes = np.array([road.edges.shape(lane) for lane in range(road.num_lanes)], object)
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    is_valid = shapely.is_valid(shapes)
    chosen = (first < second) & is_valid[first] & is_valid[second]
    first, second = first[chosen], second[chosen]
    shared = shapely.intersection(shapes[first], shapes[second])
    area = shapely.area(shared)
    return {
        (int(first[i]), int(second[i])): (
            float(area[i]),
            shapely.get_coordinates(shapely.point_on_surface(shared[i]))[0],
        )
        for i in np.flatnonzero(area > _MIN_OVERLAP).tolist()
    }


def _check_map(road: VectorMap, overlaps: _Overlaps) -> Iterator[_Finding]:
    ids, limits = road.edges.ids, road.speed_limits[~np.isnan(road.speed_limits)]
    if ((limits < 0.0) | (limits > _MAX_SPEED)).any():
        yield "map", f"a speed limit is not within 0 … {_MAX_SPEED:g} m/s", True
    if overlaps:
        (a, b), (area, point) = max(overlaps.items(), key=lambda item: item[1][0])
        what = (
            f"{len(overlaps)} pairs of lanes overlap by more than {_MIN_OVERLAP:g} m²,"
            f" most {ids[a]!r} and {ids[b]!r}, by {area:.1f} m² at ({point[0]:.1f},"
            f" {point[1]:.1f}); a rollout that comes there fails"
        )
        yield "lanes overlap", what, False
    for fault, count in line_faults(road).items():
        yield "lines", f"{fault} ({count})", False


def _check_boxes(boxes: pa.Table, time_us: IntArray) -> Iterator[_Finding]:
    """What is wrong with the boxes of a recording.

    `boxes` are rows of `schema.TRACKS`, sorted by track, then by row; `time_us` (R,) are the times.
    """
    row, track = column(boxes, "row"), column(boxes, "track")
    twice = np.flatnonzero((np.diff(row) == 0) & (np.diff(track) == 0))
    if len(twice):
        name = boxes["token"][int(twice[0])].as_py()
        what = f"track {name!r} has two boxes in row {row[twice[0]]} ({len(twice)} such boxes)"
        yield "repeated rows", what, True
        return
    motion = np.column_stack([column(boxes, name) for name in MOTION])
    kinds = column(boxes, "kind")
    good = np.isfinite(motion).all(axis=1) & (kinds <= state.LAST_AGENT_KIND)
    good = np.flatnonzero(good & (row >= 0) & (row < len(time_us)))
    if not len(good) or (np.diff(time_us) <= 0).any():
        return
    _, first, owner = np.unique(track[good], return_index=True, return_inverse=True)
    names = boxes["token"].take(good[first]).to_pylist()
    time = (time_us[row[good]] - time_us[0]) * 1e-6
    derived = fitted_velocities(motion[good, :2], time, owner, _ROW_S)
    is_wrong, share = contradiction(motion[good, 3:], derived, time, owner)
    lasts = np.bincount(owner) >= _LEAST_ROWS
    if is_wrong[lasts].sum() > _MAX_WRONG * lasts.sum():
        worst = int(np.argmax(np.where(is_wrong, share, -1.0)))
        what = (
            f"the velocity of {is_wrong.sum()} of {len(names)} tracks contradicts their positions,"
            f" most that of track {names[worst]!r}, by {share[worst]:.0%}, at most {MAX_SHARE:.0%}"
        )
        yield "velocity", what, True
    # whether most vehicles point somewhere else than they move; some do go backwards
    moving = np.hypot(derived[:, 0], derived[:, 1]) > _FAST
    moving &= kinds[good] == state.AgentKind.VEHICLE
    course = np.arctan2(derived[moving, 1], derived[moving, 0])
    turned = np.abs(wrap_angles(motion[good, 2][moving] - course))
    rows = np.bincount(owner[moving], minlength=len(names))
    away = np.bincount(owner[moving], turned > _MAX_TURNED, minlength=len(names))
    known = rows >= _LEAST_ROWS
    wrong = known & (away > 0.5 * rows)
    if wrong.sum() > 0.5 * known.sum():
        what = (
            f"{wrong.sum()} of {known.sum()} moving vehicles point more than {_MAX_TURNED:g} rad"
            f" away from their motion, such as track {names[int(np.flatnonzero(wrong)[0])]!r}"
        )
        yield "heading", what, True


def _check_ego(states: FloatArray, time_us: IntArray) -> Iterator[_Finding]:
    """What is wrong with the velocities of an ego, states (R, 11) at times (R,)."""
    if not np.isfinite(states).all() or (np.diff(time_us) <= 0).any():
        return
    cos, sin = np.cos(states[:, state.HEADING]), np.sin(states[:, state.HEADING])
    vx, vy = states[:, state.VX], states[:, state.VY]
    stored = np.column_stack([vx * cos - vy * sin, vx * sin + vy * cos])
    time, track = (time_us - time_us[0]) * 1e-6, np.zeros(len(states), np.int64)
    derived = fitted_velocities(states[:, :2], time, track, _ROW_S)
    is_wrong, share = contradiction(stored, derived, time, track)
    if is_wrong[0]:
        what = (
            "the velocity of the ego, along and across the vehicle at the rear axle, contradicts"
            f" its positions by {share[0]:.0%}, at most {MAX_SHARE:.0%}"
        )
        yield "velocity", what, True


def _check_scenario(scene: Scenario, overlaps: _Overlaps | None) -> Iterator[_Finding]:
    """What is wrong with a scenario; of what has to do with its map, where that can be read."""
    yield from (("range", what, True) for what in _wrong_numbers(scene))
    duration = _seconds(scene)[-1]
    if duration < _LEAST_S and scene.mapping[0] < _LEAST_S:  # else the log ended before
        what = (
            f"it is {duration:.1f} s long, need at least {_LEAST_S:g} s: a time to collision of 3 s"
            " cannot be looked for in less"
        )
        yield "length", what, True
    if overlaps is not None:
        yield from chain(_check_route(scene), _check_lanes(scene, overlaps), _check_place(scene))
    gap = np.diff(scene.time_us).max(initial=0)
    if gap > _MAX_STEP_US:
        what = f"the recording has a gap of {gap / 1e6:.2f} s, at most {_MAX_STEP_US / 1e6:g} s"
        yield "gap", what, False
    if scene.is_short:
        lasts = _seconds(scene)[-1]
        history = float(scene.iteration_times[0] - scene.time_us[0]) / 1e6
        if scene.mapping[0] - lasts > _LAST_STEPS_S:
            what = f"the log ended before the scenario did, after {lasts:.1f} s"
        else:
            what = (
                f"it lasts {lasts:.1f} s after {history:.1f} s of history, those of the benchmark"
                " 15 s after 3 s"
            )
        yield "short", what, False


def _seconds(scene: Scenario) -> FloatArray:
    """(T,) time of the iterations since the first [s]."""
    seconds: FloatArray = (scene.iteration_times - scene.iteration_times[0]) / 1e6
    return seconds


def _check_lanes(scene: Scenario, overlaps: _Overlaps) -> Iterator[_Finding]:
    """Lanes that overlap where the ego is, else on the route."""
    road, ids = scene.map, scene.map.edges.ids
    centers = state.center_poses(scene.expert[:, :3])
    size = np.array([state.PACIFICA.length, state.PACIFICA.width])
    for iteration, center in enumerate(centers):
        for x, y in [center[:2].tolist(), *boxes_to_corners(center, size).tolist()]:
            lanes = road.lanes_at(x, y)
            if len(lanes) > 1:
                pair = " and ".join(repr(ids[lane]) for lane in lanes[:2])
                fate = "will fail" if iteration == 0 else "fail if its lane is looked for there"
                what = (
                    f"lanes {pair} overlap at ({x:.2f}, {y:.2f}), where the ego is at"
                    f" {_seconds(scene)[iteration]:.1f} s; it cannot be assigned to one, so its"
                    f" tasks {fate}"
                )
                yield "lanes overlap", what, True
                return
    blocks = {road.blocks.index[name] for name in scene.route if name in road.blocks.index}
    for (a, b), (area, point) in overlaps.items():
        if road.block_of[a] in blocks or road.block_of[b] in blocks:
            what = (
                f"lanes {ids[a]!r} and {ids[b]!r} on the route overlap by {area:.1f} m² at"
                f" ({point[0]:.2f}, {point[1]:.2f}), at most {_MIN_OVERLAP:g} m²; tasks that"
                " come there will fail"
            )
            yield "lanes overlap", what, True
            return


def _check_place(scene: Scenario) -> Iterator[_Finding]:
    """Where the ego is beside the map; an error where it is there for long."""
    layers = [x for x in (scene.map.edges, scene.map.drivable_areas) if len(x)]
    centers = state.center_poses(scene.expert[:, :3])[:, :2]
    if not np.isfinite(centers).all():
        return
    off = np.array([min((x.nearest(*at)[1] for x in layers), default=np.inf) for at in centers])
    beside = off > _MAX_OFF
    if beside.any():
        first = int(np.flatnonzero(beside)[0])
        what = (
            f"the ego is up to {off.max():.1f} m beside lanes and drivable area, from"
            f" {_seconds(scene)[first]:.1f} s on, in {beside.mean():.0%} of the iterations,"
            f" at most {_MAX_OFF:g} m in {_MAX_OFF_SHARE:.0%}"
        )
        yield "off the map", what, bool(beside.mean() > _MAX_OFF_SHARE)


def _check_route(scene: Scenario) -> Iterator[_Finding]:
    road = scene.map
    blocks = [road.blocks.index.get(name, -1) for name in scene.route]
    for place, (one, other) in enumerate(pairwise(blocks)):
        if min(one, other) >= 0 and other not in road.block_outgoing.at(one):
            what = (
                f"roadblock {place + 2} of {len(blocks)} of the route,"
                f" {scene.route[place + 1]!r}, does not follow {scene.route[place]!r}"
            )
            yield "route", what, True
            break
    if -1 in blocks:
        what = (
            f"the route names {blocks.count(-1)} unknown roadblocks, the first is"
            f" {scene.route[blocks.index(-1)]!r}"
        )
        yield "route", what, False
    if not blocks:
        yield "route", "there is no route, so progress cannot be measured", False
    if len(blocks) == 1:
        yield "route", "the route has 1 roadblock, IDM and PDM planners need at least 2", False


def _wrong_numbers(scene: Scenario) -> Iterator[str]:
    tracks, valid, codes = scene.tracks, scene.tracks.valid, scene.traffic_lights.status
    moving = tracks.velocities[:, tracks.kinds <= state.LAST_AGENT_KIND]
    sizes = tracks.sizes[valid]
    with np.errstate(invalid="ignore"):
        wrong = {
            "time stamps do not increase": (np.diff(scene.time_us) <= 0).any(),
            "there are fewer than three iterations": len(scene.iteration_rows) < 3,
            "an ego state is not finite": not np.isfinite(scene.ego).all(),
            f"the ego is faster than {_MAX_SPEED:g} m/s": (
                np.hypot(scene.ego[:, state.VX], scene.ego[:, state.VY]) > _MAX_SPEED
            ).any(),
            "an ego heading is not in radians": (
                np.abs(scene.ego[:, state.HEADING]) > _MAX_ANGLE
            ).any(),
            "the mission goal is not finite": scene.mission_goal is not None
            and not np.isfinite(scene.mission_goal).all(),
            "two tracks have one token": len(set(tracks.tokens)) != tracks.num_tracks,
            "a track has an unknown kind": not np.isin(tracks.kinds, list(state.AgentKind)).all(),
            "a track's pose is not finite": not np.isfinite(tracks.poses[valid]).all(),
            "a track has no length or width": not (sizes > 0.0).all(),
            f"a track is longer than {_MAX_LENGTH:g} m": (sizes > _MAX_LENGTH).any(),
            f"a track is faster than {_MAX_SPEED:g} m/s": (np.abs(moving) > _MAX_SPEED).any(),
            "a traffic light has an unknown status": not np.isin(
                codes, list(state.LightStatus)
            ).all(),
        }
    yield from (what for what, is_wrong in wrong.items() if is_wrong)
