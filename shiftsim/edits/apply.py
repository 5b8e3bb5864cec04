"""Apply an edit to a recorded scenario: a pure function from a `Scenario` to another one.

Order: window, remove, move, slow, stop, reroute, density, spawn, block_lane, walk, light, speed.
"""

import random
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from shiftsim.edits.builder import ScenarioBuilder, begin
from shiftsim.edits.density import fill_lanes
from shiftsim.edits.interplan.build import assemble, build
from shiftsim.edits.interplan.path import DrivenLanes
from shiftsim.edits.places import EgoPath, ego_path, require_on_map
from shiftsim.edits.route import reroute
from shiftsim.edits.spec import (
    KIND_CODES,
    LIGHT_CODES,
    MANNERS,
    At,
    Edit,
    Light,
    Slow,
    Spawn,
    digest_of,
    edited_id,
)
from shiftsim.errors import ConfigError, ShiftsimError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.events import CAUTIOUS, FOLLOW, OFF, STOPPED, RolloutEvents, ScriptedPedestrian
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, AgentKind, LightStatus, TrafficLights

SIZES = {  # length, width [m]
    "vehicle": (4.6, 1.9),
    "pedestrian": (0.7, 0.7),
    "bicycle": (1.8, 0.7),
    "traffic_cone": (0.5, 0.5),
    "barrier": (2.0, 0.6),
    "czone_sign": (0.7, 0.7),
    "generic_object": (1.0, 1.0),
}
_BEHAVIORS = {"idm": FOLLOW, "stopped": STOPPED, "cautious": CAUTIOUS}


def apply_edit(scenario: Scenario, edit: Edit, driven_lanes: DrivenLanes | None = None) -> Scenario:
    """The scenario that an edit makes of a recorded one.

    Codes of interPlan need `driven_lanes`, such as `metrics.interplan.driven_lanes`.

    Raises:
        ConfigError: It cannot be applied; the message names scenario, edit and reason.
    """
    try:
        if not edit.code:
            return _Editor(scenario, edit).result()
        if driven_lanes is None:
            raise ConfigError(
                f"the code {edit.code!r} is applied in runs only",
                hint='write it into a file with profile = "interplan", and run that',
            )
        return assemble(scenario, build(scenario, edit.code, edit.details, driven_lanes), edit)
    except ShiftsimError as error:
        text = f"edit {edit.name!r} of scenario {scenario.token!r}: {error.message}"
        raise ConfigError(text, error.hint) from error


def seed_of(edit: Edit, token: str) -> int:
    """Seed of what an edit draws: its own, or made from the id."""
    if edit.seed is not None:
        return edit.seed
    return int(digest_of([token, edit.name])[:12], 16)


class _Editor:
    def __init__(self, scenario: Scenario, edit: Edit) -> None:
        self.edit, self.base = edit, scenario
        self.builder = begin(scenario)
        self.seed = seed_of(edit, scenario.token)
        self.random = random.Random(self.seed)
        self.count: dict[str, int] = {}
        self._path: EgoPath | None = None

    @property
    def path(self) -> EgoPath:
        """The recorded path, which places are counted along; that of the recording, always."""
        if self._path is None:
            self._path = ego_path(self.base)
        return self._path

    def result(self) -> Scenario:
        edit, builder = self.edit, self.builder
        if edit.window_s is not None:
            _set_window(builder, edit.window_s)
        self._remove()
        self._change_motion()
        if edit.reroute:
            reroute(builder, edit.reroute, ends=edit.ends_at_goal)
        if edit.speed and edit.speed.ego_mps is not None:
            ego = np.array(builder.scenario.ego)
            ego[builder.now, VX] = edit.speed.ego_mps
            builder.change(ego=ego)
        if edit.density:
            fill_lanes(builder, edit.density, self.random, self.name)
        for spawn in edit.spawn:
            self._spawn(spawn)
        self._block_lanes()
        self._walk()
        for light in edit.light:
            _set_lights(builder, light)
        if edit.speed and edit.speed.limit != 1.0:
            road = builder.scenario.map
            builder.change(map=replace(road, speed_limits=road.speed_limits * edit.speed.limit))
        return self._finished()

    def _finished(self) -> Scenario:
        edit, builder = self.edit, self.builder
        places = {token: i for i, token in enumerate(builder.tracks.tokens)}
        pedestrians = tuple(
            replace(pedestrian, track=places[token]) for token, pedestrian in builder.pedestrians
        )
        script = RolloutEvents(
            base=self.base.token,
            name=edit.name,
            digest=edit.digest,
            words=edit.words,
            tokens=tuple(token for token in builder.touched if token in places),
            behaviors=builder.behaviors,
            yielding=MANNERS.index(edit.agents) if edit.agents else OFF,
            pedestrians=pedestrians,
            termination=builder.termination,
            seed=self.seed,
        )
        return replace(
            builder.scenario,
            token=edited_id(self.base.token, edit),
            scenario_type=edit.type or self.base.scenario_type,
            tracks=builder.tracks,
            script=script,
        )

    def name(self, what: str) -> str:
        """A new token for a track."""
        self.count[what] = number = self.count.get(what, -1) + 1
        return f"{self.edit.name}.{what}{number}"

    def pose(self, place: object, what: str) -> FloatArray:
        """(3,) pose of a place."""
        at, pose = getattr(place, "at", None), getattr(place, "pose", None)
        found = self.path.pose(at) if isinstance(at, At) else np.array(pose, np.float64)
        require_on_map(self.base.map, found, what)
        return found

    def _remove(self) -> None:
        builder = self.builder
        for remove in self.edit.remove:
            chosen = builder.which(remove.kinds, remove.tokens)
            if remove.near:
                x, y, radius = remove.near
                poses = builder.tracks.poses[builder.now, chosen]
                chosen = chosen[np.hypot(poses[:, 0] - x, poses[:, 1] - y) <= radius]
            if remove.share < 1.0:
                count = round(remove.share * len(chosen))
                chosen = np.array(sorted(self.random.sample(chosen.tolist(), count)), np.int64)
            stays = np.ones(builder.tracks.num_tracks, np.bool_)
            stays[chosen] = False
            builder.keep(stays)

    def _change_motion(self) -> None:
        builder, edit = self.builder, self.edit
        if edit.move or edit.slow or edit.stop or edit.speed:
            builder.own()
        for move in edit.move:
            for track in builder.which((), move.tokens).tolist():
                _shift(builder, track, move.ahead_m, move.left_m)
        slows = list(edit.slow)
        if edit.speed and edit.speed.tracks != 1.0:
            if edit.speed.tracks > 1.0:
                raise ConfigError("speed: tracks is above 1", "a recording cannot be sped up")
            slows.append(Slow(edit.speed.tracks, kinds=("vehicle",)))
        seconds = builder.seconds
        for slow in slows:
            late = np.maximum(seconds - slow.from_s, 0.0)
            recorded = np.minimum(seconds, slow.from_s) + slow.factor * late
            _warp(builder, builder.which(slow.kinds, slow.tokens), seconds, recorded)
        for stop in edit.stop:
            for track in builder.which((), stop.tokens):
                row = min(int(np.searchsorted(seconds, stop.from_s)), len(seconds) - 1)
                speed = float(np.hypot(*np.nan_to_num(builder.tracks.velocities[row, track])))
                # the clock of the recording slows down evenly until it stands
                needed = max(speed / max(stop.decel_mps2, 0.1), 1e-3)
                late = np.clip(seconds - stop.from_s, 0.0, needed)
                recorded = np.minimum(seconds, stop.from_s) + late - 0.5 * late**2 / needed
                _warp(builder, np.array([track]), seconds, recorded)

    def _spawn(self, spawn: Spawn) -> None:
        builder, kind = self.builder, KIND_CODES[spawn.kind]
        name = self.name(spawn.kind)
        what = f"spawned {spawn.kind.replace('_', ' ')}"
        pose, size = self.pose(spawn, what), np.array(spawn.size_m or SIZES[spawn.kind])
        is_mover = kind == AgentKind.VEHICLE and spawn.behavior != "stopped"
        if not is_mover:
            builder.require_free(pose[None], size, what)
            builder.add_standing([name], kind, size, pose[None])
            return
        builder.add_vehicle(name, pose, size, spawn.speed_mps, _BEHAVIORS[spawn.behavior])

    def _block_lanes(self) -> None:
        for block in self.edit.block_lane:
            pose, size = self.pose(block, "closed lane"), np.array(SIZES[block.kind])
            spacing = max(block.spacing_m, 0.5)
            count = int(block.length_m / spacing) + 1
            left = [np.zeros(count)]
            ahead = [spacing * np.arange(count)]
            if block.taper_m > 0.0:  # a slanted row before, from the right border of the lane
                slanted = int(np.ceil(max(block.taper_m, block.width_m) / spacing))
                share = np.arange(slanted) / slanted
                left.insert(0, -block.width_m * 0.5 * (1.0 - share))
                ahead.insert(0, -block.taper_m * (1.0 - share))
            places: list[FloatArray] = []
            offsets = zip(
                np.concatenate(ahead).tolist(), np.concatenate(left).tolist(), strict=True
            )
            for distance, aside in offsets:
                if block.at:
                    at = replace(
                        block.at,
                        ahead_m=block.at.ahead_m + distance,
                        left_m=block.at.left_m + aside,
                    )
                    place = self.path.pose(at)
                else:
                    place = _ahead_of(pose, distance, aside)
                places.append(place)
            poses, what = np.array(places), block.kind.replace("_", " ")
            self.builder.require_free(poses, size, f"{what} of a closed lane")
            names = [self.name(block.kind) for _ in places]
            self.builder.add_standing(names, KIND_CODES[block.kind], size, poses)

    def _walk(self) -> None:
        builder, size = self.builder, np.array(SIZES["pedestrian"])
        for walk in self.edit.walk:
            start, end = (self.pose(place, "pedestrian") for place in (walk.start, walk.end))
            step = end[:2] - start[:2]
            length = float(np.hypot(*step))
            if length < 1e-3:
                raise ConfigError("a pedestrian walks from a place to the same place")
            start[2] = np.arctan2(step[1], step[0])
            builder.require_free(start[None], size, "pedestrian")
            name, speed = self.name("pedestrian"), max(walk.speed_mps, 1e-3)
            pedestrian = ScriptedPedestrian(
                -1, start, end[:2], size, speed, walk.ego_within_m, walk.visible
            )
            start_time = np.inf if walk.start_s is None else walk.start_s
            poses, velocities, valid = pedestrian.walk(builder.seconds, start_time)
            builder.add(name, AgentKind.PEDESTRIAN, size, poses, valid=valid, velocities=velocities)
            if walk.start_s is None:
                builder.pedestrians.append((name, pedestrian))


def _ahead_of(pose: FloatArray, ahead: float, left: float) -> FloatArray:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array(
        [pose[0] + ahead * cos - left * sin, pose[1] + ahead * sin + left * cos, pose[2]]
    )


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
    _, offset, ratio = scenario.mapping
    builder.change(iteration_rows=inside, mapping=(seconds, offset, ratio), is_short=False)


def _shift(builder: ScenarioBuilder, track: int, ahead: float, left: float) -> None:
    tracks, now = builder.tracks, builder.now
    if not tracks.valid[now, track]:
        raise ConfigError(
            f"track {tracks.tokens[track]!r} is not there at the start, so it cannot be moved"
        )
    pose = _ahead_of(tracks.poses[now, track], ahead, left)
    size = tracks.sizes[now, track].copy()
    by = pose[:2] - tracks.poses[now, track, :2]
    tracks.valid[now, track] = False  # it may be in its own way
    builder.require_free(pose[None], size, f"moved track {tracks.tokens[track]!r}")
    tracks.valid[now, track] = True
    tracks.poses[:, track, :2] += by
    builder.touched.append(tracks.tokens[track])


def _warp(
    builder: ScenarioBuilder, which: IntArray, seconds: FloatArray, recorded: FloatArray
) -> None:
    """Have tracks be at each time (R,) where they were at another one (R,), never a later one."""
    tracks = builder.tracks
    pace = np.gradient(recorded, seconds)
    low = np.clip(np.searchsorted(seconds, recorded, side="right") - 1, 0, len(seconds) - 2)
    span = seconds[low + 1] - seconds[low]
    share = np.clip((recorded - seconds[low]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
    late = recorded < seconds - 1e-9
    for track in which.tolist():
        valid, poses = tracks.valid[:, track].copy(), tracks.poses[:, track].copy()
        if not valid.any():
            continue
        poses[valid, 2] = np.unwrap(poses[valid, 2])
        velocities, sizes = tracks.velocities[:, track].copy(), tracks.sizes[:, track].copy()
        both = valid[low] & valid[low + 1]
        part = np.where(both, share, 0.0)[:, None]
        near = np.where(valid[low], low, low + 1)
        to = np.where(both, low + 1, near)
        moved = poses[near] + part * (poses[to] - poses[near])
        moved[:, 2] = (moved[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        tracks.valid[late, track] = valid[near][late]
        tracks.poses[late, track] = moved[late]
        tracks.velocities[late, track] = (velocities[near] * pace[:, None])[late]
        tracks.sizes[late, track] = sizes[near][late]
        builder.touched.append(tracks.tokens[track])


def _set_lights(builder: ScenarioBuilder, light: Light) -> None:
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
        status[during, columns[0]] = LIGHT_CODES[light.status]
        for column in columns[1:]:  # nuPlan rule 429: an id listed twice would show both
            status[during, column] = LightStatus.ABSENT
    builder.change(traffic_lights=TrafficLights(tuple(ids), status))
