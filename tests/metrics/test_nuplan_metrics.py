"""Recorded nuPlan rollouts score as the official stack scored them; a changed value shows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from shiftsim.verify.files import Scenes
from shiftsim.verify.nuplan.runs import verify_nuplan_metrics
from shiftsim.verify.report import Report

pytestmark = pytest.mark.golden
TABLES = (
    "ego",
    "log_ego",
    "objects",
    "route",
    "collisions",
    "metrics",
    "statistics",
    "time_series",
    "scores",
)


@pytest.fixture(scope="module")
def scenes(nuplan_reference: Path) -> Scenes:
    return Scenes(nuplan_reference)


def verify(folder: Path, scenes: Scenes) -> Report:
    report = Report()
    verify_nuplan_metrics(folder / "expected", report, scenes)
    return report


def test_recorded_rollouts_score_as_nuplan_scored_them(
    nuplan_reference: Path, scenes: Scenes
) -> None:
    report = verify(nuplan_reference, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.num_cases > 300
    worst = max(q.max_error for q in report.quantities.values())
    assert worst < 1e-9


def test_all_recorded_rollouts_of_the_reference_agree(shared: Path) -> None:
    folder = shared / "reference" / "nuplan"
    report = verify(folder, Scenes(folder))
    assert report.mismatches == []
    assert report.not_covered == {}


def test_a_mode_limits_the_runs(nuplan_reference: Path, scenes: Scenes) -> None:
    report = Report("XX")
    verify_nuplan_metrics(nuplan_reference / "expected", report, scenes)
    assert report.num_cases == 0


@pytest.fixture
def copy(nuplan_reference: Path, tmp_path: Path) -> Path:
    """The tables of one run with a collision, free to be changed."""
    (tmp_path / "expected").mkdir()
    collisions = pq.read_table(nuplan_reference / "expected" / "collisions.parquet")
    scene, planner = collisions["scene"][0].as_py(), collisions["planner"][0].as_py()
    for name in TABLES:
        rows = pc.field("scene") == scene
        if name != "log_ego":
            rows &= (pc.field("challenge") == "NR") & pc.field("planner").isin([planner, "*"])
        table = pq.read_table(nuplan_reference / "expected" / f"{name}.parquet").filter(rows)
        pq.write_table(table, tmp_path / "expected" / f"{name}.parquet")
    return tmp_path


def change(folder: Path, table: str, column: str, new: Callable[[Any], Any], row: int = 0) -> None:
    path = folder / "expected" / f"{table}.parquet"
    content = pq.read_table(path)
    values = content[column].to_pylist()
    values[row] = new(values[row])
    at = content.column_names.index(column)
    pq.write_table(content.set_column(at, column, pa.array(values)), path)


def add(value: float) -> float:
    return value + 1e-6


def rename(value: str) -> str:
    return f"{value}x"


CHANGES: list[tuple[str, str, Callable[[Any], Any]]] = [
    ("ego", "iteration", lambda value: value + 1),
    ("ego", "time_us", lambda value: value + 1),
    ("ego", "x", add),
    ("ego", "heading", add),
    ("ego", "center_y", add),
    ("ego", "planner", rename),
    ("log_ego", "time_us", lambda value: value + 1),
    ("objects", "type", lambda _: "UFO"),
    ("objects", "iteration", lambda value: value + 1),
    ("route", "iteration", lambda value: value + 1),
    ("route", "center", rename),
    ("route", "rear_left", rename),
    ("route", "in_common_or_connected", lambda value: not value),
    ("collisions", "time_us", lambda value: value + 1),
    ("collisions", "track_token", rename),
    ("collisions", "type", rename),
    ("collisions", "collision_type", rename),
    ("collisions", "delta_v", add),
    ("collisions", "at_fault", lambda value: not value),
    ("collisions", "timestamp_has_at_fault", lambda value: not value),
    ("metrics", "metric", rename),
    ("metrics", "category", rename),
    ("metrics", "score", lambda value: 0.5),
    ("metrics", "unit", lambda value: "x"),
    ("statistics", "statistic", rename),
    ("statistics", "unit", rename),
    ("statistics", "type", rename),
    ("statistics", "value", add),
    ("time_series", "metric", rename),
    ("time_series", "unit", rename),
    ("time_series", "index", lambda value: value + 1),
    ("time_series", "time_us", lambda value: value + 1),
    ("time_series", "value", add),
    ("scores", "scenario", rename),
    ("scores", "scenario_type", rename),
    ("scores", "score", add),
    ("scores", "drivable_area_compliance", add),
]


@pytest.mark.parametrize(
    ("table", "column", "new"), CHANGES, ids=[f"{table}-{column}" for table, column, _ in CHANGES]
)
def test_a_changed_value_turns_the_report_red(
    copy: Path, scenes: Scenes, table: str, column: str, new: Callable[[Any], Any]
) -> None:
    change(copy, table, column, new)
    assert verify(copy, scenes).exit_code() == 1


def test_an_unknown_column_is_named_as_not_covered(copy: Path, scenes: Scenes) -> None:
    path = copy / "expected" / "route.parquet"
    content = pq.read_table(path)
    pq.write_table(content.append_column("novelty", pa.array([1] * content.num_rows)), path)
    assert "route: column 'novelty'" in verify(copy, scenes).not_covered


@pytest.mark.parametrize("iteration", [-1, 10_000])
def test_objects_outside_the_run_are_named(copy: Path, scenes: Scenes, iteration: int) -> None:
    change(copy, "objects", "iteration", lambda value: iteration)
    assert "which the ego does not have" in " ".join(verify(copy, scenes).mismatches)


def test_a_statistic_that_only_the_reference_has_is_a_mismatch(copy: Path, scenes: Scenes) -> None:
    path = copy / "expected" / "statistics.parquet"
    content = pq.read_table(path)
    more = content.slice(0, 1).set_column(
        content.column_names.index("statistic"), "statistic", pa.array(["novelty"])
    )
    pq.write_table(pa.concat_tables([content, more.cast(content.schema)]), path)
    assert "statistics present" in " ".join(verify(copy, scenes).mismatches)
