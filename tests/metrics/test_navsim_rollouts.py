"""NAVSIM's scores of rollouts: plans of a rollout, and windows of what was driven."""

import numpy as np
import pytest

import shiftsim
from shiftsim.errors import ConfigError
from shiftsim.metrics import navsim, navsim_rollouts
from shiftsim.metrics.navsim_rollouts import driven_scenario, metric_name, metric_rows, plan_at
from shiftsim.sim.log import as_recorded


@pytest.fixture(scope="module")
def scenario():
    return shiftsim.open_store("demo")["01f13e"]


@pytest.fixture(scope="module")
def rows(scenario):
    log = shiftsim.simulate(scenario, "pdm-closed")
    return {row.metric: row.value for row in metric_rows(log, scenario)}


def test_both_modes_have_all_columns(rows):
    wanted = {
        metric_name(*pair)
        for pair in [
            (mode, column) for mode in navsim_rollouts.MODES for column in navsim_rollouts.COLUMNS
        ]
    }
    assert wanted - set(rows) == {"navsim_windows_EC"}
    assert rows["navsim_plans_frames"] == rows["navsim_windows_frames"]
    assert all(0.0 <= value <= 1.0 for name, value in rows.items() if "frames" not in name)


def test_a_recording_has_the_world_that_navsim_sees(scenario):
    """Where the rollout is the recording, frames are those of the scenario itself."""
    driven = driven_scenario(as_recorded(scenario), scenario)
    ours, theirs = (navsim.frame_world(one, 20, "v2") for one in (driven, scenario))
    np.testing.assert_array_equal(ours.plan, theirs.plan)
    np.testing.assert_allclose(ours.past, theirs.past, rtol=0, atol=1e-9)
    assert ours.reference.score == pytest.approx(theirs.reference.score, abs=1e-12)
    assert ours.human.score == pytest.approx(theirs.human.score, abs=1e-12)


def test_a_plan_is_interpolated_between_what_is_kept(scenario):
    log = shiftsim.simulate(scenario, "constant-velocity")
    plan = plan_at(log, 30)
    assert plan.shape == (1, 8, 3)
    speed = np.hypot(*np.diff(plan[0, :, :2], axis=0).T) / 0.5
    np.testing.assert_allclose(speed, speed[0], rtol=1e-6)
    assert plan_at(as_recorded(scenario), 30) is None


def test_commands_have_no_plans(scenario):
    rows = metric_rows(as_recorded(scenario), scenario)
    assert {row.metric.split("_")[1] for row in rows} == {"windows"}


def test_it_is_a_metric_that_needs_the_scenario(scenario):
    log = shiftsim.simulate(scenario, "constant-velocity")
    with pytest.raises(ConfigError, match="needs the scenario"):
        shiftsim.score(log, scenario.map, own=["navsim"])
    result = shiftsim.score(log, scenario, own=["navsim"])
    assert {row.metric for row in result.extra} >= {"navsim_plans_EPDMS", "navsim_windows_PDMS"}
    assert result.score == shiftsim.score(log, scenario.map).score


def test_the_table_of_a_run_shows_them(tmp_path):
    run = shiftsim.run("constant-velocity", split="demo-mini", limit=1, out=str(tmp_path / "a"))
    with pytest.raises(ConfigError, match="holds nothing of the table 'navsim'"):
        run.table("navsim")
    scored = run.rescore("nuplan", metrics=("navsim",), out=str(tmp_path / "b"))
    text = str(scored.table("navsim"))
    assert "EPDMS" in text
    assert text.count("constant-velocity") == 2
