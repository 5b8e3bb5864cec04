"""Is a store sound? Everything that can be said about it without knowing where it came from."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.tables import MANIFEST, REPORTS, digest, read_manifest
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, VX, VY, AgentKind, LightStatus

_MAX_SPEED = 100.0  # m/s; anything faster is in the wrong unit
_MAX_LENGTH = 60.0  # m, of a track
_MAX_ANGLE = 2.0 * np.pi  # rad; larger headings are in degrees
_MAX_STEP_US = 1_000_000  # us between rows
_BESIDE = ("filter", "splits")  # folders that hold statements about the scenarios


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong."""

    where: str  # file, map or scenario
    what: str  # what is wrong there
    is_error: bool = True  # whether results cannot be trusted; else it is only unusual


def check_store(path: str | Path) -> list[Problem]:
    """All problems of a store: schemas, digests, maps and scenarios.

    Raises:
        DataError: It is no store at all.
    """
    path = Path(path)
    manifest = read_manifest(path)
    problems = list(_check_files(path, manifest["files"]))
    if any(problem.is_error for problem in problems):
        return problems
    try:
        store = ScenarioStore(path)
    except DataError as error:
        return [*problems, Problem(str(path), str(error))]
    for city in store.cities:
        try:
            problems += [Problem(f"map {city}", what) for what in _check_map(store.map(city))]
        except DataError as error:
            problems.append(Problem(f"map {city}", str(error)))
    for token in store.tokens:
        where = f"scenario {token}"
        try:
            scene = store.read(token, plausible=False)
            problems += [Problem(where, what) for what in _check_scenario(scene)]
            problems += [Problem(where, what, is_error=False) for what in _unusual(scene)]
        except DataError as error:
            problems.append(Problem(where, str(error)))
    return problems


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


def _check_scenario(scene: Scenario) -> Iterator[str]:
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


def _unusual(scene: Scenario) -> Iterator[str]:
    unknown = [block for block in scene.route if block not in scene.map.blocks.index]
    if unknown:
        yield f"the route names {len(unknown)} unknown roadblocks, the first is {unknown[0]!r}"
    if not scene.route:
        yield "there is no route"
    if np.diff(scene.time_us).max(initial=0) > _MAX_STEP_US:
        yield "the recording has a gap of more than a second"
    if scene.is_short:
        yield "the log ended before the scenario did"
