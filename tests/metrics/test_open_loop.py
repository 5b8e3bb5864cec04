"""Open-loop scores of plans that are known to be right, shifted, turned, or too short."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import cruise_scenario

import shiftsim
from shiftsim.errors import DataError, PlannerError
from shiftsim.metrics.open_loop import (
    EVERY,
    METRICS,
    MISSED,
    NAMES,
    Poses,
    metric_rows,
    open_loop,
    recording,
)
from shiftsim.report.details import open_loop_scores
from shiftsim.report.groups import read_groups
from shiftsim.runs.derive import rescore
from shiftsim.sim.loop import plans_on_recording
from shiftsim.world.state import Command

FRAMES, SECONDS = 4, 8
SPEED, EAST = 10.0, 0.0


def drive(start_s: float, seconds: float, step_s: float = 0.5) -> Poses:
    """Straight on with 10 m/s."""
    times = start_s + np.arange(0.0, seconds + 1e-9, step_s)
    poses = np.stack([SPEED * times, np.zeros_like(times), np.full_like(times, EAST)], axis=1)
    return Poses(np.rint(times * 1e6).astype(np.int64), poses)


EXPERT = drive(0.0, FRAMES - 1 + SECONDS, 1.0)


def plans(aside: float = 0.0, turn: float = 0.0, seconds: float = SECONDS) -> list[Poses]:
    """Plans along the recording, beside it, or turned on the spot."""
    out = []
    for frame in range(FRAMES):
        times, poses = drive(frame, seconds)
        out.append(Poses(times, poses + np.array([0.0, aside, turn])))
    return out


@given(st.floats(0.0, 20.0))
def test_a_plan_beside_the_recording_is_off_by_its_distance(aside):
    result = open_loop(plans(aside), EXPERT)
    scores = {part.row.metric: part.row for part in result.parts}
    for name in ("average", "final"):
        row = scores[f"planner_expert_{name}_l2_error_within_bound"]
        assert row.value == pytest.approx(aside, abs=1e-9)
        assert row.score == pytest.approx(max(0.0, 1.0 - aside / 8.0), abs=1e-9)
    # within 3, 5 and 8 s a plan may be off by 6, 8 and 16 m
    assert scores["planner_miss_rate_within_bound"].score == float(aside <= 6.0)
    expected = 0.0 if aside > 6.0 else (2.0 * (1.0 - aside / 8.0) + 4.0) / 6.0
    assert result.score == pytest.approx(expected, abs=1e-9)


def test_errors_are_those_up_to_each_horizon_and_at_its_end():
    """Plans that drift aside by 1 m/s."""
    drifting = []
    for times, poses in plans():
        aside = (times - times[0]) * 1e-6
        drifting.append(Poses(times, poses + np.outer(aside, [0.0, 1.0, 0.0])))
    result = open_loop(drifting, EXPERT)
    for name, expected in (("ADE", [2.0, 3.0, 4.5]), ("FDE", [3.0, 5.0, 8.0])):
        np.testing.assert_allclose(result.errors[name].T, [expected] * FRAMES, atol=1e-9)
    np.testing.assert_allclose(result.farthest.T, [[3.0, 5.0, 8.0]] * FRAMES, atol=1e-9)


def test_the_bounds_are_those_of_nuplan():
    assert MISSED == (6.0, 8.0, 16.0)
    bounds = {name: (bound, weight) for name, _, bound, weight in METRICS.values()}
    assert bounds == {"ADE": (8.0, 1.0), "FDE": (8.0, 1.0), "FHE": (0.8, 2.0), "AHE": (0.8, 2.0)}


def test_a_full_turn_is_no_error_of_heading():
    assert open_loop(plans(turn=2.0 * np.pi), EXPERT).score == pytest.approx(1.0)
    result = open_loop(plans(turn=0.4), EXPERT)
    assert result.errors["FHE"] == pytest.approx(0.4)


def test_the_end_of_a_plan_stands_for_the_eighth_second():
    result = open_loop(plans(aside=1.0, seconds=7.5), EXPERT)  # nuPlan rule 730
    assert result.errors["FDE"][2] == pytest.approx(1.0)
    with pytest.raises(DataError, match=r"covers 6\.5 s"):
        open_loop(plans(seconds=6.5), EXPERT)
    with pytest.raises(DataError, match="the recording ends 1 s before the plan"):
        open_loop([*plans(), drive(FRAMES, SECONDS)], EXPERT, "token")


@pytest.fixture(scope="module")
def scenario():
    return shiftsim.open_store("demo")["01f13e"]


def test_the_recorded_future_has_the_full_score(scenario):
    planner = shiftsim.load_planner("log-future")
    made = plans_on_recording(scenario, planner, EVERY)
    poses = [Poses(plan.time_us, plan.states[:, :3]) for plan in made]
    rows = {row.metric: row for row in metric_rows(poses, scenario)}
    assert rows["open_loop_score"].score == pytest.approx(1.0, abs=1e-9)
    counted = rows["open_loop_plans"]
    # the last plan that is compared is made 8 s before the end of the recording
    behind = (scenario.time_us[-1] - recording(scenario).time_us[: len(made)]) * 1e-6
    assert (counted.value, counted.threshold) == (np.count_nonzero(behind >= 8.0), len(made))


def test_the_recording_reaches_eight_seconds_behind_the_last_plan():
    """It is made at 14 s; 15 s are both the last iteration and the second after (rule 732)."""
    scenario = cruise_scenario()
    seconds = 1e-6 * (recording(scenario).time_us - scenario.iteration_times[0])
    assert seconds.tolist() == pytest.approx([*range(16), *range(15, 23)])


def test_commands_are_no_plans(scenario):
    with pytest.raises(PlannerError, match="returns commands"):
        plans_on_recording(scenario, Coast(), EVERY)


def test_a_run_with_open_loop_keeps_its_rows_when_it_is_scored_again(tmp_path):
    """The rows of closed loop are those of a run without."""
    runs = [
        shiftsim.run("idm", limit=1, workers=1, out=tmp_path / name, open_loop=name == "open")
        for name in ("closed", "open")
    ]
    again = rescore(runs[1], thresholds="deepplan", out=str(tmp_path / "again"))
    without, rows, scored_again = (run.metrics.to_pylist() for run in (*runs, again))
    added = [row for row in rows if row["metric"] in NAMES]
    assert {row["metric"] for row in added} == {*NAMES}
    assert [row for row in rows if row not in added] == without
    assert runs[0].scores.equals(runs[1].scores)
    kept = [row for row in scored_again if row["metric"] in NAMES]
    assert kept == [row | {"thresholds": "deepplan"} for row in added]
    assert runs[0].manifest["determining"] != runs[1].manifest["determining"]
    assert open_loop_scores(read_groups(runs[:1])) is None
    table = open_loop_scores(read_groups(runs[1:]))
    (row,) = table.rows
    values = {row["metric"]: row["value"] for row in added}
    assert row[5].value == pytest.approx(100.0 * values["open_loop_score"])
    assert row[6].value == pytest.approx(values["planner_expert_average_l2_error_within_bound"])
    assert row[-1] == f"{values['open_loop_plans']:.0f} of {added[-1]['threshold']:.0f}"
    assert again.manifest["split_size"] == runs[1].manifest["split_size"]


class Coast:
    """Returns commands, which are no plans."""

    def reset(self, scene):
        pass

    def plan(self, observation):
        return Command(0.0, 0.0)


def test_what_has_no_open_loop_score_keeps_that_of_closed_loop(tmp_path, caplog):
    run = shiftsim.run(Coast, limit=1, workers=1, out=tmp_path / "out", open_loop=True)
    assert run.is_complete
    assert not any(row["metric"] in NAMES for row in run.metrics.to_pylist())
    assert "no open-loop score: open loop compares trajectories" in caplog.text
    assert "; return a shiftsim.Trajectory" in caplog.text  # what to do about it


def test_others_drive_as_recorded_whatever_the_traffic(tmp_path):
    rows = []
    for traffic in ("nonreactive", "reactive"):
        out = tmp_path / traffic
        run = shiftsim.run("idm", limit=1, workers=1, out=out, open_loop=True, traffic=traffic)
        rows.append([row for row in run.metrics.to_pylist() if row["metric"] in NAMES])
    assert rows[0] == rows[1] != []
