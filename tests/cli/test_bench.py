"""A whole track in one command, and its report."""

import csv
import json

import pytest
from commands import call
from stores import write_toy_store

import shiftsim

pytestmark = [pytest.mark.slow, pytest.mark.thorough]

TINY = ("-p", "constant-velocity", "-s", "toy", "--workers", "1", "--quiet")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a store `toy` and a finished benchmark of two noises and one seed."""
    folder = tmp_path_factory.mktemp("bench")
    write_toy_store(folder / "shiftsim-data" / "toy")
    words = ("-n", "none", "-n", "ou-high", "--seeds", "0", "--limit", "2", "--out", "runs/b")
    done = call(folder, "bench", "state-drift", *TINY, *words)
    assert done.returncode == 0, done.stderr
    (folder / "printed.txt").write_text(done.stdout)
    return folder


def test_a_track_is_a_run_per_traffic_mode_and_a_report(place):
    assert {path.name for path in (place / "runs/b").iterdir()} == {
        "bench.json",
        "own-nonreactive",
        "own-reactive",
        "report",
    }
    run = shiftsim.open_run(place / "runs/b/own-reactive")
    assert run.manifest["determining"]["traffic"] == "reactive"
    assert run.manifest["determining"]["thresholds"]["name"] == "deepplan"
    for name in ("report.txt", "report.md", "report.tex", "report.html", "coverage.csv"):
        assert (place / "runs/b/report" / name).stat().st_size > 0


def test_what_is_partial_says_so_everywhere(place):
    printed = (place / "printed.txt").read_text()
    # 2 of 4 scenarios, 2 of 19 settings, both modes
    assert "partial (8/152)" in printed
    assert "toy (2/4)" in printed
    assert "not run" in printed
    with (place / "runs/b/report/coverage.csv").open() as file:
        verdicts = {row["set"]: row["verdict"] for row in csv.DictReader(file)}
    assert verdicts == {"toy (2/4)": "partial (8/152)", "Val14": "not run"}
    for ending in ("txt", "md", "tex", "html"):
        assert "(2/4)" in (place / f"runs/b/report/report.{ending}").read_text()


def test_the_folder_of_a_benchmark_is_reported_as_one(place):
    done = call(place, "report", "runs/b")
    assert done.returncode == 0, done.stderr
    assert "toy (2/4), 2 s  NR " in done.stdout
    assert "toy (2/4), 2 s  R " in done.stdout
    assert "Coverage of the track state-drift" in done.stdout


def test_the_same_command_again_keeps_what_is_there(place):
    words = ("-n", "none", "-n", "ou-high", "--seeds", "0", "--limit", "2", "--out", "runs/b")
    before = (place / "runs/b/own-nonreactive/scores.parquet").stat().st_mtime_ns
    done = call(place, "bench", "state-drift", *TINY, *words)
    assert done.returncode == 0, done.stderr
    assert (place / "runs/b/own-nonreactive/scores.parquet").stat().st_mtime_ns == before


def test_the_folder_of_a_benchmark_is_shown_explained_plotted_and_compared(place):
    worst = call(place, "explain", "runs/b")
    assert worst.returncode == 0, worst.stderr
    assert "worst scenarios of own-nonreactive" in worst.stdout
    assert "worst scenarios of own-reactive" in worst.stdout
    token = shiftsim.open_run(place / "runs/b/own-reactive").worst(1)[0]["token"]
    why = call(place, "explain", "runs/b", token, "--noise", "none")
    assert why.stdout.count(f"{token}  free  constant-velocity none") == 2
    plotted = call(place, "plot", "runs/b", token, "--out", "both.png")
    assert plotted.returncode == 0, plotted.stderr
    assert (place / "both.png").is_file()
    viewed = call(place, "view", "runs/b", "--no-open", "--out", "pages", "--quiet")
    assert viewed.returncode == 0, viewed.stderr
    assert "nonreactive" in (place / "pages/index.html").read_text()
    same = call(place, "diff", "runs/b", "runs/b")
    assert same.returncode == 0, same.stderr
    assert same.stdout.count("own-nonreactive") >= 1
    assert same.stdout.count("own-reactive") >= 1


def test_resume_asks_for_a_benchmark_that_is_there(place):
    words = ("-n", "none", "-n", "ou-high", "--seeds", "0", "--limit", "2", "--resume", "--out")
    assert call(place, "bench", "state-drift", *TINY, *words, "runs/b").returncode == 0
    done = call(place, "bench", "state-drift", *TINY, *words, "runs/absent")
    assert done.returncode == 1
    assert "no benchmark to go on with" in done.stderr


def test_another_benchmark_does_not_go_into_the_same_folder(place):
    done = call(place, "bench", "semantic-shift", *TINY, "--out", "runs/b")
    assert done.returncode == 1
    assert "holds something else than a semantic-shift benchmark" in done.stderr
    other = call(place, "bench", "state-drift", *TINY, "--seeds", "5", "--out", "runs/b")
    assert other.returncode == 1
    assert "holds another run" in other.stderr


def test_a_dry_run_checks_and_writes_nothing(place):
    done = call(place, "bench", "semantic-shift", *TINY, "--dry-run", "--out", "runs/dry")
    assert done.returncode == 0
    assert "tasks       8 " in done.stdout
    assert not (place / "runs/dry").exists()


EDITS = """
[[edit]]
name = "van"
type = "parked_easy"
spawn = [{at = {ahead_m = 14, left_m = -1.2}, behavior = "stopped"}]
"""


def test_the_track_of_edits_drives_recorded_and_edited_scenarios(place):
    (place / "van.toml").write_text(EDITS)
    words = ("--edits", "van.toml", "--out", "runs/edits")
    estimated = call(place, "bench", "edits", *TINY, *words, "--estimate", "--json")
    assert estimated.returncode == 0, estimated.stderr
    runs = [cost["run"] for cost in json.loads(estimated.stdout)["costs"]]
    assert runs[2:4] == ["edited-nonreactive", "edited-reactive"]
    done = call(place, "bench", "edits", *TINY, *words)
    assert done.returncode == 0, done.stderr
    assert "toy+van" in done.stdout
    assert "recorded" in done.stdout
    run = shiftsim.open_run(place / "runs/edits/edited-reactive")
    assert set(run.scores["scenario_type"].to_pylist()) == {"parked_easy"}
    with next((place / "runs/edits/report").glob("edits_*.csv")).open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["traffic"], row["kind"], row["scenarios"]) for row in rows] == [
        ("NR", "parked", "4"),
        ("R", "parked", "4"),
    ]
    own = shiftsim.open_run(place / "runs/edits/own-nonreactive").scores["cls"].to_numpy()
    assert float(rows[0]["recorded"]) == pytest.approx(100.0 * own.mean())
    compared = (place / "runs/edits/report/benchmark-comparison.csv").read_text()
    assert "(own, edited)" in compared
    stamp = (place / "runs/edits/edited-reactive/scores.parquet").stat().st_mtime_ns
    assert call(place, "bench", "edits", *TINY, *words, "--resume").returncode == 0
    assert (place / "runs/edits/edited-reactive/scores.parquet").stat().st_mtime_ns == stamp


def test_edits_of_the_track_are_drawn_and_kept(place):
    words = ("-p", "constant-velocity", "--workers", "1", "--quiet", "--limit", "3")
    done = call(place, "bench", "edits", *words, "--traffic", "nonreactive", "--out", "runs/drawn")
    assert done.returncode == 0, done.stderr
    text = (place / "runs/drawn/edits.toml").read_text()
    assert text.count("[[edit]]") == 180
    run = shiftsim.open_run(place / "runs/drawn/edited-nonreactive")
    kinds = {kind.rpartition("_")[0] for kind in run.scores["scenario_type"].to_pylist()}
    assert kinds == {"jaywalker", "parked", "works"}
    assert "(3/180)" in done.stdout


@pytest.mark.parametrize(
    ("words", "fact"),
    [
        (("bench", "drift", *TINY), "track 'drift' unknown"),
        (("bench", "state-drift", "-s", "toy"), "no planner"),
        (("bench", "state-drift", *TINY, "--val14", "absent"), "no store 'absent'"),
        (("bench", "edits", *TINY, "--val14", "toy"), "has no published list"),
        (("bench", "state-drift", *TINY, "--edits", "van.toml"), "drives recorded scenarios"),
        (("bench", "state-drift", *TINY, "--noise", "loud"), "noise 'loud' unknown"),
        (("report", "runs/b", "-f", "pdf"), "format 'pdf' unknown"),
        (("report", "runs/b", "-t", "score"), "table 'score' unknown"),
        (("diff", "runs/b/own-reactive", "runs/absent"), "no run folder"),
    ],
)
def test_mistakes_are_found_before_anything_runs(place, words, fact):
    done = call(place, *words)
    assert done.returncode in (1, 2)
    assert fact in done.stderr
    assert len(done.stderr.splitlines()) <= 2


def test_val14_is_driven_under_the_default_thresholds(place):
    words = ("--val14", "toy", "--traffic", "nonreactive", "--out", "runs/val")
    done = call(place, "bench", "semantic-shift", *TINY, *words)
    assert done.returncode == 0, done.stderr
    run = shiftsim.open_run(place / "runs/val/val14-nonreactive")
    assert run.manifest["determining"]["thresholds"]["name"] == "nuplan"
    # the toy store is not that list, and is not called so
    assert "Val14" not in [line.split()[0] for line in done.stdout.splitlines() if " NR " in line]


def test_diff_and_report_speak_json(place):
    runs = ("runs/b/own-nonreactive", "runs/b/own-reactive")
    found = json.loads(call(place, "diff", *runs, "--json").stdout)
    assert found["same"] + found["better"] + found["worse"] == 4
    assert found["settings"] == ["traffic"]
    summaries = json.loads(call(place, "report", "runs/b", "--json").stdout)
    assert [entry["traffic"] for entry in summaries] == ["nonreactive", "reactive"]


def test_pictures_are_written_beside_the_run(place):
    pytest.importorskip("matplotlib")
    done = call(place, "report", "runs/b/own-nonreactive", "--figures", "-f", "html")
    assert done.returncode == 0, done.stderr
    folder = place / "runs/b/own-nonreactive/report"
    names = {path.suffix for path in folder.iterdir()}
    assert names == {".png", ".html"}
    assert "data:image/png;base64" in (folder / "report.html").read_text()


def test_planners_of_a_track_may_have_arguments(place):
    words = ("-p", "simple", "--planner-arg", "max_velocity=3", "-s", "toy", "--dry-run")
    assert call(place, "bench", "semantic-shift", *words).returncode == 0
