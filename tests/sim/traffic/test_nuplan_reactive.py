"""Reactive runs of nuPlan, one of them with falsified values."""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from shiftsim.verify.files import Scenes
from shiftsim.verify.nuplan.runs import verify_simulation
from shiftsim.verify.report import Report

SCENE, PLANNER = "s04_left_turn", "log_future"


@pytest.fixture(scope="module")
def scenes(nuplan_reference: Path) -> Scenes:
    return Scenes(nuplan_reference)


@pytest.fixture
def one_run(nuplan_reference: Path, tmp_path: Path) -> Path:
    """The folder with the tables of a single reactive run, and what was replayed in it."""
    (tmp_path / "expected").mkdir()
    for name in ("ego", "objects", "scores"):
        table = pq.read_table(nuplan_reference / "expected" / f"{name}.parquet")
        table = table.filter(pc.equal(table["scene"], SCENE))
        keep = pc.or_(pc.equal(table["planner"], PLANNER), pc.equal(table["planner"], "*"))
        pq.write_table(table.filter(keep), tmp_path / "expected" / f"{name}.parquet")
    return tmp_path


def verified(folder: Path, scenes: Scenes) -> Report:
    report = Report("R")
    verify_simulation(folder / "expected", report, scenes)
    return report


def test_agents_are_where_nuplan_had_them(one_run: Path, scenes: Scenes) -> None:
    report = verified(one_run, scenes)

    assert report.exit_code(require_all=True) == 0, report.lines()
    assert report.quantities["reactive x"].max_error < 1e-6


@pytest.mark.parametrize("column", ["x", "y", "heading", "vx", "vy", "length", "width", "height"])
def test_a_falsified_value_is_noticed(one_run: Path, scenes: Scenes, column: str) -> None:
    path = one_run / "expected" / "objects.parquet"
    table = pq.read_table(path)
    values = table[column].to_pylist()
    row = table["challenge"].to_pylist().index("R") + 50
    values[row] += 2e-3
    index = table.column_names.index(column)
    pq.write_table(table.set_column(index, column, pa.array(values)), path)

    assert verified(one_run, scenes).exit_code() == 1


def test_missing_objects_are_noticed(one_run: Path, scenes: Scenes) -> None:
    path = one_run / "expected" / "objects.parquet"
    table = pq.read_table(path)
    pq.write_table(table.filter(pc.not_equal(table["challenge"], "R")), path)

    assert verified(one_run, scenes).exit_code() == 1


def test_an_unknown_column_is_named(one_run: Path, scenes: Scenes) -> None:
    path = one_run / "expected" / "objects.parquet"
    table = pq.read_table(path)
    pq.write_table(table.append_column("colour", pa.array(["red"] * len(table))), path)

    assert verified(one_run, scenes).exit_code(require_all=True) == 3
