"""Closed loops against the official stack, and the recognition of reference folders."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shiftsim.errors import DataError
from shiftsim.verify import verify
from shiftsim.verify.files import Scenes
from shiftsim.verify.nuplan.runs import verify_simulation
from shiftsim.verify.report import Report

pytestmark = pytest.mark.golden


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "runs"), [("NR", 46), ("PT", 2)])
def test_closed_loops_end_where_the_official_ones_do(nuplan_reference, scenes, mode, runs):
    report = Report(mode)
    verify_simulation(nuplan_reference / "expected", report, scenes)
    assert report.mismatches == []
    assert report.quantities["ego x"].cases == runs
    scored = [q for name, q in report.quantities.items() if name.startswith("simulated score")]
    assert sum(quantity.cases for quantity in scored) == 18 * runs
    assert not report.not_covered


@pytest.fixture
def one_run(nuplan_reference, tmp_path):
    """A folder that holds one recorded run only, to be falsified."""
    (tmp_path / "expected").mkdir()
    for name in ("ego", "objects", "scores"):
        table = pq.read_table(nuplan_reference / "expected" / f"{name}.parquet")
        keep = [
            row["scene"] == "s13_empty_road"
            and row["challenge"] == "NR"
            and row["planner"] == "log_future"
            for row in table.select(["scene", "challenge", "planner"]).to_pylist()
        ]
        pq.write_table(table.filter(pa.array(keep)), tmp_path / "expected" / f"{name}.parquet")
    return tmp_path


STATE_COLUMNS = [
    "x",
    "y",
    "heading",
    "vx",
    "vy",
    "ax",
    "ay",
    "tire_steering_angle",
    "tire_steering_rate",
    "angular_velocity",
    "angular_acceleration",
    "center_x",
    "center_y",
    "center_heading",
]


@pytest.mark.parametrize("column", STATE_COLUMNS)
def test_one_changed_state_is_seen(one_run, scenes, column):
    path = one_run / "expected" / "ego.parquet"
    table = pq.read_table(path)
    values = table[column].to_numpy().copy()
    values[77] += 3e-6
    index = table.column_names.index(column)
    pq.write_table(table.set_column(index, column, pa.array(values)), path)
    report = Report()
    verify_simulation(one_run / "expected", report, scenes)
    assert len(report.mismatches) == 1
    assert f"ego {column}: s13_empty_road NR log_future" in report.mismatches[0]
    assert " at 77" in report.mismatches[0]


def test_one_changed_score_is_seen(one_run, scenes):
    path = one_run / "expected" / "scores.parquet"
    table = pq.read_table(path)
    values = table["score"].to_numpy().copy()
    values[0] += 1e-8
    index = table.column_names.index("score")
    pq.write_table(table.set_column(index, "score", pa.array(values)), path)
    report = Report()
    verify_simulation(one_run / "expected", report, scenes)
    assert len(report.mismatches) == 1
    assert "score" in report.mismatches[0]


def test_a_missing_sample_is_seen(one_run, scenes):
    path = one_run / "expected" / "ego.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(0, len(table) - 1), path)
    report = Report()
    verify_simulation(one_run / "expected", report, scenes)
    assert any("shape" in line for line in report.mismatches)


def test_an_unknown_folder_is_refused_with_the_known_kinds(tmp_path):
    np.savez(tmp_path / "something.npz", a=1)
    with pytest.raises(DataError, match="not recognised") as caught:
        verify(tmp_path)
    assert "metric_worlds" in caught.value.hint


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        verify(tmp_path / "nothing")


def test_lights_with_two_states_at_once_are_those_of_nuplan(shared):
    report = verify(shared / "reference" / "nuplan_lights")
    assert report.num_cases > 8000
    assert report.mismatches == []
    assert not report.not_covered
