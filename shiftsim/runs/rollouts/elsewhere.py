"""Rollouts that were driven elsewhere become a run: tables of poses are read, scored and stored.

A table, Parquet or CSV, has a row per scenario and sample; another one may hold the boxes of the
others. The run folder is as any other, and says in its manifest what was derived, replayed or cut.
"""

import hashlib
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from shiftsim._version import __version__
from shiftsim.data import open_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.schema import BOX, EGO_COLUMNS
from shiftsim.data.store.tables import digest
from shiftsim.errors import ConfigError, DataError, listed, nearest, one_of
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics import METRIC_VERSION, MetricResult, compute_metrics, thresholds_of
from shiftsim.metrics.score import without
from shiftsim.runs.config import RunConfig, default_workers
from shiftsim.runs.execute import OnProgress, Progress, record
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.manifest import check_target, code_digest, make_manifest, now
from shiftsim.runs.prepare import RUNS, run_name
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.columns import encode_rows, rollout_rows
from shiftsim.runs.rollouts.poses import POINTS, REAR_AXLE, Boxes, Driven, Rollout, rollout_of
from shiftsim.runs.scenarios import read_split, token_hash
from shiftsim.runs.tables import FAILED, OK, TaskResult
from shiftsim.runs.task import ScenarioReader, attempt, planner_times, score_rollout as scores_of
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.log import SimulationLog
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import STATE_COLUMNS, AgentKind, tracks_of_boxes

RECORDED = "recorded"  # in place of a table: the others did what was recorded
ELSEWHERE = "elsewhere"  # who moved ego and others, where nobody says more
_KEY = {"planner": pa.string(), "noise": pa.string(), "seed": pa.int64(), "token": pa.string()}
_TEXTS = ("planner", "noise", "token", "track_token", "type")
_BOX = (*STATE_COLUMNS[:5], "length", "width")
_FIELDS = {"seconds": "planning_seconds", "degraded": "degraded"}  # of a log, by column
_COMMANDS = ("command_accel_mps2", "command_steering_rate_radps")
_SAME = {  # other names of columns
    **dict(zip(EGO_COLUMNS, STATE_COLUMNS, strict=True)),
    **{"yaw_acceleration": "yaw_accel", "length_m": "length", "width_m": "width"},
    **{"planning_seconds": "seconds", "scenario": "token"},
}
_NESTED = "track_tokens"  # the column of boxes in rollouts of ours
_KNOWN = {*_KEY, *STATE_COLUMNS, *_FIELDS, *_COMMANDS, *_BOX, "time_us", "time_s", "iteration"}
_KNOWN |= {"track_token", "type", _NESTED, *(f"track_{name}" for name in BOX)}
_KNOWN |= {"noise_accel_mps2", "noise_steering_rate_radps"}  # what came of them is in the poses
_KNOWN |= {"plan_dx_m", "plan_dy_m", "plan_dheading_rad"}  # of no score
_MINIMAL = "the columns needed are token, time_us (or time_s), x, y, heading"


class Entry(NamedTuple):
    """A rollout that waits to be scored."""

    task: Task
    read: Callable[[], Driven]


@dataclass(frozen=True)
class Source:
    """What is scored.

    Attributes:
        name: Of the file or folder.
        files: The files it is made of.
        entries: The rollouts.
        point: Which point of the ego the poses are of; empty where nothing says it.
        remarks: What a reader of the scores must know of all of them.
    """

    name: str
    files: tuple[Path, ...]
    entries: tuple[Entry, ...]
    point: str = ""
    remarks: tuple[str, ...] = ()


class ScoredRollout(NamedTuple):
    """The score of a rollout that was driven elsewhere."""

    score: float | None  # closed-loop score; None where a metric is undefined
    scores: dict[str, float | None]  # by metric; None where it is undefined, or has no score
    result: MetricResult  # everything else that nuPlan says
    log: SimulationLog  # the rollout
    remarks: tuple[str, ...]  # what was derived, replayed or cut


def score_rollout(
    poses: Any,
    scenario: Scenario,
    *,
    times: Any = None,
    tracks: Any = None,
    point: str = REAR_AXLE,
    partial: bool = False,
    thresholds: str = "nuplan",
) -> ScoredRollout:
    """Score poses that were driven elsewhere, as `shiftsim score FILE` does.

    Args:
        poses: A table (Arrow, pandas, a dict of columns) with `time_us` or `time_s`, `x`, `y`,
            `heading` and maybe `vx`, `vy`, `ax`, `ay`, `yaw_rate`, `yaw_acceleration`; or (K, 3).
        scenario: Where they were driven.
        times: (K,) seconds from iteration 0 of poses (K, 3); without them, every iteration.
        tracks: The others: a table with `time_us` or `time_s`, `track_token`, `type`, `x`, `y`,
            `heading`, `length`, `width` and maybe `vx`, `vy`, or "recorded". Without them
            collisions and time to collision are undefined, and there is no total.
        point: Whether poses are of the "rear_axle" or the "center".
        partial: Whether it may end before the scenario; the expert ends with it then.
        thresholds: Name of the threshold profile.

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
    table = _as_table(poses, times, scenario)
    boxes = None if tracks is None or isinstance(tracks, str) else _as_table(tracks, None, scenario)
    if isinstance(tracks, str):
        one_of("tracks", tracks, [RECORDED])
    entries = table_source(table, "poses", boxes).entries
    if len(entries) != 1:
        raise DataError(
            f"poses of {len(entries)} rollouts of scenario {scenario.token!r}", hint="give one"
        )
    entry = entries[0]
    given = {"point": one_of("point", point, POINTS), "recorded": tracks == RECORDED}
    made = rollout_of(entry.read(), scenario, **given, partial=partial)
    result = compute_metrics(made.log, scenario.map, thresholds=thresholds)
    result = without(result, made.undefined)
    total = None if made.undefined else result.score
    return ScoredRollout(total, result.scores, result, made.log, made.remarks)


def _as_table(poses: Any, times: Any, scenario: Scenario) -> pa.Table:
    """Poses of one scenario in any form as a table."""
    if isinstance(poses, pa.Table):
        table = poses
    elif isinstance(poses, Mapping):
        table = pa.table(dict(poses))
    elif hasattr(poses, "iloc"):
        table = pa.Table.from_pandas(poses, preserve_index=False)
    else:
        array = np.asarray(poses, np.float64)
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"need a table or poses (K, 3), got {array.shape}")
        stamps = scenario.iteration_times[: len(array)]
        if times is not None:
            stamps = np.rint(np.asarray(times, np.float64) * 1e6).astype(np.int64)
        if len(stamps) != len(array):
            raise ValueError(f"{len(array)} poses and {len(stamps)} times")
        x, y, heading = array.T
        table = pa.table({"time_us": stamps, "x": x, "y": y, "heading": heading})
    names = {_SAME.get(name, name): name for name in table.column_names}
    if "token" not in names:
        return table.append_column("token", pa.array([scenario.token] * len(table), pa.string()))
    return table.filter(pc.equal(table[names["token"]], scenario.token))


def read_source(path: Path, tracks: str = "") -> Source:
    """The rollouts in a table of poses, or in the tables of a folder; others in another table.

    Raises:
        DataError: A file cannot be read, or a column is missing or damaged.
    """
    files = tuple(sorted([*path.glob("*.parquet"), *path.glob("*.csv")])) if path.is_dir() else ()
    if path.is_dir() and not files:
        raise DataError(
            f"{str(path)!r} holds neither a run, nor tables of poses, nor simulation logs",
            hint="name a run folder, a Parquet or CSV file, or nuPlan's simulation logs",
        )
    files = files or (path,)
    table = pa.concat_tables([read_table(file) for file in files], promote_options="default")
    boxes = None
    if tracks not in ("", RECORDED):
        files, boxes = (*files, Path(tracks)), read_table(Path(tracks))
    source = table_source(table, path.name, boxes, Path(tracks).name)
    return replace(source, files=files)


def read_table(path: Path) -> pa.Table:
    """A Parquet or CSV file.

    Raises:
        DataError: It is neither, or damaged.
    """
    try:
        if ".csv" in path.suffixes:
            texts = pyarrow.csv.ConvertOptions(
                column_types=dict.fromkeys((*_TEXTS, "scenario"), pa.string())
            )
            return pyarrow.csv.read_csv(path, convert_options=texts)
        return pq.ParquetFile(path).read()
    except (OSError, pa.ArrowException) as error:
        raise DataError(
            f"{str(path)!r} is no readable table: {error}", hint="give a Parquet or CSV file"
        ) from error


class _Table:
    """Columns of a table by the names here, and its rows by rollout."""

    def __init__(self, table: pa.Table, where: str, needed: Sequence[str], default: str) -> None:
        names = [_SAME.get(name, name) for name in table.column_names]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise DataError(f"{where}: column {twice!r} is there twice", hint=_MINIMAL)
        self.where, self._table = where, table.rename_columns(names).combine_chunks()
        self.names = set(names)
        missing = [n for n in needed if n not in self.names]
        if missing or not self.names & {"time_us", "time_s"}:
            what = ", ".join(map(repr, missing)) or "'time_us' or 'time_s'"
            raise DataError(f"{where}: {what} missing; there are {', '.join(names)}", hint=_MINIMAL)
        defaults = {"planner": default, "noise": "none", "seed": 0}
        codes, self._values = np.zeros(len(table), np.int64), []
        self.keys = [name for name in _KEY if name in self.names]
        for name in self.keys:
            column = self.column(name, _KEY[name]).dictionary_encode()
            values = column.dictionary.to_pylist()
            codes = codes * len(values) + column.indices.to_numpy()
        self.order = np.argsort(codes, kind="stable")
        ends = np.flatnonzero(np.diff(codes[self.order])) + 1
        self.groups: dict[tuple[Any, ...], IntArray] = {}
        columns = [self._table[name] for name in self.keys]
        for rows in np.split(self.order, ends) if len(table) else ():
            key = tuple(column[int(rows[0])].as_py() for column in columns)
            self.groups[key] = rows
        self._defaults = defaults

    def task(self, key: tuple[Any, ...]) -> Task:
        """The task that a group of rows is."""
        return Task(**{**self._defaults, **dict(zip(self.keys, key, strict=True))})

    def column(self, name: str, kind: pa.DataType) -> pa.Array:
        """A column of a type, without missing values unless it is of numbers."""
        try:
            column = pc.cast(self._table[name], kind).combine_chunks()
        except pa.ArrowException as error:
            what = f"{self.where}: column {name!r} is no {kind}: {error}"
            raise DataError(what, hint=_MINIMAL) from error
        if column.null_count and kind != pa.float64():
            row = int(np.argmax(column.is_null().to_numpy(zero_copy_only=False)))
            raise DataError(f"{self.where}, row {row}: no {name}", hint="give one in every row")
        return column

    def numbers(self, names: Sequence[str]) -> FloatArray:
        """(A, C) values of columns; NaN where one is missing."""
        out = np.full((self._table.num_rows, len(names)), np.nan)
        for index, name in enumerate(names):
            if name in self.names:
                out[:, index] = self.column(name, pa.float64()).to_numpy(zero_copy_only=False)
        return out

    def times(self) -> IntArray:
        """(A,) time stamps [us]."""
        if "time_us" in self.names:
            return self.column("time_us", pa.int64()).to_numpy()
        seconds = self.column("time_s", pa.float64()).to_numpy(zero_copy_only=False)
        if not np.isfinite(seconds).all():
            row = int(np.argmin(np.isfinite(seconds)))
            raise DataError(f"{self.where}, row {row}: time_s is {seconds[row]}", hint=_MINIMAL)
        return np.rint(seconds * 1e6).astype(np.int64)

    @property
    def unused(self) -> tuple[str, ...]:
        """What is said of columns that nothing reads."""
        names = sorted(self.names - _KNOWN)
        return (f"columns of {self.where} not used: {listed(names)}",) if names else ()


def table_source(
    table: pa.Table,
    where: str,
    boxes: pa.Table | None = None,
    where_boxes: str = "tracks",
) -> Source:
    """The rollouts in a table of poses.

    Args:
        table: The poses.
        where: Its name in messages; without its ending that of a planner without one.
        boxes: The others, of all planners or with the same key columns.
        where_boxes: Name of their table in messages.

    Raises:
        DataError: A column is missing, or holds something else.
    """
    stem = where.partition(".")[0]
    poses = _Table(table, where, ("token", "x", "y", "heading"), stem)
    if not poses.groups:
        raise DataError(f"{where} has no rows", hint=_MINIMAL)
    if boxes is None and _NESTED in poses.names:
        boxes, where_boxes = _nested(table), where
    others = _Others(boxes, where_boxes) if boxes is not None else None
    times, states = poses.times(), poses.numbers(STATE_COLUMNS)
    fields = {
        to: poses.numbers([name])[:, 0] for name, to in _FIELDS.items() if name in poses.names
    }
    if "degraded" in fields:
        fields["degraded"] = fields["degraded"] == 1.0
    if set(_COMMANDS) <= poses.names:
        fields["commands"] = poses.numbers(_COMMANDS)
    entries = []
    for key, rows in poses.groups.items():
        task = poses.task(key)
        driven = Driven(
            where,
            times[rows],
            states[rows],
            rows,
            fields={name: values[rows] for name, values in fields.items()},
        )
        read = partial(_with_boxes, driven, others.rows_of(task) if others else None)
        entries.append(Entry(task, read))
    remarks = (*poses.unused, *(others.table.unused if others else ()))
    point = (table.schema.metadata or {}).get(b"point", b"").decode()
    return Source(
        stem, (), tuple(sorted(entries)), point and one_of("point", point, POINTS), remarks
    )


def _nested(table: pa.Table) -> pa.Table:
    """The boxes in a table of rollouts as ours are stored, a row per box."""
    tokens = table[_NESTED].combine_chunks()
    owner = pa.array(np.repeat(np.arange(len(table)), tokens.value_lengths().to_numpy()))
    names = [name for name in (*_KEY, "time_us", "track_kinds") if name in table.column_names]
    columns = {name: table[name].take(owner) for name in names if name != "track_kinds"}
    columns |= {name: pc.list_flatten(table[f"track_{name}"]) for name in BOX}
    if "track_kinds" in names:
        columns["type"] = pc.list_flatten(table["track_kinds"])
    return pa.table(columns | {"track_token": tokens.flatten()})


class _BoxRows(NamedTuple):
    """Rows of boxes. B rows."""

    where: str  # the table, for messages
    rows: IntArray  # (B,) of the table
    time_us: IntArray  # (B,) [us]
    token: IntArray  # (B,) index into `tokens`
    tokens: tuple[str, ...]  # of the tracks, by first appearance
    kinds: IntArray  # (B,) AgentKind codes, -1 where not given
    values: FloatArray  # (B, 7) columns of `_BOX`

    def boxes(self) -> Boxes:
        """The tracks at the times that have rows.

        Raises:
            DataError: A box is damaged, there twice, or changes its type.
        """
        frames, frame = np.unique(self.time_us, return_inverse=True)
        count = len(self.tokens)
        _, first = np.unique(self.token, return_index=True)
        cells = frame * count + self.token
        is_new = np.zeros(len(cells), np.bool_)
        is_new[np.unique(cells, return_index=True)[1]] = True
        known = np.isfinite(self.values[:, [0, 1, 2, 5, 6]]).all(axis=1)
        sized = (self.values[:, 5:] > 0.0).all(axis=1)
        for is_right, what, hint in (
            (known, "x, y, heading, length or width is no number", "give them in every row"),
            (sized, "length or width is not above 0", "give them in metres"),
            (is_new, "its track is there twice at one time", "leave one of them out"),
            (
                self.kinds == self.kinds[first][self.token],
                "its track changes its type",
                "repair it",
            ),
        ):
            if not is_right.all():
                row = int(self.rows[np.argmin(is_right)])
                raise DataError(f"{self.where}, row {row}: {what}", hint)
        dense = np.full((len(frames), count, len(_BOX)), np.nan)
        dense[frame, self.token] = self.values
        return Boxes(frames, tracks_of_boxes(dense, self.kinds[first], self.tokens))


class _Others:
    """A table of boxes."""

    def __init__(self, table: pa.Table, where: str) -> None:
        needed = ("token", "track_token", "x", "y", "heading", "length", "width")
        self.table = _Table(table, where, needed, "")
        self._time_us, self._values = self.table.times(), self.table.numbers(_BOX)
        tokens = self.table.column("track_token", pa.string()).dictionary_encode()
        self._names = tokens.dictionary.to_numpy(zero_copy_only=False)
        self._codes = tokens.indices.to_numpy()
        self._kinds = np.full(len(self._codes), -1)
        self._is_ego = np.zeros(len(self._codes), np.bool_)
        if "type" in self.table.names:
            self._read_kinds()

    def _read_kinds(self) -> None:
        types = self.table.column("type", pa.string()).dictionary_encode()
        codes, names = types.indices.to_numpy(), types.dictionary.to_pylist()
        known = {word: kind for kind in AgentKind for word in (kind.name, str(kind.value))}
        for code, name in enumerate(names):
            if name.upper() == "EGO":
                self._is_ego = codes == code
            elif name.upper() in known:
                self._kinds[codes == code] = known[name.upper()]
            else:
                row = int(np.argmax(codes == code))
                kinds = ", ".join(kind.name for kind in AgentKind)
                what = f"{self.table.where}, row {row}: type {name!r} unknown"
                raise DataError(what, hint=f"types are {kinds}, and EGO, which is left out")

    def rows_of(self, task: Task) -> _BoxRows:
        """The rows of the others in a rollout."""
        key = tuple(getattr(task, name) for name in self.table.keys)
        rows = self.table.groups.get(key, np.zeros(0, np.int64))
        rows = rows[~self._is_ego[rows]]
        codes, first, token = np.unique(self._codes[rows], return_index=True, return_inverse=True)
        order = np.argsort(first)
        return _BoxRows(
            self.table.where,
            rows,
            self._time_us[rows],
            np.argsort(order)[token],
            tuple(self._names[codes[order]].tolist()),
            self._kinds[rows],
            self._values[rows],
        )


def _with_boxes(driven: Driven, boxes: _BoxRows | None) -> Driven:
    return driven if boxes is None else replace(driven, boxes=boxes.boxes())


class Scorer:
    """Scores one rollout after the other; returns what a reader must know of it as well."""

    def __init__(self, store: str, config: RunConfig, **given: Any) -> None:
        """`given` are arguments of `rollout_of`."""
        self._scenarios, self._config, self._given = ScenarioReader(store), config, given

    def __call__(self, entry: Entry) -> tuple[TaskResult, Rollout | None]:
        """The result of one rollout, and the rollout without its log."""
        seconds, made = dict[str, float](), list[Rollout]()

        def score() -> TaskResult:
            began = perf_counter()
            scenario, driven = self._scenarios.read(entry.task.token), entry.read()
            seconds["read_seconds"] = perf_counter() - began
            made.append(rollout_of(driven, scenario, **self._given))
            log, undefined, _ = made[0]
            scores, metrics = scores_of(scenario, log, self._config, undefined)
            seconds["metrics_seconds"] = perf_counter() - began - seconds["read_seconds"]
            if "planning_seconds" in driven.fields:
                seconds.update(planner_times(log))
            own_tracks = "own" if driven.boxes is not None else undefined
            rows = rollout_rows(log, with_tracks=bool(own_tracks), with_kinds=True)
            kind = scenario.scenario_type
            return TaskResult(
                entry.task, OK, kind, scores=scores, metrics=metrics, rollout=encode_rows(rows)
            )

        result = replace(attempt(entry.task, score), seconds=seconds)
        return result, made[0]._replace(log=None) if made else None


def score_source(
    source: Source,
    *,
    store: str,
    point: str = "",
    recorded: bool = False,
    partial_rollouts: bool = False,
    thresholds: str = "nuplan",
    metrics: tuple[str, ...] = (),
    traffic: str = "",
    controller: str = "",
    out: str | None = None,
    workers: int = 0,
    on_progress: OnProgress = lambda progress: None,
    argv: Sequence[str] = (),
) -> Run:
    """Write a run folder (`runs/<id>`) with the scores of rollouts that were driven elsewhere.

    Args:
        source: The rollouts.
        store: The store with their scenarios.
        point: Which point of the ego the poses are of, where the source does not say it.
        recorded: Whether the others did what was recorded.
        partial_rollouts: Whether rollouts may end before their scenarios.
        thresholds: Name of the threshold profile.
        metrics: Custom ones by `module:attribute`.
        traffic: What moved the others there; a label.
        controller: What moved the ego there; a label.
        out: The run folder.
        workers: 0 chooses from the cores.
        on_progress: Called after every rollout.
        argv: For the manifest.

    Raises:
        ConfigError: Settings contradict the source.
        DataError: A scenario is unknown, or no rollout can be scored; the message names the row.
    """
    found = open_store(store)
    _refuse_unknown(source, found)
    if point and source.point and point != source.point:
        raise ConfigError(
            f"--point {point}, but {source.name!r} says {source.point}", hint="leave --point out"
        )
    given = {"point": point or source.point or REAR_AXLE, "recorded": recorded}
    given |= {"partial": partial_rollouts}
    tasks = [entry.task for entry in source.entries]
    planners, noises = (tuple(dict.fromkeys(c)) for c in list(zip(*tasks, strict=True))[:2])
    tokens = sorted({task.token for task in tasks})
    config = RunConfig(
        planners=planners,
        noise=noises,
        seeds=tuple(sorted({task.seed for task in tasks})),
        store=store,
        traffic=traffic or ("nonreactive" if recorded else ELSEWHERE),
        thresholds=thresholds,
        metrics=metrics,
        workers=workers,
    )
    hashes = {path.name: digest(path) for path in source.files}
    of_files = hashlib.sha256(repr(hashes).encode()).hexdigest()
    fingerprint = {
        "shiftsim": __version__,
        "code": code_digest(),
        "store": found.hash,
        "tokens": token_hash(tokens),
        "planners": {name: {"driven": of_files} for name in planners},
        "noise": {name: {"kind": "none" if name == "none" else ELSEWHERE} for name in noises},
        "seeds": list(config.seeds),
        "traffic": config.traffic,
        "controller": controller or ELSEWHERE,
        "thresholds": asdict(thresholds_of(thresholds)),
        "metrics": config.added_metrics,
        "metric_version": METRIC_VERSION,
        "elsewhere": given,
    }
    split = _split_of(found, tokens, source.name)
    target = Path(out) if out else RUNS / run_name(config, split, fingerprint)
    before = check_target(target, fingerprint)
    manifest = make_manifest(
        target, config=config, split=split, store=found.source, fingerprint=fingerprint, argv=argv
    )
    remarks, failed, undefined = Counter[str](), list[TaskResult](), set[str]()
    with closing(RunWriter(target, manifest)) as writer:
        outcomes = map_unordered(
            partial(Scorer, found.source, config, **given),
            source.entries,
            workers=min(workers or default_workers(), len(tasks)),
            alone=1,
            group=lambda entry: entry.task.token,
        )

        def results() -> Iterator[list[TaskResult]]:
            for outcome in outcomes:
                if outcome.result is None:
                    result = TaskResult(outcome.task.task, FAILED, error=outcome.death)
                else:
                    result, made = outcome.result
                    remarks.update(made.remarks if made else ())
                    undefined.update(made.undefined if made else ())
                failed.extend([result] if result.status == FAILED else [])
                yield [result]

        with closing(outcomes):
            record(results(), writer.add, Progress(0, len(tasks), 0), on_progress)
        if len(failed) == len(tasks):
            first = min(failed, key=lambda result: result.task)
            if before == "new":
                shutil.rmtree(target)
            more = f"; so are {len(tasks) - 1} more rollouts" if len(tasks) > 1 else ""
            raise DataError(f"{first.error}{more}", first.hint)
        count = len(tasks) - len(failed)
        words = [
            f"{remark}{f' ({n} of {count} rollouts)' if n < count else ''}"
            for remark, n in sorted(remarks.items())
        ]
        manifest["elsewhere"] = {
            "files": hashes,
            "undefined": sorted(undefined),
            "remarks": [f"driven elsewhere: {source.name}", *source.remarks, *words],
        }
        manifest |= {"state": "finished", "ended": now()}
        combinations = dict.fromkeys(task._replace(token="") for task in tasks)
        expected = [one._replace(token=token) for one in combinations for token in tokens]
        return writer.finish(manifest, expected, default=f"not in {source.name}")


def _refuse_unknown(source: Source, store: ScenarioStore) -> None:
    unknown = [entry for entry in source.entries if entry.task.token not in store]
    if unknown:
        token = unknown[0].task.token
        near = nearest(token, store.tokens)
        raise DataError(
            f"{source.name}: {len({one.task.token for one in unknown})} scenarios are not in store "
            f"{store.path.name!r}, such as {token!r}",
            hint=f"{f'did you mean {near!r}? ' if near else ''}--store names the store that was "
            "converted for them; leave the others out",
        )


def _split_of(store: ScenarioStore, tokens: Sequence[str], default: str) -> str:
    """The split of a store that has these scenarios; a name of its own where there is none."""
    if list(store.tokens) == list(tokens):
        return store.path.name
    for path in sorted((Path(store.path) / "splits").glob("*.toml")):
        if sorted(read_split(path).tokens) == list(tokens):
            return path.stem
    return default
