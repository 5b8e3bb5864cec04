"""Statistics of a store: numbers that can be checked by hand, tables, and the picture."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pictures import cut_off, overlaps, written
from stores import write_toy_store
from worlds import cruise_scenario, standing_tracks

from shiftsim.benchmarks import published
from shiftsim.cli import main
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.statistics import PUBLISHED_SETS, scenario_stats, store_stats
from shiftsim.errors import ConfigError
from shiftsim.report.dataset import (
    stats_dict,
    stats_figure,
    stats_table,
)
from shiftsim.report.palette import save_picture
from shiftsim.world.state import AgentKind


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Four scenarios of 2.4 s at 6, 7, 8 and 9 m/s with one parked car each."""
    return open_store(write_toy_store(tmp_path_factory.mktemp("stats") / "toy"))


def with_tracks(poses, kinds, **settings):
    scene = cruise_scenario(**settings)
    tracks = standing_tracks(len(scene.time_us), np.array(poses, np.float64), kinds)
    return replace(scene, tracks=tracks)


def test_agents_are_counted_by_kind_at_the_start_and_over_the_scenario():
    kinds = [AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BICYCLE]
    scene = with_tracks([[200.0, 9.0, 0.0]] * 5, [*kinds, AgentKind.BARRIER])
    valid = scene.tracks.valid.copy()
    valid[: scene.iteration_rows[40], 1] = False  # the second vehicle comes after 4 s
    valid[scene.iteration_rows[0] :, 3] = False  # the bicycle is only seen in the history
    found = scenario_stats(replace(scene, tracks=replace(scene.tracks, valid=valid)))
    assert (found.vehicles_t0, found.vehicles) == (1.0, 2.0)
    assert (found.pedestrians_t0, found.pedestrians) == (1.0, 1.0)
    assert (found.bicycles_t0, found.bicycles) == (0.0, 0.0)
    assert found.static_objects == 1.0


def test_speed_path_and_route_follow_from_the_drive():
    found = scenario_stats(cruise_scenario(speed=8.0, iterations=51))
    assert found.mean_speed_mps == found.max_speed_mps == pytest.approx(8.0)
    assert found.path_m == pytest.approx(40.0)
    assert found.route_m == pytest.approx(420.0)


@pytest.mark.parametrize(("iterations", "expected"), [(51, 0.0), (241, 1.0)])
def test_an_intersection_counts_once_it_is_reached(iterations, expected):
    # it lies from 200 m to 220 m; 5 s at 8 m/s end at 50 m, 24 s at 202 m
    assert scenario_stats(cruise_scenario(iterations=iterations)).intersection == expected


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        ([20.0, 3.9, 0.0], 1.0),  # beside the path, its side 2.9 m away
        ([20.0, 4.1, 0.0], 0.0),  # 3.1 m away
        ([200.0, 0.0, 0.0], 0.0),  # on the lane, but 24 m after 3 s are far from it
    ],
)
def test_a_standing_car_interacts_when_the_path_of_three_seconds_comes_close(pose, expected):
    scene = with_tracks([pose], [AgentKind.VEHICLE], speed=8.0, iterations=32)
    assert scenario_stats(scene).interactions == expected


def test_a_pedestrian_interacts_when_it_walks_towards_the_path():
    scene = with_tracks([[30.0, 8.0, -np.pi / 2]], [AgentKind.PEDESTRIAN], iterations=32)
    assert scenario_stats(scene).interactions == 0.0
    walking = scene.tracks.velocities.copy()
    walking[..., 1] = -1.5
    tracks = replace(scene.tracks, velocities=walking)
    assert scenario_stats(replace(scene, tracks=tracks)).interactions == 1.0


def test_means_are_over_scenarios_by_city_and_by_type(store):
    found = store_stats(store)
    assert found.groups("city")["straight"] == found.groups("city")["all"]
    types = found.groups("type")
    assert types["free"]["scenarios"] == types["parked"]["scenarios"] == 2.0
    assert types["free"]["mean_speed_mps"] == pytest.approx(7.0)
    assert types["all"]["path_m"] == pytest.approx(7.5 * 2.4)
    assert store_stats(store, store.tokens[:1]).groups()["all"]["scenarios"] == 1.0


def test_nothing_at_all_is_a_table_without_numbers(store):
    assert stats_table(store_stats(store, ())).splitlines()[1].split() == ["all", "0"]


def test_tables_hold_the_means_and_the_published_numbers(store):
    found = store_stats(store)
    text = stats_table(found)
    assert text.splitlines()[1].split()[:2] == ["straight", "4"]
    assert "DeepPlan 1182" in text
    rows = stats_table(found, style="csv").splitlines()
    assert len(rows) == 5
    assert float(dict(zip(rows[0].split(","), rows[1].split(","), strict=True))["path_m"]) > 14.0
    assert stats_dict(found, published())["published"]["sites"] == {}
    with pytest.raises(ConfigError, match="format 'xls'"):
        stats_table(found, style="xls")


@pytest.mark.parametrize(
    ("city", "count"),
    [("sindelfingen", 490), ("SIFI", 490), ("san_francisco", 180), ("BER", 101), ("street", None)],
)
def test_sites_of_the_published_benchmark_are_recognised(city, count):
    assert published().count(city) == count


def test_the_picture_is_drawn_the_same_again(store, tmp_path):
    found = store_stats(store)
    found = replace(found, cities=dict(zip(found.rows, ["Berlin", "a", "a", "MUC"], strict=True)))
    for name in ("one.png", "two.png"):
        save_picture(stats_figure(found, published(), title="toy"), tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert (tmp_path / "one.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(ConfigError, match="no picture ends in"):
        save_picture(stats_figure(found, published(), title="toy"), tmp_path / "one.bmpx")


def test_the_picture_shows_published_sets_beside_ours_and_labels_all_axes(store):
    found = store_stats(store)
    cities = ["Berlin", "San Francisco", "a", "Sindelfingen"]
    found = replace(found, cities=dict(zip(found.rows, cities, strict=True)))
    figure = stats_figure(found, published(), title="toy: 4 scenarios")
    sets, counts, *others = figure.axes
    assert [bar.get_width() for bar in sets.patches] == [4, *PUBLISHED_SETS.values()]
    assert sorted(bar.get_width() for bar in counts.patches) == [1, 1, 1, 1, 101, 180, 490]
    assert all(axes.get_xlabel() for axes in figure.axes)
    assert "m/s" in others[-1].get_xlabel()
    words = [text for text, _ in written(figure)]
    assert {"this store", "DeepPlan (published)", "San Francisco", "all", "bicycles"} <= {*words}
    assert overlaps(figure) == []
    assert cut_off(figure) == []


def test_commands_print_write_and_leave_out_what_was_dropped(store, tmp_path, capsys):
    def call(*words):
        with pytest.raises(SystemExit) as ended:
            main([*words, "--quiet"])
        assert ended.value.code == 0
        return capsys.readouterr().out

    path, out = str(store.path), str(tmp_path / "out")
    assert "straight" in call("stats", path, "--figure", str(tmp_path / "bars.svg"))
    assert (tmp_path / "bars.svg").stat().st_size > 10_000
    assert "2 of 4 scenarios accepted" in call(
        "filter", path, "--min-path", "17.0", "--workers", "1"
    )
    assert json.loads(call("stats", path, "--json"))["cities"]["all"]["scenarios"] == 2.0
    printed = call("export", "nuplan", path, "--out", out)
    assert "2 logs" in printed
    assert f"--tokens {out}/tokens.txt" in printed
    assert "add them" in printed
    every = call("export", "nuplan", path, "--out", out, "--all", "--json")
    assert len(json.loads(every)["tokens"]) == 4
