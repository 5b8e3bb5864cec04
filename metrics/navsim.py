"""PDMS and EPDMS: NAVSIM's scores of plans of 4 s, version 1 and version 2.

A plan is driven by the tracker and the bicycle of PDM-Closed, in a world that goes on as recorded
from one iteration of a scenario on: its frame. PDM-Closed drives beside it and sets the scale of
progress.

Array axes: P plans, T = 41 states 0.1 s apart, R rows of time, N others, L red connectors.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely

from shiftsim.errors import DataError, one_of
from shiftsim.geometry.boxes import boxes_to_corners, from_frame, to_frame, wrap_angles
from shiftsim.geometry.fits import filter_signal, make_filter
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.metrics.comfort import comfort_signals, unwrap, within_bounds
from shiftsim.metrics.result import NUPLAN
from shiftsim.planners.pdm.forecast import ring_of
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.pdm.rollout import roll_out
from shiftsim.planners.pdm.scorer import AHEAD_SECONDS, TTC_STEPS, Place, first_violations
from shiftsim.planners.proposals.areas import Areas, areas_of
from shiftsim.planners.proposals.comfort import ComfortBounds, comfort
from shiftsim.planners.proposals.contacts import (
    NEVER,
    Obstacles,
    first_faults,
    near_others,
    touches_boxes,
)
from shiftsim.planners.proposals.places import (
    MULTIPLE,
    OFF_ROAD,
    OFF_ROUTE,
    ego_box,
    find_places,
)
from shiftsim.planners.proposals.tracker import DT, SCORED, STEP_US, drive_proposals
from shiftsim.planners.routes.correction import known_blocks
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.layers import (
    Polygons,
    join_polygons,
    make_polygons,
    meeting,
    square_around,
)
from shiftsim.world.map import NONE, PerMap, VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    HEADING,
    LAST_AGENT_KIND,
    PACIFICA,
    STEERING_RATE,
    Tracks,
    center_poses,
)

RADIUS = 100.0  # m, half side of the square of map around the ego, and of what PDM-Closed sees
SPACING, FRAMES = 0.5, 5  # s between recorded frames and poses of plans; steps between them
REFERENCE_HORIZON = 5.0  # s that PDM-Closed looks for leads
PAST_FRAMES = 3  # before the present one
MIN_PROGRESS = 5.0  # m, of the better of a plan and the reference; below it all are equal
DIRECTION_LIMITS, DIRECTION_STEPS = (2.0, 6.0), 11  # m off the route, within so many steps
MAX_DEVIATION, DEVIATION_STEPS = 0.5, 20  # m beside the centerline, in so many steps in a row
# of differences between two plans: acceleration, jerk, yaw rate, yaw acceleration
EXTENDED_LIMITS = (0.7, 0.5, 0.1, 0.1)
MAX_INTERVAL = 0.55  # s between the frames of two such plans
SIZE = ego_box(PACIFICA)


class Version(NamedTuple):
    """What a version of the score is made of."""

    multipliers: tuple[str, ...]
    weights: dict[str, float]
    seconds: float  # how far the recording is read [s]
    ttc_steps: int  # time indices that projections of the ego may reach


VERSIONS = {
    "v1": Version(
        ("no_at_fault_collisions", "drivable_area_compliance"),
        {"ego_progress": 5.0, "time_to_collision_within_bound": 5.0, "comfort": 2.0},
        5.0,
        SCORED + 1 + TTC_STEPS[-1],
    ),
    "v2": Version(
        (
            "no_at_fault_collisions",
            "drivable_area_compliance",
            "driving_direction_compliance",
            "traffic_light_compliance",
        ),
        {
            "ego_progress": 5.0,
            "time_to_collision_within_bound": 5.0,
            "lane_keeping": 2.0,
            "history_comfort": 2.0,
            "two_frame_extended_comfort": 2.0,
        },
        4.0,
        SCORED + 1,
    ),
}


class Ground(NamedTuple):
    """The map around the ego as NAVSIM sees it."""

    lanes: Areas  # lanes and connectors, those of the route marked
    near_lanes: IntArray  # which of them belong to the frame
    drivable: Areas  # roadblocks, intersections, car parks; the intersections marked
    near_drivable: IntArray  # which of them belong to the frame
    intersections: Polygons  # those of the frame
    centerline: shapely.LineString  # along the corrected route, prepared


class Surroundings(NamedTuple):
    """What moves and what lights show, from the frame on."""

    others: Obstacles  # centres are infinite where one is absent
    rows: IntArray  # row of time of each time index
    reaches: FloatArray  # (N,) how far each gets within the projection of the ego [m]
    connectors: list[shapely.Polygon]  # (L,) of the route that are red at some time, prepared
    red: BoolArray  # (T, L) when they are


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """NAVSIM's sub-scores of P plans by its names, all (P,); None where a version has none.

    Attributes:
        score: The total: PDMS (v1) or EPDMS (v2).
        two_frame_extended_comfort: None, and without weight, unless a previous plan was given.
        driving_direction_compliance: Without weight in v1.
        progress_m: Along the centerline [m].
        collision_index: First time index of an at-fault collision, inf if none.
        ttc_index: First time index at which the time to collision is too short, inf if none.
        flags: (P, T, 3) whether the ego is on several lanes, off the road, off the route.
        states: (P, T, 11) as driven.
        time_us: Of the frame [us].
    """

    score: FloatArray
    no_at_fault_collisions: FloatArray
    drivable_area_compliance: FloatArray
    driving_direction_compliance: FloatArray
    ego_progress: FloatArray
    time_to_collision_within_bound: FloatArray
    comfort: FloatArray | None = None
    traffic_light_compliance: FloatArray | None = None
    lane_keeping: FloatArray | None = None
    history_comfort: FloatArray | None = None
    two_frame_extended_comfort: FloatArray | None = None
    progress_m: FloatArray
    collision_index: FloatArray
    ttc_index: FloatArray
    flags: BoolArray
    states: FloatArray
    time_us: int


@dataclass(frozen=True, slots=True)
class FrameWorld:
    """What plans of one frame are scored in; made by `frame_world`.

    Attributes:
        version: `v1` or `v2`.
        time_us: Of the frame [us].
        ego: (11,) ego state.
        past: (H, 11) ego states 0.1 s apart that comfort with history begins with.
        ground: The map.
        around: Others and lights.
        plan: (T, 3) what PDM-Closed plans, in the frame of the map.
        reach: How far that plan gets, times its multipliers [m].
        reference: Scores of that plan.
        human: Scores of what was driven, alone and without a past.
    """

    version: str
    time_us: int
    ego: FloatArray
    past: FloatArray
    ground: Ground
    around: Surroundings
    plan: FloatArray
    reach: float
    reference: Scores
    human: Scores


def frame_world(scenario: Scenario, iteration: int = 0, version: str = "v2") -> FrameWorld:
    """The world of a scenario from one iteration on.

    Raises:
        ConfigError: There is no such version.
        DataError: Less than 1.5 s was recorded before the frame, or 4 s (v1: 5 s) after it.
        PlannerError: PDM-Closed cannot follow the route.
    """
    rules = VERSIONS[one_of("version", version, VERSIONS)]
    row, step = int(scenario.iteration_rows[iteration]), FRAMES * scenario.row_step
    after = row + step * np.arange(round(rules.seconds / SPACING) + 1)
    before = row - step * np.arange(PAST_FRAMES, -1, -1)
    if before[0] < 0 or after[-1] >= len(scenario.time_us):
        raise DataError(
            f"scenario {scenario.token!r}: iteration {iteration} has too little recording around "
            f"it for NAVSIM's score {version}",
            f"1.5 s before and {rules.seconds:g} s after it are needed",
        )
    ego, time_us = scenario.ego[row].copy(), int(scenario.time_us[row])
    around = recorded_surroundings(scenario.tracks.rows(after), rules.ttc_steps)
    if version == "v2":
        # nuPlan rule 741: what touches the ego at the beginning is not there
        footprint = boxes_to_corners(center_poses(ego[:3]), np.array([SIZE.length, SIZE.width]))
        here = np.isfinite(around.others.centers[0, :, 0])
        around.others.ignored[:] = here & touches_boxes(footprint, around.others.boxes[0])
        around = _with_lights(around, scenario, after[: SCORED // FRAMES + 1])
    ground, plan = _reference_plan(scenario, iteration, version)
    driven = to_frame(scenario.ego[after[1 : SCORED // FRAMES + 1], :3], ego[:3])
    poses = [sample_plans(plan[None], time_us + STEP_US * np.arange(SCORED + 1), time_us)]
    poses.append(_poses_of(driven[None], ego, time_us, SPACING))
    states = drive_proposals(np.concatenate(poses), ego).states
    past = past_states(scenario.time_us[before], scenario.ego[before])
    reference = evaluate(states[:1], ground, around, version, past)
    human = evaluate(states[1:], ground, around, version, past[:0])
    reach = float(reference["progress_m"][0] * _factor(reference, version)[0])
    scores = (_scored(parts, version, time_us) for parts in (reference, human))
    return FrameWorld(version, time_us, ego, past, ground, around, plan, reach, *scores)


def score(
    world: FrameWorld,
    plans: FloatArray,
    *,
    interval: float = SPACING,
    human_filter: bool = True,
    previous: Scores | None = None,
) -> Scores:
    """Score plans as NAVSIM does.

    Args:
        world: What they are driven in.
        plans: (P, n, 3) rear axle x [m], y [m], heading [rad] in the frame of the ego, the first
            poses one interval from now; the last ones are held up to 4 s.
        interval: Time between poses [s].
        human_filter: Whether what the driver of the recording fails as well does not count (v2).
        previous: Scores of the same planners' plans in the frame before, for the extended comfort
            (v2).

    Raises:
        ValueError: The shapes do not fit, or the previous frame is not within 0.55 s before.
    """
    plans = np.asarray(plans, np.float64)
    if plans.ndim != 3 or plans.shape[1] < 1 or plans.shape[2] != 3:
        raise ValueError(f"plans must have the shape (P, n, 3), not {plans.shape}")
    poses = _poses_of(plans, world.ego, world.time_us, interval)
    states = drive_proposals(poses, world.ego).states
    parts = evaluate(states, world.ground, world.around, world.version, world.past)
    excused = world.human if human_filter and world.version == "v2" else None
    return _scored(parts, world.version, world.time_us, world.reach, excused, previous)


def evaluate(
    states: FloatArray, ground: Ground, around: Surroundings, version: str, past: FloatArray
) -> dict[str, Any]:
    """Sub-scores of driven states (P, T, 11), all but those that compare plans, by name.

    `past` (H, 11) comes before them where comfort looks back; without rows all are comfortable.
    """
    others, rows = around.others, around.rows
    lanes, road = (
        find_places(states, SIZE, areas, near, np.zeros(len(areas.lane)), by_center=True)
        for areas, near in (
            (ground.lanes, ground.near_lanes),
            (ground.drivable, ground.near_drivable),
        )
    )
    # nuPlan rule 742: lanes tell how many of them the ego is on, other areas whether it is on any
    off_road, crosses = road.flags[..., OFF_ROAD], ~road.flags[..., OFF_ROUTE]
    flags = np.stack([lanes.flags[..., MULTIPLE], off_road, lanes.flags[..., OFF_ROUTE]], axis=-1)
    places = lanes._replace(flags=flags, off_lane=flags[..., MULTIPLE] | off_road)
    near = near_others(places, others, int(rows[-1]) + 1, AHEAD_SECONDS)
    no_fault, collision_index = first_faults(places, others, near, rows[: SCORED + 1], True)
    ttc_index = first_violations(
        places, others, near, rows, around.reaches, SIZE, ground.intersections
    )
    points = shapely.points(places.centers)
    along = shapely.line_locate_point(ground.centerline, points[:, [0, -1]])
    wrong_way = flags[..., OFF_ROUTE] & (~crosses if version == "v2" else True)
    parts = {
        "no_at_fault_collisions": no_fault,
        "drivable_area_compliance": np.where(off_road.any(axis=1), 0.0, 1.0),
        "driving_direction_compliance": _direction(places.centers, wrong_way),
        "time_to_collision_within_bound": np.where(ttc_index < NEVER, 0.0, 1.0),
        "progress_m": np.maximum(along[:, 1] - along[:, 0], 0.0),
        "collision_index": collision_index,
        "ttc_index": ttc_index,
        "flags": flags,
        "states": states,
    }
    if version == "v1":
        return {**parts, "comfort": comfort(states, ComfortBounds()).score}
    parts["traffic_light_compliance"] = _stops_at_red(places.corners, around)
    away = ~shapely.dwithin(ground.centerline, points, MAX_DEVIATION)
    # nuPlan rule 744: intersections are left out, as if they took no time
    runs = [_longest_run(row[~inside]) for row, inside in zip(away, crosses, strict=True)]
    parts["lane_keeping"] = np.where(np.array(runs) >= DEVIATION_STEPS, 0.0, 1.0)
    parts["history_comfort"] = _history_comfort(states, past)
    return parts


def _direction(centers: FloatArray, wrong_way: BoolArray) -> FloatArray:
    """(P,) factors from centres (P, T, 2), and whether they are off the route (P, T)."""
    step = np.hypot(np.diff(centers[..., 0], axis=1), np.diff(centers[..., 1], axis=1))
    padded = np.pad(np.where(wrong_way[:, 1:], step, 0.0), ((0, 0), (DIRECTION_STEPS - 1, 0)))
    within = np.lib.stride_tricks.sliding_window_view(padded, DIRECTION_STEPS, axis=1)
    longest, (low, high) = within.sum(axis=-1).max(axis=1), DIRECTION_LIMITS
    return np.where(longest < low, 1.0, np.where(longest < high, 0.5, 0.0))


def _longest_run(flags: BoolArray) -> int:
    """Most flags in a row that are set."""
    clear = np.flatnonzero(~flags)
    return int(np.diff(np.concatenate([[-1], clear, [len(flags)]])).max()) - 1


def _stops_at_red(corners: FloatArray, around: Surroundings) -> FloatArray:
    """(P,) 0 where the ego (P, T, 4, 2) touches a connector while it is red."""
    touched = np.zeros(len(corners), np.bool_)
    if around.connectors:
        boxes = shapely.polygons(corners)
        for connector, red in zip(around.connectors, around.red.T, strict=True):
            # nuPlan rule 743: it does not matter whether the ego was on it before
            touched |= (shapely.intersects(connector, boxes) & red).any(axis=1)
    return np.where(touched, 0.0, 1.0)


def _history_comfort(states: FloatArray, past: FloatArray) -> FloatArray:
    """(P,) nuPlan's comfort of states (P, T, 11) behind a past (H, 11)."""
    if not len(past):
        return np.ones(len(states))
    times = STEP_US * np.arange(len(past) + states.shape[1])
    signals = (comfort_signals(times, np.concatenate([past, row])) for row in states)
    return np.array([float(all(within_bounds(found, NUPLAN))) for found in signals])


def extended_differences(states: FloatArray, previous: FloatArray, seconds: float) -> FloatArray:
    """(P, 4) root mean squares of what two frames' plans differ in, `seconds` apart.

    Acceleration [m/s^2] and jerk [m/s^3] at the rear axle, yaw rate [rad/s], yaw acceleration
    [rad/s^2], over the states (P, T, 11) that both have.
    """
    shift = round(seconds / DT)
    pairs = zip(states[:, :-shift], previous[:, shift:], strict=True)
    differences = np.array([_motion(now) - _motion(before) for now, before in pairs])
    return np.sqrt((differences**2).mean(axis=-1))


def _motion(states: FloatArray) -> FloatArray:
    """(4, K) what `extended_differences` compares, of states (K, 11)."""
    signals, yaw_accel = comfort_signals(STEP_US * np.arange(len(states)), states), states[:, 0] + 0
    # nuPlan rule 745: a parabola here, where comfort takes a cubic
    filter_signal(unwrap(states[:, HEADING]), make_filter(5, 2, 2), DT * DT, yaw_accel)
    return np.stack([signals.mag_accel, signals.mag_jerk, signals.yaw_rate, yaw_accel])


def _scored(
    parts: dict[str, Any],
    version: str,
    time_us: int,
    reach: float = 0.0,
    excused: Scores | None = None,
    previous: Scores | None = None,
) -> Scores:
    """Compare the progress of plans with what others reach [m], and add up.

    What is 0 for `excused` counts as 1; `previous` are scores of the frame before.
    """
    rules, raw = VERSIONS[version], parts["progress_m"]
    factor = _factor(parts, version)
    most = np.maximum(raw * factor, reach)
    share = np.minimum(raw / np.maximum(most, MIN_PROGRESS), 1.0)
    if version == "v1":
        progress = np.where(most > MIN_PROGRESS, share * factor, factor > 0.0)
    else:
        # nuPlan rule 740: multipliers shorten what a plan is compared with, not its own progress
        progress = np.where(most > MIN_PROGRESS, share, 1.0)
    named = {**parts, "ego_progress": progress}
    if excused is not None:
        for name in (*rules.multipliers, *rules.weights):
            if (value := getattr(excused, name)) is not None and value[0] == 0.0:
                named[name] = np.ones(len(raw))
    if previous is not None:
        seconds = (time_us - previous.time_us) * 1e-6
        if version == "v1" or not 0.0 < seconds < MAX_INTERVAL or len(previous.score) != len(raw):
            raise ValueError(
                f"extended comfort (v2) needs as many plans from at most {MAX_INTERVAL} s before, "
                f"not {len(previous.score)} from {seconds:.3g} s before {len(raw)}"
            )
        differences = extended_differences(parts["states"], previous.states, seconds)
        alike = (differences <= EXTENDED_LIMITS).all(axis=1)
        named["two_frame_extended_comfort"] = np.where(alike, 1.0, 0.0)
    weights = {name: weight for name, weight in rules.weights.items() if name in named}
    mean = sum(weight * named[name] for name, weight in weights.items()) / sum(weights.values())
    return Scores(score=_factor(named, version) * mean, time_us=time_us, **named)


def _factor(parts: dict[str, Any], version: str) -> FloatArray:
    """(P,) product of the multipliers."""
    return np.prod([parts[name] for name in VERSIONS[version].multipliers], axis=0)


def _poses_of(plans: FloatArray, ego: FloatArray, time_us: int, interval: float) -> FloatArray:
    """(P, T, 3) poses in the frame of the map from plans (P, n, 3) in that of an ego (11,)."""
    start = np.broadcast_to(ego[:3], (len(plans), 1, 3))
    poses = np.concatenate([start, from_frame(plans, ego[:3])], axis=1)
    times = np.arange(1, plans.shape[1] + 1) * interval + time_us * 1e-6
    return sample_plans(poses, np.append(time_us, (times * 1e6).astype(np.int64)), time_us)


def sample_plans(poses: FloatArray, times: IntArray, time_us: int) -> FloatArray:
    """(P, T, 3) poses each 0.1 s from poses (P, n, 3) at times (n,), from `time_us` on [us]."""
    # nuPlan rule 746: times go through seconds, and end up to a microsecond too early
    at = ((np.arange(SCORED + 1) * DT + time_us * 1e-6) * 1e6).astype(np.int64)
    at = np.clip(at, times[0], times[-1])
    low = np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)
    poses = np.concatenate([poses[..., :2], np.unwrap(poses[..., 2:], axis=1)], axis=-1)
    slope = np.diff(poses, axis=1) / np.diff(times)[:, None]
    out: FloatArray = slope[:, low] * (at - times[low])[:, None] + poses[:, low]
    out[..., 2] = wrap_angles(out[..., 2])
    return out


def past_states(time_us: IntArray, states: FloatArray) -> FloatArray:
    """(H, 11) states each 0.1 s from some (F, 11) at times (F,), the last being the present."""
    # nuPlan rule 747: the last state before the present is left out, and rates are 0
    at = np.arange(time_us[0], time_us[-1], STEP_US)[:-1] - time_us[0]
    columns = states.copy()
    columns[:, HEADING] = unwrap(states[:, HEADING])
    out = np.stack([np.interp(at, time_us - time_us[0], values) for values in columns.T], axis=1)
    out[:, STEERING_RATE:] = 0.0
    return out


def recorded_surroundings(tracks: Tracks, ttc_steps: int) -> Surroundings:
    """Tracks recorded every 0.5 s as they are each 0.1 s, without lights."""
    tracks = tracks.select(tracks.valid.any(axis=0))
    valid, number, count = tracks.valid, np.arange(tracks.num_tracks), len(tracks)
    frames, first = np.arange(count)[:, None], valid.argmax(axis=0)
    steps = np.arange(FRAMES * (count - 1) + 1)
    before = np.maximum.accumulate(np.where(valid, frames, -1))[steps // FRAMES]
    after = np.minimum.accumulate(np.where(valid, frames, count)[::-1])[::-1][-(-steps // FRAMES)]
    # nuPlan rule 748: what was recorded once stands there all the time
    once = valid.sum(axis=0) == 1
    before[:, once] = after[:, once] = first[once]
    absent = (before < 0) | (after >= count)
    before[absent] = after[absent] = 0
    start = tracks.poses[before, number]
    change = tracks.poses[after, number] - start
    change[..., 2] = wrap_angles(change[..., 2])
    slope = change / (SPACING * np.maximum(after - before, 1))[..., None]
    poses = slope * (DT * steps[:, None] - SPACING * before)[..., None] + start
    poses[absent] = np.nan
    # nuPlan rule 749: size and speed are those of the first frame
    sizes, is_agent = tracks.sizes[first, number], tracks.kinds <= LAST_AGENT_KIND
    speeds = np.where(is_agent, np.hypot(*tracks.velocities[first, number].T), 0.0)
    boxes, centers = boxes_to_corners(poses, sizes), poses[..., :2]
    travel = np.hypot(*np.diff(centers, axis=0).T).max(axis=1, initial=0.0)
    others = Obstacles(
        boxes=boxes,
        centers=np.where(absent[..., None], np.inf, centers),
        centroids=_centroids(boxes),
        speeds=np.broadcast_to(speeds, absent.shape).copy(),
        radii=0.5 * np.hypot(*sizes.T),
        is_agent=is_agent,
        ignored=np.zeros(len(number), np.bool_),
    )
    reaches = np.nan_to_num((TTC_STEPS[-1] + 1) * travel, nan=np.inf)
    return Surroundings(others, np.arange(ttc_steps), reaches, [], np.zeros((SCORED + 1, 0), bool))


def _centroids(boxes: FloatArray) -> FloatArray:
    """(..., 2) centroids of boxes (..., 4, 2), to the last bit those of `rings.centroid` [m]."""
    x, y = np.moveaxis(boxes, (-1, -2), (0, 1))
    area = sum_x = sum_y = 0.0
    for a, b in ((1, 2), (2, 3)):
        double = (x[a] - x[0]) * (y[b] - y[0]) - (x[b] - x[0]) * (y[a] - y[0])
        sum_x = sum_x + double * (x[0] + x[a] + x[b])
        sum_y = sum_y + double * (y[0] + y[a] + y[b])
        area = area + double
    return np.stack([sum_x / 3.0 / area, sum_y / 3.0 / area], axis=-1)


def _prepared(shapes: list[shapely.Polygon]) -> list[shapely.Polygon]:
    for shape in shapes:
        shapely.prepare(shape)
    return shapes


def _with_lights(around: Surroundings, scenario: Scenario, rows: IntArray) -> Surroundings:
    """The same with the lights of the route, which are recorded every 0.5 s at some rows."""
    road = scenario.map
    route = road.lanes_of(known_blocks(road, scenario.route, scenario.token, "navsim"))
    listed = [set(scenario.traffic_lights.red(row)) for row in rows.tolist()]
    names = [
        name for name in map(road.edges.ids.__getitem__, route) if name in set().union(*listed)
    ]
    red = np.array([[name in names_at for name in names] for names_at in listed], np.bool_)
    red = red.reshape(len(listed), len(names))
    shapes = [road.edges.shape(road.edges.index[name]) for name in names]
    return around._replace(
        connectors=_prepared(shapes),
        red=red[np.arange(SCORED + 1) // FRAMES],
    )


def _reference_plan(scenario: Scenario, iteration: int, version: str) -> tuple[Ground, FloatArray]:
    """The map as seen from an iteration, and the poses (T, 3) that PDM-Closed plans there."""
    planner = PdmClosed(map_radius=RADIUS)
    planner.reset(scene_info(scenario))
    observation = observe_log(scenario, iteration)
    seen, paths, limit = planner.look(observation)
    ego, forecast = observation.history.ego[-1].copy(), seen.forecast
    scene, targets = planner.scene_in(seen, paths, ego, limit, PACIFICA)
    others, steps = forecast.others, np.arange(VERSIONS[version].ttc_steps)
    lights = [ring_of(forecast, len(others.radii) + n) for n in range(len(forecast.light_bounds))]
    around = Surroundings(
        others,
        steps // 2,
        (AHEAD_SECONDS + DT) * others.speeds[0],
        _prepared([shapely.Polygon(ring) for ring in lights]),
        np.ones((SCORED + 1, len(lights)), np.bool_),
    )
    ground = _ground(scenario.map, seen.place, center_poses(ego[:3]))
    # nuPlan rule 739: proposals look for leads as far as they get in 5 s, and never brake at last
    proposals = roll_out(scene, ego, targets, REFERENCE_HORIZON).poses[:, :, : SCORED + 1]
    poses = np.ascontiguousarray(proposals).reshape(-1, SCORED + 1, 3)
    parts = evaluate(drive_proposals(poses, ego).states, ground, around, version, ego[None, :][:0])
    reach = float((parts["progress_m"] * _factor(parts, version)).max())
    return ground, poses[np.argmax(_scored(parts, version, 0, reach).score)]


def _ground(road: VectorMap, place: Place, center: FloatArray) -> Ground:
    """The map around a centre (3,); lanes and centerline are PDM-Closed's."""
    square = square_around(center[0], center[1], RADIUS)
    blocks = meeting(road.blocks.polygons, square)
    crossings, parks = (
        meeting(layer.polygons, square) for layer in (road.intersections, road.car_parks)
    )
    offset = len(road.blocks), len(road.blocks) + len(road.intersections)
    drivable = (blocks[blocks < road.num_roadblocks], crossings + offset[0], parks + offset[1])
    line = shapely.LineString(place.centerline.xy)
    shapely.prepare(line)
    return Ground(
        place.areas,
        place.selected[place.selected < len(road.edges)],
        _drivable_areas(road),
        np.concatenate(drivable),
        make_polygons([road.intersections.rings(index) for index in crossings.tolist()]),
        line,
    )


def _make_drivable(road: VectorMap) -> Areas:
    layers = (road.blocks, road.intersections, road.car_parks)
    kind = np.repeat(np.arange(3), [len(layer) for layer in layers])
    polygons = join_polygons([layer.polygons for layer in layers])
    return areas_of(polygons, kind == 1, np.full(len(kind), NONE))


_drivable_areas = PerMap(_make_drivable)
