import json

import pytest
from made_runs import write_run
from pages import sections
from stores import write_toy_store
from typer.testing import CliRunner

import shiftsim
from shiftsim.cli import app, main
from shiftsim.report.build import TABLES


@pytest.fixture
def call():
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def test_view_writes_one_page_for_a_scenario(call, clean_run, tmp_path):
    done = call("view", clean_run.path, "0001", "--out", tmp_path, "--no-open")

    assert done.exit_code == 0, done.output
    assert [path.name for path in tmp_path.iterdir()] == ["0001cafe.html"]


def test_a_fork_needs_a_scenario(call, clean_run, tmp_path):
    done = call("view", clean_run.path, "--fork", "--out", tmp_path, "--no-open")

    assert "--fork needs a scenario" in str(done.exception)
    assert not list(tmp_path.iterdir())


def test_view_writes_a_list_with_all_scenarios(call, clean_run, tmp_path):
    done = call("view", clean_run.path, "-p", "log-future", "--out", tmp_path, "--no-open", "-q")

    rows = json.loads(sections((tmp_path / "index.html").read_text("utf-8"))["rows"])
    assert "4 replays" in done.output
    assert {row["planner"] for row in rows} == {"log-future"}


def test_view_says_how_many_it_left_out(call, clean_run, tmp_path):
    done = call("view", clean_run.path, "--limit", 1, "--out", tmp_path, "--no-open", "-q")

    assert "1 replay, 3 more with --limit 0" in done.output


def test_another_run_must_have_the_scenario(call, clean_run, tmp_path):
    store = write_toy_store(tmp_path / "store", count=1, iterations=20)
    other = shiftsim.run("simple", store=str(store), workers=1, out=tmp_path / "other").path
    words = ("--out", tmp_path / "out", "--no-open", "--with")
    assert call("view", clean_run.path, "0001", *words, clean_run.path).exit_code == 0
    done = call("view", clean_run.path, "0001", *words, other)
    assert str(done.exception) == f"--with {other}: no rollout of scenario 0001cafe of that store"


def test_the_report_page_holds_tables_pictures_and_replays(call, clean_run, tmp_path):
    pytest.importorskip("matplotlib")

    done = call("report", clean_run.path, "--html", tmp_path, "-q")

    page = (tmp_path / "index.html").read_text("utf-8")
    rows = json.loads(sections(page)["rows"])
    assert done.exit_code == 0, done.output
    assert "of all planners and noises" in page
    assert list(tmp_path.glob("*.png"))
    assert all((tmp_path / row["page"]).is_file() for row in rows)
    assert len(rows) == 24  # all seeds


def test_a_report_compares_under_noise_too_and_names_its_tables(call, clean_run):
    printed = call("report", clean_run.path)
    assert "difference of closed-loop scores × 100, first minus second" in printed.output
    assert "scenario by scenario, clean" in printed.output
    assert "scenario by scenario, under noise" in printed.output

    listed = call("report", "--list")
    assert listed.exit_code == 0, listed.output
    assert [line.split()[0] for line in listed.output.splitlines()] == list(TABLES)

    empty = call("report", clean_run.path, "--table", "edits")
    assert "no table edits: these runs hold nothing of it\n" in empty.output


def test_a_report_says_that_missing_rollouts_may_leave_out_planners(call, tmp_path):
    lost = [(planner, "ou-low", 0, "t1") for planner in ("alpha", "beta")]
    settings = {"planners": ("alpha", "beta"), "noise": ("ou-low",), "missing": lost}
    run = write_run(tmp_path / "a", **settings)
    done = call("report", run.path, "--table", "planner-comparison-noise")
    words = " ".join(done.output.split())
    assert "planners that lack rollouts may be left out, 6 of 8 in a finished" in words


def test_plot_writes_a_figure(call, clean_run, tmp_path):
    pytest.importorskip("matplotlib")

    done = call("plot", clean_run.path, "0001cafe", "--at", 1.0, "-o", tmp_path / "a.svg")

    assert done.exit_code == 0, done.output
    assert (tmp_path / "a.svg").read_text("utf-8").startswith("<?xml")


def test_a_figure_of_fewer_rollouts_says_so(call, clean_run, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("shiftsim.view.build.MAX_ROLLOUTS", 4)

    done = call("plot", clean_run.path, "0001cafe", "-o", tmp_path / "a.svg")

    assert "4 of 6 rollouts shown; --planner, --noise and --seed choose others" in done.output
    assert "4 of 6 rollouts shown" in (tmp_path / "a.svg").read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("view", "{run}", "ffff"), "hint:"),
        (("view", "{run}", "0001", "-p", "nobody"), "planners: constant-velocity, log-future"),
        (("view", "{run}", "-n", "ou-hihg"), "noise: none, ou-high; seeds: "),
        (("plot", "{run}", "0001cafe", "-o", "a.bmp"), "pictures: .pdf"),
        (("view", "nowhere"), "hint:"),
    ],
)
def test_mistakes_end_in_two_lines(clean_run, capsys, words, hint):
    with pytest.raises(SystemExit) as left:
        main([word.format(run=clean_run.path) for word in words])

    lines = capsys.readouterr().err.splitlines()
    assert left.value.code == 1
    assert len(lines) == 2
    assert lines[0].startswith("error: ")
    assert hint in lines[1]


def test_planners_are_called_otherwise_in_pictures_and_comparisons(call, clean_run, tmp_path):
    names = clean_run.manifest["config"]["planners"]
    label = ("--label", f"{names[0]}=ours")
    done = call("view", clean_run.path, *label, "-p", "ours", "--out", tmp_path, "--no-open", "-q")
    rows = json.loads(sections((tmp_path / "index.html").read_text("utf-8"))["rows"])
    assert done.exit_code == 0, done.output
    assert {row["planner"] for row in rows} == {"ours"}
    found = call("diff", clean_run.path, clean_run.path, *label)
    assert "better 0" in found.output


def test_open_against_closed_needs_open_loop_and_plot_a_scenario(call, clean_run):
    for words, hint in (((), "--open-against-closed"), (("--open-against-closed",), "--open-loop")):
        error = call("plot", clean_run.path, *words).exception
        assert hint in error.hint
