"""A run in the folders that nuPlan's own simulation writes, for nuBoard and scripts of one's own.

nuPlan knows neither noise nor seeds, so each of them has a folder:

    OUT/CHALLENGE/NOISE/metrics/METRIC.parquet          scores, statistics, time series
    OUT/CHALLENGE/NOISE/aggregator_metric/*.parquet     scores of scenarios, types and all
    OUT/CHALLENGE/NOISE/simulation_log/PLANNER/TYPE/LOG/TOKEN/TOKEN.msgpack.xz
    OUT/CHALLENGE/NOISE/runner_report.parquet, nuboard_TIME.nuboard
"""

import pickle
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.compat.nuplan.simulation_log import write_simulation_log
from shiftsim.data.nuplan.export import plain_name
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, DataError
from shiftsim.files import atomic_write, safe_join
from shiftsim.metrics import evaluate, measure
from shiftsim.metrics.score import closed_loop_score, nuplan_columns
from shiftsim.runs.derive import tasks_with_rollouts
from shiftsim.runs.results import Run, open_run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import open_run_store
from shiftsim.runs.tables import FAILED, TaskResult, task_of
from shiftsim.runs.task import attempt
from shiftsim.runs.workers import map_unordered

Row: TypeAlias = dict[str, Any]

_DATA = Path("~/nuplan/dataset")  # where the devkit looks by default
_RECORDINGS = ("*.db", "*/*.db", "nuplan-v1.1/splits/*/*.db")
_METRICS, _MEANS, _LOGS = "metrics", "aggregator_metric", "simulation_log"
_COMPUTED_WITH = {"corners_in_drivable_area": "drivable_area_compliance"}
_RUNTIMES: dict[str, Any] = {"mean": np.mean, "median": np.median, "std": np.std}


@dataclass(frozen=True, slots=True)
class ResultsExport:
    """What an export wrote."""

    folders: tuple[Path, ...]  # one per noise and seed
    rollouts: int  # rollouts in all of them
    failed: int  # tasks without a score, which runner_report.parquet names


def export_results(
    run: Run,
    out: str | Path,
    *,
    store: str | None = None,
    logs: str | Path = _DATA,
    maps: str | Path = _DATA / "maps",
    simulation_logs: bool = True,
    workers: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResultsExport:
    """Write a run as nuPlan's own simulation would have; see `shiftsim.Run.export_results`."""
    out, tasks, rows = Path(out), tasks_with_rollouts(run), run.tasks.to_pylist()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{str(out)!r} is there and not empty", hint="name another folder")
    planners = sorted({row["planner"] for row in rows})
    if len(set(map(plain_name, planners))) < len(planners):
        what = f"two of the planners {', '.join(planners)} would have the same folder"
        raise ConfigError(what, hint="run them with other names")
    if undefined := run.manifest.get("elsewhere", {}).get("undefined"):
        what = f"run {run.path.name!r} was scored without the others: undefined are"
        hint = "score it again with --tracks FILE or --tracks recorded"
        raise DataError(f"{what} {', '.join(undefined)} and the score", hint)
    opened, found = open_run_store(run, store), dict[Task, Row]()
    folders = {task_of(row): _folder(out, run, task_of(row)) for row in rows}
    places = (Path(place).expanduser().resolve() for place in (logs, maps))
    written_to = folders if simulation_logs else {}
    exporter = partial(_exporter, run.path.resolve(), opened, written_to, *places)
    with closing(map_unordered(exporter, tasks, workers=workers, alone=1)) as outcomes:
        for outcome in outcomes:
            result = outcome.result or TaskResult(outcome.task, FAILED, error=outcome.death)
            if isinstance(result, TaskResult):
                what = f"{outcome.task.words} {outcome.task.token}"
                raise DataError(f"{what}: {result.error}", result.hint)
            found[outcome.task] = result
            progress(len(found), len(tasks))
    names = {task.token: result["key"]["log_name"] for task, result in found.items()}
    began = datetime.fromisoformat(run.manifest["started"])
    written = tuple(dict.fromkeys(folders.values()))
    for folder in written:
        members = [row for row in rows if folders[task_of(row)] == folder]
        done = [task for task in map(task_of, members) if task in found]
        _write_tables(folder, {task: found[task] for task in done}, began)
        reports = [_runner_row(row, found.get(task_of(row)), names) for row in members]
        _write_table(folder / "runner_report.parquet", reports)
        _write_nuboard(folder, began, with_logs=simulation_logs)
    return ResultsExport(written, len(found), len(rows) - len(found))


def _folder(out: Path, run: Run, task: Task) -> Path:
    """The folder of a noise and seed, below that of the challenge, whose name others read."""
    traffic = run.manifest["determining"]["traffic"]
    if traffic not in ("nonreactive", "reactive"):  # those of a model of traffic react
        traffic = "elsewhere" if "elsewhere" in run.manifest else "reactive"
    name = "no-noise" if task.noise == "none" else f"{task.noise}-seed-{task.seed}"
    return out / f"closed_loop_{traffic}_agents" / plain_name(name)


def _exporter(
    path: Path, store: ScenarioStore, folders: Mapping[Task, Path], recordings: Path, maps: Path
) -> Callable[[Task], Row | TaskResult]:
    """What says a rollout in nuPlan's words, and writes its simulation log below `folders`."""
    run = open_run(path)
    files = chain.from_iterable(map(recordings.glob, _RECORDINGS if folders else ()))
    databases = {file.stem: file for file in files}

    def export(task: Task) -> Row:
        scenario = store.read(task.token)
        log, planner = run.rollout(task, scenario), plain_name(task.planner)
        result = evaluate(measure(log, scenario.map), run.manifest["config"]["thresholds"])
        name, kind = plain_name(scenario.log_name), plain_name(scenario.scenario_type)
        if folders:
            place = "/".join((_LOGS, planner, kind, name, task.token, f"{task.token}.msgpack.xz"))
            database = databases.get(name, recordings / f"{name}.db")
            target = safe_join(folders[task], place)
            write_simulation_log(target, task, scenario, log, database=database, maps=maps)
        key = {"log_name": name, "scenario_name": task.token, "scenario_type": kind}
        key |= {"planner_name": planner}
        seconds = {n: float(of(log.planning_seconds)) for n, of in _RUNTIMES.items()}
        seconds = seconds if log.planning_seconds.any() else {}  # not known where all are 0
        rows = {
            metric: {
                **key,
                "metric_computator": _COMPUTED_WITH.get(metric, metric),
                "metric_statistics_name": metric,
                **nuplan_columns(result, metric),
                "time_series_selected_frames": None,
            }
            for metric in result.scores
        }
        return {"key": key, "metrics": rows, "runtimes": seconds}

    return lambda task: attempt(task, partial(export, task))


def _write_tables(folder: Path, found: Mapping[Task, Row], began: datetime) -> None:
    """Scores, statistics and series by metric, and the scores of scenarios, types and all."""
    rows: dict[str, list[Row]] = {}
    scenarios = []
    for result in found.values():
        for metric, row in result["metrics"].items():
            rows.setdefault(metric, []).append(row)
        scores = {metric: row["metric_score"] for metric, row in sorted(result["metrics"].items())}
        scenarios.append(result["key"] | scores | {"score": closed_loop_score(scores)})
    for metric, members in rows.items():
        _write_table(folder / _METRICS / f"{metric}.parquet", members)
    metrics, table = sorted(rows), list[Row]()
    for planner in sorted({row["planner_name"] for row in scenarios}):
        own = [row for row in scenarios if row["planner_name"] == planner]
        for row in own:
            name = row["scenario_name"], row["log_name"], row["scenario_type"], None
            table.append(_scores(name, [row], metrics))
        for kind in dict.fromkeys(row["scenario_type"] for row in own):
            members = [row for row in own if row["scenario_type"] == kind]
            # nuPlan rule 606: metrics of a scenario type are added up, only the score is a mean
            table.append(_scores((kind, None, kind, float(len(members))), members, metrics))
        final = "final_score", None, "final_score", float(len(own))
        table.append(_scores(final, own, metrics, len(own)))
    if table:
        file = f"{folder.parent.name}_weighted_average_metrics_{began:%Y.%m.%d.%H.%M.%S}.parquet"
        _write_table(folder / _MEANS / file, table)


def _scores(name: tuple[Any, ...], rows: list[Row], metrics: list[str], count: int = 1) -> Row:
    """A row of scores: its names, sums of metrics over a count, and the mean of the score."""
    out = dict(zip(("scenario", "log_name", "scenario_type", "num_scenarios"), name, strict=True))
    out |= {"planner_name": rows[0]["planner_name"], "aggregator_type": "weighted_average"}
    for metric in metrics:
        values = [row[metric] for row in rows if row[metric] is not None]
        out[metric] = float(np.sum(values)) / count if values else None
    return out | {"score": float(np.mean([row["score"] for row in rows]))}


def _runner_row(row: Row, result: Row | None, names: Mapping[str, str]) -> Row:
    """How a task went; the time of its beginning is not kept, and is 0."""
    seconds = row["simulate_seconds"]
    runtimes = result["runtimes"] if result else {}
    return {
        "succeeded": result is not None,
        "error_message": row["traceback"] or row["error"] or None,
        "start_time": 0.0,
        "end_time": seconds,
        "scenario_name": row["token"],
        "planner_name": plain_name(row["planner"]),
        "log_name": names.get(row["token"]),
        **{f"compute_trajectory_runtimes_{name}": runtimes.get(name) for name in _RUNTIMES},
        "duration": seconds,
    }


def _write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as a table; some may have columns that others have not."""
    names = dict.fromkeys(chain.from_iterable(rows))
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table({name: pa.array([row.get(name) for row in rows]) for name in names})
    with atomic_write(path) as partial_file:
        pq.write_table(table, partial_file)


def _write_nuboard(folder: Path, began: datetime, *, with_logs: bool) -> None:
    """The file that nuBoard opens."""
    place = str(folder.resolve())
    names = {"simulation_main_path": place, "metric_main_path": place}
    names |= {"metric_folder": _METRICS, "aggregator_metric_folder": _MEANS}
    names |= {"simulation_folder": _LOGS} if with_logs else {}
    (folder / f"nuboard_{began.timestamp():.0f}.nuboard").write_bytes(pickle.dumps(names))
