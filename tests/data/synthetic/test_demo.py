import hashlib

import numpy as np
import pytest
from track_files import write_demo

from shiftsim.benchmarks import known_sets
from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.data.readers.dsc3d import open_site, read_recording
from shiftsim.data.readers.windows import overlap_partners
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.synthetic import store as store_module
from shiftsim.data.synthetic.layouts import random_town
from shiftsim.data.synthetic.roads import STEP
from shiftsim.data.synthetic.routes import RandomRoutes, Route, make_path
from shiftsim.data.synthetic.store import MANIFEST, demo_store
from shiftsim.data.synthetic.town import Turn
from shiftsim.metrics import compute_metrics
from shiftsim.planners.registry import load_planner
from shiftsim.runs.filter import FilterConfig, judge_scenario
from shiftsim.runs.scenarios import find_split
from shiftsim.sim.loop import simulate
from shiftsim.world.state import AgentKind

pytestmark = pytest.mark.thorough

TOWNS = ("avenue", "junction", "parking", "roundabout", "shared", "street")


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    write_demo(folder)
    return folder


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    return ScenarioStore(demo_store(tmp_path_factory.mktemp("store") / "demo"))


@pytest.fixture(scope="session")
def verdicts(store):
    return [judge_scenario(scene, FilterConfig()) for scene in store]


def _read_all(folder):
    for path in sorted(folder.iterdir()):
        site = open_site(path)
        for name in site.recordings:
            yield read_recording(site, name)


def _digest(folder):
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def test_the_demo_is_the_same_bytes_every_time(recordings, tmp_path):
    write_demo(tmp_path)
    assert _digest(tmp_path) == _digest(recordings)


def test_nobody_overlaps_anybody_in_the_demo(recordings):
    for recording in _read_all(recordings):
        on_wheels = recording.kinds != AgentKind.PEDESTRIAN  # people among themselves may
        assert (overlap_partners(recording, on_wheels, 0.0) == -1).all()


def test_traffic_of_the_demo_drives_smoothly(recordings):
    for recording in _read_all(recordings):
        same = np.diff(recording.track) == 0
        wheels = recording.kinds[recording.track[1:]] != 1
        speed = np.hypot(*recording.velocities.T)
        accel = np.diff(speed) / recording.period
        turn = np.diff(np.unwrap(recording.headings)) / recording.period
        assert np.abs(accel[same & wheels]).max() < 4.0
        assert np.abs(np.sin(turn[same & wheels] * 0.08)).max() < 0.08


def test_all_kinds_of_agents_and_of_geometry_occur(recordings):
    kinds = {int(kind) for recording in _read_all(recordings) for kind in recording.kinds}
    xml = "".join(path.read_text() for path in sorted(recordings.rglob("*.xodr")))
    assert kinds == {0, 1, 2}
    assert all(f"<{shape}" in xml for shape in ("line", "arc", "spiral", "paramPoly3"))


def test_most_scenarios_of_the_demo_pass_the_filter_and_none_hits_anybody(verdicts):
    accepted = [row for row in verdicts if row["verdict"] == "accepted"]
    reasons = {row["reason"] for row in verdicts} - {"", None}
    assert len(accepted) >= 80
    assert reasons <= {"path too short"}


def test_the_small_split_samples_every_town_and_passes_the_filter(store, verdicts):
    split = find_split("demo-mini", store.path, store.tokens)
    accepted = {row["token"] for row in verdicts if row["verdict"] == "accepted"}
    assert len(split.tokens) == 16
    assert set(split.tokens) <= accepted
    assert {store.read(token).city for token in split.tokens} == set(TOWNS) == set(store.cities)


def test_better_planners_score_higher_in_every_demo(store):
    tokens = find_split("demo-mini", store.path, store.tokens).tokens
    means = [
        np.mean(
            [
                compute_metrics(simulate(scene, load_planner(name)), scene.map).score
                for scene in map(store.read, tokens)
            ]
        )
        for name in ("log-future", "idm", "constant-velocity")
    ]
    assert means[0] > means[1] > means[2] + 0.3


@pytest.fixture(scope="module")
def avenue():
    return random_town("avenue", "test", np.random.Generator(np.random.Philox(1)))


def test_a_path_is_smooth_and_passes_the_junctions_in_turn(avenue):
    routes = RandomRoutes(avenue, np.random.Generator(np.random.Philox(2)))
    paths = [routes.path(entry, "car") for entry in routes.entries for _ in range(10)]
    assert sum(path is not None for path in paths) > 20
    for path in filter(None, paths):
        assert np.abs(np.diff(path.points[:, 2])).max() < 0.12
        steps = np.hypot(*np.diff(path.points[:, :2], axis=0).T)
        np.testing.assert_allclose(steps, STEP, atol=0.03)
        assert all(zone.entry < zone.exit for zone in path.zones)


def test_a_route_into_a_parking_space_ends_there():
    town = random_town("parking", "test", np.random.Generator(np.random.Philox(1)))
    junction = next(x for x in town.streets["lot"].junctions if x)
    entry = next(x.name for x in town.streets.values() if x.junctions == (junction, 0))
    end = make_path(town, Route(1, (Turn(junction, entry, 1, "lot"),), bay=4)).points[-1]
    np.testing.assert_allclose(end[:2], town.bays["lot"][4][:2], atol=0.6)
    assert abs(np.sin(end[2] - town.bays["lot"][4][2])) < 0.15


def test_some_scenarios_of_the_demo_have_traffic_lights(store):
    lit = [scene for scene in store if len(scene.traffic_lights.connector_ids)]
    assert len(lit) >= 10
    status = np.unique(np.concatenate([scene.traffic_lights.status.ravel() for scene in lit]))
    assert {0, 1, 2} <= set(status.tolist())


def test_every_demo_route_has_two_blocks(store):
    assert all(len(scene.route) >= 2 for scene in store)


def test_the_benchmarks_know_the_scenarios_of_the_demo(store):
    lists = {known.name: set(known.tokens) for known in known_sets()}
    assert lists["demo"] == set(store.tokens)
    assert lists["demo-mini"] == set(find_split("demo-mini", store.path, store.tokens).tokens)


def test_an_existing_demo_store_is_kept(store):
    before = (store.path / "store.json").stat().st_mtime_ns
    assert demo_store(store.path) == store.path
    assert (store.path / "store.json").stat().st_mtime_ns == before


def test_a_demo_that_another_process_made_in_the_meantime_is_kept(tmp_path, monkeypatch):
    path = tmp_path / "demo"

    def make_town(parts, town):
        path.mkdir(exist_ok=True)
        (path / MANIFEST).write_text("theirs")

    monkeypatch.setattr(store_module.recordings, "make_town", make_town)
    monkeypatch.setattr(store_module, "_join", lambda parts, towns, place, fields: place.mkdir())
    monkeypatch.setattr(store_module, "ScenarioStore", lambda place: place)
    monkeypatch.setattr(store_module, "_sample", lambda made: [])
    assert demo_store(path) == path
    assert (path / MANIFEST).read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


def test_the_benchmark_city_is_large_and_its_agents_are_near():
    scene = bench_scene(40, 0)
    again = bench_scene(40, 0)
    start = scene.iteration_rows[0]
    away = np.hypot(*(scene.tracks.poses[start, :, :2] - scene.ego[start, :2]).T)
    assert scene.map.num_lanes >= 5000
    assert scene.num_iterations == 151
    assert scene.tracks.num_tracks == 40
    assert away.max() < 50.0
    np.testing.assert_array_equal(scene.tracks.poses, again.tracks.poses)
    result = compute_metrics(simulate(scene, None, controller="log-playback"), scene.map)
    assert result.score > 0.9
