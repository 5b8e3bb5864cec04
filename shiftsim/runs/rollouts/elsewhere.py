"""Rollouts that were driven elsewhere, as tables tell of them, and the score of one.

A table, Parquet or CSV, has a row per scenario and sample; another one may have a row per sample
and box of the others. `shiftsim.runs.derive` makes a run of them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.schema import BOX, EGO_COLUMNS
from shiftsim.errors import DataError, listed, nearest, one_of
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.metrics import MetricResult, Thresholds, compute_metrics
from shiftsim.metrics.score import without
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import COMMAND_COLUMNS, KEY, KINDS, SEEN, STATES, TRACKS
from shiftsim.runs.rollouts.poses import NEED_BOXES, POINTS, REAR_AXLE, Boxes, Driven, rollout_of
from shiftsim.sim.log import SimulationLog
from shiftsim.world.ranges import Range, require
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import STATE_COLUMNS, AgentKind, tracks_of_boxes

RECORDED = "recorded"  # in place of a table: the others did what was recorded
_SAME = {  # other names of columns, those of our own rollouts among them
    **dict(zip(EGO_COLUMNS, STATE_COLUMNS, strict=True)),
    **{"yaw_acceleration": "yaw_accel", "planning_seconds": "seconds", "scenario": "token"},
    **{"length_m": "length", "width_m": "width"},
}
_TIMES, _POSE = {"time_us": 1.0, "time_s": 1e6}, ("x", "y", "heading")
_BOX = (*STATE_COLUMNS[:5], "length", "width")
_RANGES = {"heading": Range(-13, 13, "rad"), "seconds": Range(0, 1e5, "s")}
_RANGES |= dict.fromkeys(("length", "width"), Range(0, 200, "m"))
_KNOWN = {*KEY, *_TIMES, *STATE_COLUMNS, *_BOX, "seconds", "track_token", "type"}
_KNOWN |= {*STATES.names, *TRACKS.names, *SEEN.names, KINDS, "iteration"}  # of rollouts of our own
_EGO = -2  # in place of an AgentKind
_NO_ROWS = np.zeros(0, np.int64)
_NAMES = ("planner", "noise", "token", "scenario", "track_token", "type")
_HINT = "needed are token, time_us (or time_s from 0 on), x, y, heading; docs/score_elsewhere.md"
_EVERY = "give it in every row"
_BOX_HINT = f"boxes have token, time_us, track_token, type, {', '.join(_BOX)}"


class Entry(NamedTuple):
    """A rollout that waits to be scored."""

    task: Task
    read: Any = None  # makes the `Driven` of one that was driven elsewhere


@dataclass(frozen=True)
class Source:
    """Rollouts that were driven elsewhere."""

    name: str  # of the file or folder
    files: tuple[Path, ...]  # what it was read from
    entries: tuple[Entry, ...]  # the rollouts
    has_boxes: bool = False  # whether it says where the others were
    point: str = ""  # which point of the ego the poses are of, where it says that
    remarks: tuple[str, ...] = ()  # what a reader of the scores must know
    is_whole: bool = True  # whether the store must have all of its scenarios

    @property
    def tokens(self) -> list[str]:
        """Their scenarios, sorted."""
        return sorted({entry.task.token for entry in self.entries})

    def in_store(self, store: ScenarioStore) -> "Source":
        """The rollouts whose scenarios a store has: all of them, or some of what may be in part."""
        known = [entry for entry in self.entries if entry.task.token in store]
        lost = [entry.task.token for entry in self.entries if entry.task.token not in store]
        if lost and (self.is_whole or not known):
            near = nearest(lost[0], store.tokens)
            raise DataError(
                f"{self.name}: store {store.path.name!r} has no scenario {lost[0]!r}, and "
                f"{len(set(lost)) - 1} more of the file are not in it",
                f"{f'did you mean {near!r}? ' if near else ''}--store names the one with them",
            )
        words = (f"left out: {len(lost)} whose scenarios are not in the store",) if lost else ()
        return replace(self, entries=tuple(known), remarks=(*self.remarks, *words))


class ScoredRollout(NamedTuple):
    """The score of a rollout that was driven elsewhere."""

    score: float | None  # closed-loop score; None where a metric is undefined
    scores: dict[str, float | None]  # by metric; None where it is undefined or has no score
    remarks: tuple[str, ...]  # what was derived, replayed or cut
    log: SimulationLog  # the rollout
    result: MetricResult  # everything that nuPlan says of it

    def __repr__(self) -> str:
        total = "score undefined" if self.score is None else f"score {100.0 * self.score:.2f}"
        return f"<ScoredRollout of {'; '.join([self.log.token, total, *self.remarks])}>"


def score_rollout(
    poses: Any,
    scenario: Scenario,
    *,
    tracks: Any = None,
    point: str = REAR_AXLE,
    partial: bool = False,
    thresholds: str | Thresholds = "nuplan",
) -> ScoredRollout:
    """Score poses that were driven elsewhere, as `shiftsim score FILE` does.

    Args:
        poses: (K, 3) x [m], y [m], heading [rad] at the iterations of the scenario; or a table
            (Arrow, pandas, a dict of columns) with `time_us` or `time_s`, `x`, `y`, `heading` and,
            if known, `vx`, `vy`, `ax`, `ay`, `yaw_rate`, `yaw_acceleration`.
        scenario: Where they were driven.
        tracks: The others: a table with `time_us` or `time_s`, `track_token`, `type`, `x`, `y`,
            `heading`, `length`, `width` and, if known, `vx`, `vy`; or "recorded". Without them
            collisions, time to collision and the score are undefined.
        point: Whether poses are of the "rear_axle" or the "center".
        partial: Whether they may end before the scenario; the expert then ends with them.
        thresholds: Threshold profile.

    Raises:
        DataError: Something cannot be right; the message names row and number.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        poses = shiftsim.simulate(scenario, "idm").ego[:, :3]
        found = shiftsim.score_rollout(poses, scenario, tracks="recorded")
        print(found.score, found.remarks)
        ```
    """
    one_of("point", point, POINTS)
    is_recorded = isinstance(tracks, str) and bool(one_of("tracks", tracks, [RECORDED]))
    boxes = None if tracks is None or is_recorded else _as_table(tracks, scenario, "tracks")
    source = table_source(_as_table(poses, scenario, "poses"), "poses", boxes)
    if len(source.entries) != 1:
        words = f"{len(source.entries)} rollouts of scenario {scenario.token!r} in the poses"
        raise DataError(words, hint="give those of one")
    driven = source.entries[0].read()
    log, remarks = rollout_of(driven, scenario, point=point, recorded=is_recorded, partial=partial)
    undefined = () if source.has_boxes or is_recorded else NEED_BOXES
    result = without(compute_metrics(log, scenario.map, thresholds=thresholds), undefined)
    total, remarks = None if undefined else result.score, (*source.remarks, *remarks)
    return ScoredRollout(total, result.scores, remarks, log, result)


def _as_table(given: Any, scenario: Scenario, where: str) -> pa.Table:
    """What is given of one scenario as a table."""
    if not (isinstance(given, (pa.Table, Mapping)) or hasattr(given, "iloc")):
        poses, times = np.asarray(given, np.float64), scenario.iteration_times
        if poses.ndim != 2 or poses.shape[1] != 3 or len(poses) > len(times):
            raise ValueError(f"need a table, or poses (K, 3) with K <= {len(times)}: {poses.shape}")
        given = {"time_us": times[: len(poses)], **dict(zip(_POSE, poses.T, strict=True))}
    try:
        table = given if isinstance(given, pa.Table) else pa.table(dict(given))
    except pa.ArrowException as error:
        raise DataError(f"{where}: no table: {error}", "give columns of one length") from error
    table = _renamed(table, where)
    if "token" not in table.column_names:
        return table.append_column("token", pa.array([scenario.token] * len(table), pa.string()))
    return table.filter(pc.equal(table["token"], scenario.token))


def read_source(path: Path, tracks: str = "") -> Source:
    """Rollouts in tables of poses, a file or a folder; `tracks` is one of boxes, or `RECORDED`."""
    files = tuple(sorted([*path.glob("*.parquet"), *path.glob("*.csv")])) or (path,)
    table = pa.concat_tables(map(_read_table, files), promote_options="default")
    if tracks == RECORDED and TRACKS.names[0] in table.column_names:
        table = table.drop_columns([TRACKS.names[0]])
    others = [] if tracks in ("", RECORDED) else [Path(tracks)]
    source = table_source(table, path.name, _read_table(others[0]) if others else None, tracks)
    return replace(source, files=(*files, *others))


def _read_table(path: Path) -> pa.Table:
    if path.is_dir():
        raise DataError(
            f"{str(path)!r} is no run, and holds no tables of poses and no simulation logs",
            hint="name a run folder, a Parquet or CSV file, or what nuPlan's simulation wrote",
        )
    try:
        if ".csv" in path.suffixes:
            texts = pyarrow.csv.ConvertOptions(column_types=dict.fromkeys(_NAMES, pa.string()))
            return pyarrow.csv.read_csv(path, convert_options=texts)
        return pq.ParquetFile(path).read()
    except (OSError, pa.ArrowException) as error:
        words = f"{str(path)!r} is no readable table: {error}"
        raise DataError(words, hint="give a Parquet or CSV file") from error


def table_source(
    table: pa.Table, where: str, boxes: pa.Table | None = None, where_boxes: str = "tracks"
) -> Source:
    """The rollouts in a table of poses, among the boxes of another one, or a DataError."""
    point = (table.schema.metadata or {}).get(b"point", b"").decode()
    if point:
        one_of(f"{where}: point", point, POINTS)
    table = _renamed(table, where)
    _require(table, where, ("token", *_POSE), _HINT)
    if boxes is None and TRACKS.names[0] in table.column_names:
        boxes, where_boxes = _nested(table), where
    boxes = None if boxes is None else _renamed(boxes, where_boxes)
    boxes_of = None if boxes is None else _read_boxes(boxes, where_boxes)
    time_us, states = _times(table, where), _numbers(table, STATE_COLUMNS, where)
    seconds = _numbers(table, ["seconds"], where)[:, 0]
    require(_RANGES, "seconds", seconds, where, may_be_nan=True)
    entries, is_own = [], COMMAND_COLUMNS[0] in table.column_names
    for key, rows in _groups(table, where).items():
        task = Task(**{"planner": where.partition(".")[0], "noise": "none", "seed": 0, **dict(key)})
        is_known = ~np.isnan(seconds[rows])
        _refuse(~is_known & is_known.any(), where, "seconds is missing", _EVERY, rows)
        fields = {"planning_seconds": seconds[rows]} if is_known.all() else {}
        given = (where, time_us[rows], states[rows], rows, boxes_of and boxes_of(task), fields)
        entries.append(Entry(task, partial(Driven, *given, is_simulated=is_own)))
    if not entries:
        raise DataError(f"{where} has no rows", hint=_HINT)
    names = {*table.column_names, *(boxes.column_names if boxes is not None else ())}
    unused = listed(sorted(names - _KNOWN))
    remarks = (f"columns not used: {unused}",) if unused else ()
    entries.sort(key=lambda entry: (entry.task.token, entry.task))
    return Source(where, (), tuple(entries), boxes is not None, point, remarks)


def _renamed(table: pa.Table, where: str) -> pa.Table:
    """A table with the names of columns here."""
    names = [_SAME.get(name, name) for name in table.column_names]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise DataError(f"{where}: column {twice!r} is there twice", hint="leave one of them out")
    return table.rename_columns(names)


def _require(table: pa.Table, where: str, needed: Sequence[str], hint: str) -> None:
    missing = [name for name in needed if name not in table.column_names]
    missing += [] if {*_TIMES} & {*table.column_names} else ["time_us"]
    if missing:
        raise DataError(f"{where}: column {', '.join(map(repr, missing))} is missing", hint)


def _refuse(
    bad: BoolArray, where: str, words: str, hint: str = _BOX_HINT, rows: IntArray | None = None
) -> None:
    """Refuse the first row of a table, or of some `rows` of it, that is bad."""
    if bad.any():
        row = np.argmax(bad) if rows is None else rows[np.argmax(bad)]
        raise DataError(f"{where}, row {row}: {words}", hint)


def _column(table: pa.Table, name: str, kind: pa.DataType, where: str) -> pa.Array:
    """A column of a type."""
    try:
        column = table[name].cast(kind).combine_chunks()
    except pa.ArrowException as error:
        raise DataError(f"{where}: column {name!r} is no {kind}: {error}", hint=_HINT) from error
    if kind != pa.float64():
        _refuse(column.is_null().to_numpy(False), where, f"{name} is missing", _EVERY)
    return column


def _numbers(table: pa.Table, names: Sequence[str], where: str) -> FloatArray:
    """(A, C) values of columns; NaN where one is missing."""
    out = np.full((len(table), len(names)), np.nan)
    for index, name in enumerate(names):
        if name in table.column_names:
            column = _column(table, name, pa.float64(), where)
            out[:, index] = column.to_numpy(zero_copy_only=False)
    return out


def _times(table: pa.Table, where: str) -> IntArray:
    """(A,) times [us]."""
    name = next(name for name in _TIMES if name in table.column_names)
    times = _numbers(table, [name], where)[:, 0]  # microseconds since 1970 are exact
    _refuse(~np.isfinite(times), where, f"{name} is missing", _EVERY)
    return np.rint(times * _TIMES[name]).astype(np.int64)


def _groups(table: pa.Table, where: str) -> dict[tuple[tuple[str, Any], ...], IntArray]:
    """The rows of each rollout, by the names and values of the key columns there are."""
    names = [name for name in KEY if name in table.column_names]
    columns = {name: _column(table, name, KEY[name], where) for name in names}
    numbered = pa.table(columns | {"row": np.arange(len(table))})
    found = numbered.group_by(names, use_threads=False).aggregate([("row", "list")])
    keys = zip(*(found[name].to_pylist() for name in names), strict=True)
    return {
        tuple(zip(names, key, strict=True)): rows.values.to_numpy()
        for key, rows in zip(keys, found["row_list"], strict=True)
    }


def _nested(table: pa.Table) -> pa.Table:
    """The boxes in rollouts as a run stores them, a row per box."""
    tokens = table[TRACKS.names[0]].combine_chunks()
    owner = np.repeat(np.arange(len(table)), tokens.value_lengths().to_numpy())
    kept = [name for name in (*KEY, "time_us") if name in table.column_names]
    columns = {name: table[name].take(pa.array(owner)) for name in kept}
    nested = {"track_token": TRACKS.names[0], "type": KINDS, **{n: f"track_{n}" for n in BOX}}
    for name, of in nested.items():
        if of in table.column_names:
            columns[name] = pc.list_flatten(table[of])
    return pa.table(columns)


def _read_boxes(table: pa.Table, where: str) -> Callable[[Task], Callable[[], Boxes]]:
    """By a rollout, what makes its boxes; those of its scenario where no column says more."""
    _require(table, where, ("token", "track_token", *_POSE, "length", "width"), _BOX_HINT)
    groups, time_us = _groups(table, where), _times(table, where)
    values, kinds = _numbers(table, _BOX, where), _kinds(table, where)
    tracks = _column(table, "track_token", pa.string(), where)
    names = [name for name, _ in next(iter(groups), ())]
    broken = ~np.isfinite(values[:, [0, 1, 2, 5, 6]])
    _refuse(np.logical_or.reduce(broken, axis=1), where, "a number is missing")
    _refuse(values[:, 5:].min(axis=1) <= 0.0, where, "length and width must be above 0")
    for name in ("heading", "length", "width"):
        require(_RANGES, name, values[:, _BOX.index(name)], where)

    def of(task: Task) -> Callable[[], Boxes]:
        rows = groups.get(tuple((name, getattr(task, name)) for name in names), _NO_ROWS)
        rows = rows[kinds[rows] != _EGO]
        tokens = tracks.take(pa.array(rows))
        return partial(_boxes, where, rows, time_us[rows], kinds[rows], values[rows], tokens)

    return of


def _kinds(table: pa.Table, where: str) -> IntArray:
    """(A,) AgentKind codes, that of the ego among them; -1 where no type is given."""
    if "type" not in table.column_names:
        return np.full(len(table), -1)
    known = {word: kind.value for kind in AgentKind for word in (kind.name, str(kind.value))}
    known["EGO"] = _EGO
    types = _column(table, "type", pa.string(), where).dictionary_encode()
    codes, names = types.indices.to_numpy(), types.dictionary.to_pylist()
    for code, name in enumerate(names):
        if name.upper() not in known:
            words = f"type {name!r} is none of {', '.join(k.name for k in AgentKind)} and EGO"
            _refuse(codes == code, where, words)
    return np.array([known[name.upper()] for name in names], np.int64)[codes]


def _boxes(
    where: str,
    rows: IntArray,
    time_us: IntArray,
    kinds: IntArray,
    values: FloatArray,
    tokens: pa.Array,
) -> Boxes:
    """The tracks at all times that have rows of a table, in order of appearance."""
    numbered = tokens.dictionary_encode()
    track = numbered.indices.to_numpy()
    _, first = np.unique(track, return_index=True)
    times, frame = np.unique(time_us, return_inverse=True)
    is_first = np.zeros(len(rows), np.bool_)
    is_first[np.unique(frame * len(first) + track, return_index=True)[1]] = True
    _refuse(~is_first, where, "its track is there twice at one time", rows=rows)
    _refuse(kinds[first][track] != kinds, where, "its track changes its type", rows=rows)
    dense = np.full((len(times), len(first), len(_BOX)), np.nan)
    dense[frame, track] = values
    tracks = tracks_of_boxes(dense, kinds[first], numbered.dictionary.to_pylist())
    return Boxes(times, tracks, where)
