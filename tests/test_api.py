"""The public names: what they print, what notebooks show of them, and that their examples run."""

import re
import shutil
import sys

import pytest
from stores import write_toy_store

import shiftsim
from shiftsim.files import PACKAGE
from shiftsim.sim.planner import scene_info


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
        shiftsim.ShiftsimError, match="has no scenario 'nothing'\nhint: did you mean"
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
