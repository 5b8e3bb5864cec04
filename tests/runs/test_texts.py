"""Texts of planners, metrics and people cannot destroy results."""

import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import call
from stores import write_toy_store

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.review import REVIEW, Review, Reviews, read_reviews, write_reviews
from shiftsim.errors import DataError, readable
from shiftsim.metrics.result import MetricRow
from shiftsim.planners.basic import ConstantVelocity

HALF = "half \ud800 a pair"


class Hinting(shiftsim.ShiftsimError):
    def __init__(self, message="wrong", hint=7):
        super().__init__(message, hint)


class Numbered(RuntimeError):
    hint = b"\xff"


class Raising(ConstantVelocity):
    """Raises what it was given in one scenario."""

    def __init__(self, name):
        self.error = name

    def reset(self, scene):
        super().reset(scene)
        if scene.token == "0001cafe":
            raise ERRORS[self.error][0]


ERRORS = {
    "half a pair": (RuntimeError(HALF), r"RuntimeError: half \ud800 a pair"),
    "a number as hint": (Hinting(), "wrong"),
    "bytes as hint": (Numbered("wrong"), "Numbered: wrong"),
    "a zero byte": (RuntimeError("a\0b"), "RuntimeError: a\0b"),
    "a long one": (RuntimeError("x" * 10_000_000), "RuntimeError: xxxxx"),
    "bytes": (RuntimeError(b"\xff"), r"RuntimeError: b'\xff'"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_of_any_text_fails_its_task_and_nothing_else(toy, tmp_path, name):
    _, text = ERRORS[name]
    settings = {"store": str(toy), "workers": 1, "out": str(tmp_path / "run")}
    run = shiftsim.run(Raising(name), **settings)
    assert run.manifest["counts"] | {"missing": 0} == run.manifest["counts"]
    assert (run.manifest["counts"]["ok"], run.manifest["counts"]["failed"]) == (3, 1)
    (row,) = (row for row in run.tasks.to_pylist() if row["status"] == "failed")
    assert row["error"].startswith(text)
    assert len(row["error"]) < 200_000
    assert isinstance(row["hint"], str)
    again = shiftsim.run(Raising(name), **settings, retry_failed=True)
    assert again.scores.equals(run.scores)


def test_readable_keeps_what_is_text():
    assert readable("a\u2028b\r\0é") == "a\u2028b\r\0é"


def half(log, road):
    return MetricRow(HALF, None, 1.0, "", None, None)


def word(log, road):
    return MetricRow("word", None, "much", "", None, None)


def array(log, road):
    return MetricRow("array", None, np.zeros(3), "", None, None)


@pytest.mark.parametrize("metric", ["half", "word", "array"])
def test_a_metric_that_no_table_can_hold_fails_its_tasks(toy, tmp_path, metric, monkeypatch):
    monkeypatch.setattr("shiftsim.runs.task.compute_metrics", _with(globals()[metric]))
    run = shiftsim.run("constant-velocity", store=str(toy), workers=1, out=str(tmp_path / "run"))
    assert run.manifest["counts"]["failed"] == 4
    assert "metrics.parquet cannot hold" in run.tasks["error"][0].as_py()


def _with(metric):
    def compute(log, road, *, thresholds, own):
        return shiftsim.score(log, road, thresholds=thresholds, own=[metric])

    return compute


@pytest.mark.thorough
def test_a_folder_whose_name_is_no_text_can_hold_runs(toy, tmp_path):
    folder = tmp_path / os.fsdecode(b"a\xff")
    store = write_toy_store(tmp_path / "toy")
    folder.mkdir()
    done = call(folder, "run", "-p", "constant-velocity", "-s", str(store), "--out", "run")
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "run" / "manifest.json").read_text("utf-8"))["run"] == "run"


@pytest.mark.parametrize(
    "comment", ["a\u2028b", "a\u2029b", "a\x85b", "a\x0bb\x0cc\x1cd", "a\r\nb", HALF, "a\0b"]
)
def test_a_comment_of_any_text_comes_back(tmp_path, comment):
    store = write_toy_store(tmp_path / "toy")
    write_reviews(
        store, Reviews([Review("0001cafe", comment=comment), Review("0002cafe", "reject")])
    )
    found = read_reviews(store)
    assert (found["0001cafe"].comment, found["0002cafe"].decision) == (comment, "reject")


def test_bytes_that_are_no_text_are_named_by_line(tmp_path):
    store = write_toy_store(tmp_path / "toy")
    write_reviews(store, Reviews([Review("0001cafe", "reject")]))
    with (store / REVIEW).open("ab") as file:
        file.write(b'{"token": "0002cafe", "comment": "\xff"}\n')
    with pytest.raises(DataError, match=r"review\.jsonl: line 2: not JSON: .*0xff"):
        read_reviews(store)


@pytest.mark.parametrize("column", ["token", "type"])
def test_a_table_of_a_store_that_is_no_text_is_damaged(tmp_path, column):
    store = write_toy_store(tmp_path / "toy")
    path = store / "scenarios.parquet"
    table = pq.read_table(path)
    bad = pa.array([b"\xff"] * len(table), pa.binary()).view(pa.string())
    at = table.schema.get_field_index(column)
    pq.write_table(table.set_column(at, table.schema.field(at), bad), path)
    with pytest.raises(DataError, match=r"scenarios\.parquet: damaged: .*UTF8"):
        open_store(store)


def test_a_table_of_a_run_that_is_no_text_is_damaged(clean_run, tmp_path):
    import shutil

    run = shutil.copytree(clean_run.path, tmp_path / "run")
    table = pq.read_table(run / "scores.parquet")
    bad = pa.array([b"\xff"] * len(table), pa.binary()).view(pa.string())
    pq.write_table(table.set_column(0, table.schema.field(0), bad), run / "scores.parquet")
    with pytest.raises(DataError, match=r"scores\.parquet' cannot be read: .*UTF8"):
        _ = shiftsim.open_run(run).scores
