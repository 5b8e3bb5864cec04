"""Planners in processes of their own: the same scores, and their ends cost one task."""

import sys
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest

import shiftsim
from shiftsim.errors import ConfigError, PlannerError
from shiftsim.planners import stub
from shiftsim.planners.stub import Trajectory as StubTrajectory

FOLDER = Path(__file__).parent
sys.path.append(str(FOLDER))
RESULTS = ("scores.parquet", "metrics.parquet")
BAD = "0001cafe"


def drive(toy, out, planner, **settings):
    settings = {"store": str(toy), "out": str(out), "workers": 1, **settings}
    return shiftsim.run(planner, **settings)


def same_results(left, right):
    return [(left.path / n).read_bytes() == (right.path / n).read_bytes() for n in RESULTS]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.thorough)])
@pytest.mark.thorough
def test_isolated_planners_give_the_same_bytes(workers, toy, tmp_path):
    planners = ["constant-velocity", "simple", "log-future", "drivers:Remembers"]
    settings = {"noise": ["none", "ou-high"]}
    plain = drive(toy, tmp_path / "plain", planners, **settings)
    apart = drive(toy, tmp_path / "apart", planners, **settings, isolate=True, workers=workers)
    assert apart.manifest["counts"]["ok"] == 4 * 4 * 2
    assert same_results(plain, apart) == [True, True]
    assert plain.manifest["determining"] == apart.manifest["determining"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner",
    ["drivers:FollowsItsRoute", "idm", pytest.param("pdm-closed", marks=pytest.mark.thorough)],
)
@pytest.mark.thorough
def test_planners_that_read_the_map_give_the_same_bytes(planner, toy, tmp_path):
    settings = {"noise": ["none", "ou-high"], "limit": 2}
    plain = drive(toy, tmp_path / "plain", planner, **settings)
    apart = drive(toy, tmp_path / "apart", planner, **settings, isolate=True)
    assert apart.is_complete
    assert same_results(plain, apart) == [True, True]


def test_whatever_happens_there_is_the_planner_s_error_and_costs_one_task(toy, tmp_path):
    tokens = shiftsim.open_store(str(toy)).tokens
    odd = dict(zip(tokens, ("exits", "raises", "leaves", "none"), strict=True))
    arguments = {"drivers:Odd": {"odd": odd}}
    run = drive(toy, tmp_path / "run", "drivers:Odd", planner_args=arguments, isolate=True)
    tasks = {odd[task["token"]]: task for task in run.tasks.to_pylist()}
    assert {what: task["error"] for what, task in tasks.items()} == {
        "exits": "the process of planner 'drivers:Odd' ended with exit code 7",
        "raises": "KeyError: 'lane'",
        "leaves": "SystemExit: 3",
        "none": "iteration 3: plan() returned NoneType, not a Trajectory or a Command",
    }
    assert "drivers.py" in tasks["raises"]["traceback"]


@pytest.mark.thorough
def test_a_socket_that_the_planner_writes_to_costs_one_task_each(toy, tmp_path):
    first, second = shiftsim.open_store(str(toy)).tokens[:2]
    for what in ("surplus", "endless", "large", "deep"):
        given = {"planner_args": {"drivers:Intruder": {"odd": {first: what}}}, "limit": 2}
        run = drive(toy, tmp_path / what, "drivers:Intruder", isolate=True, **given)
        tasks = {task["token"]: task for task in run.tasks.to_pylist()}
        assert tasks[second]["status"] == "ok", what
        assert tasks[first]["status"] == "failed", what
        assert "was ended: it sent what cannot be read" in tasks[first]["error"], what


def sent(value, **classes):
    ours, theirs = Pipe()
    with ours, theirs:
        stub.write(ours, value)
        found = stub.read(theirs, classes)
        assert not theirs.poll()
        return found


def test_what_is_sent_arrives_bit_by_bit_and_read_only():
    values = np.array([[0.1, -0.0, np.nan], [np.inf, 5e-324, 1e300]])
    tree = {"a": (1, 2**60, 0.1 + 0.2, True, None, "é"), 3: values[:, ::2], "none": values[:0]}
    found = sent(tree)
    assert found["a"] == tree["a"]
    assert found[3].tobytes() == values[:, ::2].tobytes()
    assert found["none"].shape == (0, 3)
    with pytest.raises(ValueError, match="read-only"):
        found[3][0] = 0.0
    with pytest.raises(ValueError, match="WRITEABLE"):
        found[3].setflags(write=True)


def test_what_cannot_be_sent_arrives_as_something_of_that_name():
    assert type(sent(object())).__name__ == "object"
    assert type(sent(np.array([object()]))).__name__ == "ndarray"
    assert sent(np.float32(0.5)) == 0.5
    command = shiftsim.Command(1.5, -0.0)
    assert sent(command, Command=shiftsim.Command) == command


@pytest.mark.thorough
def test_a_planner_that_hangs_there_is_killed_with_its_worker(toy, tmp_path):
    run = drive(toy, tmp_path / "run", "drivers:Hanging", isolate=True, timeout=3.0)
    assert [task["status"] for task in run.tasks.to_pylist()].count("timeout") == 1


_RUN = """#!{python} -S
import runpy, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name in ("shiftsim", "numba"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Refuse())
sys.path.append({packages!r})
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture
def interpreter(tmp_path):
    """An interpreter that has NumPy, and does not find shiftsim."""
    path = tmp_path / "python"
    packages = str(Path(np.__file__).parents[1])
    path.write_text(_RUN.format(python=sys.executable, packages=packages))
    path.chmod(0o755)
    return str(path)


def test_another_interpreter_needs_numpy_and_nothing_of_ours(
    interpreter, toy, tmp_path, monkeypatch
):
    monkeypatch.chdir(FOLDER)
    settings = {"noise": ["none", "ou-high"]}
    here = drive(toy, tmp_path / "here", "foreign:Foreign", **settings)
    there = drive(
        toy, tmp_path / "there", ["foreign:Foreign"], planner_python=interpreter, **settings
    )
    assert there.is_complete, there.tasks.to_pylist()
    assert same_results(here, there) == [True, True]


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (
            "observation",
            "AttributeError: there is no 'lead' in an interpreter of the planner's own",
        ),
        ("module", "AttributeError: there is no 'simulate' in an interpreter of the planner's own"),
        ("env", "ModuleNotFoundError: there is no module 'shiftsim.env' in an interpreter"),
    ],
)
def test_what_another_interpreter_lacks_is_named(
    what, message, interpreter, toy, tmp_path, monkeypatch
):
    monkeypatch.chdir(FOLDER)
    run = drive(
        *(toy, tmp_path / "run", "foreign:Asks"),
        planner_args={"foreign:Asks": {"what": what}},
        planner_python=interpreter,
        limit=1,
    )
    (task,) = run.tasks.to_pylist()
    assert task["error"].startswith(message)
    assert "with --isolate alone it runs in that of shiftsim" in task["error"]


def test_another_interpreter_that_is_none_is_named(toy, tmp_path):
    with pytest.raises(PlannerError, match="'/nowhere/python' cannot be started"):
        drive(toy, tmp_path / "run", "foreign:Foreign", planner_python="/nowhere/python")


def test_an_object_of_this_process_cannot_be_isolated(toy, tmp_path):
    import foreign

    with pytest.raises(ConfigError, match="'Foreign' cannot be isolated"):
        drive(toy, tmp_path / "run", foreign.Foreign(), isolate=True)


def test_an_unknown_planner_is_named_as_ever(toy, tmp_path):
    with pytest.raises(PlannerError, match="has no class 'Missing'"):
        drive(toy, tmp_path / "run", "foreign:Missing", isolate=True)


def test_the_module_of_an_isolated_planner_is_not_imported_here(toy, tmp_path, monkeypatch):
    (tmp_path / "shy.py").write_text("from foreign import Foreign as Shy\n")
    monkeypatch.chdir(tmp_path)
    run = drive(toy, tmp_path / "run", "shy:Shy", isolate=True)
    assert run.is_complete
    assert "shy" not in sys.modules


def test_the_stub_builds_the_same_trajectory():
    times = np.arange(5) * 0.1
    poses = np.random.default_rng(3).normal(size=(5, 3))
    ours, theirs = (kind.from_poses(times, poses) for kind in (shiftsim.Trajectory, StubTrajectory))
    assert ours.relative is theirs.relative is True
    np.testing.assert_array_equal(ours.time_us, theirs.time_us)
    assert ours.states.tobytes() == theirs.states.tobytes()


def test_the_stub_is_written_for_older_interpreters():
    import ast

    from shiftsim.planners import stub

    tree = ast.parse(Path(stub.__file__).read_text(), feature_version=(3, 9))
    names = {
        name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for name in (a.name for a in node.names)
    }
    assert {n for n in names if n.partition(".")[0] not in sys.stdlib_module_names} == {"numpy"}
