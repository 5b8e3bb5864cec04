"""The importer against the official one, and proof that a changed value is noticed."""

import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import places
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shiftsim.verify.files import Scenes
from shiftsim.verify.nuplan.logs import verify_maps, verify_nuplan_format, verify_nuplan_import
from shiftsim.verify.report import Report

GOLDEN = places.GOLDEN / "nuplan_format"
pytestmark = pytest.mark.golden


@pytest.fixture
def folder(nuplan_reference: Path, tmp_path: Path) -> Path:
    """A copy with one scene, so that it can be changed."""
    out = tmp_path / "nuplan"
    shutil.copytree(nuplan_reference / "maps", out / "maps")
    (out / "logs").mkdir()
    (out / "expected").mkdir()
    name = "s06_right_turn_ped"
    shutil.copy(nuplan_reference / "logs" / f"{name}.db", out / "logs")
    scenes = json.loads((nuplan_reference / "scenes.json").read_text())
    (out / "scenes.json").write_text(json.dumps([s for s in scenes if s["scene"] == name]))
    keep_scene(nuplan_reference / "scripted.parquet", out / "scripted.parquet", name)
    for table in ("log_ego", "objects", "traffic_lights"):
        keep_scene(source_table(nuplan_reference, table), source_table(out, table), name)
    for table in ("map_objects", "map_lines"):
        shutil.copy(source_table(nuplan_reference, table), source_table(out, table))
    queries = pq.read_table(source_table(nuplan_reference, "map_queries"))
    pq.write_table(queries.take(list(range(0, len(queries), 20))), source_table(out, "map_queries"))
    meta = json.loads((nuplan_reference / "expected" / "scenario_meta.json").read_text())
    (out / "expected" / "scenario_meta.json").write_text(json.dumps({name: meta[name]}))
    return out


def source_table(folder: Path, name: str) -> Path:
    return folder / "expected" / f"{name}.parquet"


def keep_scene(source: Path, target: Path, name: str) -> None:
    pq.write_table(pq.read_table(source, filters=[("scene", "=", name)]), target)


def verify(folder: Path) -> Report:
    report = Report()
    verify_nuplan_import(folder, report)
    return report


def changed(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, bytes):
        return value[:60] + bytes([value[60] ^ 0x10]) + value[61:]
    if isinstance(value, str):
        return "{}" if value.startswith("{") else value + "1"
    if isinstance(value, list):
        return value[:-1]
    return value + 1


def change_cell(path: Path, column: str) -> None:
    table = pq.read_table(path)
    values = table[column].to_pylist()
    row = next(i for i, v in enumerate(values) if v not in ("", None))
    values[row] = changed(values[row])
    index = table.column_names.index(column)
    pq.write_table(table.set_column(index, column, pa.array(values, table[column].type)), path)


CELLS = [
    (table, column)
    for table, columns in {
        "map_objects": "map layer id attributes polygon_wkb",
        "map_lines": "map layer id line index x y heading",
        "map_queries": "map x LANE LANE_CONNECTOR ROADBLOCK INTERSECTION CROSSWALK in_INTERSECTION"
        " in_DRIVABLE_AREA drivable_area_distance nearest_lane nearest_lane_distance"
        " lane_arc_length lane_pose_x lane_pose_heading lane_curvature near20_LANE"
        " near20_LANE_CONNECTOR near20_STOP_LINE",
        "log_ego": "kind index time_us x heading vx ay tire_steering_angle angular_velocity"
        " center_y",
        "objects": "iteration track_token type x heading length height vx",
        "traffic_lights": "iteration lane_connector_id status timestamp",
    }.items()
    for column in columns.split()
]


def test_the_whole_reference_is_equal(nuplan_reference: Path) -> None:
    report = verify(nuplan_reference)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.num_cases > 4000


@pytest.mark.thorough
@pytest.mark.slow
def test_every_changed_cell_is_noticed(folder: Path) -> None:
    maps = Scenes(folder).maps

    def check_maps() -> tuple[list[str], dict[str, int]]:
        report = Report()
        verify_maps(folder / "expected", maps, report)
        return report.mismatches, report.not_covered

    def check_logs() -> tuple[list[str], dict[str, int]]:
        report = verify(folder)
        return report.mismatches, report.not_covered

    for check, is_map in ((check_maps, True), (check_logs, False)):
        clean = check()
        assert clean[0] == []
        for table, column in (cell for cell in CELLS if cell[0].startswith("map_") == is_map):
            path = source_table(folder, table)
            original = path.read_bytes()
            change_cell(path, column)
            assert check() != clean, f"{table}.{column}"
            path.write_bytes(original)
        for table in ("map_objects", "map_lines", "map_queries"):  # not needed for the logs
            source_table(folder, table).unlink(missing_ok=True)


def edit_json(path: Path, change: Callable[[Any], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.thorough
def test_every_changed_scene_fact_is_noticed(folder: Path) -> None:
    path = folder / "expected" / "scenario_meta.json"
    for field in json.loads(path.read_text())["s06_right_turn_ped"]:
        original = path.read_bytes()
        edit_json(
            path,
            lambda c, f=field: c["s06_right_turn_ped"].update(
                {f: changed(c["s06_right_turn_ped"][f])}
            ),
        )
        assert verify(folder).exit_code() == 1, field
        path.write_bytes(original)


@pytest.mark.thorough
def test_every_changed_manifest_entry_is_noticed(folder: Path) -> None:
    path = folder / "scenes.json"
    fields = set(json.loads(path.read_text())[0]) - {"scene", "db", "map", "token"}
    for field in sorted(fields):
        original = path.read_bytes()
        edit_json(path, lambda c, f=field: c[0].update({f: changed(c[0][f])}))
        assert verify(folder).exit_code() == 1, field
        path.write_bytes(original)


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE lidar_box SET x = x + 1e-5",
        "UPDATE lidar_box SET length = length + 1e-9",
        "UPDATE ego_pose SET acceleration_x = acceleration_x + 1e-9",
        "UPDATE traffic_light_status SET status = 'yellow'",
        "UPDATE scene SET roadblock_ids = '1 2'",
        "UPDATE scenario_tag SET type = 'changing_lane'",
        "DELETE FROM track WHERE rowid = 1",
    ],
)
def test_a_changed_log_is_noticed(statement: str, folder: Path) -> None:
    connection = sqlite3.connect(next((folder / "logs").iterdir()))
    connection.execute(statement)
    connection.commit()
    connection.close()
    assert verify(folder).exit_code() == 1


def test_extra_files_columns_and_rows_are_named(folder: Path) -> None:
    shutil.copy(next((folder / "logs").iterdir()), folder / "logs" / "other.db")
    table = pq.read_table(source_table(folder, "log_ego"))
    pq.write_table(
        table.append_column("extra", pa.array([0.0] * len(table))), source_table(folder, "log_ego")
    )
    named = " ".join(verify(folder).not_covered)
    assert "other.db" in named
    assert "'extra'" in named


def test_the_tiny_world_is_equal_in_all_fields() -> None:
    report = Report()
    verify_nuplan_format(GOLDEN, report)
    assert report.exit_code(require_all=True) == 0
    assert report.num_cases >= 18


@pytest.mark.thorough
def test_every_changed_field_of_the_tiny_world_is_noticed(tmp_path: Path) -> None:
    copy = tmp_path / "format"
    shutil.copytree(GOLDEN, copy)
    path = copy / "devkit_readback.json"
    original = path.read_text()
    for field, value in json.loads(original).items():
        names = list(value) if isinstance(value, dict) else [None]
        for name in names:
            edit_json(path, lambda c, f=field, n=name: _change(c, f, n))
            report = Report()
            verify_nuplan_format(copy, report)
            assert report.exit_code() == 1, (field, name)
            path.write_text(original)


def _change(content: dict[str, Any], field: str, name: str | None) -> None:
    owner, key = (content, field) if name is None else (content[field], name)
    value = owner[key]
    owner[key] = ["9"] if value == [] else changed(value)
