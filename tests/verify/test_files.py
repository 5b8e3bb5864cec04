"""Files of references: how they are called, and that whatever nothing uses is named."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shiftsim.verify.files import Groups, Source, verify_files
from shiftsim.verify.report import Report


def compare_x(file: Source, where: str) -> None:
    file.match(where, {"x": 1.0 if file.what == "field" else [1.0]})


def write_json(folder, **fields):
    (folder / "file_07.json").write_text(json.dumps(fields))


def write_arrays(folder, **arrays):
    np.savez(folder / "file_07.npz", **{name: [value] for name, value in arrays.items()})


def write_table(folder, **columns):
    table = pa.table({name: [value] for name, value in columns.items()})
    pq.write_table(table, folder / "file_07.parquet")


def verified(folder):
    report = Report()
    verify_files(folder, report, {"note.txt": None}, {"*": compare_x})
    return report


@pytest.mark.parametrize("write", [write_json, write_arrays, write_table])
def test_quantities_are_named_without_the_number_of_the_file_and_cases_with_it(tmp_path, write):
    write(tmp_path, x=2.0, y=3.0)
    report = verified(tmp_path)
    (line,) = report.mismatches
    assert line.startswith("file x: file_07: 1.0, not 2.0")
    (unused,) = report.not_covered
    assert unused.startswith("file: ")
    assert unused.endswith("'y'")


def test_columns_of_an_empty_table_are_not_missed(tmp_path):
    table = pa.table({"x": [1.0], "y": [2.0]}).slice(1)
    pq.write_table(table, tmp_path / "file.parquet")
    report = Report()
    verify_files(tmp_path, report, {}, {"*.parquet": lambda file, where: None})
    assert report.not_covered == {}


def test_a_list_in_a_json_file_is_one_field(tmp_path):
    (tmp_path / "file.json").write_text(json.dumps([{"x": 1}, {"x": 3, "y": 0}]))
    report = Report()

    def compare(file, where):
        for row in file.each("rows"):
            row.match(where, {"x": 1})

    verify_files(tmp_path, report, {}, {"*.json": compare})
    assert report.mismatches == ["file rows x: file: 1, not 3"]
    assert list(report.not_covered) == ["file rows: field 'y'"]


def test_files_without_a_part_are_named_and_what_breaks_a_part_is_a_mismatch(tmp_path):
    (tmp_path / "note.txt").write_text("of a person")
    (tmp_path / "broken.json").write_text("{")
    report = verified(tmp_path)
    assert report.informative == ["note.txt (for reading)"]
    assert "cannot be compared" in report.mismatches[0]
    report = Report()
    verify_files(tmp_path, report, {})
    assert set(report.not_covered) == {"file note.txt", "file broken.json"}


@pytest.mark.parametrize(
    ("key", "missed"),
    [
        (("scene", "challenge"), ["table: rows of a NR"]),
        (("scene",), ["table: rows of a", "table: rows of b"]),
    ],
)
def test_only_rows_of_runs_are_limited_to_a_mode(key, missed):
    report = Report("NR")
    rows = {"scene": ["a", "b"], "challenge": ["NR", "R"]}
    columns = {name: np.array(values, object) for name, values in rows.items()}
    Groups(Source("table", "column", columns, report), key).finish()
    assert list(report.not_covered) == missed
