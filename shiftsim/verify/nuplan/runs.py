"""Runs of nuPlan: scored as recorded, simulated again from the log, planned again at every state.

A recorded rollout is scored by us and by the official stack. A simulated run is compared with the
recorded one state by state; a reactive one object by object too, a scored one score by score.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.metrics import MetricResult, evaluate, measure
from shiftsim.planners.registry import PLANNERS, load_planner
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.loop import simulate
from shiftsim.sim.planner import Observation, observe_log, scene_info
from shiftsim.sim.traffic.idm.agents import order_observed
from shiftsim.verify import worlds
from shiftsim.verify.files import COMPARED, EXACT, TOLERANCE, Groups, Scenes, Source, open_tables
from shiftsim.verify.nuplan.logs import verify_nuplan_import
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.verify.worlds import EGO_COLUMNS, SCORE_TOLERANCES, ego_columns, ego_states
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario, scenario_of_rows
from shiftsim.world.state import AgentKind, Tracks, Trajectory

TABLES = read_tables(__file__)
PROFILES = {"default": "nuplan", "deepplan": "deepplan"}
# how the devkit files each metric, and the units of scores that have one
RECORDED, CATEGORIES, UNITS = (COMPARED[what] for what in ("recorded", "category", "unit"))
RUN_TABLES = "ego objects route collisions scores metrics statistics time_series".split()
EGO_TOLERANCES = COMPARED["ego.parquet"]["atol"]
OBJECT_TOLERANCES = COMPARED["objects.parquet"]["atol"]
EVERY = 10  # iterations between recorded plans; the last one is recorded as well
CHALLENGES = COMPARED["challenges"]  # controller and traffic
_SCRIPTED = "scripted_"


def verify_nuplan(folder: Path, report: Report) -> None:
    """Compare every table of the folder; of one mode only its runs, but the importer always."""
    scenes = Scenes(folder)
    with report.attempt("importer", folder.name):
        verify_nuplan_import(folder, report)
    for verify in (verify_planners, verify_simulation, verify_nuplan_metrics):
        with report.attempt(verify.__name__, folder.name):
            verify(folder / "expected", report, scenes)


def verify_nuplan_metrics(
    expected: Path, report: Report, scenes: Scenes, logged: Path | None = None
) -> None:
    """Score the recorded rollout of every run of `ego.parquet`.

    `expected` holds the tables of the runs, and where there is no `logged` those of the logs.
    """
    tables = open_tables(expected, report, *RUN_TABLES)
    replayed = open_tables(logged, report, "objects")["objects"] if logged else tables["objects"]
    experts = open_tables(logged or expected, report, "log_ego")["log_ego"]
    tables["objects"].table.note("no metric reads it", "height")
    for run in tables["ego"].of_mode():
        scene, challenge, _ = run
        with report.attempt("recorded rollout", " ".join(run)):
            entry, road = scenes.entries[scene], scenes.maps[scenes.entries[scene]["map"]]
            seen = tables["objects"][run] if challenge == "R" else replayed[scene, "NR", "*"]
            log = _rollout(tables["ego"][run], experts[scene, "iteration"], seen, road)
            times = log.expert_time_us[: len(log.ego)]
            columns = {"iteration": np.arange(len(times)), "time_us": times}
            columns |= {name: ego_columns(log.ego)[name] for name in RECORDED}
            tables["ego"].match(run, columns, RECORDED, quantity="recorded")
            measured = measure(log, road)
            contacts, names = measured.collisions, worlds.found_along(measured, road)
            names["samples"] = np.arange(len(measured.time_us))
            names["kinds"] = [AgentKind(one.kind).name for one in contacts]
            names["is_time"] = [one.time_us in measured.at_fault_times for one in contacts]
            for name, rows in TABLES.items():
                rows.match(tables[name][run], " ".join(run), **names)
            for thresholds, profile in PROFILES.items():
                result = evaluate(measured, profile)
                _compare_profile((*run, thresholds), result, entry, tables)
                if profile == "nuplan":
                    _compare_series(run, result, tables["time_series"])
    for table in tables.values():
        table.finish()


def _rollout(rows: Source, expert: Source, objects: Source, road: VectorMap) -> SimulationLog:
    ego, logged = (ego_states({n: part[n] for n in EGO_COLUMNS}) for part in (rows, expert))
    times, tracks = expert["time_us"].astype(np.int64), worlds.tracks_of(objects, len(ego))
    scenario = scenario_of_rows("recorded", road, times, logged, tracks)
    return replace(worlds.recorded_log(scenario, ego), time_us=rows["time_us"].astype(np.int64))


def _compare_profile(
    key: tuple[str, ...], result: MetricResult, entry: Source, tables: dict[str, Groups]
) -> None:
    scores = {name: np.nan if s is None else s for name, s in result.scores.items()}
    row = {"scenario": entry["token"], "scenario_type": entry["scenario_type"], **scores}
    row["score"] = result.score
    tables["scores"].match(key, {name: [value] for name, value in row.items()})
    tables["metrics"].match_keys(key, [(name,) for name in scores])
    for name, score in scores.items():
        filed = {"category": [CATEGORIES.get(name, "Planning")], "unit": [UNITS.get(name)]}
        atol = {"score": SCORE_TOLERANCES.get(name, EXACT)}
        tables["metrics"].match((*key, name), {**filed, "score": [score]}, atol)
    found = result.statistics
    tables["statistics"].match_keys(key, [(s.metric, s.name) for s in found])
    for s in found:
        ours = {"unit": [s.unit or None], "type": [s.kind or None], "value": [s.value]}
        is_exact = s.unit in ("boolean", "count")
        tables["statistics"].match((*key, s.metric, s.name), ours, EXACT if is_exact else None)


def _compare_series(run: tuple[str, ...], result: MetricResult, table: Groups) -> None:
    times = result.measurements.time_us
    table.match_keys(run, [(metric,) for metric in result.series])
    for metric, series in result.series.items():
        columns = {"unit": [series.unit or None] * len(times), "index": np.arange(len(times))}
        columns |= {"time_us": times, "value": series.values}
        atol = EXACT if series.unit == "boolean" else None
        table.match((*run, metric), columns, atol, quantity="series")


def verify_simulation(
    folder: Path, report: Report, scenes: Scenes, logged: Path | None = None
) -> None:
    """Simulate every run of `ego.parquet` and compare states, objects and scores.

    `scripted.parquet` is beside the folder; `logged` has the table of logged objects.
    """
    runs, objects, scores = open_tables(folder, report, "ego", "objects", "scores").values()
    replayed = open_tables(logged, report, "objects")["objects"] if logged else objects
    reactive = [key for key in objects.of_mode() if key[1] == "R"]
    for key in dict.fromkeys([*runs.of_mode(), *reactive]):
        scene, challenge, planner = key
        with report.attempt("simulation", " ".join(key)):
            if challenge not in CHALLENGES or scene not in scenes.entries:
                raise DataError("no such challenge or scene")
            controller, traffic = CHALLENGES[challenge]
            kind, args = planner, {}
            if planner.startswith(_SCRIPTED):
                kind, _, name = planner.partition("_")
                args = {"file": str(folder.parent / "scripted.parquet"), "name": name}
            driver = load_planner(kind.replace("_", "-"), args)
            log = simulate(scenes[scene], driver, controller=controller, traffic=traffic)
            samples = {"iteration": np.arange(len(log.time_us)), "time_us": log.time_us}
            runs.match(key, samples | ego_columns(log.ego), quantity="ego")
            if challenge == "R":
                objects.match(key, _objects(log, replayed[scene, "NR", "*"]), quantity="reactive")
            measured = measure(log, scenes[scene].map)
            for thresholds, profile in PROFILES.items():
                rated = worlds.known_scores(evaluate(measured, profile))
                columns = {name: [score] for name, score in rated.items()}
                scores.match((*key, thresholds), columns, quantity="simulated score")
    if report.mode in (None, "R"):
        objects.table.finish()


def observed_columns(tracks: Tracks, challenge: str) -> dict[str, Any]:
    """Objects of every sample in the order of observation, without heights."""
    listed = (lambda kinds, row: np.flatnonzero(row)) if challenge != "R" else order_observed
    orders = [listed(tracks.kinds, row) for row in tracks.valid]
    iteration = np.repeat(np.arange(len(orders)), [len(order) for order in orders])
    return worlds.object_columns(tracks, iteration, np.concatenate(orders))


def _objects(log: SimulationLog, replayed: Source) -> dict[str, Any]:
    """Objects that reactive traffic shows.

    Heights, which shiftsim does not keep, are of vehicles as in the first frame of the log, of
    others as in the same one.
    """
    logged = zip(*(replayed[name].tolist() for name in ("iteration", "track_token")), strict=True)
    heights = dict(zip(logged, replayed["height"].tolist(), strict=True))
    ours = observed_columns(log.tracks, "R")
    is_vehicle = np.array(ours["type"]) == AgentKind.VEHICLE.name
    first = np.where(is_vehicle, 0, ours["iteration"]).tolist()
    pairs = zip(first, ours["track_token"], strict=True)
    return {**ours, "height": [heights.get(pair, np.nan) for pair in pairs]}


def verify_planners(folder: Path, report: Report, scenes: Scenes) -> None:
    """Plan again at every iteration of `trajectories.parquet` and compare states."""
    plans, egos, objects = open_tables(folder, report, "trajectories", "ego", "objects").values()
    for key in dict.fromkeys([*egos.of_mode(), *plans.of_mode()]):
        scene, challenge, name = key
        if name.startswith(_SCRIPTED):
            continue
        spec = name.replace("_", "-")
        if spec not in PLANNERS or scene not in scenes.entries:
            report.skip(f"plans of {name} in {scene}, which is not known")
            continue
        with report.attempt("plan", " ".join(key)):
            if not egos[key].num_rows:
                raise DataError("no ego states of this run are recorded")
            seen = Seen(scenes[scene], egos[key], objects[key], challenge)
            recorded, last = plans[key]["iteration"].tolist(), len(seen.ego) - 1
            due = sorted({*range(0, last + 1, EVERY), last})
            report.compare("plan iterations", " ".join(key), due, sorted(set(recorded)))
            plan_again(" ".join(key), spec, seen, plans[key])
    plans.finish()


class Seen:
    """What a planner saw in a recorded run, from its ego states and its own objects.

    A run that is not reactive shows the objects of the log.
    """

    def __init__(self, scenario: Scenario, ego: Source, objects: Source, challenge: str) -> None:
        self.scenario = scenario
        self.ego = ego_states({name: ego[name] for name in EGO_COLUMNS})
        self._tracks = worlds.tracks_of(objects, len(self.ego)) if challenge == "R" else None

    def at(self, iteration: int) -> Observation:
        """The present alone; the rule-based planners look at nothing else."""
        row = slice(iteration, iteration + 1)
        tracks = None if self._tracks is None else self._tracks.rows(row)
        ego = self.ego[iteration]
        return observe_log(self.scenario, iteration, ego=ego, tracks=tracks, samples=1)


def plan_again(where: str, spec: str, seen: Seen, rows: Source) -> None:
    """Compare the recorded plans, a row per state, with those of our planner."""
    recorded, planner = rows["iteration"], load_planner(spec)
    planner.reset(scene_info(seen.scenario, planner=planner))
    for iteration in sorted({0, *recorded.tolist()}):
        plan = planner.plan(seen.at(iteration))
        if iteration in recorded and isinstance(plan, Trajectory):
            ours = {"index": np.arange(len(plan.time_us)), "time_us": plan.time_us}
            columns = zip(EGO_COLUMNS, plan.states.T, strict=True)
            ours |= {name: values for name, values in columns if name in rows}
            here, at = rows.at(recorded == iteration), f"{where} iteration {iteration}"
            here.match(at, ours, TOLERANCE, quantity=f"{spec} plan")
