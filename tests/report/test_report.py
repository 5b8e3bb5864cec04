"""Score tables: plain means, and never a number that looks complete and is not."""

import csv
import io

import numpy as np
import pytest

from shiftsim.errors import ConfigError
from shiftsim.report.groups import read_groups
from shiftsim.report.scores import (
    failures,
    score_table,
    scores,
    summary,
    worst_rollouts,
)
from shiftsim.report.tables import FORMATS, render
from shiftsim.report.words import severity, violations, worst_of


def of(run, planner, noise):
    groups = read_groups([run])
    (group,) = [group for group in groups if (group.planner, group.noise) == (planner, noise)]
    return group


def test_the_score_is_the_plain_mean_of_the_scenarios(clean_run):
    expected = [
        r["cls"]
        for r in clean_run.scores.to_pylist()
        if (r["planner"], r["noise"]) == ("constant-velocity", "none")
    ]
    assert len(expected) == 4
    group = of(clean_run, "constant-velocity", "none")
    assert group.seed_means() == pytest.approx([np.mean(expected)], abs=1e-15)
    assert group.estimate().std is None


def test_the_deviation_is_over_the_means_of_the_seeds(clean_run):
    means = [
        np.mean(
            [
                r["cls"]
                for r in clean_run.scores.to_pylist()
                if (r["planner"], r["noise"], r["seed"]) == ("log-future", "ou-high", seed)
            ]
        )
        for seed in (0, 1)
    ]
    found = next(
        r for r in summary(clean_run)["scores"] if r["planner"] == "log-future" and r["seeds"] == 2
    )
    assert found["mean"]["cls"] == pytest.approx(np.mean(means), abs=1e-12)
    assert found["std_over_seeds"]["cls"] == pytest.approx(np.std(means, ddof=1), abs=1e-12)


def test_rows_stand_in_the_order_of_the_settings(clean_run):
    assert [(group.planner, group.noise) for group in read_groups([clean_run])] == [
        ("constant-velocity", "none"),
        ("constant-velocity", "ou-high"),
        ("log-future", "none"),
        ("log-future", "ou-high"),
    ]


def test_rows_can_be_split_by_scenario_type(clean_run):
    table = scores(read_groups([clean_run]), by="scenario_type")
    assert [row[2] for row in table.rows[:2]] == ["free", "parked"]
    parts = of(clean_run, "log-future", "none").split("scenario_type")
    assert [len(part.data.tokens) for _, part in parts] == [2, 2]


def test_the_table_of_a_run_is_the_text_of_its_scores(clean_run):
    found = render(scores(read_groups([clean_run])), "text")
    title, _, rest = found.partition("\n")
    assert title.startswith("Scores × 100 of all planners and noises: ")
    assert rest == score_table([clean_run])


@pytest.mark.parametrize("style", FORMATS)
def test_profile_version_and_scenario_count_stand_with_every_table(clean_run, style):
    text = render(scores(read_groups([clean_run])), style)
    assert "thresholds nuplan" in text
    assert "metrics v" in text
    assert "4 scenarios" in text


def test_csv_has_unrounded_numbers(clean_run):
    table = render(scores(read_groups([clean_run])), "csv")
    rows = list(csv.DictReader(io.StringIO(table)))
    assert float(rows[0]["CLS"]) == of(clean_run, "constant-velocity", "none").estimate().value


def test_an_unknown_format_or_column_is_refused(clean_run):
    with pytest.raises(ConfigError, match="format 'pdf' unknown"):
        render(scores(read_groups([clean_run])), "pdf")
    with pytest.raises(ConfigError, match="colour"):
        scores(read_groups([clean_run]), by="colour")


def test_the_worst_scenarios_come_each_by_its_worst_rollout_and_with_a_reason(clean_run):
    lowest = {}
    for row in clean_run.scores.to_pylist():
        lowest[row["token"]] = min(row["cls"], lowest.get(row["token"], 1.0))

    worst = worst_rollouts(clean_run, 5)

    assert len({row["token"] for row in worst}) == len(worst) == len(lowest)
    assert [row["cls"] for row in worst] == sorted(lowest.values())[:5]
    assert all(row["cls"] == lowest[row["token"]] for row in worst)
    assert all(row["reason"] for row in worst if row["cls"] < 1.0)


def _worst_row(token, log, metric, value, **more):
    row = {"metric": metric, "score": 0.0, "first_violation_s": 1.0, "first_violation_value": value}
    (found,) = violations([row])
    key = {"planner": "a", "noise": "none", "seed": 0, "token": token, "cls": 0.0, "log": log}
    return {**key, "cause": found.reason, "severity": severity(found), **more}


def test_the_worst_are_ranked_by_severity_and_one_per_recording_and_cause():
    crash, off = "no_ego_at_fault_collisions", "drivable_area_compliance"
    rows = [
        _worst_row("a", "one", off, 0.5),
        _worst_row("b", "two", off, 4.0),
        _worst_row("c", "one", crash, 2.0),
        _worst_row("d", "one", crash, 9.0),
        _worst_row("e", "three", crash, 5.0),
        _worst_row("f", "one", crash, 1.0),
        _worst_row("g", "four", off, 9.0, cls=0.1),
    ]

    found = [(row["token"], others) for row, others in worst_of(rows, 10)]

    assert found == [("d", 2), ("e", 0), ("b", 0), ("a", 0), ("g", 0)]
    assert [row["token"] for row, _ in worst_of(rows, 1)] == ["d"]


def test_the_summary_is_json_and_complete(clean_run):
    found = summary(clean_run)
    assert found["counts"]["ok"] == 24
    assert found["failures"] == failures(clean_run) == []
    assert found["scores"][0]["mean"]["cls"] == read_groups([clean_run])[0].seed_means()[0]
    assert found["scores"][0]["partial_mean"] is None
