"""Result folders that nuPlan's own simulation wrote: their rollouts and scores against ours.

The ego that a simulation log recorded is scored by our metrics, and the plans in it are driven once
more by our tracker, among our traffic: whatever the planner was, nothing of it is run. Without logs
the planners that nuPlan's devkit brings along are simulated.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.kernels import FloatArray
from shiftsim.metrics import MetricResult, evaluate, measure
from shiftsim.metrics.score import closed_loop_score, nuplan_columns
from shiftsim.planners.registry import load_planner
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.loop import simulate
from shiftsim.sim.planner import Observation, Planner, SceneInfo
from shiftsim.verify import rollouts
from shiftsim.verify.report import (
    DAMAGED,
    EXACT,
    TOLERANCE,
    Groups,
    Report,
    Source,
    Tolerances,
    read_table,
)
from shiftsim.verify.simulation_log import (
    OTHER_VERSION,
    Recorded,
    find_simulation_logs,
    read_simulation_log,
)
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AX, AY, PACIFICA, Tracks, Trajectory, speeds

_PARTS = ("metrics", "aggregator_metric", "simulation_log")  # folders that nuPlan makes
_CHALLENGES = {"closed_loop_nonreactive_agents": "NR", "closed_loop_reactive_agents": "R"}
_CHALLENGES |= {"closed_loop_elsewhere_agents": "R"}  # neither simulated here nor replayed
_TWINS = {"SimplePlanner": "simple", "IDMPlanner": "idm", "LogFuturePlanner": "log-future"}
_LABELS = {  # columns that name things, or say what only their own run can know
    *("metric_computator", "metric_statistics_name", "time_series_selected_frames", "log_name"),
    *("scenario_type", "aggregator_type", "error_message"),
}
_NO_METRICS = {  # of the table of scores
    *("scenario", "log_name", "scenario_type"),
    *("num_scenarios", "planner_name", "aggregator_type"),
}
POSE = [1e-6, 1e-6, 1e-7]  # m, m, rad
_RUNTIMES = (("mean", np.mean), ("median", np.median), ("std", np.std))

FindScenario = Callable[[str], Scenario | None]  # by token; None where there is none
Tables = Mapping[str, Groups]  # by name of the file
Key = tuple[str, ...]  # token and planner


@dataclass(frozen=True, slots=True)
class Run:
    """A planner on a scenario."""

    challenge: str  # NR, R or PT
    token: str
    planner: str  # name of its class

    def __str__(self) -> str:
        return f"{self.challenge} {self.token} {self.planner}"

    @property
    def key(self) -> Key:
        """What a folder files it under."""
        return self.token, self.planner

    def drive(self, scenario: Scenario, planner: Planner) -> SimulationLog:
        """Simulate it with a planner of ours."""
        controller, traffic = rollouts.CHALLENGES[self.challenge]
        return simulate(scenario, planner, controller=controller, traffic=traffic)


def verify_experiment(folder: Path, find: FindScenario, mode: str | None = None) -> Report:
    """Compare all that `run_simulation.py` made in a folder; `find` gives scenarios by token."""
    folders = {path.parent for name in _PARTS for path in folder.rglob(name) if path.is_dir()}
    if not folders:
        raise DataError(
            f"{folder}: no results of nuPlan are in this folder",
            hint=f"run_simulation.py makes a folder with {', '.join(_PARTS)}: name that one",
        )
    report = Report()
    for path in sorted(folders):
        challenge = _challenge(path, mode)
        if mode in (None, challenge):
            _compare_results(path, challenge, find, report)
    return report


def _challenge(path: Path, mode: str | None) -> str:
    """What was simulated, by the names of the folders and of the table of scores."""
    tables = [file.name for file in path.glob("aggregator_metric/*")]
    for part in (*tables, *reversed(path.resolve().parts)):
        for name, challenge in _CHALLENGES.items():
            if part.startswith(name):
                return challenge
    if mode is None:
        what = f"{path}: its name says neither {' nor '.join(_CHALLENGES)}"
        raise DataError(what, hint="say what was simulated: --mode NR or --mode R")
    return mode


def _compare_results(path: Path, challenge: str, find: FindScenario, report: Report) -> None:
    """Compare one result folder."""
    metrics = _read(path, "metrics/*", "scenario_name", report)
    scores = _read(path, "aggregator_metric/*", "scenario", report)
    runner = _read(path, "runner_report", "scenario_name", report)
    logs, tables = find_simulation_logs(path), {**metrics, **scores, **runner}
    listed: list[Iterable[Key]] = [*tables.values(), logs]
    for name in (name for name, found in zip(_PARTS, (metrics, scores), strict=False) if not found):
        report.skip(f"{path}: there are no tables in {name}")
    left_out, known = set[str](), set[str]()
    for token, planner in dict.fromkeys(key for keys in listed for key in keys):
        run, scenario = Run(challenge, token, planner), find(token)
        with report.attempt("run", str(run)):
            recorded = read_simulation_log(logs[run.key], report) if run.key in logs else None
            if recorded:
                left_out |= recorded.left_out
                source = "exported"
                if not recorded.is_exported:
                    source = rollouts.origin(challenge, recorded.ego, recorded.plans)
                report.remarks.append(f"{run}: {rollouts.ORIGINS[source]}")
            if recorded and recorded.dropped_us:
                report.remarks.append(f"{run}: the last sample repeats a time (dt = 0): dropped")
            if recorded and scenario and (recorded.dropped_us or recorded.is_exported):
                end = recorded.ego.num_rows + 1 if recorded.is_exported else -1  # it may end early
                scenario = replace(scenario, iteration_rows=scenario.iteration_rows[:end])
            if scenario is None:
                report.skip(f"{run}: there is no such scenario")
                continue
            if runner and not _compare_runner(run, runner["runner_report"][run.key], recorded):
                continue
            if recorded:
                rollout = _compare_log(run, scenario, recorded, report)
                with report.attempt("replay", str(run)):
                    if source not in ("played back", "exported"):
                        _compare_replay(run, scenario, recorded)
                    elif source == "exported" and challenge == "NR":
                        tracks = scenario.tracks.rows(scenario.iteration_rows[:-1])
                        _compare_objects(run, recorded.objects, tracks)
            elif planner in _TWINS:
                if logs:
                    report.remarks.append(f"{run}: no simulation log, as others have: driven anew")
                rollout = run.drive(scenario, load_planner(_TWINS[planner]))
            else:
                report.skip(f"{run}: no simulation log, and a planner that shiftsim has not")
                continue
            result = evaluate(measure(rollout, scenario.map))
            known |= {*result.scores}
            _compare_result(run, result, metrics, scores, report)
    if known:  # else no run could be compared, and each is named already
        for name in sorted({*metrics} - known):
            report.skip(f"metric {name}: shiftsim has none of this name")
            del tables[name]
        columns = {name for table in scores.values() for name in table.table}
        for name in sorted((known & columns) - {*metrics} if metrics else ()):
            report.skip(f"{path}: there is no table of {name} in metrics, but a score")
        _finish(path, tables.values(), left_out, report)


def _read(folder: Path, pattern: str, token: str, report: Report) -> dict[str, Groups]:
    """Tables by name; their rows by scenario, which a column names, and planner."""
    found = {}
    for file in sorted(folder.glob(f"{pattern}.parquet")):
        table = read_table(file, report)
        has_means = "num_scenarios" in table
        for name in (token, "planner_name", *(("scenario_type",) if has_means else ())):
            if name not in table:
                raise DataError(f"{file}: column {name!r} is missing", OTHER_VERSION)
        if has_means:
            table = _compare_means(table, file)
        found[file.stem] = Groups(table, (token, "planner_name"))
    return found


def _compare_means(table: Source, file: Path) -> Source:
    """Compare the last rows of the scores, which are of several scenarios; returns the others."""
    table, numbers = replace(table, name="scores"), dict[str, FloatArray]()
    for column in ("num_scenarios", *(name for name in table if name not in _NO_METRICS)):
        try:
            numbers[column] = table[column].astype(np.float64)
        except (TypeError, ValueError) as error:
            raise DataError(f"{file}: column {column!r}: {error}", OTHER_VERSION) from None
    is_one = np.isnan(numbers.pop("num_scenarios"))
    means = table.at(~is_one)
    if len(means.groups("scenario", "planner_name")) < means.num_rows:  # each reads all rows
        raise DataError(f"{file}: column 'num_scenarios': a mean is there twice", DAMAGED)
    for row in np.flatnonzero(~is_one).tolist():
        name, planner = table["scenario"][row], table["planner_name"][row]
        is_final = name == "final_score"
        members = is_one & (table["planner_name"] == planner)
        members &= is_final | (table["scenario_type"] == name)
        ours = {"num_scenarios": float(members.sum())}
        for metric, values in numbers.items():
            known = values[members & ~np.isnan(values)]
            # nuPlan rule 606: metrics of a scenario type are added up, only the score is a mean
            count = max(members.sum(), 1) if is_final or metric == "score" else 1
            ours[metric] = float(np.sum(known)) / count if known.size else np.nan
        for column, mean in ours.items():
            where, theirs = f"{name} {planner} {column}", table[column][row]
            table.report.compare("scores of several", where, mean, theirs, atol=TOLERANCE)
    return table.at(is_one)


class _Replay:
    """Answers with recorded plans."""

    def __init__(self, plans: Source) -> None:
        self._plans = plans

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to do."""

    def plan(self, observation: Observation) -> Trajectory:
        """The plan of this iteration."""
        return rollouts.plan_at(self._plans, observation.iteration)


def _compare_log(run: Run, scenario: Scenario, recorded: Recorded, report: Report) -> SimulationLog:
    """Compare what a simulation log says but for scores; returns the rollout that it holds."""
    where, ego, objects = str(run), recorded.ego, recorded.objects
    facts = {
        "token": scenario.token,
        "map": scenario.city,
        "mapping": list(scenario.mapping),
        "goal": scenario.mission_goal,
    }
    Source("log", "field", recorded.facts, report).match(where, facts, {"goal": POSE})
    width, front, rear, _, base, _, _, height = recorded.facts["vehicle"]
    sizes = [PACIFICA.width, PACIFICA.front_length, PACIFICA.rear_length, PACIFICA.wheel_base]
    report.compare(
        "log vehicle", where, [*sizes, PACIFICA.height], [width, front, rear, base, height]
    )
    if recorded.facts["scenario_type"] != scenario.scenario_type:
        report.note("scenario types where they differ (convert with the same filter as nuPlan)")
    _compare_derived(where, ego)
    _match_unordered(
        where, recorded.lights, rollouts.light_columns(scenario), "lane_connector_id", EXACT
    )
    states = rollouts.read_ego(ego)
    return replace(
        rollouts.recorded_log(scenario, states),
        time_us=ego["time_us"],
        tracks=rollouts.tracks_of(objects, len(states)),
    )


def _compare_replay(run: Run, scenario: Scenario, recorded: Recorded) -> None:
    """Compare the states and objects that follow from the recorded plans, and the plans."""
    where, ego, objects, plans = str(run), recorded.ego, recorded.objects, recorded.plans
    if plans is None:
        ego.report.skip(f"{where}: plans of a class that is not known here")
        return
    _compare_derived(where, plans)
    log = run.drive(scenario, _Replay(plans))
    stamps = dict.fromkeys(("time_us", "ego_time_us"), log.time_us)
    ours = {"iteration": np.arange(len(log.ego)), **stamps, **rollouts.ego_columns(log.ego)}
    ego.match(where, ours, rollouts.SIMULATED)
    _compare_objects(run, objects, log.tracks)
    if run.planner in _TWINS:
        recorded_run = rollouts.RecordedRun(scenario, ego, objects, run.challenge)
        rollouts.compare_plans(where, _TWINS[run.planner], recorded_run, plans)


def _compare_objects(run: Run, theirs: Source, ours: Tracks) -> None:
    shown = rollouts.object_columns(ours, *np.nonzero(ours.valid))
    atol = rollouts.REACTIVE if run.challenge == "R" else rollouts.LOGGED
    _match_unordered(str(run), theirs, shown, "track_token", atol)


def _match_unordered(
    where: str, theirs: Source, ours: Mapping[str, Any], name: str, atol: Tolerances
) -> None:
    """Compare rows of a sample, in whatever order they are listed."""
    rows = theirs.at(np.lexsort((theirs[name], theirs["iteration"])))
    order = np.lexsort((ours[name], ours["iteration"]))
    rows.match(where, {column: np.asarray(values)[order] for column, values in ours.items()}, atol)


def _compare_derived(where: str, recorded: Source) -> None:
    """Compare what follows from ego states, or is the same for all of them."""
    states = rollouts.read_ego(recorded)
    columns = rollouts.ego_columns(states)
    ours: dict[str, Any] = {name: columns[name] for name in rollouts.DERIVED}
    ours |= {"speed": speeds(states), "acceleration": np.hypot(states[:, AX], states[:, AY])}
    sizes = {"length": PACIFICA.length, "width": PACIFICA.width, "height": PACIFICA.height}
    sizes["rear_axle_to_center"] = PACIFICA.rear_axle_to_center
    ours |= {name: np.full(len(states), size) for name, size in sizes.items()}
    recorded.match(where, ours, {**rollouts.DERIVED, "": TOLERANCE})


def _compare_result(
    run: Run, result: MetricResult, metrics: Tables, scores: Tables, report: Report
) -> None:
    """Compare scores, statistics and series, of the metrics that the folder has."""
    for table in scores.values():
        found = {name: score for name, score in result.scores.items() if name in table.table}
        row = {**found, "score": closed_loop_score(found)}
        ours = {name: [np.nan if score is None else score] for name, score in row.items()}
        table[run.key].match(str(run), ours, rollouts.SCORES)
    for metric in (name for name in result.scores if name in metrics):
        theirs, series = metrics[metric][run.key], result.series.get(metric)
        if not theirs.num_rows:
            report.fail(f"metric {metric}", str(run), "there is no row of it")
            continue
        row = nuplan_columns(result, metric)
        if row["metric_score"] is None:
            row["metric_score"] = np.nan
        atol = {"metric_score": rollouts.SCORES.get(metric, EXACT)}
        atol["time_series_values"] = EXACT if series and series.unit == "boolean" else TOLERANCE
        for one in (one for one in result.statistics if one.metric == metric):
            is_whole = one.unit in ("boolean", "count")
            atol[f"{one.name}_stat_value"] = EXACT if is_whole else TOLERANCE
        for name in (name for name in theirs if name.endswith("_stat_type")):
            row.setdefault(name, None)  # other scenarios have more of them
        for name, value in row.items():
            other, bound = theirs[name][0] if name in theirs else None, atol.get(name, EXACT)
            report.compare(f"metric {metric}", f"{run} {name}", value, other, atol=bound)


def _compare_runner(run: Run, row: Source, recorded: Recorded | None) -> bool:
    """Compare the times that a run took, as far as they follow from others; whether it ended."""
    where = str(run)
    if row.num_rows and not row["succeeded"][0]:
        reason = str(row["error_message"][0]).strip().rpartition("\n")[2]
        row.report.skip(f"{where}: it failed in nuPlan: {reason}")
        return False
    begin, end = (row[name].astype(np.float64) for name in ("start_time", "end_time"))
    row.match(where, {"succeeded": [True], "duration": end - begin}, TOLERANCE)
    if recorded and recorded.seconds:
        runtimes = {f"compute_trajectory_runtimes_{n}": [f(recorded.seconds)] for n, f in _RUNTIMES}
        row.match(where, runtimes, TOLERANCE)
    return True


def _finish(path: Path, tables: Collection[Groups], left_out: set[str], report: Report) -> None:
    """Name what was not compared."""
    count = len(report.not_covered)
    for table in tables:
        labels = _LABELS & set(table.table)
        labels |= {name for name in table.table if "_runtimes_" in name or "_stat_" in name}
        table.table.used.update(labels)
        table.table.finish()
    if len(report.not_covered) > count:
        report.note(OTHER_VERSION)
    report.note("tables: names of classes and files; when a run began; times of other planners")
    if left_out:
        report.note("simulation_log: heights of objects, outlines, other values kept for reuse")
        report.note(f"simulation_log: objects of {', '.join(sorted(left_out))}")
    for name in sorted({file.name for file in path.iterdir()} - {*_PARTS, "runner_report.parquet"}):
        report.note(name)
