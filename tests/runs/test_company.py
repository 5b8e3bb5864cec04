"""Scores do not depend on which scenarios a planner has driven before."""

import json
import os
import sys
from pathlib import Path

import pytest
from commands import call

import shiftsim
from shiftsim.planners.contract import check_planner

pytestmark = pytest.mark.thorough

FOLDER = str(Path(__file__).parent)
sys.path.append(FOLDER)
RESULTS = ("scores.parquet", "metrics.parquet")


@pytest.mark.parametrize("planner", ["drivers:Remembers", "instance"])
def test_a_planner_that_remembers_scores_the_same_with_any_number_of_workers(
    planner, toy, tmp_path
):
    import drivers

    source = drivers.Remembers() if planner == "instance" else planner
    paths = []
    for workers in (1, 2, 4):
        out = str(tmp_path / str(workers))
        paths.append(shiftsim.run(source, store=str(toy), workers=workers, out=out).path)
    for name in RESULTS:
        assert len({(path / name).read_bytes() for path in paths}) == 1


def test_the_check_names_a_planner_whose_class_remembers(toy):
    import drivers

    store = shiftsim.open_store(str(toy))
    scenes = [store.read(token) for token in store.tokens[:2]]

    alone = check_planner(drivers.RemembersInItsClass, scenes[0])
    assert "company" not in [found.check for found in alone]
    findings = check_planner(drivers.RemembersInItsClass, *scenes)
    (found,) = [found for found in findings if found.severity == "error"]
    assert found.check == "company"
    assert f"after scenario {scenes[1].token} the planner differs at iteration 0" in found.message


@pytest.mark.parametrize("workers", ["1", "2"])
def test_what_planners_print_does_not_mix_with_json(workers, toy, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*sys.path]))
    words = ["--store", str(toy), "--out", str(tmp_path / "run"), "--workers", workers]
    done = call(tmp_path, "run", "--planner", "drivers:Remembers", "--json", *words)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)
    assert "made" in done.stderr
    assert done.stderr.count("as a library writes") == 4


def test_what_a_planner_prints_while_it_is_checked_does_not_mix_with_json(
    toy, tmp_path, monkeypatch
):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*sys.path]))
    done = call(tmp_path, "planners", "check", "drivers:Remembers", "--store", str(toy), "--json")
    assert "survives reset" in [found["check"] for found in json.loads(done.stdout)]
    assert "as a library writes" in done.stderr
