"""Apply an edit to a recorded scenario: a pure function from a `Scenario` to another one.

Order: start, window, remove, move, slow, stop, reroute, density, spawn, block_lane, walk, light,
speed.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from shiftsim.edits import spec
from shiftsim.edits.builder import ScenarioBuilder
from shiftsim.edits.density import fill_lanes
from shiftsim.edits.interplan.build import InterplanEditor
from shiftsim.edits.interplan.path import DrivenLanes
from shiftsim.edits.places import require_on_map
from shiftsim.edits.route import reroute
from shiftsim.errors import ConfigError, ShiftsimError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.events import CAUTIOUS, FOLLOW, OFF, STOPPED, ScriptedPedestrian
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import HEADING, NUM_STATE, AgentKind, LightStatus, Tracks, TrafficLights

SIZES = {  # length, width [m]
    "vehicle": (4.6, 1.9),
    "pedestrian": (0.7, 0.7),
    "bicycle": (1.8, 0.7),
    "traffic_cone": (0.5, 0.5),
    "barrier": (2.0, 0.6),
    "czone_sign": (0.7, 0.7),
    "generic_object": (1.0, 1.0),
}
NONREACTIVE = "nonreactive"
_MIN_LEFT = 3  # iterations after the first that a scenario has
_BEHAVIORS = {"idm": FOLLOW, "stopped": STOPPED, "cautious": CAUTIOUS}


# tracks (i + 1, N) of a scenario's iterations in traffic, where the ego drives states (i + 1, 11)
Replay = Callable[[Scenario, FloatArray, str], Tracks]


def apply_edit(
    scenario: Scenario,
    edit: spec.Edit,
    driven_lanes: DrivenLanes | None = None,
    replay: Replay | None = None,
) -> Scenario:
    """The scenario that an edit makes of a recorded one; a ConfigError where it cannot."""
    try:
        if edit.start is not None:
            scenario = _begin_at(scenario, edit.start, replay)
        if not edit.code:
            edited = _apply_tables(scenario, edit)
            events = edited.script and (edited.script.pedestrians or edited.script.termination)
            if not (events or edit.start or edit.agents) and _seen(edited) == _seen(scenario):
                what = f"nothing changes in the {edited.duration:.1f} s of the scenario"
                raise ConfigError(what, "choose tracks and values that make a difference")
            return edited
        if driven_lanes is None:
            what = f"the code {edit.code!r} is applied in runs only"
            raise ConfigError(what, 'write it into a file with profile = "interplan", and run that')
        return InterplanEditor(scenario, edit, driven_lanes).result()
    except ShiftsimError as error:
        text = f"edit {edit.name!r} of scenario {scenario.token!r}: {error.message}"
        raise ConfigError(text, error.hint) from error


def _seen(scenario: Scenario) -> list[bytes]:
    """What an edit can change, up to the last iteration, as bytes that can be compared."""
    rows = slice(int(scenario.iteration_rows[-1]) + 1)
    tracks, status = scenario.tracks.rows(rows), scenario.traffic_lights.status[rows]
    lit = (status != LightStatus.ABSENT).any(axis=0)
    lights = np.array(scenario.traffic_lights.connector_ids)[lit]
    tracks = tracks.select(np.flatnonzero(tracks.valid.any(axis=0)))
    values = (
        *(tracks.tokens, *tracks.arrays, lights, status[:, lit], scenario.ego[rows]),
        *(scenario.map.speed_limits, scenario.route, scenario.mission_goal),
        scenario.iteration_rows,
    )
    return [np.asarray(value).tobytes() for value in values]


def _apply_tables(scenario: Scenario, edit: spec.Edit) -> Scenario:
    seed = edit.seed  # of what is drawn
    if seed is None:
        seed = int(spec.digest_of([scenario.token, edit.name])[:12], 16)
    builder, speed = ScenarioBuilder(scenario, edit, seed), edit.speed
    if edit.window_s is not None:
        _set_window(builder, edit.window_s)
    end = builder.seconds[builder.scenario.iteration_rows[-1]]
    for name in ("slow", "stop", "light"):
        for table in getattr(edit, name):
            if table.from_s >= end:
                what = f"{name}: from_s is {table.from_s:g}, the scenario ends at {end:.1f} s"
                raise ConfigError(what, f"give a time from 0 to {end:.1f} s, or a longer window_s")
    for remove in edit.remove:
        _remove(builder, remove)
    _change_motion(builder)
    if edit.reroute:
        reroute(builder, edit.reroute, ends=edit.end_at_goal is not False)
    if speed and speed.ego_mps is not None:
        builder.set_ego_speed(speed.ego_mps)
    if edit.density:
        fill_lanes(builder, edit.density)
    for spawn in edit.spawn:
        _spawn(builder, spawn)
    for block in edit.block_lane:
        _block_lane(builder, block)
    walkers = dict(filter(None, [_add_walker(builder, walk) for walk in edit.walk]))
    for light in edit.light:
        _set_lights(builder, light)
    if speed and speed.limit != 1.0:
        road = builder.scenario.map
        builder.change(map=replace(road, speed_limits=road.speed_limits * speed.limit))
    tokens = builder.tracks.tokens
    return builder.finish(
        edit.type or scenario.scenario_type,
        spec.MANNERS.index(edit.agents) if edit.agents else OFF,
        pedestrians=tuple(replace(x, track=tokens.index(name)) for name, x in walkers.items()),
        seed=seed,
    )


def _pose_of(
    builder: ScenarioBuilder, place: spec.Place | spec.Spawn | spec.Block, what: str
) -> FloatArray:
    """(3,) pose of a place."""
    pose = builder.path.pose(place.at) if place.at else np.array(place.pose, np.float64)
    require_on_map(builder.recorded.map, pose, what)
    return pose


def _remove(builder: ScenarioBuilder, remove: spec.Remove) -> None:
    chosen = builder.which(remove.kinds, remove.tokens)
    if remove.near:
        x, y, radius = remove.near
        poses = builder.tracks.poses[builder.now, chosen]
        chosen = chosen[np.hypot(poses[:, 0] - x, poses[:, 1] - y) <= radius]
    if remove.share < 1.0:
        count = round(remove.share * len(chosen))
        chosen = np.array(builder.draws.sample(chosen.tolist(), count), np.int64)
    builder.select(np.delete(np.arange(builder.tracks.num_tracks), chosen))


def _change_motion(builder: ScenarioBuilder) -> None:
    edit = builder.edit
    if edit.move or edit.slow or edit.stop or edit.speed:
        builder.tracks = builder.tracks.copy()
    for move in edit.move:
        for track in builder.which((), move.tokens).tolist():
            _shift(builder, track, move.ahead_m, move.left_m)
    slows = list(edit.slow)
    if edit.speed and edit.speed.tracks != 1.0:
        if edit.speed.tracks > 1.0:
            raise ConfigError("speed: tracks is above 1", "a recording cannot be sped up")
        slows.append(spec.Slow(edit.speed.tracks, kinds=("vehicle",)))
    seconds = builder.seconds
    for slow in slows:
        late = np.maximum(seconds - slow.from_s, 0.0)
        recorded = np.minimum(seconds, slow.from_s) + slow.factor * late
        for track in builder.which(slow.kinds, slow.tokens).tolist():
            _warp(builder, track, recorded)
    for stop in edit.stop:
        for track in builder.which((), stop.tokens).tolist():
            _stop(builder, track, stop)


def _stop(builder: ScenarioBuilder, track: int, stop: spec.Stop) -> None:
    seconds = builder.seconds
    row = min(int(np.searchsorted(seconds, stop.from_s)), len(seconds) - 1)
    speed = float(np.hypot(*np.nan_to_num(builder.tracks.velocities[row, track])))
    # the clock of the recording slows down evenly until it stands
    needed = max(speed / max(stop.decel_mps2, 0.1), 1e-3)
    late = np.clip(seconds - stop.from_s, 0.0, needed)
    _warp(builder, track, np.minimum(seconds, stop.from_s) + late - 0.5 * late**2 / needed)


def _spawn(builder: ScenarioBuilder, spawn: spec.Spawn) -> None:
    kind, name = spec.KIND_CODES[spawn.kind], builder.name(spawn.kind)
    what = f"spawned {spawn.kind.replace('_', ' ')}"
    pose, size = _pose_of(builder, spawn, what), np.array(spawn.size_m or SIZES[spawn.kind])
    if kind == AgentKind.VEHICLE and spawn.behavior != "stopped":
        builder.add_vehicle(name, pose, size, spawn.speed_mps, _BEHAVIORS[spawn.behavior])
        return
    builder.require_free(pose[None], size, what)
    builder.add([name], kind, size, pose[None], behaviors=STOPPED)


def _block_lane(builder: ScenarioBuilder, block: spec.Block) -> None:
    pose, size = _pose_of(builder, block, "closed lane"), np.array(SIZES[block.kind])
    spacing = max(block.spacing_m, 0.5)
    ahead = spacing * np.arange(int(block.length_m / spacing) + 1)
    left = np.zeros(len(ahead))
    if block.taper_m > 0.0:  # a slanted row before, from the right border of the lane
        slanted = int(np.ceil(max(block.taper_m, block.width_m) / spacing))
        rest = 1.0 - np.arange(slanted) / slanted
        left = np.concatenate([-block.width_m * 0.5 * rest, left])
        ahead = np.concatenate([-block.taper_m * rest, ahead])
    poses = np.array(
        [
            builder.path.pose(
                spec.At(block.at.ahead_m + along, block.at.left_m + aside, block.at.turn)
            )
            if block.at
            else _ahead_of(pose, along, aside)
            for along, aside in zip(ahead.tolist(), left.tolist(), strict=True)
        ]
    )
    builder.require_free(poses, size, f"{block.kind.replace('_', ' ')} of a closed lane")
    names = [builder.name(block.kind) for _ in poses]
    builder.add(names, spec.KIND_CODES[block.kind], size, poses, behaviors=STOPPED)


def _add_walker(builder: ScenarioBuilder, walk: spec.Walk) -> tuple[str, ScriptedPedestrian] | None:
    """Add a pedestrian; its token, and how it walks, where it waits for the ego."""
    size = np.array(SIZES["pedestrian"])
    start, end = (_pose_of(builder, place, "pedestrian") for place in (walk.start, walk.end))
    step = end[:2] - start[:2]
    if float(np.hypot(*step)) < 1e-3:
        raise ConfigError("a pedestrian walks from a place to the same place")
    start[2] = np.arctan2(step[1], step[0])
    builder.require_free(start[None], size, "pedestrian")
    name, speed = builder.name("pedestrian"), max(walk.speed_mps, 1e-3)
    pedestrian = ScriptedPedestrian(
        -1, start, end[:2], size, speed, walk.ego_within_m, walk.visible
    )
    start_time = np.inf if walk.start_s is None else walk.start_s
    poses, velocities, valid = pedestrian.walk(builder.seconds, start_time)
    builder.add(
        [name],
        AgentKind.PEDESTRIAN,
        size,
        poses[:, None],
        valid=valid[:, None],
        velocities=velocities[:, None],
    )
    return (name, pedestrian) if walk.start_s is None else None


def _ahead_of(pose: FloatArray, ahead: float, left: float) -> FloatArray:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array(
        [pose[0] + ahead * cos - left * sin, pose[1] + ahead * sin + left * cos, pose[2]]
    )


def _begin_at(scenario: Scenario, start: spec.Start, replay: Replay | None) -> Scenario:
    """The scenario from where a rollout had come; what that drove is its past."""
    rows, driven = scenario.iteration_rows, np.array(start.ego)
    known = rows[: len(driven)]
    if driven.shape != (len(known), NUM_STATE) or len(known) + _MIN_LEFT > len(rows):
        raise ConfigError(
            f"start: {driven.shape} states of {NUM_STATE} numbers do not begin {len(rows)} "
            "iterations",
            hint="make the edit anew, with shiftsim mine",
        )
    past: IntArray = np.arange(known[0], known[-1] + 1)
    ego, times, columns = np.array(scenario.ego), scenario.time_us - scenario.time_us[0], driven.T
    columns = np.vstack([columns[:HEADING], np.unwrap(columns[HEADING]), columns[HEADING + 1 :]])
    for column, values in enumerate(columns):
        ego[past, column] = np.interp(times[past], times[known], values)
    ego[past, HEADING] = wrap_angles(ego[past, HEADING])
    ego[known], tracks = driven, scenario.tracks
    if start.traffic != NONREACTIVE:
        if replay is None:
            what = f"start: traffic {start.traffic!r} is driven in runs only"
            raise ConfigError(what, hint="write the edit into a file, and run that")
        seen, tracks = replay(scenario, driven, start.traffic), tracks.copy()
        at = np.searchsorted(known, past, side="right") - 1
        for target, values in zip(tracks.arrays, seen.arrays, strict=True):
            target[past] = values[at]
    left = float(times[rows[-1]] - times[known[-1]]) * 1e-6
    mapping = (round(left, 1), *scenario.mapping[1:])
    later = rows[len(driven) - 1 :]
    return replace(scenario, ego=ego, tracks=tracks, iteration_rows=later, mapping=mapping)


def _set_window(builder: ScenarioBuilder, seconds: float) -> None:
    scenario = builder.scenario
    rows: IntArray = np.arange(builder.now, len(scenario.time_us), scenario.row_step)
    time_us = scenario.time_us[rows]
    inside = rows[time_us <= time_us[0] + round(seconds * 1e6)]
    known = float(time_us[-1] - time_us[0]) * 1e-6
    step = float(np.median(np.diff(time_us))) * 1e-6
    if known < seconds - step:
        raise ConfigError(
            f"a window of {seconds:g} s is longer than the {known:.1f} s that are recorded from "
            "its start on",
            hint="convert the recording with a longer duration",
        )
    if len(inside) <= _MIN_LEFT:
        raise ConfigError(f"a window of {seconds:g} s is too short", "give some seconds")
    _, offset, ratio = scenario.mapping
    builder.change(iteration_rows=inside, mapping=(seconds, offset, ratio), is_short=False)


def _shift(builder: ScenarioBuilder, track: int, ahead: float, left: float) -> None:
    tracks, now = builder.tracks, builder.now
    if not tracks.valid[now, track]:
        what = f"track {tracks.tokens[track]!r} is not there at the start, so it cannot be moved"
        raise ConfigError(what)
    pose = _ahead_of(tracks.poses[now, track], ahead, left)
    size = tracks.sizes[now, track].copy()
    by = pose[:2] - tracks.poses[now, track, :2]
    tracks.valid[now, track] = False  # it may be in its own way
    builder.require_free(pose[None], size, f"moved track {tracks.tokens[track]!r}")
    tracks.valid[now, track] = True
    tracks.poses[:, track, :2] += by
    builder.touched.append(tracks.tokens[track])


def _warp(builder: ScenarioBuilder, track: int, recorded: FloatArray) -> None:
    """Have a track be at each time where it was at another one (R,) [s], never a later one."""
    tracks, seconds = builder.tracks, builder.seconds
    valid, poses = tracks.valid[:, track].copy(), tracks.poses[:, track].copy()
    if not valid.any():
        return
    low = np.clip(np.searchsorted(seconds, recorded, side="right") - 1, 0, len(seconds) - 2)
    span = seconds[low + 1] - seconds[low]
    share = np.clip((recorded - seconds[low]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
    poses[valid, 2] = np.unwrap(poses[valid, 2])
    both = valid[low] & valid[low + 1]
    near = np.where(valid[low], low, low + 1)
    other = np.where(both, low + 1, near)
    moved = poses[near] + np.where(both, share, 0.0)[:, None] * (poses[other] - poses[near])
    moved[:, 2] = (moved[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    velocities = tracks.velocities[near, track] * np.gradient(recorded, seconds)[:, None]
    sizes, late = tracks.sizes[near, track], recorded < seconds - 1e-9
    tracks.valid[late, track] = valid[near][late]
    tracks.poses[late, track] = moved[late]
    tracks.velocities[late, track] = velocities[late]
    tracks.sizes[late, track] = sizes[late]
    builder.touched.append(tracks.tokens[track])


def _set_lights(builder: ScenarioBuilder, light: spec.Light) -> None:
    scenario = builder.scenario
    road, lights = scenario.map, scenario.traffic_lights
    names: Iterable[str] = light.connectors
    if light.route:
        blocks = {road.blocks.index[name] for name in scenario.route if name in road.blocks.index}
        names = [
            road.edges.ids[edge]
            for edge in range(road.num_lanes, len(road.edges))
            if road.has_traffic_lights[edge] and int(road.block_of[edge]) in blocks
        ]
        if not names:
            raise ConfigError("light: no connector on the route has traffic lights")
    for name in names:
        if not road.is_connector(road.edge(name)):
            raise ConfigError(f"light: {name!r} is a lane, not a connector")
    seconds = builder.seconds
    during = (seconds >= light.from_s) & (seconds < (np.inf if light.to_s is None else light.to_s))
    ids, status = list(lights.connector_ids), np.array(lights.status)
    for name in names:
        columns = [column for column, known in enumerate(ids) if known == name]
        if not columns:
            columns = [len(ids)]
            ids.append(name)
            blank = np.full((len(status), 1), LightStatus.ABSENT, np.int8)
            status = np.concatenate([status, blank], axis=1)
        status[during, columns[0]] = spec.LIGHT_CODES[light.status]
        for column in columns[1:]:  # nuPlan rule 429: an id listed twice would show both
            status[during, column] = LightStatus.ABSENT
    builder.change(traffic_lights=TrafficLights(tuple(ids), status))
