"""What is exported to nuPlan's files comes back: scenarios, maps, scores."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from nuplan_trips import SCENES, round_trip
from stores import write_toy_store

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.export import export_nuplan
from shiftsim.data.nuplan.export_log import quaternions_of
from shiftsim.data.nuplan.log import yaw_of
from shiftsim.data.store.reading import open_store
from shiftsim.data.synthetic.recordings import make_town
from shiftsim.data.synthetic.store import DEMO_TOWNS, demo_store
from shiftsim.metrics import compute_metrics
from shiftsim.planners.idm import Idm
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.sim.loop import simulate
from shiftsim.world.state import center_poses

TOLERANCE = 0.0  # m


def assert_same_scenario(one, other):
    assert (one.token, one.scenario_type, one.city) == (
        other.token,
        other.scenario_type,
        other.city,
    )
    assert one.route == other.route
    assert one.mapping == other.mapping
    np.testing.assert_array_equal(one.time_us, other.time_us)
    np.testing.assert_array_equal(one.iteration_rows, other.iteration_rows)
    np.testing.assert_allclose(one.ego, other.ego, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.mission_goal, other.mission_goal, rtol=0, atol=1e-9)
    assert one.tracks.tokens == other.tracks.tokens
    for name in ("valid", "poses", "velocities", "sizes", "kinds"):
        np.testing.assert_array_equal(getattr(one.tracks, name), getattr(other.tracks, name))
    assert one.traffic_lights.connector_ids == other.traffic_lights.connector_ids
    np.testing.assert_array_equal(one.traffic_lights.status, other.traffic_lights.status)


def assert_same_scores(one, other):
    scores = [
        compute_metrics(simulate(scene, None, controller="log-playback"), scene.map)
        for scene in (one, other)
    ]
    assert scores[0].score == pytest.approx(scores[1].score, abs=1e-6)
    for first, second in zip(scores[0].rows, scores[1].rows, strict=True):
        assert first.score == pytest.approx(second.score, abs=1e-6)
        assert first.violation is None or first.violation[:3] == second.violation[:3]


def assert_same_map(one, other):
    assert (one.epsg, one.num_lanes, one.num_roadblocks) == (
        other.epsg,
        other.num_lanes,
        other.num_roadblocks,
    )
    for name in (
        "speed_limits",
        "lane_index",
        "left_lane",
        "right_lane",
        "block_of",
        "has_traffic_lights",
        "intersection_of",
        "turn_type",
        "is_bike",
        "intersection_kinds",
        "stop_kinds",
    ):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    for name in ("incoming", "outgoing", "block_edges", "block_incoming", "block_outgoing"):
        for part in ("ptr", "items"):
            first, second = (getattr(getattr(road, name), part) for road in (one, other))
            np.testing.assert_array_equal(first, second, err_msg=name)
    for name in ("baselines", "left_boundaries", "right_boundaries"):
        first, second = (getattr(road, name) for road in (one, other))
        np.testing.assert_array_equal(first.ptr, second.ptr)
        np.testing.assert_allclose(first.xy, second.xy, rtol=0, atol=TOLERANCE)
    for name in ("edges", "blocks", "intersections", "stop_polygons", "crosswalks", "walkways"):
        first, second = (getattr(road, name) for road in (one, other))
        assert first.ids == second.ids
        np.testing.assert_allclose(first.polygons.xy, second.polygons.xy, rtol=0, atol=TOLERANCE)
    areas = [
        shapely.union_all([road.drivable_areas.shape(i) for i in range(len(road.drivable_areas))])
        for road in (one, other)
    ]
    assert shapely.symmetric_difference(*areas).area < 1e-3  # m^2, along 1e-8 m of border


def test_scenarios_and_scores_come_back(trip):
    first, second, report = trip
    assert report.renamed == {}
    for token in first.tokens:
        assert_same_scenario(first.read(token), second.read(token))
        assert_same_scores(first.read(token), second.read(token))


def test_maps_come_back_with_their_ids_and_links(trip):
    first, second, _ = trip
    for city in first.cities:
        one, other = first.map(city), second.map(city)
        assert_same_map(one, other)
        assert one.boundary_ids == other.boundary_ids
        assert one.drivable_areas.ids == other.drivable_areas.ids
        assert one.car_parks.ids == other.car_parks.ids
        np.testing.assert_array_equal(one.stop_lines.items, other.stop_lines.items)


def test_scenes_cut_with_an_offset_come_back_by_the_table_of_nuplan(nuplan_reference, tmp_path):
    first, second, report = round_trip(nuplan_reference, tmp_path, None, SCENES[1:2])
    (token,) = first.tokens
    assert list(report.mappings) == [("starting_left_turn", (15.0, -3.0, 0.5))]
    assert_same_scenario(first.read(token), second.read(token))


def test_a_store_with_tokens_and_durations_of_its_own_says_what_to_use_instead(tmp_path):
    store = open_store(write_toy_store(tmp_path / "toy", count=2))
    report = export_nuplan(store, tmp_path / "out")
    assert set(report.renamed) == set(store.tokens)
    assert report.token_file.read_text().split() == sorted(report.renamed.values())
    (mapping,) = {mapping for _, mapping in report.mappings}
    convert_nuplan(
        report.logs, report.maps, tmp_path / "back", tokens=report.tokens.values(), mapping=mapping
    )
    for token in store.tokens:
        one, other = store.read(token), open_store(tmp_path / "back").read(report.tokens[token])
        assert_same_scenario(replace(one, token=other.token, mapping=mapping), other)
        assert_same_scores(one, other)


def test_headings_come_back_to_the_bit(rng):
    halves = np.pi / 2.0 * np.arange(-2, 3)
    headings = np.concatenate(
        [
            halves,
            np.clip(np.repeat(halves, 500) + rng.normal(0, 1e-9, 2500), -np.pi, np.pi),
            rng.uniform(-np.pi, np.pi, 5000),
            rng.normal(0.0, 1e-5, 2000),
        ]
    )
    # the arctan2 of NumPy 1 does not return every float
    last_bit = 0.0 if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else np.spacing(np.pi) / 2.0
    found = yaw_of(quaternions_of(headings))
    np.testing.assert_allclose(found, headings, rtol=0.0, atol=last_bit)


# A recording that goes on where the window ends, as those of drones do.


@pytest.fixture(scope="module")
def drone(tmp_path_factory):
    """The store of the demo."""
    return open_store(demo_store(tmp_path_factory.mktemp("drone") / "demo"))


def exported(drone, folder, tokens):
    report = export_nuplan(drone, folder / "out", tokens=tokens)
    ((_, mapping),) = report.mappings
    done = convert_nuplan(report.logs, report.maps, folder / "back", tokens=tokens, mapping=mapping)
    assert done.failed == {}
    return open_store(folder / "back"), report


@pytest.mark.slow
@pytest.mark.thorough
def test_what_was_recorded_around_a_window_is_exported_too(tmp_path):
    street = next(town for town in DEMO_TOWNS if town.name == "street")
    make_town(tmp_path, replace(street, overlap_s=12.0))  # scenarios up to the last row
    drone = open_store(tmp_path / "street")
    early = next(t for t in drone.tokens if drone.window(t).first_row == 0)
    late = next(t for t in drone.tokens if drone.window(t).last_row == 840)
    back, report = exported(drone, tmp_path, (early, late))
    assert report.cut_off == 1
    for token in (early, late):
        one, other = drone.read(token), back.read(token)
        start = int(np.searchsorted(other.time_us, one.time_us[0]))
        rows = slice(start, start + len(one.time_us))
        np.testing.assert_array_equal(other.time_us[rows], one.time_us)
        np.testing.assert_array_equal(other.ego[rows], one.ego)
        np.testing.assert_array_equal(other.iteration_times, one.iteration_times)
        assert not one.is_short
        assert not other.is_short
    window, stored = drone.window(early), drone.recording(drone.window(early).log_name)
    more, other = stored.read(0, stored.num_rows), back.read(early)
    rows = np.searchsorted(more.time_us, other.time_us)
    assert len(rows) > window.last_row
    track = more.tracks.tokens.index(window.ego)
    seen = more.tracks.poses[rows, track]
    np.testing.assert_allclose(center_poses(other.ego[:, :3]), seen, rtol=0, atol=1e-6)


@pytest.mark.thorough
@pytest.mark.slow
def test_scores_of_what_comes_back_are_the_same(drone, tmp_path):
    back, _ = exported(drone, tmp_path, drone.tokens)
    for token in drone.tokens:
        for traffic in ("nonreactive", "reactive"):
            for planner in (Idm, PdmClosed):
                rows = []
                for scene in (drone.read(token), back.read(token)):
                    log = simulate(scene, planner(), traffic=traffic)
                    result = compute_metrics(log, scene.map)
                    rows.append((result.score, [(row.metric, row.score) for row in result.rows]))
                assert rows[0] == rows[1], (token, traffic, planner)


def test_maps_come_back_to_the_bit(trip):
    one, other = (store.map("us-ma-boston") for store in trip[:2])
    assert other.epsg == one.epsg
    for name in ("edges", "blocks", "intersections", "stop_polygons", "drivable_areas"):
        first, second = (getattr(road, name).polygons.xy for road in (one, other))
        np.testing.assert_array_equal(first, second, err_msg=name)
    for name in ("baselines", "left_boundaries", "right_boundaries"):
        first, second = (getattr(road, name).xy for road in (one, other))
        np.testing.assert_array_equal(first, second, err_msg=name)
