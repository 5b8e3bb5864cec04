"""The paper's tables, and that nothing in them looks complete that is not."""

import csv
import io
import re

import numpy as np
import pytest
from made_runs import METRICS, random_scores, write_run

from shiftsim.benchmarks import known_sets, published
from shiftsim.errors import ConfigError, DataError
from shiftsim.metrics import MULTIPLIERS, SHORT_NAMES, WEIGHTS
from shiftsim.report.build import CITED, TABLES, Options, make_tables, runs_table, write_report
from shiftsim.report.details import (
    edited_scores,
    planner_comparison,
    planning_times,
    scenario_types,
)
from shiftsim.report.groups import KnownSet, read_groups, token_digest
from shiftsim.report.paper import noise_robustness, published_semantic, semantic_shift
from shiftsim.report.scores import score_table, scores, summary
from shiftsim.report.tables import (
    FORMATS,
    Number,
    Table,
    latex_escape,
    markdown_escape,
    render,
    shown,
)
from shiftsim.report.words import LONG
from shiftsim.runs.diff import diff_lines, diff_runs
from shiftsim.runs.results import label_runs

TOKENS = ("t0", "t1", "t2", "t3")


def cells(table, *labels):
    """The row that begins with some labels, by column."""
    (row,) = [row for row in table.rows if row[: len(labels)] == labels]
    return {name: shown(cell) for name, cell in zip(table.header, row, strict=True)}


def test_scores_per_city_are_means_over_its_scenarios(tmp_path):
    score = random_scores(1)
    run = write_run(tmp_path / "a", score=score)
    (table,) = semantic_shift(read_groups([run]))
    values = [100.0 * score("alpha", "none", 0, number) for number in range(4)]
    row = cells(table, "NR", "alpha")
    assert row["made-up"] == f"{np.mean(values):.2f}"
    assert row["x"] == f"{np.mean(values[:2]):.2f}"
    assert row["y"] == f"{np.mean(values[2:]):.2f}"
    assert row["DAC"] == row["made-up"]


def test_a_missing_rollout_withholds_its_city_and_the_whole_but_no_other_city(tmp_path):
    lost = [("alpha", "none", 0, "t3")]
    run = write_run(tmp_path / "a", planners=("alpha", "beta"), missing=lost)
    (table,) = semantic_shift(read_groups([run]))
    row = cells(table, "NR", "alpha")
    assert row["made-up"] == "– (3/4)"
    assert row["y"] == "– (1/2)"
    assert row["x"] == "50.00"
    assert row["95 % CI"] == ""
    assert cells(table, "NR", "beta")["made-up"] == "50.00"


def test_a_scenario_that_nobody_finished_could_be_in_any_city(tmp_path):
    run = write_run(tmp_path / "a", missing=[("alpha", "none", 0, "t3")])
    (table,) = semantic_shift(read_groups([run]))
    row = cells(table, "NR", "alpha")
    assert row["x"] == "– (2/3)"
    assert row["y"] == "– (1/2)"


def test_a_partial_mean_is_labelled_wherever_it_stands(tmp_path):
    run = write_run(tmp_path / "a", missing=[("alpha", "none", 0, "t3")])
    (table,) = semantic_shift(read_groups([run], allow_partial=True))
    assert cells(table, "NR", "alpha")["made-up"] == "50.00 partial (3/4)"
    for style in ("text", "md", "latex", "html", "csv"):
        assert "partial (3/4)" in render(table, style)


def test_part_of_a_known_list_says_so_in_its_name(tmp_path):
    whole = tuple(f"t{i}" for i in range(9))
    known = KnownSet("nine", "Nine", "nuplan", 9, token_digest(whole), whole)
    run = write_run(tmp_path / "a", split="something")
    assert read_groups([run], [known])[0].data.label == "Nine (4/9)"


def test_a_known_list_is_told_by_its_hash_and_not_by_its_name(tmp_path):
    hashed = KnownSet("val14", "Val14", "nuplan", 4, token_digest(TOKENS))
    real = write_run(tmp_path / "a", split="my-copy")
    other = write_run(tmp_path / "b", split="val14", tokens=("u0", "u1", "u2", "u3"))
    short = write_run(
        tmp_path / "c", split="val14", tokens=("u0",), cities="x", logs="l", types=["k"]
    )
    labels = [read_groups([run], [hashed])[0].data.label for run in (real, other, short)]
    assert labels == ["Val14", "val14 (not the published list)", "Val14 (1/4)"]


def test_a_limited_run_of_an_unknown_list_says_so(tmp_path):
    run = write_run(tmp_path / "a", limit=4)
    assert read_groups([run])[0].data.label == "made-up (first 4)"


def test_a_shard_says_so(tmp_path):
    run = write_run(tmp_path / "a", shard="1/3")
    assert read_groups([run])[0].data.label == "made-up (shard 1/3)"


def test_seeds_have_a_mean_and_a_sample_deviation(tmp_path):
    score = random_scores(2)
    run = write_run(tmp_path / "a", noise=("none", "ou-high"), seeds=(0, 1, 2), score=score)
    means = [
        np.mean([100.0 * score("alpha", "ou-high", seed, n) for n in range(4)]) for seed in range(3)
    ]
    table = noise_robustness(read_groups([run]))
    row = cells(table, "made-up", "NR", "alpha")
    assert row["ou-high"] == f"{np.mean(means):.2f} ± {np.std(means, ddof=1):.2f}"
    assert "±" not in row["none"]


def test_clean_runs_have_no_noise_table(tmp_path):
    assert noise_robustness(read_groups([write_run(tmp_path / "a")])) is None


def test_both_traffic_modes_of_two_runs_stand_in_one_table(tmp_path):
    runs = [
        write_run(tmp_path / "a", traffic="reactive", score=lambda *key: 0.25),
        write_run(tmp_path / "b", traffic="nonreactive"),
    ]
    (table,) = semantic_shift(read_groups(runs))
    assert [row[:2] for row in table.rows] == [("NR", "alpha"), ("R", "alpha")]
    assert cells(table, "R", "alpha")["made-up"] == "25.00"


def test_val14_under_several_rules_has_a_column_for_each(tmp_path):
    known = [KnownSet("val14", "Val14", "nuplan", 2, token_digest(("v0", "v1")))]
    val14 = {"split": "val14", "tokens": ("v0", "v1"), "cities": "xx", "logs": "lm"}
    runs = [write_run(tmp_path / "own")]
    for rules, score in (("nuplan", 0.25), ("deepplan", 0.75)):
        settings = val14 | {"thresholds": rules, "score": lambda *key, score=score: score}
        runs.append(write_run(tmp_path / rules, **settings))

    (table,) = semantic_shift(read_groups(runs, known))

    columns = [i for i, name in enumerate(table.header) if name.startswith("Val14")]
    assert [str(table.rows[0][i]) for i in columns] == ["25.00", "75.00"]


def test_val14_stands_beside_the_own_scenarios(tmp_path):
    known = [KnownSet("val14", "Val14", "nuplan", 2, token_digest(("v0", "v1")))]
    runs = [
        write_run(tmp_path / "own", thresholds="deepplan"),
        write_run(
            tmp_path / "val",
            tokens=("v0", "v1"),
            cities=("z", "z"),
            logs=("k", "k"),
            score=lambda *key: 0.9,
        ),
    ]
    (table,) = semantic_shift(read_groups(runs, known))
    row = cells(table, "NR", "alpha")
    assert (row["Val14"], row["made-up"]) == ("90.00", "50.00")
    assert "z" not in table.header


def test_different_thresholds_are_different_tables(tmp_path):
    runs = [
        write_run(tmp_path / "a", thresholds="nuplan"),
        write_run(tmp_path / "b", thresholds="deepplan"),
    ]
    tables = make_tables(read_groups(runs), options=Options(tables=("semantic-shift",)))
    assert ["thresholds nuplan" in t.notes[0] for t in tables] == [True, False]
    assert len({t.name for t in tables}) == 2


def test_sets_of_one_name_say_what_tells_them_apart(tmp_path):
    runs = [
        write_run(tmp_path / "a", thresholds="nuplan", noise=("none", "ou-low")),
        write_run(tmp_path / "b", thresholds="deepplan", noise=("none", "ou-low")),
        write_run(tmp_path / "c", split="third"),
    ]
    table = noise_robustness(read_groups(runs))
    assert [row[0] for row in table.rows] == ["made-up, nuplan", "made-up, deepplan", "third"]


def test_a_name_that_means_two_planners_is_told_apart(tmp_path):
    runs = [
        write_run(tmp_path / "a", fingerprint="old"),
        write_run(tmp_path / "b", fingerprint="new", score=lambda *key: 0.75),
    ]
    (table,) = semantic_shift(read_groups(runs))
    assert [row[1] for row in table.rows] == ["alpha @a", "alpha @b"]


def fingerprint(**arguments):
    return {"planner": "m:P", "arguments": arguments, "source": "5a"}


def test_two_planners_of_one_name_say_what_differs(tmp_path):
    runs = [
        write_run(tmp_path / "a", fingerprint=fingerprint(headway=2.0, file="x/one.npy")),
        write_run(tmp_path / "b", fingerprint=fingerprint(headway=2.0, file="y/two.npy")),
        write_run(tmp_path / "c", fingerprint=fingerprint(headway=2.0, file="y/two.npy")),
        write_run(tmp_path / "d", fingerprint=fingerprint(headway=2.0)),
    ]
    names = [group.planner for group in read_groups(runs)]
    assert names == ["alpha (file one.npy)", "alpha (file two.npy)", "alpha"]


def test_the_checkpoint_of_a_learned_planner_is_named(tmp_path):
    runs = []
    for name, given in (("a", "w/one.ckpt"), ("b", "alpha=two.ckpt")):
        run = write_run(tmp_path / name, fingerprint=fingerprint() | {"checkpoint": name})
        run.manifest["config"]["checkpoints"] = [given]
        runs.append(run)
    names = [group.planner for group in read_groups(runs)]
    assert names == ["alpha (checkpoint one.ckpt)", "alpha (checkpoint two.ckpt)"]


def test_the_same_planner_run_otherwise_says_so_where_it_did_otherwise(tmp_path):
    runs = [write_run(tmp_path / "a"), write_run(tmp_path / "b", score=random_scores(1))]
    for run, size in zip(runs, (1, 16), strict=True):
        run.manifest["determining"]["batch_size"] = size
    names = [group.planner for group in read_groups(runs)]
    assert names == ["alpha (batch size 1)", "alpha (batch size 16)"]
    runs[1] = write_run(tmp_path / "c")
    runs[1].manifest["determining"]["batch_size"] = 16
    assert [group.planner for group in read_groups(runs)] == ["alpha"]


def test_other_seeds_are_rows_of_their_own(tmp_path):
    runs = [write_run(tmp_path / str(s), noise=("ou-low",), seeds=s) for s in ((0, 1), (2, 3))]
    names = [group.planner for group in read_groups(runs)]
    assert names == ["alpha (seeds 0 1)", "alpha (seeds 2 3)"]


def test_a_run_is_labelled_in_all_its_tables(tmp_path):
    run = write_run(tmp_path / "a", planners=("alpha", "beta"), fingerprint=fingerprint())
    run.manifest["config"] |= {"planner_args": {"beta": {"x": 1}}, "checkpoints": ["beta=f"]}
    named = run.labelled({"alpha": "ours"}).labelled({"beta": "theirs", "ours": "mine"})
    for table in (named.scores, named.tasks):
        assert set(table["planner"].to_pylist()) == {"mine", "theirs"}
    assert named.manifest["config"]["planner_args"] == {"theirs": {"x": 1}}
    assert named.manifest["config"]["checkpoints"] == ["theirs=f"]
    assert list(named.manifest["determining"]["planners"]) == ["mine", "theirs"]
    assert {task.planner for task in named.rollout_places} == {"mine", "theirs"}
    assert [group.planner for group in read_groups([named])] == ["mine", "theirs"]
    assert set(run.scores["planner"].to_pylist()) == {"alpha", "beta"}
    with pytest.raises(ConfigError, match="called the same"):
        run.labelled({"alpha": "beta"})


def test_labels_are_of_all_runs_or_of_one(tmp_path):
    runs = [write_run(tmp_path / name) for name in "ab"]
    both = label_runs(runs, ["alpha=lr=1e-4", "b/alpha=new"])
    assert [run.manifest["config"]["planners"] for run in both] == [["lr=1e-4"], ["new"]]
    with pytest.raises(ConfigError, match=r"planner 'alhpa' unknown\nhint: did you mean 'alpha'"):
        label_runs(runs, ["alhpa=ours"])
    with pytest.raises(ConfigError, match="is empty"):
        label_runs(runs, ["alpha="])


def test_the_same_result_twice_is_shown_once_and_a_contradiction_is_refused(tmp_path):
    runs = [write_run(tmp_path / name) for name in "ab"]
    assert len(read_groups(runs)) == 1
    other = write_run(tmp_path / "c", score=lambda *key: 0.1)
    with pytest.raises(DataError, match=r"both hold alpha none NR[^\0]*--label c/alpha=other"):
        read_groups([*runs, other])
    labelled = label_runs([*runs, other], ["c/alpha=other"])
    assert [group.planner for group in read_groups(labelled)] == ["alpha", "other"]


def test_planners_are_compared_on_complete_scores_only(tmp_path):
    score = {"alpha": 0.5, "beta": 0.75, "gamma": 0.1}
    run = write_run(
        tmp_path / "a",
        planners=tuple(score),
        score=lambda planner, *key: score[planner],
        missing=[("gamma", "none", 0, "t0")],
    )
    table = planner_comparison(read_groups([run]))
    row = cells(table, "made-up", "NR", "none", "alpha", "beta")
    assert len(table.rows) == 1
    assert (row["difference"], row["better/same/worse"]) == ("-25.00", "0/0/4")
    # three recordings: all signs alike happens by chance in 2 of 8 patterns
    assert row["p"] == "0.2500"
    assert any("few recordings (3)" in note for note in table.notes)
    assert any("not compared" in note and "gamma none NR" in note for note in table.notes)


def test_scenario_types_are_rows(tmp_path):
    kinds = ["left", "left", "right", "right"]
    run = write_run(tmp_path / "a", types=kinds, score=lambda p, n, s, number: number / 4.0)
    (table,) = scenario_types(read_groups([run]))
    assert cells(table, "left")["alpha NR"] == "12.50"
    assert cells(table, "right")["alpha NR"] == "62.50"


def test_degraded_steps_are_counted(tmp_path):
    table = planning_times(read_groups([write_run(tmp_path / "a")]))
    row = cells(table, "made-up", "NR", "alpha")
    assert (row["degraded steps"], row["in rollouts"]) == ("6", "3")
    assert (row["ms per step"], row["95 % ms"]) == ("2.00", "3.00")


def test_published_rows_stand_beside_own_ones_of_the_same_cities(tmp_path):
    cities = ("Sindelfingen", "Berlin", "München", "Stuttgart")
    run = write_run(tmp_path / "a", planners=("pdm-closed",), cities=cities)
    (table,) = semantic_shift(read_groups([run]), published(), with_published=True)
    own = cells(table, "NR", "pdm-closed")
    theirs = cells(table, "NR", "PDM-Closed (published)")
    assert table.header[4:8] == ("SIFI", "MUC", "STR", "BER")
    assert own["MUC"] == "50.00"
    assert (theirs["made-up"], theirs["MUC"], theirs["EIC"]) == ("48.07", "57.02", "72.17")
    assert any("not the paper's" in note for note in table.notes)


def test_published_rows_stand_alone_where_the_cities_are_others(tmp_path):
    tables = semantic_shift(
        read_groups([write_run(tmp_path / "a")]), published(), with_published=True
    )
    assert [t.name for t in tables] == ["semantic-shift_made-up", "semantic-shift_published"]
    assert cells(tables[1], "R", "CaRL (published)")["SFO"] == "87.67"


def test_the_demo_is_never_called_the_benchmark(tmp_path):
    run = write_run(tmp_path / "a")
    (table,) = semantic_shift(read_groups([run], known_sets()), published())
    assert "not a set of the published benchmark" in table.notes


HOSTILE = 'a&b_50%#1 {x} $y$ \\z ~^ <i>|"q" *s* `c`'


def hostile_table():
    return Table("t", HOSTILE, ("planner", "CLS"), ((HOSTILE, Number(1.0)),), 1, (HOSTILE,))


def test_latex_prints_names_as_they_are():
    escaped = latex_escape(HOSTILE)
    assert escaped.startswith(r"a\&b\_50\%\#1 \{x\} \$y\$ \textbackslash{}z")
    body = render(hostile_table(), "latex")
    assert body.count(r"\&b\_50\%") == 3
    assert latex_escape("[1, 2]") == "[1, 2]"


def test_a_latex_cell_is_not_taken_for_an_option():
    table = Table("t", "", ("a", "b"), (("x", None), ("[1]", Number(2.0))), 1)
    assert "{[1]} & 2.00" in render(table, "latex")


def paper_tables(tmp_path, **settings):
    """Every kind of table of a run, in LaTeX, by name."""
    values = {"planners": ("alpha", "beta_2"), "noise": ("none", "ou-low"), "seeds": (0, 1)}
    run = write_run(tmp_path / "a", **{**values, "score": random_scores(6), **settings})
    kinds = tuple(name for name in TABLES if "data" not in name and "benchmark" not in name)
    tables = make_tables(read_groups([run]), published(), Options(tables=kinds))
    return {table.name: render(table, "latex") for table in tables}


def test_latex_is_sound(tmp_path):
    types = ["left", "left", "right", "right"]
    for name, text in paper_tables(tmp_path, types=types).items():
        begun = re.findall(r"\\(begin|end)\{(\S+?)\}", text)
        opened = []
        for verb, kind in begun:
            opened += [kind] if verb == "begin" else []
            assert verb == "begin" or opened.pop() == kind
        assert not opened, name
        assert text.isascii(), name
        assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
        body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0]
        rows = [line for line in body.splitlines() if "&" in line or line.endswith(r"\\")]
        columns = len(re.search(r"tabular\}\{([lr]+)\}", text)[1])
        assert {row.replace(r"\&", "").count("&") + 1 for row in rows} == {columns}, name
        assert text.index(r"\caption") < text.index(r"\begin{tabular}")
        assert name == "runs" or text.index(r"\end{tabular}") < text.index(r"\begin{minipage}")


def test_latex_has_measured_columns_the_best_in_bold_and_seeds_as_subscripts(tmp_path):
    score = {"alpha": 0.5, "beta_2": 0.75}
    noisy = lambda planner, noise, seed, number: score[planner] - 0.1 * seed  # noqa: E731
    found = paper_tables(tmp_path, score=noisy)
    lines = found["noise-robustness"].splitlines()
    assert (
        r"\caption{Noise robustness: closed-loop score $\times$ 100; set made-up, traffic NR.}"
        in lines
    )
    assert r"  planner & none & ou-low \\" in lines
    assert r"  alpha & 50.00 & 45.00$_{\pm 7.07}$ \\" in lines
    assert r"  beta\_2 & \textbf{75.00} & \textbf{70.00}$_{\pm 7.07}$ \\" in lines
    rows = found["scores"].splitlines()
    assert rows[9].startswith("  none & alpha & 50.00 & ")
    assert rows[10].startswith(r"   & beta\_2 & \textbf{75.00} & ")
    assert rows[11] == r"\midrule"
    assert found["scores"].count("seeds") == 1  # in the note, and no row of deviations
    assert r"$\pm$ sample standard deviation (n $-$ 1) over 2 seeds." in found["scores"]
    assert "95" not in found["semantic-shift_made-up"]
    assert "95" in found["planner-comparison"]


def test_the_best_is_the_smallest_error_and_nothing_where_all_are_alike():
    rows = [("a", Number(1.0), Number(2.0)), ("b", Number(3.0), Number(2.0))]
    rows.append(("c", Number(0.5, done=1, expected=2), Number(2.0)))
    text = render(
        Table("t", "", ("planner", "e", "s"), rows, 1, best={"e": min, "s": max}), "latex"
    )
    assert re.findall(r"textbf\{(.*?)\}", text) == ["1.00"]
    assert r"0.50 partial (1/2)" in text


def test_a_wide_table_goes_over_both_columns_and_a_wider_one_is_made_smaller():
    def float_of(count):
        header = ("planner", *(f"c{i}" for i in range(count)))
        rows = [("a", *[Number(100.0)] * count)]
        return render(Table("t", "", header, rows, 1), "latex")

    assert r"\begin{table} " in float_of(3)
    assert r"\begin{table*} " in float_of(10)
    assert r"\scriptsize\setlength" in float_of(18)
    assert r"\resizebox{\textwidth}" in float_of(30)
    assert "booktabs,graphicx" in float_of(30)


def test_html_prints_names_as_they_are():
    import html.parser

    seen = []

    class Reader(html.parser.HTMLParser):
        def handle_data(self, data):
            seen.append(data)

        def handle_starttag(self, tag, attributes):
            assert tag != "i"

    Reader().feed(render(hostile_table(), "html"))
    assert seen.count(HOSTILE) == 3


def test_markdown_keeps_its_columns():
    lines = render(hostile_table(), "md").splitlines()
    (*_, line) = (line for line in lines if line.startswith("|"))
    assert line.replace(r"\|", "").count("|") == 3
    assert markdown_escape("a_b\nc") == r"a\_b c"


def test_csv_has_every_number_in_full_and_in_its_own_column(tmp_path):
    score = random_scores(3)
    run = write_run(tmp_path / "a", noise=("ou-low",), seeds=(0, 1), score=score)
    table = noise_robustness(read_groups([run]))
    (row,) = csv.DictReader(io.StringIO(render(table, "csv")))
    means = [
        np.mean([100.0 * score("alpha", "ou-low", seed, n) for n in range(4)]) for seed in (0, 1)
    ]
    assert float(row["ou-low"]) == pytest.approx(np.mean(means), abs=1e-12)
    assert float(row["ou-low std"]) == pytest.approx(np.std(means, ddof=1), abs=1e-12)
    assert "thresholds nuplan" in row["notes"]


def test_intervals_are_two_columns_in_csv(tmp_path):
    run = write_run(tmp_path / "a", score=random_scores(4))
    (table,) = semantic_shift(read_groups([run]))
    (row,) = csv.DictReader(io.StringIO(render(table, "csv")))
    assert float(row["95 % CI low"]) < float(row["made-up"]) < float(row["95 % CI high"])


def test_wide_text_is_printed_in_pieces_that_repeat_the_labels(tmp_path):
    (table,) = semantic_shift(read_groups([write_run(tmp_path / "a")]))
    text = render(Table("t", "", table.header, table.rows, 2), "text", width=60)
    assert max(map(len, text.splitlines())) <= 60
    assert text.count("alpha") == text.count("traffic") > 1


def test_a_row_of_the_wrong_length_is_a_mistake():
    with pytest.raises(ValueError, match="2 cells, 1 columns"):
        Table("t", "", ("a",), (("x", "y"),), 1)


def test_unknown_tables_are_refused():
    with pytest.raises(ConfigError, match="'semantic-shft' unknown"):
        Options(tables=("semantic-shft",))


def test_a_report_is_a_folder_with_a_file_per_format(tmp_path):
    run = write_run(tmp_path / "a", planners=("alpha", "beta"), noise=("none", "ou-low"))
    groups = read_groups([run])
    kinds = tuple(name for name in TABLES if "data" not in name and "benchmark" not in name)
    tables = make_tables(groups, published(), Options(tables=kinds))
    files = write_report(tmp_path / "out", "On <a>", [run], tables, [], FORMATS)
    names = {path.name for path in files}
    assert {"report.txt", "report.md", "report.tex", "report.html", "scores.csv"} <= names
    assert "@misc{nuplan," in (tmp_path / "out" / CITED).read_text("utf-8")
    for ending in ("txt", "md", "tex", "html"):
        text = (tmp_path / "out" / f"report.{ending}").read_text("utf-8")
        assert "thresholds nuplan" in text
        assert "Noise robustness" in text
        assert "Zero-shot" not in text
        escaped = {"html": "On &lt;a&gt;", "md": r"# On \<a\>"}
        assert escaped.get(ending, "On <a>") in text
        assert "2026-01-02 03:04 UTC" in text
        assert "shiftsim 9.8.7" in text
        assert (CITED if ending == "tex" else "@misc{shiftsim,") in text


def test_the_runs_table_says_when_from_what_and_with_which_versions(tmp_path):
    weights = {"checkpoint": "1f" * 32, "weights": "own weights"}
    run = write_run(tmp_path / "a", planners=("carl", "idm"), fingerprint=weights)
    rows = {row[0]: row[1] for row in runs_table([run]).rows}
    assert rows["date"] == "2026-01-02 03:04 UTC"
    assert rows["store"] == "nowhere, 0123456789ab"
    assert rows["weights"] == "carl: own weights; idm: own weights"
    assert (rows["shiftsim"], rows["numpy"], rows["numba"]) == ("9.8.7 (abc)", "1.2", "0.3")
    assert rows["rollouts finished"] == "8 of 8"
    files = {"planner": "policy:nets/a.zip", "arguments": {}, "files": {"policy": "2e" * 32}}
    run = write_run(tmp_path / "b", planners=("ours",), fingerprint=files)
    rows = {row[0]: row[1] for row in runs_table([run]).rows}
    assert rows["weights"] == "ours: a.zip 2e2e2e2e2e2e"


def test_metrics_stand_in_one_order_with_their_words(tmp_path):
    run = write_run(tmp_path / "a", noise=("none", "ou-low"))
    order = [short for name, short in SHORT_NAMES.items() if name != "score"]
    assert list(LONG) == ["CLS", *order]
    assert [SHORT_NAMES[name] for name in (*MULTIPLIERS, *WEIGHTS)] == order
    assert [name for name in run.scores.column_names if name in SHORT_NAMES] == METRICS
    (shift,) = semantic_shift(read_groups([run]))
    theirs = published_semantic(published())
    for table in (scores(read_groups([run])), shift, theirs):
        assert [name for name in table.header if name in order] == order
        text = render(table, "text")
        assert "no at-fault collision (NCR), drivable area (DAC), making progress (EMP)" in text
        assert "<small>no at-fault collision</small> NCR" in render(table, "html")
    first = next(iter(published().semantic_shift["NR"].items()))
    row = cells(theirs, "NR", f"{first[0]} (published)")
    assert row["NCR"] == f"{first[1][list(published().columns).index('NCR')]:.2f}"


# --- edits


KINDS = ["parked_easy", "parked_hard", "walk_easy", "walk_easy"]
NAMES = ("t0-a", "t1-a", "t1-b", "t0-c")


def edited_run(folder, score, profile="shiftsim", types=KINDS, **settings):
    made = {name: {"base": name[:2], "edit": name[-1], "digest": "0"} for name in NAMES}
    edits = {"name": "e", "profile": profile, "edit": [], "made": made}
    settings = {"split": "made-up+e", "edits": edits, **settings}
    return write_run(folder, tokens=NAMES, types=types, score=score, **settings)


def test_edits_are_rows_of_kinds_and_columns_of_difficulty(tmp_path):
    score, recorded = random_scores(1), random_scores(2)
    runs = [write_run(tmp_path / "own", score=recorded), edited_run(tmp_path / "e", score)]
    [table] = edited_scores(read_groups(runs))
    own = [100.0 * recorded("alpha", "none", 0, number) for number in range(4)]
    new = [100.0 * score("alpha", "none", 0, number) for number in range(4)]
    parked = cells(table, "NR", "alpha", "parked")
    assert parked["recorded"] == f"{np.mean(own[:2]):.2f}"
    assert (parked["easy"], parked["hard"]) == (f"{new[0]:.2f}", f"{new[1]:.2f}")
    assert (parked["medium"], parked["all"]) == ("", f"{np.mean(new[:2]):.2f}")
    whole = cells(table, "NR", "alpha", "all")
    assert whole["scenarios"] == "4"
    assert whole["easy"] == f"{np.mean([new[0], new[2], new[3]]):.2f}"
    assert whole["recorded"] == f"{np.mean([own[0], own[1], own[1], own[0]]):.2f}"
    assert "windows of 15 s" in table.notes[0]


def test_recorded_scores_of_other_rules_do_not_stand_beside_edits(tmp_path):
    score = random_scores(1)
    others = [{"thresholds": "deepplan"}, {"traffic": "reactive"}, {"planners": ("beta",)}]
    others.append({"durations": ["30 s"] * 4})
    others.append({"tokens": ("t0", "t2", "t3", "t4")})
    for number, settings in enumerate(others):
        own = write_run(tmp_path / f"own{number}", score=score, **settings)
        edited = edited_run(tmp_path / f"e{number}", score)
        [table] = edited_scores(read_groups([own, edited]))
        assert cells(table, "NR", "alpha", "all")["recorded"] == ""


def test_scenarios_of_interplan_have_its_score_and_their_window(tmp_path):
    score = random_scores(1)
    kinds = ["overtake", "overtake", "low_traffic_density", "low_traffic_density"]
    options = {"types": kinds, "durations": ["30 s"] * 4, "traffic": "reactive"}
    [table] = edited_scores(
        read_groups([edited_run(tmp_path / "e", score, profile="interplan", **options)])
    )
    new = [100.0 * score("alpha", "none", 0, number) for number in range(4)]
    assert table.header == ("traffic", "planner", "kind", "scenarios", "interPlan score")
    assert cells(table, "R", "alpha", "overtake")["interPlan score"] == f"{np.mean(new[:2]):.2f}"
    assert cells(table, "R", "alpha", "all")["interPlan score"] == f"{np.mean(new):.2f}"
    assert "30 s" in table.title


def test_edits_under_noise_have_rows_of_their_own(tmp_path):
    score, recorded = random_scores(1), random_scores(2)
    settings = {"noise": ("none", "ou-low"), "seeds": (0, 1)}
    runs = [
        write_run(tmp_path / "own", score=recorded, **settings),
        edited_run(tmp_path / "e", score, **settings),
    ]
    [table] = edited_scores(read_groups(runs))
    noisy = cells(table, "NR", "alpha", "ou-low", "parked")
    new, own = (
        [[100.0 * values("alpha", "ou-low", seed, n) for n in range(2)] for seed in (0, 1)]
        for values in (score, recorded)
    )
    assert noisy["recorded"] == f"{np.mean(own):.2f}"
    assert noisy["all"].startswith(f"{np.mean(new):.2f} ± ")
    clean = edited_scores(read_groups([edited_run(tmp_path / "clean", score)]))[0]
    assert [row[:2] + row[3:5] for row in table.rows if row[2] == "none"] == [
        row[:4] for row in clean.rows
    ]


def test_runs_without_edits_have_no_such_table(tmp_path):
    assert edited_scores(read_groups([write_run(tmp_path / "a")])) == []


# --- durations


def test_scenarios_of_different_durations_never_share_a_mean(tmp_path):
    score = random_scores(1)
    run = write_run(tmp_path / "a", score=score, durations=("15 s", "8 s", "8 s", "15 s"))
    table = scores(read_groups([run]))
    values = [100.0 * score("alpha", "none", 0, number) for number in range(4)]
    full = cells(table, "made-up, 15 s", "NR", "alpha")
    short = cells(table, "made-up, 8 s", "NR", "alpha")
    assert full["CLS"] == f"{np.mean([values[0], values[3]]):.2f}"
    assert short["CLS"] == f"{np.mean(values[1:3]):.2f}"
    assert len(table.rows) == 2
    assert [row["set"] for row in summary(run)["scores"]] == ["made-up, 8 s", "made-up, 15 s"]


def test_short_scenarios_alone_are_labelled(tmp_path):
    run = write_run(tmp_path / "a", durations=["8 s"] * 4)
    assert "split made-up, 8 s (4 scenarios)" in score_table([run])
    run = write_run(tmp_path / "b", durations=["8 s"], tokens=("a",))
    assert "(1 scenario)" in score_table([run])


def test_a_rollout_of_unknown_duration_withholds_every_class(tmp_path):
    durations = ("15 s", "8 s", "8 s", "15 s")
    lost = {("alpha", "none", 0, "t0")}
    run = write_run(tmp_path / "a", durations=durations, missing=lost)
    table = scores(read_groups([run]))
    assert cells(table, "made-up, 8 s")["CLS"] == "– (2/3 done)"
    assert cells(table, "made-up, 15 s")["CLS"] == "– (1/2 done)"


def test_a_diff_of_different_durations_gives_no_mean(tmp_path):
    runs = [
        write_run(tmp_path / name, durations=("15 s", "8 s", "8 s", "15 s")) for name in ("a", "b")
    ]
    found = diff_runs(*runs)
    assert (found.means, found.same) == (None, 4)
    assert "CLS of the common ones –" in diff_lines(found)[0]
