"""Scenario -> one nuPlan log (.db) of its own."""

import hashlib
import pickle
import re
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import TypeAlias

import numpy as np

from shiftsim.data.nuplan.log import LIDAR_CHANNEL, yaw_of
from shiftsim.data.nuplan.scenarios import Mapping, ends_early, iteration_rows
from shiftsim.data.nuplan.sqlite import Value, write_database
from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, LightStatus

Rows: TypeAlias = list[tuple[Value, ...]]

UNKNOWN_TYPE = "unknown"
_TOKEN = re.compile(r"[0-9a-f]{16}\Z")
# Heights are not kept in a store and are not used in the plane; typical ones are written.
HEIGHTS = {
    AgentKind.VEHICLE: 1.6,
    AgentKind.PEDESTRIAN: 1.75,
    AgentKind.BICYCLE: 1.7,
    AgentKind.TRAFFIC_CONE: 0.7,
    AgentKind.BARRIER: 1.0,
    AgentKind.CZONE_SIGN: 1.2,
    AgentKind.GENERIC_OBJECT: 1.0,
}  # m
_SCENES = 5  # nuPlan rule 411: the first two and the last two are ignored
_PICKLE = 2  # protocol

# tables with their columns: `!` is a token that must be there, the letters are of `_TYPES`
_COLUMNS = {
    "log": "token! vehicle_name:64 date:64 timestamp:i logfile:64 location:64 map_version:64",
    "lidar": "token! log_token! channel:64 model:64 translation:b rotation:b",
    "camera": "token! log_token! channel:64 model:64 translation:b rotation:b intrinsic:b"
    " distortion:b width:i height:i",
    "image": "token! next_token:b prev_token:b ego_pose_token! camera_token! filename_jpg:128"
    " timestamp:i",
    "ego_pose": "token! timestamp:i x y z qw qx qy qz vx vy vz acceleration_x acceleration_y"
    " acceleration_z angular_rate_x angular_rate_y angular_rate_z epsg:i log_token!",
    "scene": "token! log_token! name:t goal_ego_pose_token:b roadblock_ids:t",
    "lidar_pc": "token! next_token:b prev_token:b ego_pose_token! lidar_token! scene_token!"
    " filename:128 timestamp:i",
    "category": "token! name:64 description:t",
    "track": "token! category_token! width length height",
    "lidar_box": "token! lidar_pc_token! track_token! next_token:b prev_token:b x y z width length"
    " height vx vy vz yaw confidence",
    "scenario_tag": "token! lidar_pc_token! type:t agent_track_token:b",
    "traffic_light_status": "token! lidar_pc_token! lane_connector_id:i status:8",
}
_TYPES = {"": "FLOAT", "i": "INTEGER", "t": "TEXT", "b": "BLOB"}


def _definition(columns: str) -> str:
    """The columns of a table in SQL."""
    out = []
    for text in columns.split():
        name, _, kind = text.partition(":")
        sql = f"VARCHAR({kind})" if kind.isdigit() else _TYPES[kind]
        out.append(f"{name[:-1]} BLOB NOT NULL" if name.endswith("!") else f"{name} {sql}")
    return ", ".join([*out, "PRIMARY KEY (token)"])


_INDEXES = tuple(
    f"CREATE INDEX {table}_{column}_idx ON {table} ({column})"
    for table, column in [("lidar_pc", "timestamp")]
    + [(t, "lidar_pc_token") for t in ("lidar_box", "scenario_tag", "traffic_light_status")]
)


def cut_of(scenario: Scenario) -> tuple[int, Mapping]:
    """Row that carries token and tag, and the mapping that cuts the scenario out again from it.

    The mapping is the scenario's own, unless that does not give its iterations, or would not if
    the recording went on. Raises ConversionError: the iterations are not evenly spaced rows.
    """
    time, rows = scenario.time_us, scenario.iteration_rows
    span = int(time[rows[-1]] - time[rows[0]]) / 1e6
    for mapping in (scenario.mapping, (span, 0.0, 1.0 / scenario.row_step)):
        end = int(time[rows[0]]) + int(mapping[0] * 1e6)
        if mapping == scenario.mapping and ends_early(time, end) and not scenario.is_short:
            continue
        starts = time + int(mapping[1] * 1e6)
        fitting = np.flatnonzero(np.searchsorted(time, starts) == rows[0])
        for anchor in fitting[::-1].tolist():  # several where the log starts too late
            if np.array_equal(iteration_rows(time, int(time[anchor]), mapping), rows):
                return anchor, mapping
    raise ConversionError(
        f"scenario {scenario.token!r}: its iterations are not every n-th row of its recording",
        hint="nuPlan cuts a scenario by duration, offset and ratio; convert it so",
    )


def log_token(text: str) -> bytes:
    """A token of 8 bytes; one of 16 hexadecimal digits stays as it is."""
    if _TOKEN.match(text):
        return bytes.fromhex(text)
    return hashlib.blake2b(text.encode(), digest_size=8).digest()


def connector_number(scenario: Scenario, name: str) -> int:
    """The id of a lane connector that a light names; a ConversionError where it is no integer."""
    try:
        return int(name)
    except ValueError as error:
        what = f"scenario {scenario.token!r}: a traffic light names connector {name!r}"
        raise ConversionError(what, "nuPlan's format has integer ids") from error


def write_nuplan_log(path: Path, scenario: Scenario, *, epsg: int) -> Mapping:
    """Write one scenario as a log: five scenes, of which the middle one holds all rows.

    The file's name is the log's. Returns the mapping that cuts the scenario out again. Raises
    ConversionError: a light belongs to a connector without an integer id, or the iterations are not
    evenly spaced rows.
    """
    log = _Log(path.stem, scenario, epsg)
    place = (pickle.dumps(values, _PICKLE) for values in ([0.0] * 3, [1.0, 0.0, 0.0, 0.0]))
    rows: dict[str, Rows] = {
        "log": log.header(),
        "lidar": [(log.lidar, log.token, LIDAR_CHANNEL, "none", *place)],
        "ego_pose": log.ego_poses(),
        "scene": log.scene_rows(),
        "lidar_pc": log.lidar_pcs(),
        "category": [(t, k.name.lower(), k.name.lower()) for k, t in log.categories.items()],
    }
    rows["track"], rows["lidar_box"] = log.boxes()
    if scenario.scenario_type != UNKNOWN_TYPE:
        anchor = log_token(scenario.token)
        rows["scenario_tag"] = [(log.make("tag"), anchor, scenario.scenario_type, None)]
    rows["traffic_light_status"] = log.lights()
    tables = {name: _definition(columns) for name, columns in _COLUMNS.items()}
    write_database(path, tables, rows, _INDEXES)
    return log.mapping


class _Log:
    """The rows of one log. Tokens are digests of what they name."""

    def __init__(self, name: str, scenario: Scenario, epsg: int) -> None:
        self.name, self.scenario, self.epsg = name, scenario, epsg
        self.token, self.lidar = self.make("log"), self.make("lidar")
        count = len(scenario.time_us)
        self.samples = [self.make(f"lidar_pc {row}") for row in range(count)]
        anchor, self.mapping = cut_of(scenario)
        self.samples[anchor] = log_token(scenario.token)
        self.poses = [self.make(f"ego_pose {row}") for row in range(count)]
        self.scenes = [self.make(f"scene {number}") for number in range(_SCENES)]
        self.categories = {kind: self.make(kind.name) for kind in AgentKind}

    def make(self, what: str) -> bytes:
        return hashlib.blake2b(f"{self.name}|{what}".encode(), digest_size=8).digest()

    def header(self) -> Rows:
        start = int(self.scenario.time_us[0])
        date = datetime.fromtimestamp(start * 1e-6, UTC).date().isoformat()
        city = self.scenario.city
        return [(self.token, "shiftsim", date, start, self.name, city, city)]

    def ego_poses(self) -> Rows:
        scenario, zero = self.scenario, 0.0
        columns = np.column_stack([scenario.ego, quaternions_of(scenario.ego[:, 2])]).tolist()
        out: Rows = []
        for token, time, row in zip(self.poses, scenario.time_us.tolist(), columns, strict=True):
            x, y, _, vx, vy, ax, ay, *_ = row
            quaternion = row[-4:]
            motion = (vx, vy, zero, ax, ay, zero, zero, zero, zero)
            out.append((token, time, x, y, zero, *quaternion, *motion, self.epsg, self.token))
        goal = scenario.mission_goal
        if goal is not None:
            (x, y, _), (quaternion,) = goal.tolist(), quaternions_of(goal[2:]).tolist()
            after = int(scenario.time_us[-1]) + 1
            still = (zero,) * 9
            token = self.make("goal")
            out.append((token, after, x, y, zero, *quaternion, *still, self.epsg, self.token))
        return out

    def scene_rows(self) -> Rows:
        goal = None if self.scenario.mission_goal is None else self.make("goal")
        route = " ".join(self.scenario.route)
        return [
            (token, self.token, f"scene-{number:03d}", goal, route)
            for number, token in enumerate(self.scenes)
        ]

    def lidar_pcs(self) -> Rows:
        after, before = [*self.samples[1:], None], [None, *self.samples[:-1]]
        scene = self.scenes[_SCENES // 2]
        times = self.scenario.time_us.tolist()
        return [
            (token, after[i], before[i], self.poses[i], self.lidar, scene, f"{i:06d}.pcd", times[i])
            for i, token in enumerate(self.samples)
        ]

    def boxes(self) -> tuple[Rows, Rows]:
        tracks = self.scenario.tracks
        row, track = np.nonzero(tracks.valid)  # each row lists the tracks in our order
        names = self._track_tokens()
        heights = [HEIGHTS[AgentKind(kind)] for kind in tracks.kinds.tolist()]
        after, before = _neighbours(row, track)
        prefix = self.make("lidar_box")[:4]
        own: list[bytes | None] = [prefix + i.to_bytes(4, "big") for i in range(len(row))]
        own.append(None)  # number -1: no neighbour
        velocities = np.nan_to_num(tracks.velocities[row, track])
        boxes = [tracks.poses[row, track], tracks.sizes[row, track], velocities]
        values = np.column_stack(boxes).tolist()
        lines: Rows = []
        for i, (at, who) in enumerate(zip(row.tolist(), track.tolist(), strict=True)):
            x, y, heading, length, width, vx, vy = values[i]
            height = heights[who]
            links = (own[i], self.samples[at], names[who], own[after[i]], own[before[i]])
            sizes = (width, length, height)
            lines.append((*links, x, y, height / 2.0, *sizes, vx, vy, 0.0, heading, 1.0))
        first = np.argmax(tracks.valid, axis=0) if len(names) else np.zeros(0, np.int64)
        listed: Rows = []
        for who, name in enumerate(names):
            length, width = tracks.sizes[first[who], who].tolist()
            kind = self.categories[AgentKind(tracks.kinds[who])]
            listed.append((name, kind, width, length, heights[who]))
        return listed, lines

    def _track_tokens(self) -> list[bytes]:
        """A number becomes the token of that value, so that it can be read."""
        names = self.scenario.tracks.tokens
        out = [
            int(name).to_bytes(8, "big") if name.isdecimal() and len(name) < 16 else log_token(name)
            for name in names
        ]
        return out if len(set(out)) == len(out) else [self.make(f"track {name}") for name in names]

    def lights(self) -> Rows:
        lights = self.scenario.traffic_lights
        row, connector = np.nonzero(lights.status != LightStatus.ABSENT)
        codes = lights.status[row, connector].tolist()
        names = [connector_number(self.scenario, name) for name in lights.connector_ids]
        out: Rows = []
        for at, which, code in zip(row.tolist(), connector.tolist(), codes, strict=True):
            token, status = self.make(f"light {at} {which}"), LightStatus(code).name.lower()
            out.append((token, self.samples[at], names[which], status))
        return out


def quaternions_of(headings: FloatArray) -> FloatArray:
    """(K, 4) w, x, y, z from which nuPlan reads the headings (K,) back to the bit [rad].

    Of the nearest floats of w and z, and of no tilt and one of 2e-8 rad, which adds the last bit.
    """
    exact = np.column_stack(
        [np.cos(headings / 2), *np.zeros((2, len(headings))), np.sin(headings / 2)]
    )
    out = exact.copy()
    for tilt, towards_w, towards_z in product((0.0, 1e-8), (0, 1, -1), (0, 1, -1)):
        missing = yaw_of(out) != headings
        if not missing.any():
            break
        near = exact[missing]
        for column, towards in ((0, towards_w), (3, towards_z)):
            if towards:
                near[:, column] = np.nextafter(near[:, column], towards * np.inf)
        near[:, 2] = tilt
        found = yaw_of(near) == headings[missing]
        out[np.flatnonzero(missing)[found]] = near[found]
    return out


def _neighbours(row: IntArray, track: IntArray) -> tuple[list[int], list[int]]:
    """Number of the next and of the previous box of the same track, -1 where there is none."""
    order = np.lexsort((row, track))
    same = track[order[1:]] == track[order[:-1]]
    after, before = (np.full(len(row), -1, np.int64) for _ in range(2))
    after[order[:-1][same]] = order[1:][same]
    before[order[1:][same]] = order[:-1][same]
    return after.tolist(), before.tolist()
