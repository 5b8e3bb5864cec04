"""Why a score is what it is."""

import pytest

from shiftsim.metrics import SHORT_NAMES
from shiftsim.metrics.score import closed_loop_score
from shiftsim.report.explain import explain_lines, losses, select_tasks, why
from shiftsim.report.words import in_words


def metric(name, score, role, weight=None, **first):
    row = {"metric": name, "score": score, "role": role, "weight": weight}
    empty = {"first_violation_iteration": None, "first_violation_s": None, "partner_token": None}
    return row | empty | first


def test_a_score_of_zero_names_every_cause_with_time_and_partner():
    hit = {"first_violation_iteration": 43, "first_violation_s": 4.3, "partner_token": "17"}
    rows = [
        metric("no_ego_at_fault_collisions", 0.0, "multiplier", **hit),
        metric("drivable_area_compliance", 1.0, "multiplier"),
        metric("ego_is_making_progress", 0.0, "multiplier"),
    ]
    assert why(0.0, rows) == (
        "score 0 because of at-fault collision (NCR) at 4.3 s, track 17 and no progress (EMP)"
    )


def test_a_score_is_taken_apart_into_its_terms():
    rows = [
        metric("driving_direction_compliance", 0.5, "multiplier"),
        metric("ego_progress_along_expert_route", 0.8, "weighted", 5.0),
        metric("ego_is_comfortable", 0.0, "weighted", 2.0),
        metric("speed_limit_compliance", None, "weighted", 4.0),
    ]
    score = 0.5 * 5.0 * 0.8 / 7.0
    assert why(score, rows) == f"{100.0 * score:.2f} = 0.5 × (5·80 + 2·0) / 7"


def at(second):
    return {"first_violation_iteration": int(10 * second), "first_violation_s": second}


def test_losses_are_the_falls_of_the_score_in_order_of_time():
    rows = [
        metric("driving_direction_compliance", 0.5, "multiplier", **at(4.0)),
        metric("no_ego_at_fault_collisions", 1.0, "multiplier"),
        metric("ego_progress_along_expert_route", 0.8, "weighted", 5.0),
        metric("time_to_collision_within_bound", 0.0, "weighted", 5.0, **at(3.0)),
        metric("speed_limit_compliance", None, "weighted", 4.0),
        metric("ego_is_comfortable", 1.0, "weighted", 2.0),
    ]
    found = [(row["metric"], points) for row, points in losses(rows)]
    assert [name for name, _ in found] == [
        "time_to_collision_within_bound",
        "driving_direction_compliance",
        "ego_progress_along_expert_route",
    ]
    # weights 5 + 5 + 2: 100 -> 58.3 -> 29.2 -> half of (5 * 0.8 + 2) / 12
    after = [700.0 / 12.0, 350.0 / 12.0, 300.0 / 12.0]
    assert [points for _, points in found] == pytest.approx(
        [100.0 - after[0], after[0] - after[1], after[1] - after[2]]
    )


def test_multipliers_fall_first_at_equal_times_and_nothing_is_lost_of_zero():
    rows = [
        metric("time_to_collision_within_bound", 0.0, "weighted", 5.0, **at(3.0)),
        metric("ego_progress_along_expert_route", 1.0, "weighted", 5.0),
        metric("drivable_area_compliance", 0.0, "multiplier", **at(3.0)),
    ]
    found = [(row["metric"], points) for row, points in losses(rows)]
    assert found == [
        ("drivable_area_compliance", 100.0),
        ("time_to_collision_within_bound", 0.0),
    ]


def test_losses_of_a_run_sum_to_its_scores(clean_run):
    for token in {*clean_run.scores["token"].to_pylist()}:
        for task in select_tasks(clean_run, token):
            lost = sum(points for _, points in losses(task["metrics"]))
            assert 100.0 - lost == pytest.approx(100.0 * task["cls"], abs=1e-9)


def test_a_score_that_is_zero_without_a_multiplier_says_so():
    rows = [metric("ego_is_comfortable", 0.0, "weighted", 2.0)]
    assert why(0.0, rows) == "score 0 because every weighted metric is 0"


def test_the_terms_of_every_real_score_give_that_score(clean_run):
    for token in set(clean_run.tasks["token"].to_pylist()):
        for task in select_tasks(clean_run, token):
            scores = {row["metric"]: row["score"] for row in task["metrics"] if row["role"]}
            assert closed_loop_score(scores) == pytest.approx(task["cls"], abs=1e-12)
            assert task["why"].startswith(
                f"{100.0 * task['cls']:.2f} = " if task["cls"] else "score 0"
            )


def test_every_metric_has_a_line_with_value_threshold_and_weight(clean_run):
    (task,) = select_tasks(clean_run, "0001cafe", planner="constant-velocity", noise="none")
    text = "\n".join(explain_lines(task))
    for row in task["metrics"]:
        assert in_words(row["metric"]) in text
    assert "threshold 0.95 s" in text
    assert text.count("weight ") == 4


def test_metrics_stand_in_the_one_order_in_files_and_explanations(clean_run):
    order = [name for name in SHORT_NAMES if name != "score"]
    for task in select_tasks(clean_run, "0001cafe"):
        assert [row["metric"] for row in task["metrics"]][: len(order)] == order
    table = clean_run.metrics
    first = table.slice(0, table.num_rows // clean_run.scores.num_rows)["metric"].to_pylist()
    assert first[: len(order)] == order
    assert [name for name in clean_run.scores.column_names if name in order] == order
