"""Results that nuPlan itself wrote: equal as they are, and every changed number is named."""

import lzma
import os
import pickle
import shutil
import struct
from pathlib import Path

import msgpack
import places
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import call
from parity_cases import open_scenes

from shiftsim.errors import DataError, MissingExtraError
from shiftsim.metrics import compute_metrics
from shiftsim.runs.rollouts.poses import rollout_of
from shiftsim.verify import simulation_log
from shiftsim.verify.experiment import _compare_means, verify_experiment
from shiftsim.verify.report import Report, read_table
from shiftsim.verify.simulation_log import (
    find_simulation_logs,
    log_source,
    read_simulation_log,
)

pytestmark = pytest.mark.golden
GOLDEN = places.GOLDEN / "nuplan_experiment"
LOGGED = "a00a065c00000032"  # the run whose simulation log is kept
WITHOUT = "a001065c00000032"  # one of those that have none


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(GOLDEN, tmp_path / "experiment"))


@pytest.fixture(scope="module")
def recorded():
    return read_simulation_log(log_of(GOLDEN), Report())


def log_of(folder: Path) -> Path:
    return next(folder.rglob("*.msgpack.xz"))


def compare(folder: Path, scenes: Path) -> Report:
    return verify_experiment(folder, open_scenes(scenes).by_token)


def keep(folder: Path, *tokens: str) -> None:
    """Leave the rows of some runs only."""
    for path in folder.rglob("*.parquet"):
        table = pq.read_table(path)
        name = "scenario" if "num_scenarios" in table.column_names else "scenario_name"
        rows = [row for row, token in enumerate(table[name].to_pylist()) if token in tokens]
        pq.write_table(table.take(rows), path)


def change(path: Path, column: str, row: int, add: float) -> None:
    """Add to a number of a table, to the fifth one where a cell is a list."""
    table = pq.read_table(path)
    values = table[column].to_pylist()
    if isinstance(values[row], list):
        values[row][5] += add
    else:
        values[row] += add
    index = table.column_names.index(column)
    pq.write_table(table.set_column(index, column, pa.array(values, table[column].type)), path)


def change_log(path: Path, old: bytes, new: bytes) -> None:
    """Change some bytes of the pickle in a log, where they occur first."""
    content = msgpack.unpackb(lzma.decompress(path.read_bytes()))
    assert old in content
    write_log(path, content.replace(old, new, 1))


def write_log(path: Path, content: bytes) -> None:
    path.write_bytes(lzma.compress(msgpack.packb(content), preset=0))


@pytest.mark.slow
def test_results_of_nuplan_are_equal_with_and_without_logs(nuplan_reference):
    report = compare(GOLDEN, nuplan_reference)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert sum("no simulation log, as others have" in line for line in report.remarks) == 3
    assert report.quantities["ego x"].cases == 1
    assert report.quantities["scores score"].cases == 4
    assert report.quantities["simple plan x"].cases == 150
    assert sum(name.startswith("metric ") for name in report.quantities) == 16
    assert any("pathlib.PosixPath" in line for line in report.informative)


def test_a_scored_metric_without_a_table_is_not_covered(folder, nuplan_reference):
    keep(folder, LOGGED)
    [path] = folder.rglob("ego_is_comfortable.parquet")
    path.unlink()
    lacking = f"{path.parents[1]}: there is no table of ego_is_comfortable in metrics, but a score"
    assert compare(folder, nuplan_reference).not_covered == {lacking: 1}


@pytest.mark.parametrize("name", ["metrics", "aggregator_metric"])
def test_tables_that_are_not_there_are_not_covered(nuplan_reference, tmp_path, name):
    shutil.copytree(GOLDEN, tmp_path / "exp")
    [folder] = (tmp_path / "exp").rglob(name)
    shutil.rmtree(folder)
    report = compare(tmp_path / "exp", nuplan_reference)
    assert f"{folder.parent}: there are no tables in {name}" in report.not_covered


TABLE_NUMBERS = [  # of the last row, and what names them
    ("metrics/ego_lon_jerk", "max_ego_lon_jerk_stat_value", 1e-6),
    ("metrics/ego_yaw_rate", "time_series_values", 1e-6),
    ("metrics/ego_jerk", "time_series_timestamps", 1),
    ("metrics/drivable_area_compliance", "metric_score", -1.0),
    (
        "metrics/no_ego_at_fault_collisions",
        "number_of_all_at_fault_collisions_stat_value",
        1,
    ),
    ("aggregator_metric/*", "ego_progress_along_expert_route", 1e-6),
    ("aggregator_metric/*", "score", 1e-6),
    ("runner_report", "duration", 1e-6),
    ("runner_report", "compute_trajectory_runtimes_mean", 1e-6),
    ("runner_report", "compute_trajectory_runtimes_std", 1e-6),
]


def test_a_log_gets_the_score_that_nuplan_gave(nuplan_reference):
    source = log_source(GOLDEN)
    (entry,) = source.entries
    assert entry.task == ("SimplePlanner", "none", 0, LOGGED)
    scenario = open_scenes(nuplan_reference).by_token(LOGGED)
    log, _ = rollout_of(entry.read(), scenario)
    result = compute_metrics(log, scenario.map)
    [path] = GOLDEN.rglob("aggregator_metric/*.parquet")
    (row,) = (row for row in pq.read_table(path).to_pylist() if row["scenario"] == LOGGED)
    assert abs(result.score - row["score"]) < 1e-9
    for name, score in result.scores.items():
        if score is not None:
            assert abs(score - row[name]) < 1e-9, name


@pytest.mark.thorough
def test_every_changed_number_of_a_table_is_named(folder, nuplan_reference):
    keep(folder, LOGGED)
    named = []
    for table, column, add in TABLE_NUMBERS:
        [path] = folder.rglob(f"{table}.parquet")
        change(path, column, 0, add)
        run, kind = f"NR {LOGGED} SimplePlanner", table.partition("/")[0]
        words = f"metric {path.stem}: {run} {column}: ", f"{kind} {column}: {run}: "
        named.append(words[kind != "metrics"].replace("aggregator_metric", "scores"))
    report = compare(folder, nuplan_reference)
    assert report.exit_code() == 1
    for words in named:
        assert sum(line.startswith(words) for line in report.mismatches) == 1, words
    assert len(report.mismatches) == len(named)


@pytest.mark.parametrize("row", [4, 8])  # of a scenario type, and of all
def test_a_changed_mean_is_named(folder, row):
    [path] = folder.rglob("aggregator_metric/*.parquet")
    for column in ("score", "ego_is_comfortable", "num_scenarios"):
        change(path, column, row, 1e-6)
    report = Report()
    _compare_means(read_table(path, report), path)
    name = pq.read_table(path)["scenario"][row].as_py()
    assert sorted(line.split(": ")[1] for line in report.mismatches) == [
        f"{name} SimplePlanner {column}"
        for column in ("ego_is_comfortable", "num_scenarios", "score")
    ]


LOG_NUMBERS = [
    # table of the log, column, row, how a pickle holds it, the first mismatch
    ("ego", "center_x", 77, "<d", "ego center_x"),
    ("ego", "x", 77, "<d", "ego center_x"),
    ("ego", "vx", 77, ">d", "run"),  # its vector is there twice
    ("ego", "time_us", 77, "<q", "ego time_us"),
    ("objects", "x", 303, ">d", "objects x"),
    ("plans", "x", 3030, "<d", "plan center_x"),
    ("plans", "vx", 3030, "<d", "run"),
]


@pytest.mark.thorough
@pytest.mark.parametrize(("part", "column", "row", "form", "named"), LOG_NUMBERS)
def test_a_changed_number_of_a_log_is_named(
    folder, nuplan_reference, recorded, part, column, row, form, named
):
    keep(folder, LOGGED)
    value = getattr(recorded, part)[column][row]
    if form == "<q":  # as a pickle writes an integer of more than four bytes
        old, new = (int(v).to_bytes(7, "little") for v in (value, value + 1))
    else:
        old, new = (struct.pack(form, v) for v in (value, value + 3e-3))
    change_log(log_of(folder), old, new)
    report = compare(folder, nuplan_reference)
    assert report.exit_code() == 1
    assert report.mismatches[0].startswith(f"{named}: NR {LOGGED} SimplePlanner")


@pytest.mark.thorough
def test_nothing_in_a_log_is_run(folder, recorded, tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    content = msgpack.unpackb(lzma.decompress(log_of(folder).read_bytes()))
    planner = b"nuplan.planning.simulation.planner.simple_planner"
    assert planner in content
    write_log(log_of(folder), pickle.dumps({"log": Evil()}))
    with pytest.raises(DataError, match="log"):
        read_simulation_log(log_of(folder), Report())
    assert not (tmp_path / "made").exists()


@pytest.mark.thorough
def test_objects_of_other_classes_are_left_out_and_named(folder, nuplan_reference):
    keep(folder, LOGGED)
    change_log(log_of(folder), b"interpolated_trajectory", b"interpolated_trajectorx")
    change_log(log_of(folder), b"InterpolatedTrajectory", b"InterpolatedTrajectorx")
    report = compare(folder, nuplan_reference)
    assert report.mismatches == []
    assert list(report.not_covered) == [
        f"NR {LOGGED} SimplePlanner: plans of a class that is not known here"
    ]
    assert any("InterpolatedTrajectorx" in line for line in report.informative)


@pytest.mark.parametrize(
    "content",
    [b"", b"no pickle", pickle.dumps([1]), pickle.dumps({}), b"\x80\x04N.", b"\x80\x04]\x94"],
)
def test_a_damaged_log_is_one_error_that_names_it(folder, content):
    write_log(log_of(folder), content)
    with pytest.raises(DataError, match=r"a00a065c00000032\.msgpack\.xz"):
        read_simulation_log(log_of(folder), Report())
    log_of(folder).write_bytes(content)
    with pytest.raises(DataError, match=r"not a readable simulation log"):
        read_simulation_log(log_of(folder), Report())


@pytest.mark.thorough
def test_a_log_of_another_version_is_said_to_be_one(folder, nuplan_reference):
    keep(folder, LOGGED)
    change_log(log_of(folder), b"_car_footprint", b"_car_outlining")
    with pytest.raises(DataError, match="_car_footprint") as caught:
        read_simulation_log(log_of(folder), Report())
    assert "1.2.2" in caught.value.hint
    report = compare(folder, nuplan_reference)
    assert any("_car_footprint" in line for line in report.mismatches)


@pytest.mark.thorough
def test_a_table_of_another_version_is_said_to_be_one(folder, nuplan_reference):
    keep(folder, LOGGED)
    [path] = folder.rglob("ego_jerk.parquet")
    table = pq.read_table(path)
    pq.write_table(table.append_column("extra", pa.array([1.0])), path)
    pq.write_table(table, path.with_name("ego_mean_speed.parquet"))
    report = compare(folder, nuplan_reference)
    assert report.mismatches == []
    assert set(report.not_covered) == {
        "ego_jerk: column 'extra'",
        "metric ego_mean_speed: shiftsim has none of this name",
    }
    assert any("another version than nuPlan's devkit 1.2.2" in line for line in report.informative)
    pq.write_table(table.drop_columns(["scenario_name"]), path)
    with pytest.raises(DataError, match=r"ego_jerk\.parquet: column 'scenario_name'") as caught:
        compare(folder, nuplan_reference)
    assert "1.2.2" in caught.value.hint


@pytest.mark.thorough
def test_a_row_that_is_gone_is_named(folder, nuplan_reference):
    keep(folder, LOGGED)
    [path] = folder.rglob("ego_jerk.parquet")
    pq.write_table(pq.read_table(path).slice(0, 0), path)
    report = compare(folder, nuplan_reference)
    assert report.mismatches == [
        f"metric ego_jerk: NR {LOGGED} SimplePlanner: there is no row of it"
    ]


def test_text_in_a_column_of_numbers_is_named(folder, nuplan_reference):
    keep(folder, LOGGED)
    path = next(folder.rglob("aggregator_metric/*"))
    table = pq.read_table(path)
    index, texts = table.column_names.index("score"), pa.array(["many"] * len(table))
    pq.write_table(table.set_column(index, "score", texts), path)
    with pytest.raises(DataError, match=r"\.parquet: column 'score': .*'many'"):
        compare(folder, nuplan_reference)


def test_runs_that_cannot_be_compared_are_named(folder, nuplan_reference):
    keep(folder, WITHOUT, LOGGED)
    for path in folder.rglob("*.parquet"):
        table = pq.read_table(path)
        name = "scenario" if "num_scenarios" in table.column_names else "scenario_name"
        names = [{LOGGED: "another"}.get(token, token) for token in table[name].to_pylist()]
        table = table.set_column(table.column_names.index(name), name, pa.array(names))
        planners = pa.array(["MyPlanner"] * len(table))
        index = table.column_names.index("planner_name")
        pq.write_table(table.set_column(index, "planner_name", planners), path)
    log_of(folder).unlink()
    report = compare(folder, nuplan_reference)
    assert report.exit_code() == 2 if not report.num_cases else True
    assert set(report.not_covered) >= {
        f"NR {WITHOUT} MyPlanner: no simulation log, and a planner that shiftsim has not",
        "NR another MyPlanner: there is no such scenario",
    }


@pytest.mark.thorough
def test_a_run_that_failed_in_nuplan_is_named(folder, nuplan_reference):
    keep(folder, LOGGED)
    [path] = folder.rglob("runner_report.parquet")
    table = pq.read_table(path)
    for name, value in (("succeeded", [False]), ("error_message", ["Traceback …\nValueError: no"])):
        table = table.set_column(table.column_names.index(name), name, pa.array(value))
    pq.write_table(table, path)
    report = compare(folder, nuplan_reference)
    assert list(report.not_covered) == [
        f"NR {LOGGED} SimplePlanner: it failed in nuPlan: ValueError: no"
    ]


def test_what_is_missing_is_said_with_a_remedy(folder, nuplan_reference, monkeypatch):
    with pytest.raises(DataError, match="no results of nuPlan"):
        compare(nuplan_reference, nuplan_reference)
    other = folder.rename(folder.with_name("other"))
    inner = next(other.iterdir()).rename(other / "mine") / "simple_planner"
    for path in inner.glob("aggregator_metric/*"):
        path.rename(path.with_name("table.parquet"))
    with pytest.raises(DataError, match="closed_loop_reactive_agents") as caught:
        compare(other, nuplan_reference)
    assert "--mode" in caught.value.hint
    monkeypatch.setattr(simulation_log, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="msgpack") as missing:
        find_simulation_logs(inner)
    assert "shiftsim[nuplan]" in missing.value.hint


@pytest.mark.thorough
def test_the_command_compares_with_the_scenarios_of_a_store(nuplan_reference, folder, tmp_path):
    keep(folder, LOGGED)
    logs, maps = nuplan_reference / "logs" / "s10_lane_change.db", nuplan_reference / "maps"
    store = tmp_path / "store"
    chosen = ("--mapping", "15,0,0.5", "--tokens", LOGGED, "--store", store)
    made = call(tmp_path, "convert", "nuplan", logs, maps, *chosen)
    assert made.returncode == 0, made.stderr
    found = call(tmp_path, "verify", "--experiment", folder, "--store", store, "--require-all")
    assert found.returncode == 0, found.stdout + found.stderr
    assert found.stdout.splitlines()[-1].endswith("0 mismatches, 0 not covered")
    [path] = folder.rglob("ego_jerk.parquet")
    change(path, "max_ego_jerk_stat_value", 0, 1e-6)
    found = call(tmp_path, "verify", "--experiment", folder, "--store", store)
    assert found.returncode == 1
    assert f"MISMATCH metric ego_jerk: NR {LOGGED} SimplePlanner max_ego_jerk" in found.stdout
