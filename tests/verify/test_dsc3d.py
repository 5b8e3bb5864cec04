import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shiftsim.verify.dsc3d import verify_dsc3d_sample, verify_dsc3d_synthetic
from shiftsim.verify.report import Report

pytestmark = pytest.mark.golden


def _copy(source, target):
    shutil.copytree(source, target, copy_function=shutil.copyfile)
    for path in [target, *target.rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)
    return target


def _shift(path, column):
    table = pq.read_table(path)
    values = table[column].to_numpy().copy()
    values[len(values) // 2] += 0.1
    at = table.column_names.index(column)
    field = table.schema.field(at)
    pq.write_table(table.set_column(at, field, pa.array(values, field.type)), path)


def test_the_sample_is_read_as_expected(shared):
    report = Report()
    verify_dsc3d_sample(shared / "reference/dsc3d_sample", report)
    assert report.exit_code(require_all=True) == 0, report.lines()


@pytest.mark.slow
def test_scripted_recordings_are_converted_as_expected(shared):
    report = Report()
    verify_dsc3d_synthetic(shared / "reference/dsc3d_synthetic", report, shared / "maps")
    assert report.exit_code(require_all=True) == 0, report.lines()


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("expected_rows.parquet", "yaw"),
        ("expected_rows.parquet", "lat"),
        ("expected_20hz.parquet", "vx"),
        ("data/annotations/2000-12-31T23-59-59/annotations.parquet", "translation_x"),
        ("data/annotations/2000-12-31T23-59-59/annotations.parquet", "rotation_z"),
        ("data/annotations/2000-12-31T23-59-59/annotations.parquet", "velocity_y"),
    ],
)
def test_a_changed_value_of_the_sample_is_found(shared, tmp_path, name, column):
    folder = _copy(shared / "reference/dsc3d_sample", tmp_path / "sample")
    _shift(folder / name, column)
    report = Report()
    verify_dsc3d_sample(folder, report)
    assert report.mismatches


def test_a_changed_number_of_the_summary_is_found(shared, tmp_path):
    folder = _copy(shared / "reference/dsc3d_sample", tmp_path / "sample")
    path = folder / "expected.json"
    content = json.loads(path.read_text())
    content["tracks"]["3"]["path_length_xy"] += 0.01
    path.write_text(json.dumps(content))
    report = Report()
    verify_dsc3d_sample(folder, report)
    assert report.mismatches


def test_changed_answers_of_a_scripted_recording_are_found(shared, tmp_path):
    folder = _copy(shared / "reference/dsc3d_synthetic/mona_15hz", tmp_path / "mona")
    path = folder / "expected.json"
    content = json.loads(path.read_text())
    content["windows"][1]["verdict"]["10"] = "ego"
    content["windows"][2]["lanes_from_t0"]["1"][0][2] += 1
    path.write_text(json.dumps(content))
    _shift(folder / "expected_ego_20hz.parquet", "y_local")
    report = Report()
    verify_dsc3d_synthetic(folder, report, shared / "maps")
    found = {line.partition(":")[0] for line in report.mismatches}
    assert found == {"verdict", "lanes", "20 Hz position"}
    assert np.isfinite(report.quantities["20 Hz position"].max_error)
