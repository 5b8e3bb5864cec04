"""Whether a planner acts on what it sees: what it plans where a recorded scene is changed.

A case is an iteration of a recording, and a change of what is seen after which a driver would go
farther, or less far, or come back to the lane. Nothing is driven.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import shapely

from shiftsim.errors import MapError
from shiftsim.geometry.boxes import from_frame
from shiftsim.sim.planner import Observation, Planner, observe_log, scene_info
from shiftsim.world.line import Line
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, VX, AgentKind, LightStatus, Tracks, Trajectory

EVERY = 20  # iterations between two cases
MOVING, STANDING = 3.0, 0.5  # m/s
CHANGE = 1.0  # m by which a plan of 8 s has to be longer or shorter
OBSTACLE, CLEAR = 15.0, 30.0  # m ahead: of the vehicle that is added; with nobody there before
CLOSE = 10.0  # m ahead: of a lead that holds the ego up, of a stop line where it stands
ASIDE, TURNED = 0.5, 0.1  # m to the left, rad: what the ego is moved by
# m that it may be farther beside the recorded path than without, at that pose, which is after 5 s;
# m that the path goes on straight
BACK, AT, FARTHEST = 0.2, 49, 100.0

CHECKS = ("slower behind an obstacle", "goes on without the lead", "starts at green", "comes back")


class Case(NamedTuple):
    """A scene that was changed."""

    check: str
    changed: Observation
    farther: int  # 1 where the plan has to reach farther than before, -1 less far, 0 to come back


def check(planner: Planner, scenarios: Iterable[Scenario]) -> list[dict[str, Any]]:
    """By check how many cases there are and the share that is passed, NaN where there is none."""
    passed: dict[str, list[bool]] = {name: [] for name in CHECKS}
    for scenario in scenarios:
        scene = scene_info(scenario)
        for iteration in range(0, scenario.num_iterations, EVERY):
            seen = observe_log(scenario, iteration)
            try:
                line = scene.route_line(seen.ego.pose)
            except MapError:  # no lane to follow: nothing to expect
                continue
            if not (cases := list(_cases(scenario, seen, line))):
                continue
            planner.reset(scene)
            before = planner.plan(seen)
            for case in cases:
                planner.reset(scene)
                after = planner.plan(case.changed)
                passed[case.check].append(_is_passed(scenario, case, before, after))
    return [
        {"check": name, "cases": len(found), "passed": float(np.mean(found)) if found else np.nan}
        for name, found in passed.items()
    ]


def _cases(scenario: Scenario, seen: Observation, line: Line) -> Iterator[Case]:
    ego, lead, red = seen.history.ego, seen.lead(line), seen.lights_on(line)
    speed, gap = ego[-1, VX], np.inf if lead is None else lead.gap
    tracks = seen.history.tracks
    if speed > MOVING and gap > CLEAR:
        front = PACIFICA.rear_axle_to_center + 0.5 * PACIFICA.length
        here = line.to_frenet(ego[-1, :3])[0]
        place = line.to_poses(np.array([here + front + OBSTACLE, 0.0, 0.0]))
        yield Case(CHECKS[0], _with_tracks(seen, _with_vehicle(tracks, place)), -1)
    if speed < MOVING and gap < CLOSE and red is None:
        nobody = replace(tracks, valid=np.zeros_like(tracks.valid))
        yield Case(CHECKS[1], _with_tracks(seen, nobody), 1)
    if speed < STANDING and red is not None and red.gap < CLOSE < gap:
        status = seen.lights.status.copy()
        status[status == LightStatus.RED] = LightStatus.GREEN
        yield Case(CHECKS[2], replace(seen, lights=replace(seen.lights, status=status)), 1)
    if speed > MOVING:
        moved = ego.copy()
        moved[-1, :3] = from_frame(np.array([0.0, ASIDE, TURNED]), ego[-1])
        yield Case(CHECKS[3], observe_log(scenario, seen.iteration, ego=moved), 0)


def _is_passed(scenario: Scenario, case: Case, before: Any, after: Any) -> bool:
    """Whether the plan changed as a driver's would have; what is no trajectory does not."""
    if not (isinstance(before, Trajectory) and isinstance(after, Trajectory)):
        return False
    if case.farther:
        return bool(case.farther * (_length(after) - _length(before)) > CHANGE)
    rows = scenario.iteration_rows[case.changed.iteration :]
    path = scenario.ego[rows, :2]
    x, y, heading = scenario.ego[rows[-1], :3]
    beyond = [x + FARTHEST * np.cos(heading), y + FARTHEST * np.sin(heading)]
    line = shapely.LineString(np.vstack([path, beyond]))
    places = [
        shapely.Point(plan.states[min(AT, len(plan.states) - 1), :2]) for plan in (before, after)
    ]
    return bool(line.distance(places[1]) - line.distance(places[0]) < BACK)


def _length(plan: Trajectory) -> float:
    return float(np.hypot(*np.diff(plan.states[:, :2], axis=0).T).sum())


def _with_tracks(seen: Observation, tracks: Tracks) -> Observation:
    return replace(seen, history=replace(seen.history, tracks=tracks))


def _with_vehicle(tracks: Tracks, pose: np.ndarray) -> Tracks:
    """The same tracks and a vehicle like the ego that stands with its rear end at a pose (3,)."""
    center = from_frame(np.array([0.5 * PACIFICA.length, 0.0, 0.0]), pose)
    new = (True, center, np.zeros(2), [PACIFICA.length, PACIFICA.width])

    def wider(array: np.ndarray, value: Any) -> np.ndarray:
        column = np.full((len(array), 1, *array.shape[2:]), value, array.dtype)
        return np.concatenate([array, column], axis=1)

    valid, poses, velocities, sizes = map(wider, tracks.arrays, new)
    kinds = np.append(tracks.kinds, AgentKind.VEHICLE)
    return Tracks(valid, poses, velocities, sizes, kinds, (*tracks.tokens, "obstacle"))
