"""The ranking of planners, and what it says in sentences."""

import pytest
from made_runs import write_run

from shiftsim.report.details import planner_comparison, ranking
from shiftsim.report.groups import read_groups
from shiftsim.report.statistics import Comparison, forest, score_interval
from shiftsim.report.tables import FORMATS, Interval, render, shown

NOISE = ("none", "ou-low", "ou-high")
MEANS = {
    ("alpha", "none"): 0.5,
    ("beta", "none"): 0.9,
    ("alpha", "ou-low"): 0.3,
    ("beta", "ou-low"): 0.6,
    ("alpha", "ou-high"): 0.4,
    ("beta", "ou-high"): 0.0,
}
LOGS = ("l0", "l1", "l2", "l3")


def ranked(path, **more):
    settings = {"planners": ("alpha", "beta"), "noise": NOISE, "logs": LOGS, **more}
    run = write_run(path, score=lambda planner, noise, *_: MEANS[planner, noise], **settings)
    groups = read_groups([run])
    return groups, ranking(groups)


def test_the_best_without_noise_is_first_beside_the_noise_of_the_lowest_mean(tmp_path):
    groups, table = ranked(tmp_path / "a")

    assert [shown(row[2]) for row in table.rows] == ["beta", "alpha"]
    assert table.header[3:] == ("without noise", "95 % CI", "under ou-high", "95 % CI with it")
    assert [shown(cell) for cell in table.rows[0][3:]] == [
        "90.00",
        "[90.00, 90.00]",
        "0.00",
        "[0.00, 0.00]",
    ]
    (clean,) = [g for g in groups if (g.planner, g.noise) == ("beta", "none")]
    assert table.rows[0][4] == score_interval(clean)


def test_it_says_who_leads_what_noise_changes_and_what_scores_nothing(tmp_path):
    _, table = ranked(tmp_path / "a")

    assert table.findings == [
        "beta is first with 90.00 (95 % interval 90.00 to 90.00) without noise, on 4 scenarios in "
        "nonreactive traffic; alpha follows, 40.00 behind, which is not significant (p = 0.12, "
        "Holm).",
        "Under ou-high scores change by −90.00 (beta) to −10.00 (alpha); alpha is first with "
        "40.00.",
        "4 of 24 rollouts score 0: at-fault collision in 4, drivable area in 4, no progress in 4, "
        "driving direction in 4.",
    ]


def test_a_significant_lead_is_the_one_of_the_comparison(tmp_path):
    tokens = tuple(f"t{number}" for number in range(8))
    more = {"tokens": tokens, "cities": ("x",) * 8, "logs": tokens, "noise": ("none",)}
    groups, table = ranked(tmp_path / "a", **more)

    p = planner_comparison(groups).rows[0][-1]
    assert f"which is significant (p = {p.value:.2g}, Holm)" in table.findings[0]
    assert table.findings[1] == "There are no complete scores under noise."


def test_one_planner_alone_leads_nobody(tmp_path):
    _, table = ranked(tmp_path / "a", planners=("alpha",))

    assert table.findings[0].startswith("alpha scores 50.00 (95 % interval")
    assert table.findings[1] == (
        "Under ou-low scores change by −20.00 (alpha); alpha stays first with 30.00."
    )


@pytest.mark.parametrize("allow_partial", [False, True])
def test_what_is_not_complete_is_not_ranked_and_named(tmp_path, allow_partial):
    lost = [("beta", "none", 0, "t1"), *(("alpha", n, 0, "t0") for n in NOISE[1:])]
    more = {"planners": ("alpha", "beta"), "noise": NOISE, "logs": LOGS, "missing": lost}
    run = write_run(tmp_path / "a", score=lambda planner, noise, *_: MEANS[planner, noise], **more)

    table = ranking(read_groups([run], allow_partial=allow_partial))

    assert [shown(row[2]) for row in table.rows] == ["alpha"]
    assert table.rows[0][-2:] == (None, None)
    left_out = "not ranked, as scores are missing: alpha ou-low NR, alpha ou-high NR, beta none NR"
    assert left_out in table.notes
    assert table.findings[1] == "Under ou-high beta is first with 0.00."
    assert ranking([group for group in read_groups([run]) if not group.is_complete]) is None


@pytest.mark.parametrize("style", [name for name in FORMATS if name not in ("csv", "latex")])
def test_the_sentences_stand_with_the_table(tmp_path, style):
    _, table = ranked(tmp_path / "a")

    assert "24 rollouts score 0" in render(table, style)


def test_a_forest_has_one_scale_with_zero_in_the_middle():
    more = (0.5, 0.1, 1, 0, 1)
    pairs = [Comparison(-30.0, Interval(-44.0, -10.0), *more), Comparison(5.0, None, *more)]

    axis, first, second = forest(pairs)

    assert ">−50</text>" in axis
    assert ">50</text>" in axis
    assert '<path d="M16.4 8H81.0"/><circle cx="43.0"' in first
    assert '<path d="M109.5 8H109.5"/><circle cx="109.5"' in second
