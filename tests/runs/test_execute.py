"""Many tasks: the same bytes in any order, and what happens when some of them fail."""

import random
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stores import write_toy_store

import shiftsim
from shiftsim.errors import ConfigError, DataError
from shiftsim.metrics import MetricRow, Violation
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare
from shiftsim.sim.noise import NoiseModel

sys.path.append(str(Path(__file__).parent))  # worker processes import `drivers`, too

BAD = "0001cafe"
RESULTS = ("scores.parquet", "metrics.parquet")


def settings(store, out, **more):
    values = {"planners": ["constant-velocity"], "store": str(store), "out": str(out), "workers": 1}
    return make_config(values | more)


def same_results(left, right):
    return [(left.path / n).read_bytes() == (right.path / n).read_bytes() for n in RESULTS]


@pytest.mark.thorough
def test_two_workers_give_the_same_bytes_as_one(clean_run, toy, tmp_path):
    other = shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        seeds=[0, 1],
        store=str(toy),
        workers=2,
        out=str(tmp_path / "two"),
    )
    assert other.manifest["workers"] == 2
    assert same_results(clean_run, other) == [True, True]


@pytest.mark.thorough
@pytest.mark.parametrize("workers", [1, 2])
def test_short_plans_are_warned_of_once_per_run_and_planner(toy, tmp_path, workers, caplog, capfd):
    planners = ["drivers:Short", "constant-velocity"]
    for name in ("first", "again"):
        config = settings(toy, tmp_path / name, planners=planners, workers=workers)
        assert execute(prepare(config)).is_complete
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    for text in said:
        assert text.startswith("planner drivers:Short: plans reach less than 1 s ahead")
    assert "less than 1 s" not in capfd.readouterr().err


def test_shuffled_tasks_give_the_same_bytes(clean_run, toy, tmp_path):
    config = settings(
        toy,
        tmp_path / "shuffled",
        planners=["log-future", "constant-velocity"],
        noise=["ou-high", "none"],
        seeds=[1, 0],
    )
    prepared = prepare(config)
    batches = list(prepared.batches)
    random.Random(5).shuffle(batches)
    other = execute(replace(prepared, batches=tuple(batches)))
    assert same_results(clean_run, other) == [True, True]


def test_a_second_run_replaces_the_first_with_the_same_bytes(clean_run):
    config = make_config({**clean_run.manifest["config"], "workers": 1})
    before = [(clean_run.path / name).read_bytes() for name in RESULTS]
    again = execute(prepare(config))
    assert again.path == clean_run.path
    assert [(again.path / name).read_bytes() for name in RESULTS] == before
    assert {path.name for path in again.path.parent.iterdir()} == {again.path.name}


def test_seeds_do_not_multiply_the_clean_tasks(clean_run):
    tasks = clean_run.tasks.to_pylist()
    assert len(tasks) == 2 * 4 * (1 + 2)
    assert {task["seed"] for task in tasks if task["noise"] == "none"} == {0}


def test_other_settings_may_not_overwrite_a_run(clean_run, toy):
    with pytest.raises(ConfigError, match=r"holds another run: .*thresholds"):
        prepare(settings(toy, clean_run.path, thresholds="deepplan"))


def test_a_folder_with_other_content_is_left_alone(toy, tmp_path):
    (tmp_path / "letters.txt").write_text("dear")
    with pytest.raises(ConfigError, match="is not a run folder"):
        prepare(settings(toy, tmp_path))


def test_a_failing_task_is_a_row_and_withholds_the_score(toy, tmp_path):
    run = execute(prepare(settings(toy, tmp_path / "run", planners=["drivers:Failing"])))
    assert run.manifest["counts"] == {
        "expected": 4,
        "ok": 3,
        "failed": 1,
        "timeout": 0,
        "missing": 0,
    }
    failed = [task for task in run.tasks.to_pylist() if task["status"] == "failed"]
    assert failed[0]["token"] == BAD
    assert failed[0]["error"] == "RuntimeError: cannot drive here"
    assert "drivers.py" in failed[0]["traceback"]
    assert len(run.scores) == 3
    assert "– (3/4 done)" in shiftsim.open_run(run.path).table()
    assert "partial" not in shiftsim.open_run(run.path).table()
    assert "partial (3/4)" in shiftsim.open_run(run.path).table(allow_partial=True)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_dying_worker_costs_one_task(toy, tmp_path):
    config = settings(toy, tmp_path / "run", planners=["drivers:Dying"], workers=2)
    run = execute(prepare(config))
    assert run.manifest["counts"] == {
        "expected": 4,
        "ok": 3,
        "failed": 1,
        "timeout": 0,
        "missing": 0,
    }
    failed = next(task for task in run.tasks.to_pylist() if task["status"] == "failed")
    assert (failed["token"], failed["error"]) == (BAD, "worker process ended with exit code 11")


def test_an_interrupt_keeps_what_is_finished(toy, tmp_path):
    config = settings(toy, tmp_path / "run", planners=["drivers:Interrupting"])
    with pytest.raises(KeyboardInterrupt):
        execute(prepare(config))
    run = shiftsim.open_run(tmp_path / "run")
    assert run.manifest["state"] == "interrupted"
    assert run.manifest["counts"] == {
        "expected": 4,
        "ok": 1,
        "failed": 0,
        "timeout": 0,
        "missing": 3,
    }
    assert "– (1/4 done)" in shiftsim.open_run(run.path).table()


def test_an_answer_that_is_no_plan_is_named(toy, tmp_path):
    config = settings(toy, tmp_path / "run", planners=["drivers:Sloppy"], limit=1)
    run = execute(prepare(config))
    assert "list" in run.tasks.to_pylist()[0]["error"]


@pytest.mark.parametrize(
    ("planner", "message"),
    [
        ("calr", "planner 'calr' unknown"),
        ("idn", "planner 'idn' unknown"),
        ("drivers:NoPlan", r"no method plan\(\)"),
        ("drivers:Greedy", "cannot be made: ValueError: no weights"),
        ("no_such_module:Planner", "cannot be imported"),
    ],
)
def test_wrong_planners_are_found_before_the_first_task(toy, tmp_path, planner, message):
    with pytest.raises(ConfigError, match=message):
        prepare(settings(toy, tmp_path / "run", planners=[planner]))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"noise": ["ou-hihg"]}, "noise 'ou-hihg' unknown"),
        ({"perception": ["hihg"]}, "perception 'hihg' unknown"),
        ({"thresholds": "nuplam"}, "nuplam"),
        ({"traffic": "jammed"}, "jammed"),
        ({"split": "val14"}, "split 'val14' unknown"),
        ({"planner_args": {"constant-velocity": {"speed": 1.0}}}, "no argument 'speed'"),
        ({"metrics": ["no_such_module:metric"]}, "no_such_module"),
    ],
)
def test_wrong_names_are_found_before_the_first_task(toy, tmp_path, more, message):
    with pytest.raises(ConfigError, match=message):
        prepare(settings(toy, tmp_path / "run", **more))


def test_an_unknown_store_is_named_with_the_known_ones(toy, tmp_path, monkeypatch):
    monkeypatch.setenv("SHIFTSIM_DATA", str(toy.parent))
    with pytest.raises(DataError, match="no store 'toi'") as caught:
        prepare(settings("toi", tmp_path / "run"))
    assert "toy" in caught.value.hint
    assert len(prepare(settings("toy", tmp_path / "run")).tasks) == 4


def test_scenarios_that_the_store_lacks_stop_the_run_or_are_counted(toy, tmp_path):
    split = tmp_path / "mine.toml"
    split.write_text('tokens = ["0000cafe", "0002cafe", "feed"]\n')
    with pytest.raises(DataError, match=r"needs 3 scenarios, store .* lacks 1 .*'feed'"):
        prepare(settings(toy, tmp_path / "run", split=str(split)))
    config = settings(toy, tmp_path / "run", split=str(split), allow_partial=True)
    run = execute(prepare(config))
    assert run.manifest["split"] == "mine"
    assert run.manifest["counts"] == {
        "expected": 3,
        "ok": 2,
        "failed": 0,
        "timeout": 0,
        "missing": 1,
    }
    assert "– (2/3 done)" in shiftsim.open_run(run.path).table()


def test_a_broken_scenario_fails_alone(tmp_path):
    store = write_toy_store(tmp_path / "toy", count=3)
    ego = next((store / "recordings").glob("*1/ego*"))
    ego.write_bytes(ego.read_bytes()[:200])
    run = execute(prepare(settings(store, tmp_path / "run")))
    assert run.manifest["counts"] == {
        "expected": 3,
        "ok": 2,
        "failed": 1,
        "timeout": 0,
        "missing": 0,
    }
    failed = next(task for task in run.tasks.to_pylist() if task["status"] == "failed")
    assert failed["token"] == BAD
    assert ego.name in failed["error"]


class Local:
    """A planner of the main script."""

    def reset(self, scene):
        self.inner = ConstantVelocity()
        self.inner.reset(scene)

    def plan(self, observation):
        return self.inner.plan(observation)


@pytest.mark.thorough
def test_classes_and_instances_run_like_names(toy, tmp_path, clean_run):
    runs = [
        shiftsim.run(source, store=str(toy), workers=workers, out=str(tmp_path / f"{number}"))
        for number, (source, workers) in enumerate([(Local, 1), (Local(), 1), (Local(), 2)])
    ]
    expected = [
        row["cls"]
        for row in clean_run.scores.to_pylist()
        if (row["planner"], row["noise"]) == ("constant-velocity", "none")
    ]
    for run in runs:
        assert run.scores["planner"].to_pylist() == ["Local"] * 4
        assert run.scores["cls"].to_pylist() == expected


def test_noise_models_of_ones_own_have_their_own_name_and_id(toy, tmp_path):
    noise = NoiseModel("ou", 1.0, 0.05)
    run = shiftsim.run(
        "constant-velocity",
        noise=noise,
        store=str(toy),
        workers=1,
        limit=1,
        out=str(tmp_path / "run"),
    )
    assert run.scores["noise"].to_pylist() == [noise.name]
    assert run.manifest["determining"]["noise"][noise.name]["sigma_rate"] == 0.05


def own_metric(log, road):
    return float(np.abs(log.ego[:, 3]).max())


def test_own_metrics_are_reported_and_never_scored(toy, tmp_path, clean_run):
    config = settings(toy, tmp_path / "run", metrics=[f"{__name__}:own_metric"], limit=1)
    run = execute(prepare(config))
    row = next(r for r in run.metrics.to_pylist() if r["metric"] == "own_metric")
    assert row["value"] == pytest.approx(6.0)
    assert run.scores["cls"].to_pylist() == clean_run.scores["cls"].to_pylist()[:1]


def zeroing(log, road):
    log.ego[:] = 0.0
    return 0.0


def scored(log, road):
    return MetricRow("scored", 5.0, 1.0, "meters", 2.0, None)


def violated(log, road):
    return MetricRow("violated", 0.0, 1.0, "", None, Violation(99999, 5, None, 1.0))


def test_metrics_write_to_a_copy(toy, tmp_path):
    names = [f"{__name__}:{name}" for name in ("zeroing", "own_metric")]
    run = execute(prepare(settings(toy, tmp_path / "run", metrics=names, limit=1)))
    row = next(r for r in run.metrics.to_pylist() if r["metric"] == "own_metric")
    assert row["value"] == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scored", "metric 'scored' has score 5"),
        ("violated", "metric 'violated' has a violation at iteration 99999"),
    ],
)
def test_what_a_metric_cannot_return_fails_its_task(toy, tmp_path, name, message):
    metrics = [f"{__name__}:{name}"]
    run = execute(prepare(settings(toy, tmp_path / "run", metrics=metrics, limit=1)))
    assert run.tasks["error"].to_pylist() == [message]


def test_the_name_of_a_run_depends_on_what_determines_it(toy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    base = prepare(settings(toy, ""))
    assert base.folder.parent == Path("runs")
    assert base.folder.name.startswith("constant-velocity_none_toy_")
    same = prepare(settings(toy, "", seeds=[3], workers=2, save_rollouts="none"))
    assert same.folder == base.folder
    for change in ({"thresholds": "deepplan"}, {"controller": "perfect"}, {"limit": 2}):
        assert prepare(settings(toy, "", **change)).folder != base.folder
