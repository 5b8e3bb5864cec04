import hashlib

import numpy as np
import pytest

from shiftsim.data.deepplan_windows import overlap_partners
from shiftsim.data.dsc3d import open_site, read_recording
from shiftsim.data.store import ScenarioStore
from shiftsim.data.synthetic import bench_scene, demo_store, write_demo
from shiftsim.metrics import compute_metrics
from shiftsim.simulation import simulate


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    write_demo(folder)
    return folder


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return ScenarioStore(demo_store(tmp_path_factory.mktemp("store") / "demo"))


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
        everybody = np.ones(len(recording.track_ids), np.bool_)
        assert (overlap_partners(recording, everybody, 0.0) == -1).all()


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


def test_log_playback_of_the_demo_scores_well_and_hits_nobody(store):
    results = [
        compute_metrics(simulate(scene, None, controller="log-playback"), scene.map)
        for scene in store
    ]
    assert 12 <= len(results) <= 24
    assert np.mean([result.score for result in results]) > 0.9
    assert all(result.scores["no_ego_at_fault_collisions"] == 1.0 for result in results)


def test_every_demo_route_has_two_blocks(store):
    assert all(len(scene.route) >= 2 for scene in store)


def test_an_existing_demo_store_is_kept(store):
    before = (store.path / "store.json").stat().st_mtime_ns
    assert demo_store(store.path) == store.path
    assert (store.path / "store.json").stat().st_mtime_ns == before


@pytest.mark.slow
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
