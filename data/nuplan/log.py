"""One nuPlan log (.db): its clock, scenes and tags, and the rows of a span of time.

Objects are read box by box as the log has them, and as dense tracks. Columns with pickled content
are never read.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.nuplan.sqlite import Database, open_database
from shiftsim.data.recording import sort_tracks
from shiftsim.errors import ConversionError, DataError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world import state
from shiftsim.world.ranges import NUPLAN_LOG, STORE, require
from shiftsim.world.state import AgentKind, LightStatus, Tracks, TrafficLights, tracks_of_boxes

LIDAR_CHANNEL = "MergedPointCloud"
_REPAIR = "the log is damaged or not a nuPlan log; get it again from its source"
_TABLES = {
    "log": "map_version",
    "lidar": "token channel",
    "lidar_pc": "token next_token ego_pose_token lidar_token scene_token timestamp",
    "ego_pose": "token x y qw qx qy qz vx vy acceleration_x acceleration_y",
    "scene": "token name goal_ego_pose_token roadblock_ids",
    "category": "token name",
    "track": "token category_token",
    "lidar_box": "lidar_pc_token track_token x y yaw vx vy length width height",
    "scenario_tag": "lidar_pc_token type",
    "traffic_light_status": "lidar_pc_token lane_connector_id status",
}
_EGO_COLUMNS = {
    **{"x": "x_m", "y": "y_m", "heading": "heading_rad", "vx": "vx_mps", "vy": "vy_mps"},
    **{"acceleration_x": "ax_mps2", "acceleration_y": "ay_mps2"},
}
_LIGHTS = {status.name.lower(): status for status in LightStatus if status >= 0}
UNTAGGED = "unknown"
_UNIT_TOLERANCE = 1e-14  # nuPlan rule 414: quaternions this near to length 1 stay as they are
_IGNORED_SCENES = 2  # nuPlan rule 411: at either end of a log
_COLUMNS = ("x", "y", "heading", "vx", "vy", "length", "width")
_KINDS = {kind.name.lower(): int(kind) for kind in AgentKind}


def _damaged(path: Path, what: str, kind: type[DataError] = DataError) -> DataError:
    return kind(f"{path}: {what}", _REPAIR)


@dataclass
class Log:
    """An open log. R rows, ordered by time."""

    database: Database  # the file
    name: str  # log name, the file name without its ending
    map_name: str  # map it was recorded on
    tokens: list[str]  # R tokens of the lidar rows, 16 hexadecimal digits
    time_us: IntArray  # (R,) time stamps, not decreasing [us]
    rowids: IntArray  # (R,) where the rows stand in the table
    types: list[str]  # R scenario types, `unknown` without a tag
    scenes: list[bytes]  # R tokens of the scenes
    is_offered: BoolArray  # (R,) whether nuPlan offers the row as a scenario
    row_of: dict[str, int] = field(init=False)  # row by token
    # the first track that was found with something odd, by what it is: warnings of several parts of
    # a log name the same one
    examples: dict[str, str] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.row_of = {token: row for row, token in enumerate(self.tokens)}

    @property
    def path(self) -> Path:
        """The file."""
        return self.database.path


@contextmanager
def open_log(path: Path) -> Iterator[Log]:
    """Open a log and read its clock; a DataError where it is broken or lacks something."""
    with open_database(Path(path)) as database:
        for table, columns in _TABLES.items():
            database.require(table, columns.split())
        yield _read_clock(database)


def _read_clock(database: Database) -> Log:
    path = database.path
    maps = database.query("SELECT map_version FROM log", "table 'log'")
    if not maps or not isinstance(maps[0][0], str):
        raise _damaged(path, "table 'log' names no map in map_version")
    lidars = database.query("SELECT token FROM lidar WHERE channel = ?", "lidar", [LIDAR_CHANNEL])
    if not lidars:
        what = f"{path}: table 'lidar' has no channel {LIDAR_CHANNEL!r}"
        raise DataError(what, "the log was exported without its lidar rows; export it again")
    rows = database.query(
        "SELECT pc.token, pc.timestamp, pc.scene_token, pc.next_token, pc.rowid"
        " FROM lidar_pc AS pc JOIN lidar AS l ON pc.lidar_token = l.token"
        " WHERE l.channel = ? ORDER BY pc.timestamp, pc.rowid",
        "table 'lidar_pc'",
        [LIDAR_CHANNEL],
    )
    if not rows:
        raise _damaged(path, f"table 'lidar_pc' has no row of {LIDAR_CHANNEL!r}")
    tokens = [token_text(row[0], path, "lidar_pc") for row in rows]
    time_us = _check_clock(path, tokens, rows)
    ordered = database.query("SELECT token FROM scene ORDER BY name", "table 'scene'")
    offered = {row[0] for row in ordered[_IGNORED_SCENES : max(len(ordered) - _IGNORED_SCENES, 0)]}
    return Log(
        database=database,
        name=path.stem,
        map_name=maps[0][0].removesuffix(".gpkg"),  # nuPlan rule 419
        tokens=tokens,
        time_us=time_us,
        rowids=np.array([row[4] for row in rows], np.int64),
        types=[text or UNTAGGED for text in _read_tags(database, [row[0] for row in rows])],
        scenes=[row[2] for row in rows],
        is_offered=np.array([row[2] in offered for row in rows], np.bool_),
    )


def read_types(log: Log, wanted: frozenset[str]) -> list[str]:
    """R scenario types, as in `Log.types`, of the tags that are wanted; empty without one."""
    return _read_tags(log.database, [bytes.fromhex(token) for token in log.tokens], wanted)


def _read_tags(
    database: Database, tokens: list[bytes], wanted: frozenset[str] | None = None
) -> list[str]:
    tags: dict[bytes, str] = {}
    listed = database.query("SELECT lidar_pc_token, type FROM scenario_tag", "'scenario_tag'")
    for token, text in listed:  # nuPlan rule 418: the largest of several tags, of those asked for
        if text is not None and (wanted is None or text in wanted):
            tags[token] = max(tags.get(token, ""), str(text))
    return [tags.get(token, "") for token in tokens]


def _check_clock(path: Path, tokens: list[str], rows: Sequence[tuple[Any, ...]]) -> IntArray:
    try:
        time_us = np.array([row[1] for row in rows], np.int64)
    except (TypeError, ValueError, OverflowError) as error:
        raise _damaged(path, f"lidar_pc.timestamp is not an integer: {error}") from error
    require(STORE, "time_us", time_us, f"{path}: lidar_pc")
    row_of = {row[0]: index for index, row in enumerate(rows)}
    for index, row in enumerate(rows):
        if time_us[row_of.get(row[3], index)] < time_us[index]:
            what = f"lidar_pc {tokens[index]!r}: its next row has an earlier time stamp"
            raise _damaged(path, what)
    return time_us


def token_text(value: object, path: Path, table: str) -> str:
    """A token of the file as 16 hexadecimal digits."""
    if not isinstance(value, bytes):
        raise _damaged(path, f"table {table!r}: token {value!r} is not a blob")
    return value.hex()


def as_numbers(path: Path, what: str, rows: Sequence[Sequence[object]]) -> FloatArray:
    """Rows of a query as floats."""
    try:
        return np.array(rows, np.float64)
    except (TypeError, ValueError) as error:
        raise _damaged(path, f"{what} holds something that is no number: {error}") from error


def note_implausible(
    table: str, columns: Iterable[str], values: FloatArray, flaws: Counter[str]
) -> None:
    """Count what is implausible in rows (K, C) of a table with these columns, as nuPlan runs it."""
    for index, name in enumerate(columns):
        allowed = NUPLAN_LOG[f"{table} {name}"]
        beyond = int((~allowed.holds(values[:, index])).sum())
        flaws[f"{table}: {name} beyond {allowed}"] += beyond


def has_goals(log: Log) -> BoolArray:
    """(R,) whether the scene of each row has a goal that is a known ego pose."""
    rows = log.database.query(
        "SELECT s.token FROM scene AS s JOIN ego_pose AS e ON s.goal_ego_pose_token = e.token",
        "table 'scene'",
    )
    known = {row[0] for row in rows}
    return np.array([scene in known for scene in log.scenes], np.bool_)


def read_route(log: Log, row: int) -> tuple[tuple[str, ...], FloatArray | None]:
    """Route roadblock ids and mission goal (3,) of the scene of a row."""
    found = log.database.query(
        "SELECT s.roadblock_ids, e.x, e.y, e.qw, e.qx, e.qy, e.qz FROM scene AS s"
        " LEFT JOIN ego_pose AS e ON s.goal_ego_pose_token = e.token WHERE s.token = ?",
        "table 'scene'",
        [log.scenes[row]],
    )
    if not found:
        what = f"lidar_pc {log.tokens[row]!r} belongs to an unknown scene"
        raise _damaged(log.path, what, ConversionError)
    text, *goal = found[0]
    # nuPlan rule 412: split at blanks
    route = tuple(part for part in str(text or "").split(" ") if part)
    if goal[0] is None:
        return route, None
    pose = as_numbers(log.path, "ego_pose of a goal", [goal])
    if not np.isfinite(pose).all():
        what = f"the goal of {log.tokens[row]!r} is not finite"
        raise _damaged(log.path, what, ConversionError)
    return route, np.array([pose[0, 0], pose[0, 1], yaw_of(pose[:, 2:])[0]])


def yaw_of(quaternions: FloatArray) -> FloatArray:
    """Heading of quaternions (K, 4) w, x, y, z [rad]."""
    square = (quaternions * quaternions).sum(axis=1, keepdims=True)
    unit = np.abs(1.0 - square) < _UNIT_TOLERANCE
    w, x, y, z = np.where(unit, quaternions, quaternions / np.sqrt(square)).T
    # nuPlan rule 413: w z - x y, not w z + x y
    return np.arctan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y * y + z * z))


def read_ego(log: Log, first: int, last: int, flaws: Counter[str] | None = None) -> FloatArray:
    """Ego states (R, 11) of the rows first … last - 1.

    nuPlan rule 415: steering, yaw rate and their rates are 0.
    """
    place, rows = read_rows(
        log,
        first,
        last,
        columns="e.x, e.y, e.qw, e.qx, e.qy, e.qz, e.vx, e.vy, e.acceleration_x, e.acceleration_y",
        joins="JOIN ego_pose AS e ON pc.ego_pose_token = e.token",
    )
    if not np.array_equal(place, np.arange(first, last)):
        between = f"between {log.tokens[first]!r} and {log.tokens[last - 1]!r}"
        what = f"{between} a row of 'lidar_pc' names an unknown ego_pose"
        raise _damaged(log.path, what, ConversionError)
    values = as_numbers(log.path, "ego_pose", rows)
    with np.errstate(invalid="ignore"):
        heading = yaw_of(values[:, 2:6])
    states = np.zeros((len(values), state.NUM_STATE))
    states[:, :2], states[:, 2], states[:, 3:7] = values[:, :2], heading, values[:, 6:10]
    bad = np.flatnonzero(~np.isfinite(states).all(axis=1))
    if len(bad):
        what = f"{log.path}: ego_pose of lidar_pc {log.tokens[first + int(bad[0])]!r} is not finite"
        raise ConversionError(what, "leave this scenario out or repair the log")
    counts = Counter[str]() if flaws is None else flaws
    note_implausible("ego_pose", _EGO_COLUMNS, states[:, :7], counts)
    for name, values in zip(_EGO_COLUMNS, states.T, strict=False):
        where = f"{log.path}: ego_pose {name!r} as"
        require(STORE, _EGO_COLUMNS[name], values, where, error=ConversionError)
    return states


def read_rows(
    log: Log, first: int, last: int, *, columns: str, joins: str, order: str = ""
) -> tuple[IntArray, list[tuple[Any, ...]]]:
    """Row of the log and columns of what belongs to the rows first … last - 1, ordered by row.

    `joins` are tables besides `lidar_pc` (`pc`) and `lidar` (`l`), and errors name the first one;
    the column `order` orders what belongs to one row.
    """
    sql = (
        f"SELECT {columns}, pc.rowid FROM lidar_pc AS pc"
        f" JOIN lidar AS l ON pc.lidar_token = l.token {joins}"
        " WHERE l.channel = ? AND pc.timestamp BETWEEN ? AND ?"
        f" ORDER BY pc.timestamp, pc.rowid{order and ', '}{order}"
    )
    ends = int(log.time_us[first]), int(log.time_us[last - 1])
    found = log.database.query(sql, f"table {joins.split()[1]!r}", [LIDAR_CHANNEL, *ends])
    # nuPlan rule 431: time stamps may repeat, so rows are told apart by their place in the table
    by_place = np.argsort(log.rowids)
    rowids = np.array([row[-1] for row in found], np.int64)
    place = by_place[np.searchsorted(log.rowids, rowids, sorter=by_place)]
    inside = (place >= first) & (place < last)
    values = [row[:-1] for row, good in zip(found, inside.tolist(), strict=True) if good]
    return place[inside], values


def read_lights(log: Log, first: int, last: int, flaws: Counter[str]) -> TrafficLights:
    """Traffic lights of the rows first … last - 1."""
    row, listed = read_rows(
        log,
        first,
        last,
        columns="s.lane_connector_id, s.status",
        joins="JOIN traffic_light_status AS s ON s.lidar_pc_token = pc.token",
        order="s.rowid",
    )
    frame = row - first
    # nuPlan rule 429: a connector keeps all the states that a frame lists, the n-th in column n
    index: dict[tuple[str, int], int] = {}
    times: Counter[tuple[int, str]] = Counter()
    column = np.empty(len(listed), np.int64)
    for place, (at, (connector, _)) in enumerate(zip(frame.tolist(), listed, strict=True)):
        name = str(connector)
        column[place] = index.setdefault((name, times[at, name]), len(index))
        times[at, name] += 1
    status = np.full((last - first, len(index)), int(LightStatus.ABSENT), np.int8)
    # nuPlan rule 428
    status[frame, column] = [int(_LIGHTS.get(text, LightStatus.UNKNOWN)) for _, text in listed]
    flaws["traffic light listed several times in a frame"] += len(listed) - len(times)
    return TrafficLights(tuple(name for name, _ in index), status)


@dataclass(frozen=True)
class Boxes:
    """Objects of a span of rows, box by box, each frame in the order nuPlan lists it. B boxes."""

    row: IntArray  # (B,) row of the log
    token: list[str]  # B track tokens
    kind: IntArray  # (B,) AgentKind codes
    # (B, 8) centre x, y [m], heading [rad], velocity x, y in the map frame [m/s], length, width,
    # height [m]
    values: FloatArray


def read_boxes(log: Log, first: int, last: int, flaws: Counter[str] | None = None) -> Boxes:
    """Objects of the rows first … last - 1; else a ConversionError."""
    row, rows = read_rows(
        log,
        first,
        last,
        columns="t.token, c.name, b.x, b.y, b.yaw, b.vx, b.vy, b.length, b.width, b.height",
        joins="JOIN lidar_box AS b ON b.lidar_pc_token = pc.token"
        " JOIN track AS t ON b.track_token = t.token"
        " JOIN category AS c ON t.category_token = c.token",
        order="b.rowid",
    )
    unknown = sorted({str(r[1]) for r in rows} - set(_KINDS))
    if unknown:
        what = f"{log.path}: table 'category': unknown category {unknown[0]!r}"
        raise ConversionError(what, f"known are {', '.join(_KINDS)}")
    kind = np.array([_KINDS[r[1]] for r in rows], np.int64)
    values = as_numbers(log.path, "lidar_box", [r[2:] for r in rows]).reshape(-1, 8)
    order = np.lexsort((np.arange(len(rows)), kind, row))
    token = [token_text(rows[i][0], log.path, "track") for i in order.tolist()]
    boxes = Boxes(row[order].astype(np.int64), token, kind[order], values[order])
    counts = Counter[str]() if flaws is None else flaws
    boxes = _checked(log, boxes, counts)
    note_implausible("lidar_box", _COLUMNS, boxes.values[:, :7], counts)
    _bound(boxes.values)
    return boxes


def _bound(values: FloatArray) -> None:
    """Bring boxes, as in `Boxes.values`, into the ranges that a store can hold.

    These are so wide that a box is on the whole map, or off it after the first step, before and
    after; headings keep their directions.
    """
    heading, speed, size = (STORE[name] for name in ("heading_rad", "vx_mps", "length_m"))
    turned = ~heading.holds(values[:, 2])
    values[turned, 2] = np.arctan2(np.sin(values[turned, 2]), np.cos(values[turned, 2]))
    np.clip(values[:, 3:5], speed.low, speed.high, out=values[:, 3:5])  # NaN stays
    np.minimum(values[:, 5:7], size.high, out=values[:, 5:7])


def _checked(log: Log, boxes: Boxes, flaws: Counter[str]) -> Boxes:
    """The boxes that something can touch, with positive sizes."""
    places, sizes = boxes.values[:, :2], boxes.values[:, 5:7]
    is_nowhere = np.isnan(places).any(axis=1) | ~np.isfinite(boxes.values[:, 2])
    for bad, what in (
        (is_nowhere, "a pose that is not finite"),
        (np.isinf(boxes.values[:, 3:5]).any(axis=1), "an infinite velocity"),
        (~np.isfinite(sizes).all(axis=1), "no finite length or width"),
    ):
        if bad.any():
            box = int(np.flatnonzero(bad)[0])
            raise ConversionError(
                f"{log.path}: lidar_box of track {boxes.token[box]!r} at lidar_pc"
                f" {log.tokens[int(boxes.row[box])]!r} has {what}",
                hint="leave this scenario out or repair the log",
            )
    # nuPlan rule 436
    is_near = STORE["x_m"].holds(places).all(axis=1)
    is_flat = is_near & (np.abs(sizes) < STORE["length_m"].low).any(axis=1)
    is_negative = is_near & ~is_flat & (sizes < 0.0).any(axis=1)
    for odd, what in (
        (is_flat, "boxes without length or width touch nothing and are left out"),
        (~is_near, "boxes off the earth touch nothing and are left out"),
        (is_negative, "boxes of negative length or width cover the same area as positive ones"),
    ):
        if odd.any():
            first = boxes.token[int(np.flatnonzero(odd)[0])]
            first = log.examples.setdefault(what, first)
            flaws[f"lidar_box: {what}; first of track {first!r}"] += int(odd.sum())
    keep = np.flatnonzero(is_near & ~is_flat)
    values = boxes.values[keep]
    values[:, 5:7] = np.abs(values[:, 5:7])
    return Boxes(boxes.row[keep], [boxes.token[i] for i in keep.tolist()], boxes.kind[keep], values)


def make_tracks(boxes: Boxes, first: int, last: int, flaws: Counter[str]) -> Tracks:
    """Dense tracks over the rows first … last - 1 from their boxes."""
    index: dict[str, int] = {}
    track = np.array([index.setdefault(token, len(index)) for token in boxes.token], np.int64)
    frame = boxes.row - first
    kinds = np.zeros(len(index), np.int64)
    kinds[track] = boxes.kind
    before = np.zeros((len(index), len(index)), np.bool_)  # in a frame, directly before the other
    next_to = (np.diff(frame) == 0) & (np.diff(boxes.kind) == 0) & (np.diff(track) != 0)
    before[track[:-1][next_to], track[1:][next_to]] = True
    first_frame = frame[np.unique(track, return_index=True)[1]]
    order = sort_tracks(before, kinds, first_frame)
    place = np.argsort(order)
    dense = np.full((last - first, len(index), 7), np.nan)
    dense[frame, place[track]] = boxes.values[:, :7]
    dense[:, kinds[order] > state.LAST_AGENT_KIND, 3:5] = np.nan  # nuPlan rule 420
    tokens = np.array(list(index), object)[order].tolist()
    tracks = tracks_of_boxes(dense, kinds[order], tokens)
    twice = int(len(frame) - tracks.valid.sum())
    flaws["track listed twice in a frame: the last one is kept"] += twice
    return tracks
