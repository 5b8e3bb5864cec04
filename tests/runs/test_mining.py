"""Failure mining: what went wrong begins again, shortly before."""

import numpy as np
import pytest

import shiftsim
from shiftsim.edits.spec import make_edit
from shiftsim.errors import ConfigError
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.runs.edited import EditedStore, read_edits
from shiftsim.runs.rollouts import Task
from shiftsim.sim.loop import Rollout

NAME = "constant-velocity"


@pytest.fixture(scope="module", params=["nonreactive", "reactive"])
def run(request, tmp_path_factory):
    out = tmp_path_factory.mktemp("mine") / request.param
    return shiftsim.run(
        NAME, split="demo-mini", limit=4, traffic=request.param, workers=1, out=str(out)
    )


def first_off_road(run):
    rows = run.metrics.to_pylist()
    return {
        row["token"]: row["first_violation_iteration"]
        for row in rows
        if row["metric"] == "drivable_area_compliance" and row["score"] < 1.0
    }


def test_scenarios_begin_where_the_rollouts_had_come(run, tmp_path):
    path = run.mine("off-road", before=2.0, out=tmp_path / "mined.toml")
    store = EditedStore(shiftsim.open_store("demo"), read_edits(str(path)))
    wrong = first_off_road(run)
    assert {store.base(token) for token in store.tokens} == set(wrong)
    traffic = run.manifest["determining"]["traffic"]
    for token in store.tokens:
        base = store.base(token)
        scenario, recorded = store.read(token), shiftsim.open_store("demo").read(base)
        start = (
            recorded.num_iterations
            - 1
            - round((recorded.iteration_times[-1] - scenario.iteration_times[0]) * 1e-5)
        )
        assert start <= max(wrong[base] - 20, 0)
        driven = run.rollout(Task(NAME, "none", 0, base), recorded)
        rollout = Rollout(scenario, ConstantVelocity(), traffic=traffic)
        history = rollout.observe().history
        count = min(start + 1, len(history.ego))
        assert history.ego[-count:].tobytes() == driven.ego[start + 1 - count : start + 1].tobytes()
        there = driven.tracks.valid[start]
        seen = history.tracks
        index = [seen.tokens.index(name) for name in driven.tracks.tokens]
        if traffic == "nonreactive":
            np.testing.assert_array_equal(seen.valid[-1, index], there)
            np.testing.assert_array_equal(seen.poses[-1, index], driven.tracks.poses[start])
        else:  # agents are put on their lanes again
            moved = seen.poses[-2, index] - driven.tracks.poses[start - 1]
            assert np.nanmax(np.abs(moved)) == 0.0
        assert scenario.duration_class == "7 s"


def test_any_planner_drives_what_was_mined(run, tmp_path):
    path = run.mine("off-road", before=2.0, out=tmp_path / "mined.toml")
    traffic = run.manifest["determining"]["traffic"]
    again = shiftsim.run(
        ["idm", NAME],
        edits=str(path),
        split="demo-mini",
        traffic=traffic,
        workers=1,
        out=str(tmp_path / "out"),
    )
    assert again.is_complete
    if traffic == "nonreactive":  # the same again, and it goes wrong again
        rows = [row for row in again.scores.to_pylist() if row["planner"] == NAME]
        assert {row["drivable_area_compliance"] for row in rows} == {0.0}
    else:
        with pytest.raises(ConfigError, match="it begins in traffic reactive"):
            shiftsim.run("idm", edits=str(path), split="demo-mini", out=str(tmp_path / "other"))
    with pytest.raises(ConfigError, match="drove edited scenarios"):
        again.mine()


def test_what_is_not_there_is_told(run, tmp_path):
    with pytest.raises(ConfigError, match="kind"):
        run.mine("boredom")
    with pytest.raises(ConfigError, match="no rollout with 'off-road'"):
        run.mine("off-road", planner="nobody", out=tmp_path / "none.toml")


def test_a_start_that_does_not_fit_is_refused():
    scenario = shiftsim.open_store("demo")["01f13e"]
    edit = {"name": "x", "start": {"ego": [[1.0, 2.0]]}}
    assert make_edit(edit, "here").words == ("start: 0.0 s into a rollout",)
    with pytest.raises(ConfigError, match="states of 11 numbers"):
        scenario.edited(start=edit["start"])
    ego = scenario.expert[:5].tolist()
    with pytest.raises(ConfigError, match="driven in runs only"):
        scenario.edited(start={"ego": ego, "traffic": "reactive"})
    later = scenario.edited(start={"ego": ego})
    assert later.num_iterations == scenario.num_iterations - 4
