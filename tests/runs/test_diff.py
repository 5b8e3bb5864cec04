"""Where two runs part: which scenarios, at which step, in which quantity."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_runs import write_run

import shiftsim
from shiftsim.errors import ConfigError, DataError
from shiftsim.runs.diff import diff_lines, diff_runs, find_departure
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import rollout_rows


class Coast:
    """Keeps heading and speed; brakes from one step on."""

    name = "coast"

    def __init__(self, brakes_at=10**6):
        self.brakes_at = brakes_at

    def reset(self, scene):
        pass

    def plan(self, observation):
        braking = observation.iteration >= self.brakes_at
        return shiftsim.Command(-3.0 if braking else 0.0, 0.0)


@pytest.fixture(scope="module")
def runs(toy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("diff")
    return [
        shiftsim.run(Coast(at), store=str(toy), workers=1, out=str(folder / name))
        for name, at in (("never", 10**6), ("late", 12))
    ]


def test_rollouts_part_at_the_step_where_the_planner_acts_differently(runs):
    found = diff_runs(*runs)
    assert found.changes
    for change in found.changes:
        assert change.departure.iteration == 12
        assert change.departure.quantity == "command accel [m/s²]"
        assert (change.departure.first, change.departure.second) == (0.0, -3.0)
        assert change.departure.seconds == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("traffic", "note"),
    [
        ("nonreactive", "the rollouts are the same: they were scored differently"),
        ("reactive", "the ego drove the same, but in other traffic (nonreactive, reactive)"),
    ],
)
def test_scores_that_differ_without_another_step_are_explained(runs, traffic, note):
    determining = runs[0].manifest["determining"] | {"traffic": traffic}
    other = Run(runs[0].path, runs[0].manifest | {"determining": determining})
    column = other.scores.column_names.index("cls")
    worse = other.scores.set_column(column, "cls", [[0.0] * len(other.scores)])
    other.__dict__["scores"] = worse
    changes = diff_runs(runs[0], other).changes
    assert {(change.departure, change.note) for change in changes} == {(None, note)}


def test_a_damaged_rollout_is_named(runs, monkeypatch):
    def damaged(run, task):
        rows = whole(run, task)
        at = rows.schema.get_field_index("plan_dx_m")
        long = pa.array([[7] * 100] * len(rows), rows["plan_dx_m"].type)
        return rows.set_column(at, rows.schema.field(at), long)

    whole = Run.rollout_rows
    monkeypatch.setattr(Run, "rollout_rows", damaged)
    with pytest.raises(
        DataError, match=r"rollout of scenario '\w+' in .*never.* is damaged: "
    ) as found:
        diff_runs(*runs)
    assert found.value.hint == "make the run again"


def test_changes_are_ranked_and_counted(runs):
    found = diff_runs(*runs)
    sizes = [abs(change.second - change.first) for change in found.changes]
    assert sizes == sorted(sizes, reverse=True)
    assert found.same + found.better + found.worse == 4
    assert len(found.changes) == found.better + found.worse
    assert "planners" in found.settings


def test_a_run_does_not_differ_from_itself(runs):
    found = diff_runs(runs[0], runs[0])
    assert (found.same, found.better, found.worse, found.changes, found.settings) == (
        4,
        0,
        0,
        (),
        (),
    )


def test_means_are_those_of_the_common_rollouts(tmp_path):
    first = write_run(tmp_path / "a", missing=[("alpha", "none", 0, "t0")])
    second = write_run(tmp_path / "b", score=lambda p, n, s, number: number / 4.0)
    found = diff_runs(first, second)
    assert found.means == (0.5, 0.5)
    assert (found.same, found.better, found.worse) == (1, 1, 1)
    assert (found.only_first, found.only_second) == (0, 1)


def test_single_planners_are_paired_whatever_their_names(tmp_path):
    first = write_run(tmp_path / "a", planners=("old",))
    second = write_run(tmp_path / "b", planners=("new",), score=lambda *key: 0.25)
    found = diff_runs(first, second, limit=3)
    assert found.worse == 4
    lines = diff_lines(found)
    assert "old/new none  50.00 → 25.00" in lines[2]
    assert lines[3] == "   rollouts are not stored"
    assert lines[-1] == " and 1 more (--limit)"


def test_runs_of_other_things_are_refused(tmp_path):
    first = write_run(tmp_path / "a", planners=("x", "y"))
    second = write_run(tmp_path / "b", planners=("z",))
    with pytest.raises(ConfigError, match="no rollout in common"):
        diff_runs(first, second)


@pytest.mark.parametrize(
    ("field", "row", "quantity"),
    [
        ("ego", 7, "ego y [m]"),
        ("noise", 3, "noise steering rate [rad/s]"),
        ("plans", 5, "plan, pose 0 y [m]"),
    ],
)
def test_the_quantity_that_differs_is_named(runs, toy, field, row, quantity):
    task = Task("coast", "none", 0, "0000cafe")
    scenario = shiftsim.open_store(str(toy)).read(task.token)
    log = runs[0].rollout(task, scenario)
    if field == "plans":
        log = replace(log, plans=np.zeros((len(log.time_us), 2, 3)))
    values = np.array(getattr(log, field))
    step = 2.0 / 1024.0 if field == "plans" else 1e-9  # plans are rounded
    values[row].reshape(-1)[1] += step
    tables = [rollout_rows(one, with_tracks=True) for one in (log, replace(log, **{field: values}))]
    found = find_departure(*tables)
    assert (found.iteration, found.quantity) == (row, quantity)
    assert found.second - found.first == pytest.approx(step, rel=1e-4)


def test_rounding_is_no_departure_and_the_largest_distance_is_told(runs):
    def moved(table, row, by):
        at = table.schema.get_field_index("y_m")
        values = table["y_m"].to_numpy().copy()
        values[row] += by
        return table.set_column(at, "y_m", pa.array(values))

    table = runs[0].rollout_rows(Task("coast", "none", 0, "0000cafe"))
    rounded = moved(table, 2, 1e-9)
    assert find_departure(table, rounded).iteration == 2
    assert find_departure(table, rounded, tolerance=1e-6) is None
    assert find_departure(table, moved(rounded, 5, 0.5), tolerance=1e-6).iteration == 5
    assert find_departure(table, moved(rounded, 5, np.nan), tolerance=1e-6).iteration == 5

    at = table.schema.get_field_index("heading_rad")
    west = [
        table.set_column(at, "heading_rad", pa.array([angle] * len(table)))
        for angle in (np.pi, -np.pi + 1e-12)
    ]
    assert find_departure(*west, tolerance=1e-6) is None

    change = diff_runs(*runs).changes[0]
    assert change.largest[0] > 0.1
    assert "largest distance of the egos" in "\n".join(diff_lines(diff_runs(*runs)))
    lenient = diff_runs(*runs, tolerance=1e6).changes[0]
    assert lenient.departure is None
    assert lenient.note == "the rollouts are the same to 1e+06 m: they were scored differently"


def test_a_shorter_rollout_differs_in_length(runs):
    table = runs[0].rollout_rows(Task("coast", "none", 0, "0000cafe"))
    found = find_departure(table, table.slice(0, 9))
    assert (found.iteration, found.quantity) == (9, "length of the rollout")
    assert (found.first, found.second) == (24.0, 9.0)


def test_the_same_rollout_never_parts(runs):
    table = runs[0].rollout_rows(Task("coast", "none", 0, "0000cafe"))
    assert find_departure(table, table) is None
