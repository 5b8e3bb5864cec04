"""A planner that leaves the process, wherever it does, costs a task or is refused; never a run."""

import asyncio
import sys

import pytest

import shiftsim
from shiftsim.cli import main
from shiftsim.planners.basic import ConstantVelocity

BAD = "0001cafe"
MODULE = """
import sys
from shiftsim.planners.basic import ConstantVelocity
{0}
class Mine(ConstantVelocity):
    def __init__(self):
        {1}
    def close(self):
        {2}
"""


class Leaving(ConstantVelocity):
    """Raises in one scenario what is no Exception."""

    def __init__(self, error, method):
        self.error, self.method = error, method

    def reset(self, scene):
        super().reset(scene)
        self.is_bad = scene.token == BAD
        if self.is_bad and self.method == "reset":
            raise self.error

    def plan(self, observation):
        if self.is_bad and self.method == "plan":
            raise self.error
        return super().plan(observation)


class Own(BaseException):
    pass


@pytest.mark.parametrize("method", ["reset", "plan"])
@pytest.mark.parametrize(
    "error", [SystemExit(0), SystemExit("bye"), asyncio.CancelledError(), Own("own")]
)
def test_a_planner_that_leaves_fails_its_task(toy, tmp_path, caplog, error, method):
    planner = Leaving(error, method)
    run = shiftsim.run(planner, store=str(toy), workers=1, out=str(tmp_path / "run"))
    assert (run.manifest["counts"]["ok"], run.manifest["counts"]["failed"]) == (3, 1)
    (row,) = (row for row in run.tasks.to_pylist() if row["status"] == "failed")
    assert row["token"] == BAD
    assert type(error).__name__ in row["error"]
    assert ("(at iteration 0)" in row["error"]) == (method == "plan")
    assert f"1 of 4 tasks failed, the first: constant-velocity none: {row['error']}" in caplog.text


@pytest.mark.parametrize(
    ("place", "code", "text"),
    [
        (0, 1, "cannot be imported (SystemExit: 0"),
        (1, 1, "cannot be made: SystemExit: 0"),
        (2, 0, "results: run"),
    ],
    ids=["import", "constructor", "close"],
)
def test_a_module_that_leaves_says_so(toy, tmp_path, monkeypatch, capsys, place, code, text):
    parts = ["pass", "pass", "pass"]
    parts[place] = "sys.exit(0)"
    (tmp_path / f"leaving_{place}.py").write_text(MODULE.format(*parts))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    words = ["-p", f"leaving_{place}:Mine", "-s", str(toy), "--workers", "1", "--out", "run"]
    with pytest.raises(SystemExit) as end:
        main(["run", *words])
    shown = capsys.readouterr()
    assert (end.value.code, text in shown.out + shown.err) == (code, True)
