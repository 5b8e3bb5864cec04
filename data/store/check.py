"""Is a store sound? Everything that can be said about it without knowing where it came from."""

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from shiftsim.data.store.check_map import MapCheck
from shiftsim.data.store.check_motion import Finding, check_boxes, check_ego, read_boxes
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.tables import MANIFEST, REPORTS, digest, read_manifest
from shiftsim.data.store.tracks import open_ego, open_recording, whole_ego
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import CHECK
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, VX, VY, AgentKind, LightStatus

_MAX_SPEED = 100.0  # m/s; anything faster is in the wrong unit
_LAST_STEPS_S = 0.5  # by which the last iteration may come before the end
_MAX_LENGTH = 60.0  # m, of a track
_MAX_ANGLE = 2.0 * np.pi  # rad; larger headings are in degrees
_LEAST_S = 3.0  # s, of a scenario
_MAX_STEP_US = 1_000_000  # us between rows
_BESIDE = ("filter", "splits")  # folders that hold statements about the scenarios


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong."""

    where: str  # file, map or scenario
    what: str  # what is wrong there: value and limit
    is_error: bool = True  # whether results cannot be trusted; else it is only unusual
    remedy: str = ""  # what to do
    kind: str = ""  # short name of what was looked at
    recording: str = ""  # the recording that it belongs to


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


def check_store(path: str | Path) -> list[Problem]:
    """All problems of a store: schemas, digests, maps, recordings and scenarios.

    Raises:
        DataError: It is no store at all.
    """
    return survey_store(path).problems


def survey_store(path: str | Path) -> CheckReport:
    """All problems of a store, and what was found in each recording.

    Raises:
        DataError: It is no store at all.
    """
    path = Path(path)
    manifest = read_manifest(path)
    problems = list(_check_files(path, manifest["files"]))
    if any(problem.is_error for problem in problems):
        return CheckReport(problems, [])
    try:
        store = ScenarioStore(path)
    except DataError as error:
        return CheckReport([*problems, Problem(str(path), error.message, remedy=error.hint)], [])
    if not len(store):
        what = "the store has no scenarios, need at least 1"
        hint = "convert recordings again: the conversion says why it dropped what it dropped"
        problems.append(Problem(str(path), what, remedy=hint, kind="scenarios"))
    maps: dict[str, MapCheck] = {}
    for city in store.cities:
        where = f"map {city}"
        try:
            maps[city] = MapCheck(store.map(city))
            problems += [
                Problem(where, what, remedy=CHECK, kind="map")
                for what in _check_map(store.map(city))
            ]
            problems += [_problem(where, f) for f in maps[city].of_map()]
        except DataError as error:
            problems.append(Problem(where, error.message, remedy=error.hint, kind="map"))
    rows = []
    summary = store.summary().select(["token", "recording", "city", "ego"]).to_pylist()
    for name, group in groupby(sorted(summary, key=_place), lambda row: row["recording"]):
        row, found = _check_recording(store, name, list(group), maps)
        rows.append(row)
        problems += found
    return CheckReport(problems, rows)


def _place(row: dict[str, str]) -> tuple[str, str]:
    return row["recording"], row["token"]


def _problem(where: str, found: Finding, recording: str = "") -> Problem:
    return Problem(where, found.what, found.is_error, found.remedy, found.kind, recording)


def _check_recording(
    store: ScenarioStore, name: str, scenarios: list[dict[str, str]], maps: dict[str, MapCheck]
) -> tuple[RecordingRow, list[Problem]]:
    """One recording with its egos and scenarios."""
    problems: list[Problem] = []
    where, city, duration, tracks = f"recording {name}", scenarios[0]["city"], 0.0, 0
    try:
        folder = store.recording_folder(name)
        recording = open_recording(folder)
        time_us = recording.frames.read(columns=["time_us"])["time_us"].to_numpy()
        duration, tracks = float(time_us[-1] - time_us[0]) / 1e6, len(recording.tokens)
        found = check_boxes(recording, read_boxes(recording), time_us)
        problems += [_problem(where, f, name) for f in found]
        for ego in sorted({row["ego"] for row in scenarios}):
            table = open_ego(folder, ego)
            first, states = whole_ego(table)
            found = check_ego(states, time_us[first : first + len(states)])
            problems += [_problem(f"{where}, ego {ego}", f, name) for f in found]
    except DataError as error:
        problems.append(Problem(where, error.message, True, error.hint, "file", name))
    for row in scenarios:
        place = f"scenario {row['token']}"
        try:
            scene = store.read(row["token"], plausible=False)
            problems += [
                Problem(place, what, True, hint, "range", name)
                for what, hint in _check_scenario(scene)
            ]
            if row["city"] in maps:
                found = maps[row["city"]].of_scenario(scene)
                problems += [_problem(place, f, name) for f in found]
            problems += [
                Problem(place, what, False, hint, kind, name)
                for kind, what, hint in _unusual(scene)
            ]
        except DataError as error:
            problems.append(Problem(place, error.message, True, error.hint, "file", name))
    errors = sum(problem.is_error for problem in problems)
    kinds = Counter(problem.kind for problem in problems)
    counts = len(scenarios), errors, len(problems) - errors
    return RecordingRow(
        name, city, duration, tracks, *counts, dict(sorted(kinds.items()))
    ), problems


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
        beside = top in _BESIDE or (top == REPORTS and path.suffix == ".png")
        if path.is_file() and not beside and name not in known:
            yield Problem(name, f"the file is not listed in {MANIFEST}", is_error=False)


def _check_map(road: VectorMap) -> Iterator[str]:
    limits = road.speed_limits[~np.isnan(road.speed_limits)]
    if ((limits < 0.0) | (limits > _MAX_SPEED)).any():
        yield f"a speed limit is not within 0 … {_MAX_SPEED:g} m/s"


def _check_scenario(scene: Scenario) -> Iterator[tuple[str, str]]:
    """What is wrong with the numbers, and what to do."""
    for what in _wrong_numbers(scene):
        yield what, CHECK
    duration = _duration(scene)
    if duration < _LEAST_S and scene.mapping[0] < _LEAST_S:  # else the log ended before
        yield (
            f"it is {duration:.1f} s long, need at least {_LEAST_S:g} s: a time to collision of 3 s"
            " cannot be looked for in less",
            "cut longer windows, or leave the scenario out",
        )


def _duration(scene: Scenario) -> float:
    times = scene.iteration_times
    return float(times[-1] - times[0]) / 1e6


def _wrong_numbers(scene: Scenario) -> Iterator[str]:
    steps = np.diff(scene.time_us)
    if (steps <= 0).any():
        yield "time stamps do not increase"
    rows = scene.iteration_rows
    if len(rows) < 3 or rows[0] < 0 or rows[-1] >= len(scene.time_us) or (np.diff(rows) <= 0).any():
        yield "the iterations are not at least three increasing rows"
    if not np.isfinite(scene.ego).all():
        yield "an ego state is not finite"
    elif np.hypot(scene.ego[:, VX], scene.ego[:, VY]).max() > _MAX_SPEED:
        yield f"the ego is faster than {_MAX_SPEED:g} m/s"
    elif np.abs(scene.ego[:, 2]).max() > _MAX_ANGLE:
        yield "an ego heading is not in radians"
    if scene.mission_goal is not None and not np.isfinite(scene.mission_goal).all():
        yield "the mission goal is not finite"
    yield from _check_tracks(scene)
    codes = scene.traffic_lights.status
    if codes.size and not int(LightStatus.ABSENT) <= codes.min() <= codes.max() <= max(LightStatus):
        yield "a traffic light has an unknown status"


def _check_tracks(scene: Scenario) -> Iterator[str]:
    tracks, valid = scene.tracks, scene.tracks.valid
    if len(set(tracks.tokens)) != tracks.num_tracks:
        yield "two tracks have one token"
    if not np.isin(tracks.kinds, list(map(int, AgentKind))).all():
        yield "a track has an unknown kind"
    if not np.isfinite(tracks.poses[valid]).all():
        yield "a track's pose is not finite"
    if not (tracks.sizes[valid] > 0.0).all():
        yield "a track has no length or width"
    elif (tracks.sizes[valid] > _MAX_LENGTH).any():
        yield f"a track is longer than {_MAX_LENGTH:g} m"
    moving = tracks.velocities[:, tracks.kinds <= LAST_AGENT_KIND]
    if (np.abs(moving[~np.isnan(moving)]) > _MAX_SPEED).any():
        yield f"a track is faster than {_MAX_SPEED:g} m/s"


def _unusual(scene: Scenario) -> Iterator[tuple[str, str, str]]:
    """Kind, what is unusual, and what to do."""
    unknown = [block for block in scene.route if block not in scene.map.blocks.index]
    correct = "correct the route in shiftsim inspect"
    if unknown:
        what = f"the route names {len(unknown)} unknown roadblocks, the first is {unknown[0]!r}"
        yield "route", what, correct
    if not scene.route:
        yield "route", "there is no route, so progress cannot be measured", correct
    gap = np.diff(scene.time_us).max(initial=0)
    if gap > _MAX_STEP_US:
        what = f"the recording has a gap of {gap / 1e6:.2f} s, at most {_MAX_STEP_US / 1e6:g} s"
        yield "gap", what, "leave the scenario out"
    if scene.is_short:
        lasts = _duration(scene)
        history = float(scene.iteration_times[0] - scene.time_us[0]) / 1e6
        if scene.mapping[0] - lasts > _LAST_STEPS_S:
            what = f"the log ended before the scenario did, after {lasts:.1f} s"
        else:
            what = (
                f"it lasts {lasts:.1f} s after {history:.1f} s of history, those of the benchmark"
                " 15 s after 3 s"
            )
        yield "short", what, "its score does not compare with that of a whole scenario"
