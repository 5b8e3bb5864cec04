"""Whole runs with planners written for nuPlan: the command line, several workers, the contract."""

import copy
import pickle
import shutil

import numpy as np
import places
import pyarrow.parquet as pq
import pytest
from commands import call
from worlds import cruise_scenario

import shiftsim
from shiftsim.compat import nuplan
from shiftsim.planners.registry import run_planner

nuplan.install()
import nuplan_planners as planners  # noqa: E402  # the names must exist first

PAGE = places.TESTS / "nuplan_planners.py"


def _scores(folder, planner):
    rows = pq.read_table(folder / "scores.parquet").to_pylist()
    return {row["token"]: row["cls"] for row in rows if row["planner"] == planner}


@pytest.mark.thorough
def test_the_command_line_drives_a_planner_of_the_present_folder(toy, tmp_path):
    shutil.copy(PAGE, tmp_path / "mine.py")
    name = "nuplan:mine:Coast"
    words = ("--planner", name, "--planner", "constant-velocity", "--planner-arg")
    argument = f"{name}.horizon=8"
    store = ("--store", str(toy), "--workers", "2", "--out", "out")
    done = call(tmp_path, "run", *words, argument, *store)
    assert done.returncode == 0, done.stderr
    theirs = _scores(tmp_path / "out", "Coast")
    assert len(theirs) == 4
    assert theirs == pytest.approx(_scores(tmp_path / "out", "constant-velocity"), abs=1e-9)


@pytest.mark.parametrize(
    "planner",
    [
        "nuplan_pdm_like:PdmLike",
        pytest.param("nuplan_plantf_like:PlanTfLike", marks=pytest.mark.learned),
    ],
)
@pytest.mark.thorough
def test_planners_with_the_imports_of_public_ones_drive(toy, tmp_path, planner):
    module = planner.partition(":")[0]
    shutil.copy(places.TESTS / f"{module}.py", tmp_path)
    words = ("--planner", f"nuplan:{planner}", "--store", str(toy), "--workers", "1")
    done = call(tmp_path, "run", *words, "--limit", "1", "--out", "out")
    assert done.returncode == 0, done.stderr
    (task,) = pq.read_table(tmp_path / "out/tasks.parquet").to_pylist()
    assert (task["status"], task["error"]) == ("ok", "")


@pytest.mark.thorough
def test_the_command_line_checks_the_contract(toy, tmp_path):
    shutil.copy(PAGE, tmp_path / "mine.py")
    done = call(tmp_path, "planners", "check", "nuplan:mine:FollowRoute", "--store", str(toy))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.thorough
def test_an_instance_travels_to_workers(toy, tmp_path):
    run = shiftsim.run(
        [nuplan.wrap(planners.Coast(horizon=8.0)), "constant-velocity"],
        store=str(toy),
        workers=2,
        out=str(tmp_path / "run"),
    )
    wanted = pytest.approx(_scores(run.path, "constant-velocity"), abs=1e-9)
    assert _scores(run.path, "Coast") == wanted


def test_a_copy_drives_like_the_original():
    scenario = cruise_scenario(iterations=10)
    wrapped = nuplan.wrap(planners.Coast, horizon=4.0)
    wanted = shiftsim.simulate(scenario, wrapped).ego
    for twin in (copy.deepcopy(wrapped), pickle.loads(pickle.dumps(wrapped))):
        np.testing.assert_array_equal(shiftsim.simulate(scenario, twin).ego, wanted)


def test_a_planner_of_the_main_script_stays_at_home(monkeypatch):
    class Mine(planners.Coast):
        pass

    monkeypatch.setattr(Mine, "__module__", "__main__")
    entry = run_planner(nuplan.wrap(Mine()), {})
    assert entry.name == "Mine"
    assert not entry.can_travel
    assert shiftsim.simulate(cruise_scenario(iterations=5), entry.make()).ego.shape == (4, 11)


def test_a_planner_without_a_name_is_called_as_its_class():
    class Silent(planners.Coast):
        def name(self):
            return None

    assert nuplan.wrap(Silent).name == "Silent"


def test_the_contract_finds_no_fault():
    findings = shiftsim.check_planner(
        nuplan.wrap(planners.FollowLeader), cruise_scenario(iterations=60)
    )
    assert [finding for finding in findings if finding.severity == "error"] == []


def test_an_error_of_the_planner_is_that_of_its_task(toy, tmp_path):
    class Broken(planners.Coast):
        def compute_planner_trajectory(self, current_input):
            raise ZeroDivisionError("of all things")

    run = shiftsim.run(nuplan.wrap(Broken()), store=str(toy), workers=1, out=str(tmp_path / "run"))
    errors = pq.read_table(run.path / "tasks.parquet").column("error").to_pylist()
    assert errors == ["ZeroDivisionError: of all things (at iteration 0)"] * 4


def test_maps_and_their_objects_outlive_a_scenario():
    wrapped = nuplan.wrap(planners.FollowRoute)
    scenario = cruise_scenario(iterations=5)
    lanes = set()
    for _ in range(3):
        shiftsim.simulate(scenario, wrapped)
        lanes.add(id(wrapped._planner._road.object("edges", 0)))
    assert len(lanes) == 1
