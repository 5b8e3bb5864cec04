"""A town of the demo, written as the files of open data sets, and converted back."""

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import call
from map_checks import check_map
from open_data_files import (
    COMMANDS,
    LABELS,
    START_US,
    WRITERS,
    demo_content,
    demo_map,
    known_route,
    lit_lane,
    write_av2,
    write_commonroad,
    write_py123d,
)

from shiftsim.data.readers.av2 import Av2Reader
from shiftsim.data.readers.convert import convert
from shiftsim.data.readers.py123d import Py123dReader, read_starts
from shiftsim.data.readers.scenarios import convert_recording
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConversionError
from shiftsim.world.state import center_poses


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """By data set: the scene of a town."""
    out = {}
    for name, (reader, write) in WRITERS.items():
        path = write(tmp_path_factory.mktemp(name))
        out[name] = reader(path).read(path)
    return out


@pytest.mark.parametrize("name", WRITERS)
def test_the_map_of_a_town_comes_back(scenes, name):
    road, before = scenes[name].map.road, demo_map()
    assert all(check_map(road, set())[0].values())
    for layer in ("edges", "blocks", "intersections"):
        assert len(getattr(road, layer)) == len(getattr(before, layer)), layer
    assert (road.num_lanes, road.num_roadblocks) == (before.num_lanes, before.num_roadblocks)
    if name != "commonroad":  # whose signs say something else
        first_pieces = [parts[0].piece.id for parts in scenes[name].map.segments.values()]
        ends = [before.edges.index[first] for first in first_pieces]
        expected = before.speed_limits[ends] if name != "av2" else np.full(len(ends), np.nan)
        np.testing.assert_array_equal(road.speed_limits, expected)
    for edge, (first, *_) in zip(road.edges.ids, scenes[name].map.segments.values(), strict=True):
        new, old = road.edge(edge), before.edge(first.piece.id)
        assert road.is_connector(new) == before.is_connector(old)
        ends = road.baselines.at(new)[[0, -1]]
        np.testing.assert_allclose(ends, before.baselines.at(old)[[0, -1]], atol=0.2)


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_the_recording_car_is_the_ego_and_drives_as_recorded(scenes, name):
    made = convert_recording(scenes[name])
    (window,) = made.windows
    assert window.ego == {"av2": "AV", "py123d": "ego"}[name]
    rows = np.array(demo_content()["ego"]["rows"])
    states = made.egos[0].states[: 2 * len(rows) - 1 : 2]
    centers = center_poses(states[:, :3])[:, :2]
    np.testing.assert_allclose(centers, rows[: len(states), 1:3], atol=2e-3)
    np.testing.assert_allclose(states[5:-5, 3], rows[5 : len(states) - 5, 4], atol=0.3)
    assert window.iteration_rows[0] == 40  # 2 s of history
    assert len(window.route) >= 3


def test_argoverse_leaves_out_the_squeezed_end_of_its_tracks(scenes):
    (window,) = convert_recording(scenes["av2"]).windows
    assert (window.last_row, len(window.iteration_rows), window.is_short) == (209, 85, True)
    assert window.metadata["duration_class"] == "8 s"
    assert window.metadata["licence"] == "CC BY-NC-SA 4.0"
    assert window.metadata["sizes"] == "by type"


@pytest.mark.parametrize("name", ["av2", "py123d"])
def test_with_vehicles_every_car_that_drives_is_an_ego(scenes, name):
    every = replace(scenes[name], egos=None, config=None)
    egos = {window.ego for window in convert_recording(every).windows}
    cars = {window.ego for window in convert_recording(scenes["commonroad"]).windows}
    content = demo_content()
    trucks = {x["id"] for x in content["tracks"] if x["category"] == "truck"}  # vehicles, in both
    recording_car = {"av2": "AV", "py123d": "ego"}[name]
    assert egos - trucks == cars - {content["ego"]["id"]} | {recording_car}
    assert len(cars) > 3


def test_the_route_of_py123d_is_that_of_the_log_from_its_begin_on(scenes):
    scene = scenes["py123d"]
    groups = known_route(demo_content())
    assert [from_s for from_s, _ in scene.routes] == pytest.approx([0.0, 1.0], abs=1e-9)
    wanted = {str(n["id"]) for n in demo_content()["lanes"] if n["group"] in groups}
    (window,) = convert_recording(scene).windows  # it begins after 2 s
    road = scene.map.road
    edges = [i for i, b in enumerate(road.block_of) if road.blocks.ids[b] in window.route]
    lanes = {part.piece.id for i in edges for part in scene.map.segments[road.edges.ids[i]]}
    assert wanted <= lanes
    assert len(window.route) == len(groups)
    (found,) = convert_recording(replace(scene, routes=scene.routes[:1])).windows
    assert set(found.route) != set(window.route)  # of no blocks: as of any other data


def test_scenarios_of_py123d_are_found_by_log_and_time(tmp_path):
    log = write_py123d(tmp_path / "data", site="avenue")
    starts = tmp_path / "starts.csv"
    starts.write_text(f"log_name,time_us\n{log.name},{START_US + 2_000_000}\n")
    reader = Py123dReader(tmp_path / "data", starts=read_starts(starts))
    (path,) = reader.recordings()
    recording = reader.read(path)
    assert recording.spans == []  # 11 s are too short for one
    assert sum(recording.warnings.values()) == 1
    with pytest.raises(ConversionError, match="1 logs are not there, such as another"):
        Py123dReader(tmp_path / "data", starts={"another": [0]}).recordings()
    starts.write_text("log,time\na,1\n")
    with pytest.raises(ConversionError, match="columns log_name and time_us"):
        read_starts(starts)


def test_lights_of_py123d_are_those_of_the_connector_of_their_lane(scenes):
    scene = scenes["py123d"]
    lights = convert_recording(scene).recording.lights
    (connector,) = lights.connector_ids
    (part,) = scene.map.segments[connector]
    assert part.piece.id == str(lit_lane(demo_content()))
    assert lights.status[:, 0].tolist() == [2] * 60 + [0] * (len(lights.status) - 60)


def test_lights_of_commonroad_govern_what_leaves_their_lanelet(scenes):
    scene = scenes["commonroad"]
    road = scene.map.road
    lights = convert_recording(scene).recording.lights
    assert len(lights.connector_ids) >= 2
    sources = {int(road.incoming.at(road.edge(i))[0]) for i in lights.connector_ids}
    assert len(sources) == 1
    # green for 30 steps, red for 50, begun 10 steps late: red, then green from step 10 to 40
    expected = [2] * 20 + [0] * 60 + [2] * 100 + [0] * (len(lights.status) - 180)
    assert lights.status[:, 0].tolist() == expected
    assert [len(road.stop_lines.at(road.edge(i))) for i in lights.connector_ids] == [1] * len(
        lights.connector_ids
    )
    assert set(road.speed_limits.tolist()) == {8.5}  # of the sign


@pytest.mark.slow
def test_a_store_of_all_three_is_sound_and_goes_on_where_it_stopped(tmp_path):
    for name in COMMANDS:
        reader, write = WRITERS[name]
        write(tmp_path / name)
        report = convert(reader(tmp_path / name), tmp_path / "store")
        assert (report.converted, report.skipped) == (1, {})
        second = convert(reader(tmp_path / name), tmp_path / "store")
        assert (second.converted, second.kept) == (0, 1)
    assert not [
        problem for problem in survey_store(tmp_path / "store").problems if problem.is_error
    ]
    classes = {scene.duration_class for scene in ScenarioStore(tmp_path / "store")}
    assert classes == {"8 s"}


def test_a_broken_scene_is_skipped_and_named(tmp_path):
    write_av2(tmp_path / "good")
    bad = write_av2(tmp_path / "bad", "00000000-0000-0000-0000-00000000000b")
    bad.write_bytes(b"nonsense")
    report = convert(Av2Reader(tmp_path), tmp_path / "store")
    assert (report.converted, list(report.skipped)) == (1, [str(bad)])
    assert "cannot be read" in report.skipped[str(bad)]


def test_a_log_that_does_not_say_where_its_map_is_is_skipped_and_named(tmp_path):
    write_py123d(tmp_path / "good")
    bad = write_py123d(tmp_path / "bad")
    (bad / "sync.arrow").write_bytes(b"nonsense")
    report = convert(Py123dReader(tmp_path), tmp_path / "store")
    assert (report.converted, list(report.skipped)) == (1, [str(bad)])
    assert "sync.arrow: cannot be read" in report.skipped[str(bad)]


@pytest.mark.thorough
def test_the_command_converts_and_says_what_comes_next(tmp_path):
    write_commonroad(tmp_path / "files")
    done = call(tmp_path, "convert", "commonroad", "files", "--store", "./s", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert "1 scene converted" in done.stdout
    assert "next: shiftsim filter" in done.stdout


def test_a_folder_without_scenes_is_refused(tmp_path):
    for name in COMMANDS:
        with pytest.raises(ConversionError, match=str(tmp_path)):
            WRITERS[name][0](tmp_path).recordings()


def test_logs_of_a_city_share_its_map(tmp_path):
    log = write_py123d(tmp_path)
    shared = tmp_path / "maps/demo/demo_here.arrow"
    shared.parent.mkdir(parents=True)
    (log / "map.arrow").rename(shared)
    reader = Py123dReader(tmp_path)
    scene = reader.read(log)
    assert scene.map.road.name == "demo-here"
    assert shared in reader.files(log)


@pytest.mark.slow
def test_a_folder_that_py123d_wrote_is_read_as_ours(tmp_path, scenes):
    python = os.environ.get("SHIFTSIM_PY123D_PYTHON")
    if not python:
        pytest.skip("needs SHIFTSIM_PY123D_PYTHON, a Python with py123d 0.7.0")
    content = demo_content()
    notes = {"labels": LABELS, "lit_lane": lit_lane(content), "start_us": START_US}
    (tmp_path / "content.json").write_text(json.dumps(content | notes))
    script = Path(__file__).with_name("write_py123d.py")
    command = [python, script, tmp_path / "content.json", tmp_path]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    report = convert(Py123dReader(tmp_path), tmp_path / "store")
    assert (report.accepted, report.skipped) == (1, {})
    (found,) = ScenarioStore(tmp_path / "store")
    expected = convert_recording(scenes["py123d"])
    np.testing.assert_allclose(found.ego, expected.egos[0].states, atol=1e-9)
    assert len(found.route) == len(expected.windows[0].route)
    assert found.traffic_lights.status.tolist() == expected.recording.lights.status.tolist()
    assert found.tracks.num_tracks == expected.recording.tracks.num_tracks - 1
    assert len(found.map.edges) == len(scenes["py123d"].map.road.edges)
