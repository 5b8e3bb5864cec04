"""Runs of nuPlan: scored as recorded, simulated again, and planned again at every state."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from parity_cases import (
    EXACT,
    TABLES,
    Cases,
    File,
    Rows,
    Scenes,
    change_column,
    noticed,
    observed_columns,
    open_scenes,
    open_tables,
    read_file,
)

from shiftsim.metrics import MetricResult, evaluate, measure
from shiftsim.metrics.score import nuplan_columns
from shiftsim.planners.registry import PLANNERS, load_planner
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.loop import simulate
from shiftsim.verify.rollouts import (
    CHALLENGES,
    DERIVED,
    SCORES,
    RecordedRun,
    compare_plans,
    ego_columns,
    read_ego,
    recorded_log,
    tracks_of,
)
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import scenario_of_rows
from shiftsim.world.state import AgentKind

pytestmark = [pytest.mark.golden, pytest.mark.slow]

PROFILES = {"default": "nuplan", "deepplan": "deepplan"}
RUN_TABLES = "ego objects route collisions scores metrics statistics time_series".split()
EVERY = 10  # iterations between recorded plans; the last one is recorded as well
CORNERS = ("front_left", "rear_left", "rear_right", "front_right")
SCRIPTED = "scripted_"


@pytest.fixture
def tables(request: pytest.FixtureRequest, scenes_folder: Path) -> Iterator[tuple[Path, Path]]:
    """Folders of the recorded runs and of the logged states: of `nuplan`, or of `pdm/loop`."""
    folder = request.getfixturevalue("folder")
    if (folder / "scenes.json").is_file():
        yield folder / "expected", folder / "expected"
    else:
        yield folder / "loop", scenes_folder / "expected"


@pytest.fixture
def run_scenes(request: pytest.FixtureRequest, scenes_folder: Path) -> Scenes:
    """The scenes of the runs."""
    folder = request.getfixturevalue("folder")
    return open_scenes(folder if (folder / "scenes.json").is_file() else scenes_folder)


both = pytest.mark.reference("nuplan", "pdm")


@both
def test_recorded_rollouts_are_scored_alike(
    folder: Path, tables: Any, run_scenes: Scenes, cases: Cases
) -> None:
    if (tables[0] / "scores.parquet").is_file():
        compare_metrics(*tables, run_scenes, cases)


@both
def test_simulations_end_alike(folder: Path, tables: Any, run_scenes: Scenes, cases: Cases) -> None:
    if (tables[0] / "scores.parquet").is_file():
        compare_simulations(*tables, run_scenes, cases)


@pytest.mark.reference("nuplan")
def test_plans_are_made_alike(folder: Path, run_scenes: Scenes, cases: Cases) -> None:
    compare_recorded_plans(folder / "expected", run_scenes, cases)


@pytest.mark.reference("idm_ties")
def test_agents_that_touch_several_follow_the_same_one(folder: Path, cases: Cases) -> None:
    scenes, table = Scenes(folder, cases, (4.0, 0.0, 0.5)), "official/objects_a_0.parquet"
    objects = Rows(read_file(folder / table, cases, "objects"), *TABLES["objects"])
    for scene in scenes.entries:
        log = simulate(scenes[scene], load_planner("constant-velocity"), traffic="reactive")
        rows = objects[scene, "R", "simple"]
        objects.match((scene, "R", "simple"), reactive_objects(log, rows), quantity="reactive")


def compare_metrics(expected: Path, logged: Path, scenes: Scenes, cases: Cases) -> None:
    """Score the recorded rollout of every run of `ego.parquet`."""
    tables = open_tables(expected, cases, *RUN_TABLES)
    replayed = tables["objects"]
    if logged != expected:
        replayed = open_tables(logged, cases, "objects")["objects"]
    experts = open_tables(logged, cases, "log_ego")["log_ego"]
    tables["objects"].table.note("no metric reads it", "height")
    for run in tables["ego"].of_mode():
        scene, challenge, _ = run
        entry, road = scenes.entries[scene], scenes.maps[scenes.entries[scene]["map"]]
        seen = tables["objects"][run] if challenge == "R" else replayed[scene, "NR", "*"]
        log = recorded_rollout(tables["ego"][run], experts[scene, "iteration"], seen, road)
        times = log.expert_time_us[: len(log.ego)]
        columns = {"iteration": np.arange(len(times)), "time_us": times}
        columns |= {name: ego_columns(log.ego)[name] for name in DERIVED}
        tables["ego"].match(run, columns, DERIVED, quantity="recorded")
        measured = measure(log, road)
        compare_route(run, measured, road, tables)
        for thresholds, profile in PROFILES.items():
            result = evaluate(measured, profile)
            compare_profile((*run, thresholds), result, entry, tables)
            if profile == "nuplan":
                compare_series(run, result, tables["time_series"])
    for table in tables.values():
        table.finish()


def recorded_rollout(rows: File, expert: File, objects: File, road: VectorMap) -> SimulationLog:
    ego, times = read_ego(rows), expert["time_us"].astype(np.int64)
    tracks = tracks_of(objects, len(ego))
    scenario = scenario_of_rows("recorded", road, times, read_ego(expert), tracks)
    return replace(recorded_log(scenario, ego), time_us=rows["time_us"].astype(np.int64))


def compare_route(run: Any, measured: Any, road: VectorMap, tables: dict[str, Rows]) -> None:
    """Roadblocks under the centre and the corners at every sample, and the collisions."""
    samples, corners = range(len(measured.time_us)), measured.corners
    route: dict[str, Any] = {
        "iteration": np.arange(len(samples)),
        "center": [",".join(measured.route.ids(road, i)) for i in samples],
        "in_common_or_connected": measured.lanes.is_common,
    }
    for number, name in enumerate(CORNERS):
        route[name] = [",".join(corners.ids(road, i, number)) for i in samples]
    tables["route"].match(run, route)
    contacts = measured.collisions
    at_fault = {one.time_us for one in contacts if one.at_fault}
    collisions = {
        "time_us": [one.time_us for one in contacts],
        "track_token": [one.token for one in contacts],
        "type": [AgentKind(one.kind).name for one in contacts],
        "collision_type": [f"{one.collision_type.upper()}_COLLISION" for one in contacts],
        "delta_v": [one.delta_v for one in contacts],
        "at_fault": [one.at_fault for one in contacts],
        "timestamp_has_at_fault": [one.time_us in at_fault for one in contacts],
    }
    tables["collisions"].match(run, collisions, {"delta_v": 1e-9})


def compare_profile(
    key: tuple[str, ...], result: MetricResult, entry: File, tables: dict[str, Rows]
) -> None:
    scores = {name: np.nan if s is None else s for name, s in result.scores.items()}
    row = {"scenario": entry["token"], "scenario_type": entry["scenario_type"], **scores}
    row["score"] = result.score
    tables["scores"].match(key, {name: [value] for name, value in row.items()})
    tables["metrics"].match_keys(key, [(name,) for name in scores])
    for name, score in scores.items():
        row = nuplan_columns(result, name)
        filed = {"category": [row["metric_category"]], "unit": [row["metric_score_unit"]]}
        atol = {"score": SCORES.get(name, EXACT)}
        tables["metrics"].match((*key, name), {**filed, "score": [score]}, atol)
    found = result.statistics
    tables["statistics"].match_keys(key, [(s.metric, s.name) for s in found])
    for s in found:
        ours = {"unit": [s.unit or None], "type": [s.kind or None], "value": [s.value]}
        is_exact = s.unit in ("boolean", "count")
        tables["statistics"].match((*key, s.metric, s.name), ours, EXACT if is_exact else None)


def compare_series(run: tuple[str, ...], result: MetricResult, table: Rows) -> None:
    times = result.measurements.time_us
    table.match_keys(run, [(metric,) for metric in result.series])
    for metric, series in result.series.items():
        columns = {"unit": [series.unit or None] * len(times), "index": np.arange(len(times))}
        columns |= {"time_us": times, "value": series.values}
        atol = EXACT if series.unit == "boolean" else None
        table.match((*run, metric), columns, atol, quantity="series")


def compare_simulations(expected: Path, logged: Path, scenes: Scenes, cases: Cases) -> None:
    """Simulate every run of `ego.parquet` and compare states, objects and scores."""
    runs, objects, scores = open_tables(expected, cases, "ego", "objects", "scores").values()
    replayed = objects
    if logged != expected:
        replayed = open_tables(logged, cases, "objects")["objects"]
    reactive = [key for key in objects.of_mode() if key[1] == "R"]
    for key in dict.fromkeys([*runs.of_mode(), *reactive]):
        scene, challenge, planner = key
        controller, traffic = CHALLENGES[challenge]
        kind, args = planner, {}
        if planner.startswith(SCRIPTED):
            kind, _, name = planner.partition("_")
            args = {"file": str(expected.parent / "scripted.parquet"), "name": name}
        driver = load_planner(kind.replace("_", "-"), args)
        log = simulate(scenes[scene], driver, controller=controller, traffic=traffic)
        samples = {"iteration": np.arange(len(log.time_us)), "time_us": log.time_us}
        runs.match(key, samples | ego_columns(log.ego), quantity="ego")
        if challenge == "R":
            ours = reactive_objects(log, replayed[scene, "NR", "*"])
            objects.match(key, ours, quantity="reactive")
        measured = measure(log, scenes[scene].map)
        for thresholds, profile in PROFILES.items():
            result = evaluate(measured, profile)
            found = {**result.scores, "score": result.score}
            columns = {name: [score] for name, score in found.items() if score is not None}
            scores.match((*key, thresholds), columns, quantity="simulated score")
    if cases.mode in (None, "R"):
        objects.table.finish()


def reactive_objects(log: SimulationLog, replayed: File) -> dict[str, Any]:
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


def compare_recorded_plans(expected: Path, scenes: Scenes, cases: Cases) -> None:
    """Plan again at every iteration of `trajectories.parquet` and compare states."""
    plans, egos, objects = open_tables(expected, cases, "trajectories", "ego", "objects").values()
    for key in dict.fromkeys([*egos.of_mode(), *plans.of_mode()]):
        scene, challenge, name = key
        if name.startswith(SCRIPTED):
            continue
        spec = name.replace("_", "-")
        if spec not in PLANNERS or scene not in scenes.entries:
            cases.skip(f"plans of {name} in {scene}, which is not known")
            continue
        if not egos[key].num_rows:
            cases.fail("plan", " ".join(key), "no ego states of this run are recorded")
            continue
        run = RecordedRun(scenes[scene], egos[key], objects[key], challenge)
        recorded, last = plans[key]["iteration"].tolist(), len(run.ego) - 1
        due = sorted({*range(0, last + 1, EVERY), last})
        cases.compare("plan iterations", " ".join(key), due, sorted(set(recorded)))
        compare_plans(" ".join(key), spec, run, plans[key])
    plans.finish()


# --- proof that a changed value is noticed


@pytest.fixture
def golden_scenes(nuplan_reference: Path) -> Scenes:
    return open_scenes(nuplan_reference)


def one_run(source: Path, target: Path, scene: str, challenge: str) -> Path:
    """A folder that holds one recorded run only, to be changed."""
    (target / "expected").mkdir()
    for name in (*RUN_TABLES, "trajectories", "log_ego"):
        table = pq.read_table(source / "expected" / f"{name}.parquet")
        keep = pc.equal(table["scene"], scene)
        if "planner" in table.column_names:
            ours = pc.and_(
                pc.equal(table["challenge"], challenge), pc.equal(table["planner"], "log_future")
            )
            keep = pc.and_(keep, pc.or_(ours, pc.equal(table["planner"], "*")))
        pq.write_table(table.filter(keep), target / "expected" / f"{name}.parquet")
    shutil.copy(source / "scripted.parquet", target)
    return target / "expected"


@pytest.mark.parametrize(
    ("compare", "table", "column"),
    [
        *((compare_simulations, "ego", name) for name in ("x", "heading", "vx", "center_y")),
        *((compare_simulations, "ego", name) for name in ("ay", "tire_steering_rate")),
        (compare_simulations, "scores", "score"),
        *((compare_metrics, "ego", name) for name in ("x", "time_us", "center_heading")),
        *((compare_metrics, "route", name) for name in ("center", "rear_left")),
        *((compare_metrics, "metrics", name) for name in ("category", "score")),
        *((compare_metrics, "statistics", name) for name in ("statistic", "unit", "value")),
        *((compare_metrics, "time_series", name) for name in ("index", "value")),
        *((compare_metrics, "scores", name) for name in ("scenario", "drivable_area_compliance")),
        *((compare_recorded_plans, "trajectories", name) for name in ("x", "vx", "time_us")),
        *((compare_recorded_plans, "trajectories", name) for name in ("index", "iteration")),
    ],
)
@pytest.mark.thorough
def test_a_changed_value_is_noticed(
    compare: Any,
    table: str,
    column: str,
    nuplan_reference: Path,
    golden_scenes: Scenes,
    tmp_path: Path,
) -> None:
    expected, cases = one_run(nuplan_reference, tmp_path, "s13_empty_road", "NR"), Cases()
    path = expected / f"{table}.parquet"
    amount = 3e-6 if compare is compare_simulations else 1e-2
    change_column(path, path, column, row=-1, amount=amount)
    logged = () if compare is compare_recorded_plans else (expected,)
    assert noticed(compare, expected, *logged, golden_scenes, cases)


@pytest.mark.parametrize("column", ["x", "heading", "vx", "length", "height"])
def test_a_changed_reactive_object_is_noticed(
    column: str, nuplan_reference: Path, golden_scenes: Scenes, tmp_path: Path
) -> None:
    expected, cases = one_run(nuplan_reference, tmp_path, "s04_left_turn", "R"), Cases(mode="R")
    path = expected / "objects.parquet"
    row = pq.read_table(path)["challenge"].to_pylist().index("R") + 50
    change_column(path, path, column, row=row, amount=2e-3)
    assert noticed(compare_simulations, expected, expected, golden_scenes, cases)


def test_missing_rows_and_unknown_columns_are_named(
    nuplan_reference: Path, golden_scenes: Scenes, tmp_path: Path
) -> None:
    expected, cases = one_run(nuplan_reference, tmp_path, "s13_empty_road", "NR"), Cases()
    table = pq.read_table(expected / "route.parquet")
    novel = table.append_column("novelty", pa.array([1] * len(table)))
    pq.write_table(novel, expected / "route.parquet")
    table = pq.read_table(expected / "statistics.parquet")
    pq.write_table(table.slice(1), expected / "statistics.parquet")
    compare_metrics(expected, expected, golden_scenes, cases)
    assert list(cases.not_covered) == ["route: column 'novelty'"]
    assert any(line.startswith("statistics present") for line in cases.mismatches)
