"""What a replay shows: map clippings, tracks, lights and rollouts of one scenario, as arrays.

Positions are relative to a whole-metre origin near the scene, so that quantised values are small.

A page holds sections of them as text: base64 of a zlib stream of the length of the JSON header
(uint32, little endian), the header (a list of fields), and the fields' bytes one after the other. A
quantised field holds second differences along its first axis, one series after the other, as int32
with the sign in the lowest bit and in four byte planes, least significant first: smooth motion
leaves small numbers, and three planes nearly constant. A field with a base holds what is to be
added to the first rollout's, as most traffic is the same in all rollouts. `codec.js` reads it.
"""

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.kernels import FloatArray
from shiftsim.metrics import SHORT_NAMES
from shiftsim.metrics.result import Collision
from shiftsim.report.explain import losses
from shiftsim.report.palette import Style, planner_styles
from shiftsim.report.words import REASONS, violation_words, violations
from shiftsim.sim.log import SimulationLog
from shiftsim.world.layers import Layer
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AX, PACIFICA, AgentKind, Tracks, speeds

MISSING = -(2**31)  # stands for NaN
_LARGEST = 2**31 - 1
MARGIN = 100.0  # m of map around everything the ego does
_METRES, _RADIANS, _SPEED, _SECONDS = 0.01, 0.001, 0.01, 0.001
_COARSE = 0.05  # m, of plans beyond their first second
_FIRST_SECOND = 11  # poses of a plan up to 1 s ahead
_MAP_STEP = 0.05  # m
_TOLERANCE = 0.05  # m, of simplified map lines


@dataclass(frozen=True, slots=True)
class Quantised:
    """An array to be stored as multiples of a step."""

    values: FloatArray  # (T, …) the values; NaN is kept
    step: float  # resolution, in the unit of the values


Fields: TypeAlias = dict[str, Quantised | np.ndarray]


class Branch(NamedTuple):
    """What is driven from the fork of a rollout on."""

    name: str  # of the planner, or "braking"
    poses: FloatArray  # (K, 3) rear axle from the fork on
    hit: Collision | None  # the first collision at fault


class Fork(NamedTuple):
    """The last moment at which a collision could be avoided."""

    start: int  # its iteration; without branches how far back there is none
    branches: tuple[Branch, ...]


@dataclass(frozen=True)
class ShownRollout:
    """One rollout in a replay."""

    planner: str  # its planner
    noise: str  # name of the noise
    seed: int  # seed of the noise
    log: SimulationLog  # the rollout
    cls: float | None = None  # its score in [0, 1]; None where it was not scored
    metrics: Sequence[Mapping[str, Any]] = ()  # rows of `metrics.parquet`
    fork: Fork | None = None  # where it was searched for


@dataclass(frozen=True)
class Replay:
    """A scenario and the rollouts of it that are shown together."""

    scenario: Scenario
    shown: Sequence[ShownRollout]
    seeds: Sequence[ShownRollout] = ()  # all of the scenario, also those of other pages

    @property
    def paths(self) -> list[FloatArray]:
        """What the recorded driver and the rollouts drive, (N, 2) each [m]."""
        return [self.scenario.expert[:, :2], *(item.log.ego[:, :2] for item in self.shown)]

    @cached_property
    def box(self) -> FloatArray:
        """(4,) min x, min y, max x, max y of the map that is shown [m]."""
        return box_around(self.paths, MARGIN)

    @cached_property
    def origin(self) -> FloatArray:
        """(2,) whole metres that positions are relative to."""
        return np.rint((self.box[:2] + self.box[2:]) / 2.0)

    @cached_property
    def tubes(self) -> list[list[ShownRollout]]:
        """Rollouts that differ in their seed alone, where there are several."""
        groups: dict[tuple[str, str], list[ShownRollout]] = {}
        for item in self.seeds or self.shown:
            if item.noise != "none":
                groups.setdefault((item.planner, item.noise), []).append(item)
        return [members for members in groups.values() if len(members) > 1]

    @cached_property
    def own_tracks(self) -> bool:
        """Whether the traffic differs from the recording, as reactive traffic does."""
        recorded = self.scenario.tracks.rows(self.scenario.iteration_rows[:-1])
        return any(
            not np.array_equal(item.log.tracks.valid, recorded.valid)
            or not np.array_equal(item.log.tracks.poses, recorded.poses, equal_nan=True)
            for item in self.shown
        )


def scene_fields(replay: Replay) -> Fields:
    """Map, expert, lights and recorded tracks, unless rollouts have their own."""
    origin = replay.origin
    road, nothing = replay.scenario.map, np.zeros((0, 2))
    layers = map_lines(road, replay.scenario.route, replay.box)
    layers["lights"] = [
        road.baselines.at(road.edges.index[name]) if name in road.edges.index else nothing
        for name in replay.scenario.traffic_lights.connector_ids
    ]
    fields: Fields = {}
    for name, lines in layers.items():
        fields |= line_fields(name, lines, origin)
    log = replay.shown[0].log
    fields["time"] = Quantised((log.time_us - log.time_us[0]) * 1e-6, _SECONDS)
    fields |= _poses("expert", log.expert_ego[:, None, :3], origin)
    fields["expert.speed"] = Quantised(speeds(log.expert_ego), _SPEED)
    fields["lights.status"] = (log.traffic_lights.status + 1).astype(np.uint8)
    if not replay.own_tracks:
        fields |= _track_fields(log.tracks, origin)
    for number, members in enumerate(replay.tubes):
        fields |= _tube_fields(f"tube{number}", [item.log.ego[:, :2] - origin for item in members])
    return fields


def _tube_fields(name: str, paths: Sequence[FloatArray]) -> Fields:
    """The area between paths (T, 2), their distances `across`, and `along` as driven [m]."""
    count = min(map(len, paths))
    lines = [shapely.LineString(path[:count]) for path in paths]
    across, areas = np.zeros(count), []
    for one, other in permutations(lines, 2):
        points = shapely.points(shapely.get_coordinates(one))
        where = shapely.line_locate_point(other, points)
        far = shapely.distance(points, other)
        across = np.maximum(across, np.where(where < other.length, far, 0.0))
        common = substring(other, 0.0, where[-1]), substring(one, 0.0, one.length)
        corners = [shapely.get_coordinates(line) for line in common]
        if where[-1] < other.length:  # the other one goes on beyond its end
            areas.append(shapely.Polygon(np.concatenate([corners[0], corners[1][::-1]])))
    steps = [np.hypot(*np.diff(path[:count], axis=0, prepend=path[:1]).T) for path in paths]
    along = np.ptp(np.cumsum(steps, axis=1), axis=0)
    rings = _rings(areas, box_around(paths, 1.0))
    apart = {"across": across, "along": along}
    return line_fields(name, rings, np.zeros(2)) | {
        f"{name}.{key}": Quantised(values, _METRES) for key, values in apart.items()
    }


def rollout_fields(replay: Replay, index: int) -> Fields:
    """What belongs to one rollout."""
    origin, item = replay.origin, replay.shown[index]
    log, branches = item.log, item.fork.branches if item.fork else ()
    fields = _poses("ego", log.ego[:, None, :3], origin)
    fields["speed"] = Quantised(speeds(log.ego), _SPEED)
    fields["accel"] = Quantised(log.ego[:, AX].copy(), _SPEED)
    plans = log.plans[:, :, :2] - log.ego[:, None, :2]
    fields["plan"] = Quantised(plans[:, :_FIRST_SECOND], _METRES)
    fields["rest"] = Quantised(plans[:, _FIRST_SECOND - 1 :], _COARSE)
    fields["noise"] = Quantised(log.noise, _RADIANS)
    fields["degraded"] = log.degraded
    for number, branch in enumerate(branches):
        fields |= _poses(f"branch{number}", branch.poses[:, None], origin)
    if replay.own_tracks:
        fields |= _track_fields(log.tracks, origin)
    if log.seen is not None:
        fields |= _track_fields(log.seen.tracks, origin, "seen")
        fields |= _poses("believed", log.seen.ego[:, None], origin)
    return fields


def describe_scene(replay: Replay) -> dict[str, Any]:
    """Everything that is text or a single number, as JSON values."""
    scenario, shown, own = replay.scenario, replay.shown, replay.own_tracks
    script = scenario.script
    branched = [one.name for item in shown if item.fork for one in item.fork.branches[1:]]
    styles = planner_styles([*(item.planner for item in (*shown, *replay.seeds)), *branched])
    return {
        "token": scenario.token,
        "type": scenario.scenario_type,
        "city": scenario.city,
        "log": scenario.log_name,
        "edits": list(script.words) if script else [],
        "edited": list(script.tokens) if script else [],
        "metrics": {SHORT_NAMES[name]: words for name, words in REASONS.items()},
        "vehicle": [PACIFICA.length, PACIFICA.width, PACIFICA.rear_axle_to_center],
        "ownTracks": own,
        "tracks": None if own else _track_names(shown[0].log.tracks),
        "tubes": [_describe_tube(replay, members, styles) for members in replay.tubes],
        "rollouts": [
            {
                "planner": item.planner,
                "noise": item.noise,
                "seed": item.seed,
                "cls": item.cls,
                **styles[item.planner]._asdict(),
                "violations": describe_violations(item),
                "losses": _losses(item),
                "fork": _describe_fork(item, styles),
                "scores": {
                    SHORT_NAMES[row["metric"]]: row["score"]
                    for row in item.metrics
                    if row["metric"] in SHORT_NAMES and row["score"] is not None
                },
                "degraded": int(item.log.degraded.sum()),
                "seen": item.log.seen is not None,
                "tracks": _track_names(item.log.tracks) if own else None,
            }
            for item in shown
        ],
    }


def _describe_tube(
    replay: Replay, members: Sequence[ShownRollout], styles: Mapping[str, Style]
) -> dict[str, Any]:
    """Several seeds of a planner as JSON values; `dots` are where each violated something."""
    planner, noise = members[0].planner, members[0].noise
    dots = []
    for item in members:
        seconds = (item.log.time_us - item.log.time_us[0]) * 1e-6
        for one in describe_violations(item):
            row = int(np.searchsorted(seconds, one["t"] - 1e-6))
            x, y = (item.log.ego[min(row, len(seconds) - 1), :2] - replay.origin).tolist()
            words = f"{planner} {noise} #{item.seed} at {one['t']:.1f} s: {one['words']}"
            dots.append([round(x, 2), round(y, 2), words])
    return {"planner": planner, "noise": noise, "dots": dots, **styles[planner]._asdict()}


def line_fields(name: str, lines: Sequence[FloatArray], origin: FloatArray) -> Fields:
    """Vertices (K, 2) of lines or rings, one after the other, and how many each of them has."""
    xy = np.concatenate([np.zeros((0, 2)), *lines])
    count = np.array([len(line) for line in lines], float)
    return {f"{name}.xy": Quantised(xy - origin, _MAP_STEP), f"{name}.count": Quantised(count, 1.0)}


def _poses(name: str, poses: FloatArray, origin: FloatArray) -> Fields:
    """(T, N, 3) poses, none missing, as positions and continuous headings."""
    return {
        f"{name}.xy": Quantised(poses[:, :, :2] - origin, _METRES),
        f"{name}.heading": Quantised(np.unwrap(poses[:, :, 2], axis=0), _RADIANS),
    }


def _track_fields(tracks: Tracks, origin: FloatArray, name: str = "tracks") -> Fields:
    """Tracks that are there at some time; values of absent samples repeat the one before."""
    used = np.flatnonzero(tracks.valid.any(axis=0))
    valid = tracks.valid[:, used]
    first = valid.argmax(axis=0)
    rows = np.maximum.accumulate(np.where(valid, np.arange(len(valid))[:, None], 0), axis=0)
    rows = np.maximum(rows, first)  # before its first sample: that one
    return {
        f"{name}.valid": valid,
        f"{name}.kind": tracks.kinds[used].astype(np.uint8),
        f"{name}.size": Quantised(tracks.sizes[first, used], _METRES),
        **_poses(name, tracks.poses[rows, used], origin),
    }


def _track_names(tracks: Tracks) -> list[str]:
    """Tokens of the tracks of `_track_fields`."""
    return [tracks.tokens[i] for i in np.flatnonzero(tracks.valid.any(axis=0))]


def describe_violations(item: ShownRollout) -> list[dict[str, Any]]:
    """First violations of scored metrics as JSON values, by time; `words` say what happened."""
    return [
        {
            "metric": one.row["metric"],
            "short": one.short,
            "t": one.time,
            "threshold": one.row["threshold"] if np.isfinite(one.row["threshold"] or 0.0) else None,
            "partner": one.row["partner_token"],
            "words": violation_words(one.row, item.log.tracks),
        }
        for one in violations(item.metrics)
        if one.time is not None
    ]


def _losses(item: ShownRollout) -> list[dict[str, Any]]:
    """What takes points from a score of 100, in order of time, as JSON values; see `losses`."""
    if item.cls is None:
        return []
    out = []
    for row, points in losses(item.metrics):
        name, time = row["metric"], row["first_violation_s"]
        reason = REASONS.get(name, name.replace("_", " "))
        words = violation_words(row, item.log.tracks)
        words += f", {100.0 * row['score']:.0f} of 100" if time is None else ""
        out.append({"metric": name, "t": time, "points": points, "reason": reason, "words": words})
    return out


def _describe_fork(item: ShownRollout, styles: Mapping[str, Style]) -> dict[str, Any] | None:
    """A fork as JSON values, times in s from the start."""
    if item.fork is None:
        return None
    seconds = (item.log.time_us - item.log.time_us[0]) * 1e-6
    branches = []
    for one in item.fork.branches:
        words, hit = "nothing hit", None
        if one.hit is not None:
            hit = float(seconds[one.hit.iteration])
            kind = AgentKind(one.hit.kind).name.lower().replace("_", " ")
            words = f"hits {kind} {one.hit.token} at {hit:.1f} s, Δv {one.hit.delta_v:.1f} m/s"
        style = styles[one.name]._asdict() if one.name in styles else {"colour": "", "marker": ""}
        branches.append({"name": one.name, "hit": hit, "words": words, **style})
    start = item.fork.start
    return {"t": float(seconds[start]), "row": start, "branches": branches}


def map_lines(
    road: VectorMap, route: Sequence[str], box: FloatArray
) -> dict[str, list[FloatArray]]:
    """Rings (for even-odd filling) and lines of the map inside the box, by layer."""
    areas = {
        "drivable": road.drivable_areas,
        "walkway": road.walkways,
        "crosswalk": road.crosswalks,
        "stop": road.stop_polygons,
        "route": road.blocks,
    }
    out = {}
    for name, layer in areas.items():
        near = indices_near(layer, box)
        shown = [index for index in near if name != "route" or layer.ids[index] in route]
        out[name] = _rings([layer.shape(index) for index in shown], box)
    edges = indices_near(road.edges, box)
    sides = [lines.at(e) for e in edges for lines in (road.left_boundaries, road.right_boundaries)]
    out["boundary"] = _lines(sides, box)
    out["centre"] = _lines([road.baselines.at(e) for e in edges], box)
    return out


def box_around(paths: Sequence[FloatArray], margin: float = 0.0) -> FloatArray:
    """(4,) min x, min y, max x, max y of a box around paths (N, 2) [m]."""
    points = np.concatenate(paths)
    return np.concatenate([points.min(axis=0) - margin, points.max(axis=0) + margin])


def indices_near(layer: Layer, box: FloatArray) -> list[int]:
    """Objects of a layer whose bounds share a point with a box (min x, min y, max x, max y) [m]."""
    bounds = layer.polygons.bounds
    near = (bounds[:, :2] <= box[2:]).all(axis=1) & (bounds[:, 2:] >= box[:2]).all(axis=1)
    return np.flatnonzero(near).tolist()


def _rings(polygons: list[shapely.Polygon], box: FloatArray) -> list[FloatArray]:
    """Outlines of the union, so that overlapping polygons do not show their seams."""
    clipped = shapely.clip_by_rect(np.array(polygons, object), *box)
    union = shapely.union_all(shapely.make_valid(clipped), grid_size=_MAP_STEP)
    parts = shapely.get_parts(shapely.simplify(union, _TOLERANCE))
    return [
        shapely.get_coordinates(ring)
        for part in parts
        if part.geom_type == "Polygon"
        for ring in (part.exterior, *part.interiors)
    ]


def _lines(lines: list[FloatArray], box: FloatArray) -> list[FloatArray]:
    """Lines inside the box, each once: neighbouring lanes share a boundary."""
    strings = [shapely.LineString(line) for line in lines if len(line) > 1]
    clipped = shapely.clip_by_rect(np.array(strings, object), *box)
    parts = shapely.get_parts(shapely.simplify(clipped, _TOLERANCE))
    found = {part.normalize().wkb: part for part in parts if part.geom_type == "LineString"}
    return [coords for part in found.values() if len(coords := shapely.get_coordinates(part)) > 1]


def pack(fields: Fields, base: Fields | None = None) -> str:
    """One section: quantised arrays, or what they differ by from `base`, and byte arrays."""
    header, chunks = [], []
    for name, value in fields.items():
        about = {"name": name, "step": 0.0}
        if isinstance(value, Quantised):
            steps, other = _steps(value), (base or {}).get(name)
            ways = [_planes(steps)]
            if isinstance(other, Quantised) and other.values.shape == steps.shape:
                ways.append(_planes(steps - _steps(other)))
            chunk = min(ways, key=lambda planes: len(zlib.compress(planes)))
            about |= {"step": value.step, "base": chunk is not ways[0]}
        else:
            steps = np.ascontiguousarray(value, np.uint8)
            chunk = steps.tobytes()
        chunks.append(chunk)
        header.append(about | {"shape": list(steps.shape)})
    text = json.dumps(header, separators=(",", ":")).encode()
    body = len(text).to_bytes(4, "little") + text + b"".join(chunks)
    return base64.b64encode(zlib.compress(body, 9)).decode("ascii")


def _steps(field: Quantised) -> np.ndarray:
    missing = np.isnan(field.values)
    scaled = np.rint(np.where(missing, 0.0, field.values) / field.step)
    steps = np.clip(scaled, -_LARGEST, _LARGEST).astype(np.int64)
    steps[missing] = MISSING
    return steps


def _planes(steps: np.ndarray) -> bytes:
    steps = steps.copy()
    steps[1:] -= steps[:-1].copy()
    steps[2:] -= steps[1:-1].copy()
    wrapped = np.moveaxis(steps, 0, -1).astype(np.int32)
    signed = ((wrapped << 1) ^ (wrapped >> 31)).astype("<i4")
    return signed.reshape(-1, 1).view(np.uint8).T.tobytes()
