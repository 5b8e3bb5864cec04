"""The public names: what they print, what notebooks show of them, and that their examples run."""

import copy
import pickle
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from stores import write_toy_store
from track_files import export_town, write_tracks

import shiftsim
from shiftsim.files import PACKAGE
from shiftsim.report.build import TABLES
from shiftsim.report.tables import FORMATS
from shiftsim.sim.planner import observe_log, scene_info


def is_short(text):
    return "\n" not in text and len(text) < 250


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("api") / "toy"
    write_toy_store(path)
    return shiftsim.open_store(path)


@pytest.fixture(scope="module")
def scenario(store):
    return store[store.tokens[0]]


@pytest.fixture(scope="module")
def log(scenario):
    return shiftsim.simulate(scenario, "constant-velocity")


@pytest.fixture(scope="module")
def run(store, tmp_path_factory):
    out = str(tmp_path_factory.mktemp("run") / "out")
    return shiftsim.run("constant-velocity", store=str(store.path), out=out, workers=1)


def test_the_representations_are_one_short_line_with_what_matters(store, scenario, log, run):
    page = shiftsim.show(scenario, mine=log)
    told = (
        (store, f"{len(store)} scenarios"),
        (scenario, scenario.token),
        (scenario.map, f"{scenario.map.num_lanes} lanes"),
        (scenario.map.edges, f"{len(scenario.map.edges)} objects"),
        (scenario.map.baselines, f"{len(scenario.map.edges)} lines"),
        (scenario.map.outgoing, f"{len(scenario.map.edges)} lists"),
        (scenario.tracks, f"{scenario.tracks.num_tracks} tracks"),
        (scenario.traffic_lights, "connectors"),
        (scene_info(scenario), scenario.map.name),
        (log, scenario.token),
        (shiftsim.score(log, scenario), "score "),
        (shiftsim.score_rollout(log.ego[:, :3], scenario, tracks="recorded"), scenario.token),
        (page, "kB"),
        (run, "4 of 4 tasks"),
    )
    for thing, words in told:
        assert words in repr(thing)
        assert is_short(repr(thing)), repr(thing)


class _Watcher:
    def reset(self, scene):
        self.seen = []

    def plan(self, observation):
        self.seen.append(observation)
        return shiftsim.Trajectory.from_poses([0, 0.5, 1.0], [observation.ego.pose] * 3)


def test_what_a_planner_sees_and_answers_prints_as_one_line(scenario):
    watcher = _Watcher()
    shiftsim.simulate(scenario, watcher)
    seen = watcher.seen[3]
    plan = watcher.plan(seen)
    for thing in (seen, seen.history, seen.ego, seen.tracks, plan):
        assert is_short(repr(thing)), repr(thing)
    assert "iteration 3" in repr(seen)
    assert "3 states over 1.0 s" in repr(plan)
    assert f"{seen.ego.speed:.2f} m/s" in repr(seen.ego)


def test_a_scenario_is_found_by_the_beginning_of_its_token(store):
    token = store.tokens[0]
    short = next(
        token[:n] for n in range(1, 17) if sum(t[:n] == token[:n] for t in store.tokens) == 1
    )
    assert store[short].token == token
    with pytest.raises(
        shiftsim.ShiftsimError, match="has no scenario 'nothing'\nhint: there are 0"
    ):
        store["nothing"]
    with pytest.raises(shiftsim.ShiftsimError, match="4 scenarios of store 'toy' begin with ''"):
        store[""]


def test_what_is_no_scenario_is_refused_with_what_to_write(store, log):
    for use, hint in (
        (lambda: store[0], r"store\[store.tokens\[0\]\] is the first one"),
        (lambda: shiftsim.simulate("0000cafe", "idm"), r"open_store\(.*\)\[TOKEN\]"),
        (lambda: shiftsim.show(log), r"shiftsim.show\(scenario, …\)"),
    ):
        with pytest.raises(shiftsim.ShiftsimError, match=hint):
            use()


def test_a_planner_is_made_or_driven_by_its_name(scenario, log):
    planner = shiftsim.load_planner("idm", headway=2.0)
    assert planner.name == "idm"
    again = shiftsim.simulate(scenario, shiftsim.load_planner("constant-velocity"))
    assert (again.ego == log.ego).all()
    with pytest.raises(shiftsim.ShiftsimError, match="did you mean 'idm'"):
        shiftsim.simulate(scenario, "idmm")


@pytest.mark.slow
def test_a_rollout_loads_what_it_needs(store):
    code = (
        "import shiftsim, sys\n"
        f"scenario = shiftsim.open_store({str(store.path)!r})[{store.tokens[0]!r}]\n"
        "shiftsim.simulate(scenario, 'idm')\n"
        "ours = (m for name, m in sys.modules.items() if name.split('.')[0] == 'shiftsim')\n"
        "print(*(m.__file__ for m in ours if m.__file__))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    paths = [Path(path) for path in done.stdout.split()]
    assert len(paths) <= 55
    assert sum(len(path.read_text().splitlines()) for path in paths) <= 10_500


def test_a_run_explains_and_plots_a_scenario(run, scenario, tmp_path):
    text = run.explain(scenario.token)
    assert scenario.token in text
    assert "CLS" in text
    assert repr(text) == text
    with pytest.raises(shiftsim.ShiftsimError, match="no task with planner idm, scenario"):
        run.explain(scenario.token, planner="idm")
    run.plot(scenario.token, at=1.0).savefig(tmp_path / "scene.png")
    assert (tmp_path / "scene.png").stat().st_size > 5000
    with pytest.raises(shiftsim.ShiftsimError, match="time 99"):
        run.plot(scenario.token, at=99.0)


class Straight:
    """Keeps heading and speed."""

    name = "straight"

    def __init__(self, share: float = 1.0):
        self.share = share

    def reset(self, scene): ...
    def plan(self, observation):
        times = [0.0, 4.0, 8.0]
        x, y, heading = observation.ego.pose
        ways = [self.share * observation.ego.speed * time for time in times]
        poses = [(x + w * np.cos(heading), y + w * np.sin(heading), heading) for w in ways]
        return shiftsim.Trajectory.from_poses(times, poses)


@pytest.fixture(scope="module")
def pair(store, tmp_path_factory):
    """A run of two labelled planners, with open-loop scores and NAVSIM's."""
    settings = {"store": str(store.path), "workers": 1, "open_loop": True, "metrics": ["navsim"]}
    out = str(tmp_path_factory.mktemp("pair") / "out")
    return shiftsim.run({"fast": Straight(), "slow": Straight(0.9)}, out=out, **settings)


def test_a_dict_of_planners_gives_them_their_names(pair, store):
    assert pair.scores["planner"].unique().to_pylist() == ["fast", "slow"]
    assert list(pair.manifest["determining"]["planners"]) == ["fast", "slow"]
    with pytest.raises(shiftsim.ShiftsimError, match="holds '='"):
        shiftsim.run({"lr=1": Straight()}, store=str(store.path))
    with pytest.raises(shiftsim.ShiftsimError, match=r"shiftsim\.run\(\{label: planner\}\)"):
        shiftsim.run([Straight(), Straight(0.9)], store=str(store.path))


@pytest.mark.parametrize("name", [*TABLES])
def test_every_table_comes_in_every_format(pair, name):
    pandas = pytest.importorskip("pandas")
    if name in ("noise-robustness", "drift", "edits", "planner-comparison-noise"):
        with pytest.raises(shiftsim.ShiftsimError, match="holds nothing of the table"):
            pair.table(name)
        return
    for style in FORMATS:
        text = pair.table(name, style)
        assert repr(text) == str(text)
    frame = pair.table(name, "pandas")
    assert isinstance(frame, pandas.DataFrame)
    assert len(frame) == len(pair.table(name, "csv").splitlines()) - 1
    assert isinstance(frame.attrs["notes"], list)


def test_a_data_frame_has_numbers_in_full(pair):
    pytest.importorskip("pandas")
    frame = pair.table("scores", "pandas").set_index("planner")
    rows = pair.scores.to_pandas().groupby("planner").cls.mean()
    assert frame.CLS["fast"] == pytest.approx(100.0 * rows["fast"], abs=1e-12)
    with pytest.raises(shiftsim.ShiftsimError, match="did you mean 'scores'"):
        pair.table("score")
    with pytest.raises(shiftsim.ShiftsimError, match="format 'excel' unknown"):
        pair.table(format="excel")


def test_runs_are_compared_in_pairs(pair, run):
    found = pair.compare(run)
    assert repr(found) == "<Comparison of 3 pairs of planners>"
    assert "fast" in str(found)
    assert "constant-velocity" in found.table("latex")
    assert "<table>" in found._repr_html_()
    with pytest.raises(shiftsim.ShiftsimError, match="nothing to compare"):
        run.compare(run)


@pytest.mark.thorough
def test_a_run_writes_its_report(pair, run, tmp_path):
    files = pair.report(tmp_path / "a", formats=["latex", "csv"], tables=["scores"])
    assert {"report.tex", "scores.csv", "open-against-closed.pdf"} <= {path.name for path in files}
    (page,) = pair.report(tmp_path / "b", run, pages=True, tables=["scores"])
    assert "constant-velocity" in page.read_text("utf-8")
    assert list((tmp_path / "b/replay").glob("*.html"))
    with pytest.raises(shiftsim.ShiftsimError, match="format 'word' unknown"):
        pair.report(tmp_path / "c", formats=["word"])


def test_a_grid_has_a_row_per_rollout_and_a_column_per_time(pair, scenario):
    assert len(pair.plot(scenario.token, at=(0.0, 1.0)).axes) == 4
    assert len(pair.plot(scenario.token, at=1.0, grid=True, planner="slow").axes) == 1
    with pytest.raises(shiftsim.ShiftsimError, match="planner nobody"):
        pair.plot(scenario.token, planner=["nobody"])


def test_open_loop_is_drawn_against_closed_loop(pair, run):
    figure = pair.plot_open_against_closed()
    assert [axes.get_xlabel()[:9] for axes in figure.axes] == ["open-loop", "average d"]
    for axes in figure.axes:
        labels = [text.get_text() for text in axes.get_legend().get_texts()]
        assert [label.partition(":")[0] for label in labels] == [
            "fast",
            "slow",
            "means of planners",
        ]
        assert labels[0].endswith("n = 4")
        assert labels[2].endswith("ρ undefined, n = 2")
        below, marks = axes.get_legend().get_window_extent(), axes.get_window_extent()
        assert below.y1 < marks.y0  # it covers none of them
    with pytest.raises(shiftsim.ShiftsimError, match="no open-loop scores"):
        run.plot_open_against_closed()


@pytest.mark.thorough
def test_a_run_is_scored_again_compared_and_made_self_contained(run, tmp_path):
    again = run.rescore("deepplan", out=tmp_path / "again")
    assert again.manifest["determining"]["thresholds"]["name"] == "deepplan"
    found = run.diff(again)
    assert "thresholds" in found.settings
    assert str(found).startswith(f" same {found.same} · better {found.better}")
    moved = shiftsim.open_run(shutil.copytree(run.path, tmp_path / "moved"))
    assert not (moved.path / "store").exists()
    assert shiftsim.open_store(moved.bundle().path / "store").tokens


def test_notebooks_show_pictures_of_scenarios_and_maps_and_tables_of_the_others(run, scenario, log):
    for thing in (scenario, scenario.map):
        assert "<svg" in thing._repr_html_()
    assert f"<td>{scenario.token}</td>" in log._repr_html_()
    assert "constant-velocity" in run._repr_html_()


def test_without_matplotlib_a_notebook_shows_text(scenario, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "<svg" not in scenario._repr_html_()
    assert scenario.token in scenario._repr_html_()


def test_a_hint_is_part_of_the_text_of_an_error():
    error = shiftsim.ShiftsimError("no map", "name one")
    assert (str(error), error.message) == ("no map\nhint: name one", "no map")
    assert str(shiftsim.ShiftsimError("no map")) == "no map"


def test_no_hint_is_said_twice():
    # who passes a hint on takes the message without it
    twice = re.compile(r"(\{error\}|str\(error\)).*\berror\.hint")
    folders = ("shiftsim", "planners", "metrics", "data", "benchmarks")
    sources = [path for folder in folders for path in (PACKAGE.parent / folder).rglob("*.py")]
    assert len(sources) > 300
    assert not [str(path) for path in sources if twice.search(path.read_text("utf-8"))]


def test_what_other_tools_call_otherwise_is_answered_with_the_name_here(run, scenario, store, log):
    tables = tomllib.loads((PACKAGE / "synonyms.toml").read_text("utf-8"))
    words_of = {
        kind: {name: here for names, here in table.items() for name in names.split(", ")}
        for kind, table in tables.items()
    }
    result = shiftsim.score(log, scenario)
    scene, seen = scene_info(scenario), observe_log(scenario, 3)
    plan = shiftsim.Trajectory.from_poses([0, 1.0], [seen.ego.pose] * 2)
    asked = run, scenario, store, log, result, scene, seen, seen.ego, seen.tracks, plan
    for thing in (*asked, scenario.map):
        for name, meant in words_of[type(thing).__name__].items():
            with pytest.raises(AttributeError, match=f"no attribute '{name}'") as caught:
                getattr(thing, name)
            assert meant in str(caught.value)
            first = re.match(r"\w+", meant)[0]
            assert hasattr(thing, first) or first in NO_ATTRIBUTES, (name, meant)
    with pytest.raises(AttributeError, match="may be: tracks"):
        _ = scenario.track
    assert not hasattr(scenario, "_private")
    for name, meant in words_of["shiftsim"].items():
        if f"shiftsim.{name}" in sys.modules:  # a package that something has imported
            continue
        with pytest.raises(AttributeError) as caught:
            getattr(shiftsim, name)
        assert meant in str(caught.value)


NO_ATTRIBUTES = "iteration that those for np shiftsim Trajectory store".split()


def test_what_is_asked_for_by_name_survives_copies(scenario):
    for thing in (scenario, scene_info(scenario), observe_log(scenario, 3)):
        assert repr(pickle.loads(pickle.dumps(thing))) == repr(thing)
        assert repr(copy.deepcopy(thing)) == repr(thing)


def test_a_scenario_has_a_duration_and_an_ego_its_parts(scenario):
    times = scenario.iteration_times
    assert scenario.duration == pytest.approx((times[-1] - times[0]) * 1e-6)
    ego = observe_log(scenario, 0).ego
    assert (ego.x, ego.y, ego.heading) == tuple(ego.pose)


@pytest.mark.thorough
def test_a_rollout_is_found_by_the_token_of_its_scenario(run, scenario, store, tmp_path):
    found = run.rollout(scenario.token)
    assert found.token == scenario.token
    assert (found.ego == shiftsim.simulate(scenario, "constant-velocity").ego).all()
    planners = ["constant-velocity", "simple"]
    several = shiftsim.run(planners, store=str(store.path), limit=1, out=str(tmp_path / "two"))
    token = several.scores["token"][0].as_py()
    with pytest.raises(shiftsim.ShiftsimError, match="driven 2 times"):
        several.rollout(token)
    assert several.rollout(token, planner="simple").token == token


def test_a_store_is_checked_filtered_counted_and_exported(tmp_path):
    write_toy_store(tmp_path / "toy")
    opened = shiftsim.open_store(tmp_path / "toy")
    kept = opened.filter(min_path_m=0.0, min_progress_share=0.0, workers=1)
    assert len(kept.rows) == len(opened)
    assert set(opened.stats().rows) == set(opened.tokens)
    written = opened.export_nuplan(tmp_path / "out")
    for thing in (kept, opened.check(), opened.stats(), written):
        assert is_short(repr(thing)), repr(thing)
    back = shiftsim.convert_nuplan(
        written.logs, written.maps, tmp_path / "back", tokens=written.tokens.values()
    )
    assert f"{len(opened)} scenarios converted, 0 unchanged, 0 failed" in repr(back)
    assert len(shiftsim.open_store(tmp_path / "back")) == len(opened)


@pytest.mark.thorough
def test_recordings_and_tracks_are_converted_from_python(tmp_path):
    columns, road = export_town(tmp_path / "sites", "street")
    site = tmp_path / "sites/street"
    report = shiftsim.convert_dsc3d(site, tmp_path / "street", overlap_s=0.0, workers=1)
    assert f"{len(shiftsim.open_store(tmp_path / 'street'))} scenarios" in repr(report)
    with pytest.raises(shiftsim.ShiftsimError, match="window"):
        shiftsim.convert_dsc3d(site, tmp_path / "none", windows=3.0)
    table = write_tracks(tmp_path / "t.csv", columns)
    report = shiftsim.convert_tracks(table, road, tmp_path / "own")
    assert report.accepted == len(shiftsim.open_store(tmp_path / "own"))
    with pytest.raises(shiftsim.ShiftsimError, match="did you mean 'av2'"):
        shiftsim.convert_dataset("av", tmp_path, tmp_path / "none")


@pytest.mark.thorough
def test_shards_are_joined_from_python(store, tmp_path):
    shards = [
        shiftsim.run("simple", store=str(store.path), shard=f"{n}/2", out=str(tmp_path / f"{n}"))
        for n in (1, 2)
    ]
    merged = shiftsim.merge([shards[0], shards[1].path], out=str(tmp_path / "all"))
    assert len(merged.scores) == len(store)
