"""Tables of what is compared with what: where ours is, tolerances, texts, cases of files."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from shiftsim.verify import tables
from shiftsim.verify.files import Source
from shiftsim.verify.report import ERRORS, Report
from shiftsim.verify.tables import Table, read_tables, verify_cases


class Lane:
    edges = (SimpleNamespace(id="E1", ends=[1, 2]), None)

    def roadblock(self):
        return SimpleNamespace(id="B7")


ROAD = SimpleNamespace(blocks=SimpleNamespace(ids=["B0", "B1", "B2"]))
NAMES = {
    "road": ROAD,
    "tracks": SimpleNamespace(tokens=("t0", "t1")),
    "step": SimpleNamespace(best=2, poses=np.arange(6.0).reshape(2, 3)),
    "third": 2,
    "made": {"lanes": [4, 5, 6], "lanes in it": 3},
    "chosen": np.array([2, 0]),
    "lane": Lane(),
}


def compared(rows, theirs, **names):
    report = Report()
    Table(rows).match(Source("file", "array", theirs, report), "case 0", **NAMES, **names)
    return report


@pytest.mark.parametrize(
    ("row", "value", "other"),
    [
        ("step.best", 2, 3),
        ("made[lanes in it]", 3, 4),
        ("made.lanes", [4, 5, 6], [4, 5, 7]),
        ("made.lanes[third]", 6, 5),
        ("step.poses.T[chosen][0]", [2.0, 5.0], [0.0, 3.0]),
        ("step.poses.max", 5.0, 4.0),
        ("step.poses[1, 2]", 5.0, 5.1),
        ("step.poses[-1]", [3.0, 4.0, 5.0], [3.0, 4.0, 5.1]),
        ("step.poses[:, :2]", [[0.0, 1.0], [3.0, 4.0]], [[0.0, 1.0], [3.0, 4.1]]),
        ("number of made.lanes", 3, 4),
        ("blocks of step.best", "B2", "B1"),
        ("blocks of chosen", ["B2", "B0"], ["B0", "B2"]),
        ("tracks of made.lanes[:0]", [], ["t0"]),
        ("lane.edges[:1][*].ends", [[1, 2]], [[1, 3]]),
        ("lane.edges[:1][*].ends[*]", [1, 2], [2, 1]),
        ("ids of lane.edges", ["E1", None], ["E1", "E2"]),
        ("ids of lane.roadblock", "B7", "B8"),
        ("= planner {step.best}", "planner 2", "planner 3"),
        ("= planner *", "planner of somebody", "a planner"),
        ("= *", "anything", 7),
        (41, 41, 42),
        ({"lanes": "made.lanes", "text": "= *"}, {"lanes": [4, 5, 6], "text": "?"}, {"lanes": []}),
    ],
)
def test_a_row_says_where_ours_is(row, value, other):
    assert compared({"x": row}, {"x": value}).mismatches == []
    assert compared({"x": row}, {"x": other}).mismatches
    assert compared({"x": row}, {}).mismatches


def test_a_row_may_have_a_tolerance_of_its_own():
    rows = {"*": {"atol": 1e-3}, "a": "step.poses[0]", "b": ["step.poses[0]", [0.0, 0.0, 0.1]]}
    near, far = np.array([0.0, 1.0, 2.01]), np.array([0.01, 1.0, 2.0])
    assert len(compared(rows, {"a": near, "b": near}).mismatches) == 1
    assert compared(rows, {"a": near, "b": near}).mismatches[0].startswith("file a")
    assert len(compared(rows, {"a": far, "b": far}).mismatches) == 2


def test_a_tolerance_may_depend_on_the_variant():
    rows = {"x": ["step.poses[0, 1]", {"base": 1e-3, "drive": 1e-1}]}
    assert compared(rows, {"x": 1.01}, variant="base").mismatches
    assert compared(rows, {"x": 1.01}, variant="drive").mismatches == []


def test_a_tolerance_may_be_computed():
    rows = {"x": ["step.poses[0]", "gap"]}
    gap = np.array([0.1, 0.1, 0.0])
    assert compared(rows, {"x": [0.05, 1.05, 2.0]}, gap=gap).mismatches == []
    assert compared(rows, {"x": [0.05, 1.05, 2.05]}, gap=gap).mismatches


def test_values_may_be_angles_and_lists_without_an_order():
    rows = {
        "*": {"angles": ["turn"], "unordered": ["lanes"], "atol": 1e-9},
        "turn": "turn",
        "lanes": "made.lanes",
    }
    theirs = {"turn": 0.5 - 2.0 * np.pi, "lanes": [6, 5, 4]}
    assert compared(rows, theirs, turn=0.5).mismatches == []
    assert len(compared(rows, theirs | {"lanes": [6, 5, 5]}, turn=0.6).mismatches) == 2


def test_rows_of_an_optional_section_may_be_missing_and_not_differ():
    rows = {"*": {"optional": True, "called": "PDM"}, "x": "step.best", "y": "step.best"}
    report = compared(rows, {"y": 3})
    assert [line.split(":")[0] for line in report.mismatches] == ["PDM y"]


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("x[:, :2]", "step.poses[:, :2]"),
        ("x[..., 2]", "step.poses[..., 2]"),
        ("x[1]", "step.poses[1]"),
    ],
)
def test_a_row_may_be_of_a_part_of_a_value(name, path):
    theirs = np.arange(6.0).reshape(2, 3)
    assert compared({name: path}, {"x": theirs}).mismatches == []
    report = compared({name: path}, {"x": theirs + 1.0})
    assert list(report.quantities) == [f"file {name}"]
    assert len(report.mismatches) == 1
    assert compared({name: path}, {}).mismatches


def test_what_is_beside_the_compared_part_is_not_compared():
    theirs = np.arange(6.0).reshape(2, 3) + np.array([0.0, 0.0, 1.0])
    assert compared({"x[:, :2]": "step.poses[:, :2]"}, {"x": theirs}).mismatches == []


def cases_of(path, compare):
    report = Report()
    verify_cases(compare, path, report)
    return report


@pytest.mark.parametrize("numbered", [False, True])
def test_cases_are_the_rows_or_the_numbered_arrays_of_a_file(tmp_path, numbered):
    rows = {"x": np.arange(3.0), "y": np.arange(3.0) ** 2}
    parts = {f"{i}_{name}": array[i] for name, array in rows.items() for i in range(3)}
    np.savez(tmp_path / "file.npz", **(parts if numbered else rows))
    report = cases_of(
        tmp_path / "file.npz", lambda case, where: case.match(where, {"y": case["x"] * 2.0})
    )
    assert [line.split(":")[1].strip() for line in report.mismatches] == ["file 1"]
    assert report.num_cases == 3
    assert report.not_covered == {}


@pytest.mark.parametrize("short", ["x", "y"])
def test_an_array_with_fewer_rows_is_a_mismatch_and_one_that_nothing_reads_is_named(
    tmp_path, short
):
    arrays = {"x": np.arange(3.0), "y": np.arange(3.0), "more": np.zeros(1)}
    np.savez(tmp_path / "file.npz", **{**arrays, short: arrays[short][:2]})
    report = cases_of(
        tmp_path / "file.npz", lambda case, where: case.match(where, {"y": case["x"]})
    )
    assert len(report.mismatches) == 1
    assert list(report.not_covered) == ["file: array 'more'"]


def test_rows_between_two_numbers_of_a_pointer_are_one_case(tmp_path):
    lines = np.arange(5.0)
    np.savez(tmp_path / "file.npz", x=[1.0, 9.0], line_ptr=[0, 2, 5], line_x=lines)
    report = cases_of(
        tmp_path / "file.npz", lambda case, where: case.match(where, {"x": case["line_x"].sum()})
    )
    assert (report.num_cases, report.mismatches, report.not_covered) == (2, [], {})
    np.savez(tmp_path / "file.npz", x=[1.0, 9.0], line_ptr=[0, 2, 4], line_x=lines)
    with pytest.raises(ERRORS, match="has 5 rows, which are not those of 2 cases"):
        cases_of(tmp_path / "file.npz", lambda case, where: None)


def test_an_array_without_a_number_among_those_with_one_is_refused(tmp_path):
    np.savez(tmp_path / "file.npz", **{"0_x": [1], "y": [1]})
    with pytest.raises(ERRORS, match="invalid literal"):
        cases_of(tmp_path / "file.npz", lambda case, where: None)


def test_a_case_that_fails_is_a_mismatch_and_the_others_are_compared(tmp_path):
    path = tmp_path / "file.json"
    path.write_text(json.dumps([{"x": 1}, {"y": 1}, {"x": 2, "z": 3}]))
    report = cases_of(path, lambda case, where: case.match(where, {"x": case["x"]}))
    assert len(report.mismatches) == 1
    assert report.num_cases == 3
    assert set(report.not_covered) == {"file.json: field 'y'", "file.json: field 'z'"}


def test_a_table_is_read_from_beside_the_module(tmp_path):
    (tmp_path / "part.toml").write_text('[ends]\n"*" = { atol = 1e-9 }\n"a/b" = "line[-1]"\n')
    tables = read_tables(str(tmp_path / "part.py"))
    assert tables["ends"].rows == {"a/b": "line[-1]"}
    assert tables["ends"].about["atol"] == 1e-9


EXAMPLES = {
    "start_block": ({"road": ROAD, "route": SimpleNamespace(start=SimpleNamespace(block=1))}, "B1"),
    "type": ({"contacts": [SimpleNamespace(kind="CAR")]}, ["CAR"]),
    "incoming": ({"lane": SimpleNamespace(incoming_edges=[SimpleNamespace(id="E0")])}, ["E0"]),
    "route": ({"route": [["B0", "B1"], ["B2"]]}, ["B0,B1", "B2"]),
    "n_centerline": ({"line": np.zeros((4, 3))}, 4),
    "centerline_last": ({"line": np.eye(3)}, [1e-7, 0.0]),
    "poses": ({"poses": np.zeros((2, 3))}, [[1e-3, 1e-3, 1e-4], [0.0, 0.0, 0.0]]),
    "ends[..., :2]": ({"line": np.eye(3)}, [[0.0, 1.0, 9.0], [0.0, 0.0, 9.0]]),
    "score": ({"variant": "drive", "score": 0.5}, 0.50005),
    "x": ({"line": SimpleNamespace(x=1.0), "gap": 0.5}, 1.25),
    "roads": ({"counts": {"road with trams": 2}}, 2),
    "category": ({"categories": ["car", "van"], "track": 1}, "van"),
    "best_score": ({"scores": np.array([0.5, 0.75])}, 0.75),
    "planner": ({}, "PDM-Closed of anybody"),
    "samples": ({}, 41),
}


@pytest.mark.parametrize("name", read_tables(tables.__file__)["routes"].rows)
def test_the_examples_of_rows_mean_what_they_say(name):
    section, (names, value) = read_tables(tables.__file__)["routes"], EXAMPLES[name]
    report, stored = Report(), np.asarray(value) if isinstance(value, list) else value
    one = Table({"*": section.about, name: section.rows[name]})
    one.match(Source("file", "array", {name.partition("[")[0]: stored}, report), "case", **names)
    assert report.mismatches == []
    assert report.num_cases == 1


def test_a_later_table_adds_rows_and_replaces_those_of_the_same_name(tmp_path):
    (tmp_path / "first.toml").write_text('[a]\n"*" = { atol = 1.0 }\nx = "p"\ny = { u = 1 }\n')
    (tmp_path / "second.toml").write_text('[a]\nx = "q"\ny = { v = 2 }\n[b]\nz = "r"\n')
    tables = read_tables(str(tmp_path / "first.py"), str(tmp_path / "second.py"))
    assert tables["a"].rows == {"x": "q", "y": {"u": 1, "v": 2}}
    assert tables["a"].about["atol"] == 1.0
    assert tables["b"].rows == {"z": "r"}
