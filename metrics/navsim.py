"""PDMS and EPDMS: NAVSIM's scores of plans of 4 s, in versions v1 and v2.

Plans of one iteration, the frame, are driven by the tracker and the bicycle of PDM-Closed while all
else goes on as recorded. PDM-Closed's own plan sets the scale of progress.

Array axes: P plans, T = 41 states 0.1 s apart, R rows of time, N others, L red connectors.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely

from shiftsim.errors import DataError, one_of
from shiftsim.geometry.boxes import boxes_to_corners, from_frame, to_frame, wrap_angles
from shiftsim.geometry.fits import filter_signal, make_filter
from shiftsim.geometry.rings import centroid
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.metrics.comfort import comfort_signals, unwrap, within_bounds
from shiftsim.metrics.result import NUPLAN
from shiftsim.planners.pdm.forecast import ring_of
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.pdm.rollout import roll_out
from shiftsim.planners.pdm.scorer import AHEAD_SECONDS, TTC_STEPS, meet
from shiftsim.planners.proposals import contacts, places
from shiftsim.planners.proposals.areas import Areas, areas_of
from shiftsim.planners.proposals.comfort import ComfortBounds, comfort
from shiftsim.planners.proposals.tracker import DT, SCORED, STEP_US, drive_proposals
from shiftsim.sim.planner import Observation, observe_log, scene_info
from shiftsim.world import layers, state
from shiftsim.world.map import NONE, PerMap, VectorMap
from shiftsim.world.scenario import Scenario

RADIUS = 100.0  # m, half side of the square of map around the ego, and how far PDM-Closed sees
SPACING, FRAMES = 0.5, 5  # s between recorded frames, and between poses of plans; steps of 0.1 s
LEAD_HORIZON = 5.0  # s in which PDM-Closed looks for leads
MIN_PROGRESS = 5.0  # m, of the better of a plan and PDM-Closed's; below it all are equal
DIRECTION_LIMITS, DIRECTION_STEPS = (2.0, 6.0), 11  # m off the route, in so many steps
MAX_DEVIATION, DEVIATION_STEPS = 0.5, 20  # m beside the centerline, in so many steps in a row
# between two plans: acceleration [m/s^2], jerk [m/s^3], yaw rate [rad/s], its change [rad/s^2]
EXTENDED_LIMITS = (0.7, 0.5, 0.1, 0.1)
MAX_INTERVAL = 0.55  # s between the frames of two such plans
SIZE = places.ego_box(state.PACIFICA)
Parts = dict[str, Any]  # sub-scores by name


class Version(NamedTuple):
    """What a version of the score is made of."""

    multipliers: tuple[str, ...]
    weights: dict[str, float]
    seconds: float  # how far the recording is read [s]
    ttc_steps: int  # time indices that projections of the ego may reach


_FACTORS = ("no_at_fault_collisions", "drivable_area_compliance", "driving_direction_compliance")
_BOTH = {"ego_progress": 5.0, "time_to_collision_within_bound": 5.0}
_V2 = dict.fromkeys(("lane_keeping", "history_comfort", "two_frame_extended_comfort"), 2.0)
VERSIONS = {
    "v1": Version(_FACTORS[:2], {**_BOTH, "comfort": 2.0}, 5.0, SCORED + 1 + TTC_STEPS[-1]),
    "v2": Version((*_FACTORS, "traffic_light_compliance"), {**_BOTH, **_V2}, 4.0, SCORED + 1),
}


class Ground(NamedTuple):
    """The map around the ego as NAVSIM sees it."""

    lanes: Areas  # lanes and connectors, those of the route marked
    near_lanes: IntArray  # which of them belong to the frame
    drivable: Areas  # roadblocks, intersections, car parks; the intersections marked
    near_drivable: IntArray  # which of them belong to the frame
    intersections: layers.Polygons  # those of the frame
    centerline: shapely.LineString  # along the corrected route, prepared


class Surroundings(NamedTuple):
    """What moves and what lights show, from the frame on."""

    others: contacts.Obstacles  # centres are infinite where one is absent
    rows: IntArray  # row of time of each time index
    reaches: FloatArray  # (N,) how far each gets within the projection of the ego [m]
    connectors: list[shapely.Polygon]  # (L,) of the route that are red at some time
    red: BoolArray  # (T, L) when they are


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Sub-scores of P plans by NAVSIM's names, all (P,); None where a version has none."""

    score: FloatArray  # the total: PDMS (v1), EPDMS (v2)
    multiplicative_metrics_prod: FloatArray  # product of the multipliers
    no_at_fault_collisions: FloatArray
    drivable_area_compliance: FloatArray
    driving_direction_compliance: FloatArray  # not in the total of v1
    traffic_light_compliance: FloatArray | None = None
    ego_progress: FloatArray
    time_to_collision_within_bound: FloatArray
    comfort: FloatArray | None = None
    lane_keeping: FloatArray | None = None
    history_comfort: FloatArray | None = None
    two_frame_extended_comfort: FloatArray | None = None  # where a frame before is given
    progress_m: FloatArray  # along the centerline [m]
    collision_index: FloatArray  # first time index of an at-fault collision, inf if none
    ttc_index: FloatArray  # first time index with too short a time to collision, inf if none
    off_road_index: FloatArray  # and so on: with a corner off the drivable area
    wrong_way_index: FloatArray  # too far off the route
    red_light_index: FloatArray | None = None  # on a connector that is red
    flags: BoolArray  # (P, T, 3) whether the ego is on several lanes, off the road, off the route
    states: FloatArray  # (P, T, 11) as driven
    time_us: int  # of the frame [us]


@dataclass(frozen=True, slots=True)
class FrameWorld:
    """What the plans of one frame are scored in; made by `frame_world`."""

    version: str  # `v1` or `v2`
    time_us: int  # of the frame [us]
    ego: FloatArray  # (11,) ego state
    past: FloatArray  # (H, 11) ego states before, 0.1 s apart
    ground: Ground  # the map
    around: Surroundings  # others and lights
    plan: FloatArray  # (T, 3) what PDM-Closed plans, in the frame of the map
    reference: Scores  # of that plan
    human: Scores  # of what was driven, alone and without a past
    reach: FloatArray  # (1,) progress of the reference, less where it fails [m]


def frame_world(scenario: Scenario, iteration: int = 0, version: str = "v2") -> FrameWorld:
    """The world of a scenario from one iteration on; a PlannerError if PDM-Closed has no route.

    Raises DataError: less than 1.5 s was recorded before the frame, or 4 s (v1: 5 s) after it.
    """
    rules = VERSIONS[one_of("version", version, VERSIONS)]
    row, step = int(scenario.iteration_rows[iteration]), FRAMES * scenario.row_step
    after = row + step * np.arange(round(rules.seconds / SPACING) + 1)
    before = row - step * np.arange(3, -1, -1)
    if before[0] < 0 or after[-1] >= len(scenario.time_us):
        raise DataError(
            f"scenario {scenario.token!r} has too little recording around iteration {iteration}",
            f"NAVSIM's score {version} needs 1.5 s before it and {rules.seconds:g} s after it",
        )
    ego, time_us = scenario.ego[row].copy(), int(scenario.time_us[row])
    around = recorded_surroundings(scenario.tracks.rows(after), rules.ttc_steps)
    if version == "v2":
        around = seen_by_v2(around, scenario, after, FRAMES, ego)
    ground, plan = _reference_plan(scenario, iteration, version)
    driven = to_frame(scenario.ego[after[1:9], :3], ego[:3])[None]
    poses = [sample_plans(plan[None], time_us + STEP_US * np.arange(SCORED + 1), time_us)]
    poses.append(_poses_of(driven, ego, time_us))
    states = drive_proposals(np.concatenate(poses), ego).states
    past = past_states(scenario.time_us[before], scenario.ego[before])
    pairs = (states[:1], past), (states[1:], past[:0])
    parts = (evaluate(each, ground, around, version, before) for each, before in pairs)
    reference, human = (total(part, version, time_us, None) for part in parts)
    reach = reference.progress_m * reference.multiplicative_metrics_prod
    at = version, time_us, ego, past
    return FrameWorld(*at, ground, around, plan, reference, human, reach)


def score(
    world: FrameWorld,
    plans: FloatArray,
    *,
    human_filter: bool = True,
    previous: Scores | None = None,
) -> Scores:
    """Score plans as NAVSIM does.

    Args:
        world: What they are driven in.
        plans: (P, n, 3) rear axle x [m], y [m], heading [rad] in the frame of the ego, 0.5 s, 1 s,
            … from now; the last pose is held up to 4 s.
        human_filter: Whether what the recorded driver fails as well does not count (v2).
        previous: Scores of the plans in the frame before, for the extended comfort (v2).

    Raises:
        ValueError: The plans are not finite or do not fit, or the previous frame is not within
            0.55 s before.
    """
    plans = np.asarray(plans, np.float64)
    if plans.ndim != 3 or plans.shape[2] != 3 or not plans.size or not np.isfinite(plans).all():
        raise ValueError(f"plans must be finite and have the shape (P, n, 3), not {plans.shape}")
    states = drive_proposals(_poses_of(plans, world.ego, world.time_us), world.ego).states
    parts = evaluate(states, world.ground, world.around, world.version, world.past)
    if previous is not None:
        seconds = (world.time_us - previous.time_us) * 1e-6
        if not 0.0 < seconds < MAX_INTERVAL or previous.states.shape != states.shape:
            text = f"extended comfort compares {len(states)} plans of up to {MAX_INTERVAL} s before"
            raise ValueError(f"{text}, not {len(previous.score)} of {seconds:.3g} s before")
        differences = extended_differences(states, previous.states, seconds)
        parts["two_frame_extended_comfort"] = 1.0 * (differences <= EXTENDED_LIMITS).all(axis=1)
    human = world.human if human_filter and world.version == "v2" else None
    return total(parts, world.version, world.time_us, human, world.reach)


def evaluate(
    states: FloatArray,
    ground: Ground,
    around: Surroundings,
    version: str,
    past: FloatArray,
    worlds: tuple[Surroundings, ...] = (),
) -> Parts:
    """Sub-scores of driven states (P, T, 11), all but those that compare plans, by name.

    `past` (H, 11) comes before them where comfort looks back; without rows all are comfortable.
    With `worlds` (P,) each is among the others of its own one.
    """
    on_lanes, on_road = (
        places.find_places(states, SIZE, areas, near, np.zeros(len(areas.lane)), by_center=True)
        for areas, near in (ground[:2], ground[2:4])
    )
    # nuPlan rule 742: lanes tell how many of them the ego is on, other areas whether it is on any
    flags, crosses = on_lanes.flags.copy(), ~on_road.flags[..., places.OFF_ROUTE]
    off_road = flags[..., places.OFF_ROAD] = on_road.flags[..., places.OFF_ROAD]
    at = on_lanes._replace(flags=flags, off_lane=flags[..., places.MULTIPLE] | off_road)
    each: list[Any] = [[c[row : row + 1] for c in at] for row in range(len(worlds))] or [at]
    pairs = zip(each, (one[:3] for one in worlds or [around]), strict=True)
    met = (meet(places.ProposalStates(*a), *b, SIZE, ground.intersections) for a, b in pairs)
    fault, fault_index, ttc_index = map(np.concatenate, zip(*met, strict=True))
    points = shapely.points(at.centers)
    along = shapely.line_locate_point(ground.centerline, points[:, [0, -1]])
    # nuPlan rule 743: v2 has no wrong direction within intersections
    wrong_way = flags[..., places.OFF_ROUTE] & ~(crosses & (version == "v2"))
    way, off_road_index = way_off_route(at.centers, wrong_way), _first(off_road)
    parts = {
        "no_at_fault_collisions": fault,
        "drivable_area_compliance": 1.0 * (off_road_index == contacts.NEVER),
        "driving_direction_compliance": 0.5 * sum(way.max(axis=1) < m for m in DIRECTION_LIMITS),
        "time_to_collision_within_bound": 1.0 * (ttc_index == contacts.NEVER),
        "progress_m": np.maximum(along[:, 1] - along[:, 0], 0.0),
        "collision_index": fault_index,
        "ttc_index": ttc_index,
        "off_road_index": off_road_index,
        "wrong_way_index": _first(way >= DIRECTION_LIMITS[0]),
        "flags": flags,
        "states": states,
    }
    if version == "v1":
        return {**parts, "comfort": comfort(states, ComfortBounds()).score}
    index = parts["red_light_index"] = _first(_touches_red(at.corners, around))
    parts["traffic_light_compliance"] = 1.0 * (index == contacts.NEVER)
    # nuPlan rule 744: intersections are left out, as if they took no time
    outside = (row[~inside] for row, inside in zip(points, crosses, strict=True))
    leaves = [_leaves_line(row, ground.centerline) for row in outside]
    parts["lane_keeping"] = 1.0 - np.array(leaves)
    times = STEP_US * np.arange(len(past) + states.shape[1])
    whole = (np.concatenate([past, row]) for row in states if len(past))
    calm = [all(within_bounds(comfort_signals(times, row), NUPLAN)) for row in whole]
    return {**parts, "history_comfort": np.array(calm or [True] * len(states), np.float64)}


def _first(violated: BoolArray) -> FloatArray:
    """(P,) first of the steps (P, T) that violate, inf without one."""
    return np.where(violated.any(axis=1), violated.argmax(axis=1), contacts.NEVER)


def way_off_route(centers: FloatArray, wrong_way: BoolArray) -> FloatArray:
    """(P, T) way off the route in the last second [m], from centres (P, T, 2) and flags (P, T)."""
    step = np.hypot(*np.moveaxis(np.diff(centers, axis=1), -1, 0))
    way = np.zeros((len(centers), DIRECTION_STEPS + centers.shape[1]))
    np.cumsum(np.where(wrong_way[:, 1:], step, 0.0), axis=1, out=way[:, DIRECTION_STEPS + 1 :])
    return way[:, DIRECTION_STEPS:] - way[:, :-DIRECTION_STEPS]


def _leaves_line(points: np.ndarray, line: shapely.LineString) -> bool:
    """Whether so many points (K,) in a row are too far from a line."""
    near = np.flatnonzero(shapely.dwithin(line, points, MAX_DEVIATION))
    return bool(np.diff(near, prepend=-1, append=len(points)).max() > DEVIATION_STEPS)


def _touches_red(corners: FloatArray, around: Surroundings) -> BoolArray:
    """(P, T) whether the ego (P, T, 4, 2) touches a connector while it is red."""
    touched = np.zeros(corners.shape[:2], np.bool_)
    if around.connectors:
        boxes = shapely.polygons(corners)
        shapely.prepare(around.connectors)
        for connector, red in zip(around.connectors, around.red.T, strict=True):
            touched |= shapely.intersects(connector, boxes) & red
    return touched


def extended_differences(states: FloatArray, previous: FloatArray, seconds: float) -> FloatArray:
    """(P, 4) RMS of `EXTENDED_LIMITS`' differences of states (P, T, 11), frames `seconds` apart."""
    shift = round(seconds / DT)
    pairs = zip(states[:, :-shift], previous[:, shift:], strict=True)
    differences = np.array([_motion(now) - _motion(before) for now, before in pairs])
    return np.sqrt((differences**2).mean(axis=-1))


def _motion(states: FloatArray) -> FloatArray:
    """(4, K) what `extended_differences` compares, of states (K, 11)."""
    signals, yaw_accel = comfort_signals(STEP_US * np.arange(len(states)), states), states[:, 0] + 0
    # nuPlan rule 745: a parabola here, where comfort takes a cubic
    filter_signal(unwrap(states[:, state.HEADING]), make_filter(5, 2, 2), DT * DT, yaw_accel)
    return np.stack([signals.mag_accel, signals.mag_jerk, signals.yaw_rate, yaw_accel])


def total(
    parts: Parts, version: str, time_us: int, human: Scores | None, reach: FloatArray | float = 0.0
) -> Scores:
    """Compare progress with how far others get [m], and add up; what is 0 for the human is 1."""
    rules, raw, factor = VERSIONS[version], parts["progress_m"], _factor(parts, version)
    most = np.maximum(raw * factor, reach)
    share = np.minimum(raw / np.maximum(most, MIN_PROGRESS), 1.0)
    # nuPlan rule 740: in v2 multipliers shorten what is compared with, not a plan's own progress
    kept = (factor, 1.0 * (factor > 0.0)) if version == "v1" else (1.0, 1.0)
    progress = np.where(most > MIN_PROGRESS, share * kept[0], kept[1])
    named = {**parts, "ego_progress": progress}
    for name in (*rules.multipliers, *rules.weights):
        if human is not None and getattr(human, name) is not None:
            named[name] = np.where(getattr(human, name) == 0.0, 1.0, named[name])
    weights = {name: weight for name, weight in rules.weights.items() if name in named}
    mean = sum(weight * named[name] for name, weight in weights.items()) / sum(weights.values())
    named["multiplicative_metrics_prod"] = _factor(named, version)
    return Scores(score=named["multiplicative_metrics_prod"] * mean, time_us=time_us, **named)


def _factor(parts: Parts, version: str) -> FloatArray:
    """(P,) product of the multipliers."""
    return np.prod([parts[name] for name in VERSIONS[version].multipliers], axis=0)


def _poses_of(plans: FloatArray, ego: FloatArray, time_us: int) -> FloatArray:
    """(P, T, 3) poses in the frame of the map from plans (P, n, 3) in that of an ego (11,)."""
    start = np.broadcast_to(ego[:3], (len(plans), 1, 3))
    poses = np.concatenate([start, from_frame(plans, ego[:3])], axis=1)
    times = np.arange(1, plans.shape[1] + 1) * SPACING + time_us * 1e-6
    return sample_plans(poses, np.append(time_us, (times * 1e6).astype(np.int64)), time_us)


def sample_plans(poses: FloatArray, times: IntArray, time_us: int) -> FloatArray:
    """(P, T, 3) poses each 0.1 s from poses (P, n, 3) at times (n,), from `time_us` on [us]."""
    # nuPlan rule 746: times go through seconds, and end up to a microsecond too early
    at = ((np.arange(SCORED + 1) * DT + time_us * 1e-6) * 1e6).astype(np.int64)
    at = np.clip(at, times[0], times[-1])
    low = np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)
    poses = poses.copy()
    poses[..., 2] = unwrap(poses[..., 2])
    slope = np.diff(poses, axis=1) / np.diff(times)[:, None]
    out: FloatArray = slope[:, low] * (at - times[low])[:, None] + poses[:, low]
    out[..., 2] = wrap_angles(out[..., 2])
    return out


def past_states(time_us: IntArray, states: FloatArray) -> FloatArray:
    """(H, 11) states each 0.1 s from some (F, 11) at times (F,), the last being the present."""
    # nuPlan rule 747: the last state before the present is left out, and rates are 0
    at = np.arange(time_us[0], time_us[-1], STEP_US)[:-1] - time_us[0]
    columns = states.copy()
    columns[:, state.HEADING] = unwrap(states[:, state.HEADING])
    out = np.stack([np.interp(at, time_us - time_us[0], values) for values in columns.T], axis=1)
    out[:, state.STEERING_RATE :] = 0.0
    return out


def recorded_surroundings(tracks: state.Tracks, ttc_steps: int) -> Surroundings:
    """Tracks recorded every 0.5 s as they are each 0.1 s, without lights."""
    tracks = tracks.select(np.flatnonzero(tracks.valid.any(axis=0)))
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
    sizes, is_agent = tracks.sizes[first, number], tracks.kinds <= state.LAST_AGENT_KIND
    speeds = np.where(is_agent, np.hypot(*tracks.velocities[first, number].T), 0.0)
    boxes, centers = boxes_to_corners(poses, sizes), poses[..., :2]
    travel = np.hypot(*np.diff(centers, axis=0).T).max(axis=1, initial=0.0)
    centers = np.where(absent[..., None], np.inf, centers)
    middles = np.array([centroid(box) for box in boxes.reshape(-1, 4, 2)]).reshape(centers.shape)
    speeds, radii = np.broadcast_to(speeds, absent.shape).copy(), 0.5 * np.hypot(*sizes.T)
    ignored = np.zeros(len(number), np.bool_)
    others = contacts.Obstacles(boxes, centers, middles, speeds, radii, is_agent, ignored)
    reaches = np.nan_to_num((TTC_STEPS[-1] + 1) * travel, nan=np.inf)
    return Surroundings(others, np.arange(ttc_steps), reaches, [], np.zeros((SCORED + 1, 0), bool))


def seen_by_v2(
    on: Surroundings, scenario: Scenario, rows: IntArray, each: int, ego: FloatArray
) -> Surroundings:
    """The same as v2 sees it, with the lights of rows that are `each` steps apart."""
    # nuPlan rule 741: what touches the ego at the beginning is not there
    others, footprint = on.others, boxes_to_corners(state.center_poses(ego[:3]), np.array(SIZE[:2]))
    touching = contacts.touches_boxes(footprint, others.boxes[0])
    others.ignored[:] = touching & np.isfinite(others.centers[0, :, 0])
    edges, route = scenario.map.edges, scene_info(scenario).route_lanes
    listed = [set(scenario.traffic_lights.red(row)) for row in rows.tolist()]
    lanes = [e for e in route if any(edges.ids[e] in red for red in listed)]
    red = np.array([[edges.ids[e] in ids for e in lanes] for ids in listed], np.bool_)
    red = red.reshape(len(listed), len(lanes)).repeat(each, axis=0)[: each * (len(rows) - 1) + 1]
    return on._replace(connectors=[edges.shape(e) for e in lanes], red=red)


def _reference_plan(scenario: Scenario, iteration: int, version: str) -> tuple[Ground, FloatArray]:
    """The map as seen from an iteration, and the poses (T, 3) that PDM-Closed plans there."""
    planner, observation = PdmClosed(map_radius=RADIUS), observe_log(scenario, iteration)
    ground, (seen, paths, limit) = look_around(scenario, observation, planner)
    ego, forecast = observation.history.ego[-1].copy(), seen.forecast
    scene, targets = planner.scene_in(seen, paths, ego, limit, state.PACIFICA)
    others, numbers = forecast.others, range(len(forecast.moves), len(forecast.ignored))
    lights = [shapely.Polygon(ring_of(forecast, number)) for number in numbers]
    steps, red = VERSIONS[version].ttc_steps, np.ones((SCORED + 1, len(lights)), np.bool_)
    reaches = (AHEAD_SECONDS + DT) * others.speeds[0]
    around = Surroundings(others, np.arange(steps) // 2, reaches, lights, red)
    # nuPlan rule 750: proposals look for leads as far as they get in 5 s, and never brake at last
    proposals = roll_out(scene, ego, targets, LEAD_HORIZON).poses[:, :, : SCORED + 1]
    poses = np.ascontiguousarray(proposals).reshape(-1, SCORED + 1, 3)
    states = drive_proposals(poses, ego).states
    parts = evaluate(states, ground, around, version, states[0, :0])
    reach = (parts["progress_m"] * _factor(parts, version)).max()
    return ground, poses[np.argmax(total(parts, version, 0, None, reach).score)]


def look_around(scenario: Scenario, seen: Observation, planner: PdmClosed) -> tuple[Ground, Any]:
    """The map around an observation, with the planner's lanes and centerline, and its `look`."""
    planner.reset(scene_info(scenario))
    look, road, (x, y, _) = planner.look(seen), scenario.map, seen.ego.center.tolist()
    place, drivable = look[0].place, _drivable_areas(road)
    first = len(road.blocks)  # of the intersections
    near = layers.meeting(drivable.polygons, layers.square_around(x, y, RADIUS))
    near = near[(near < road.num_roadblocks) | (near >= first)]
    crossings = near[drivable.on_route[near]] - first
    shapes = [road.intersections.rings(index) for index in crossings.tolist()]
    lanes = place.selected[place.selected < len(road.edges)]
    line, polygons = shapely.LineString(place.centerline.xy), layers.make_polygons(shapes)
    shapely.prepare(line)
    return Ground(place.areas, lanes, drivable, near, polygons, line), look


@PerMap
def _drivable_areas(road: VectorMap) -> Areas:
    parts = (road.blocks, road.intersections, road.car_parks)
    kind = np.repeat(np.arange(3), [len(part) for part in parts])
    polygons = layers.join_polygons([part.polygons for part in parts])
    return areas_of(polygons, kind == 1, np.full(len(kind), NONE))
