"""Which scenarios nuPlan's filters take, step by step."""

import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import places
import pytest
from commands import call
from nuplan_logs import list_scenarios

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.filter import ScenarioFilter, is_taken, thin_out
from shiftsim.data.nuplan.log import Log, open_log
from shiftsim.data.nuplan.map import read_map
from shiftsim.data.nuplan.scenarios import ScenarioEntry, cut_window
from shiftsim.errors import ConfigError
from shiftsim.world.map import VectorMap
from shiftsim.world.state import center_poses

GOLDEN = places.GOLDEN / "nuplan_format"
MAPS = GOLDEN / "maps"
TOKEN = "000000012a05f23c"
FROM_START = (15.0, 0.0, 0.5)


def entries(*times: float, kind: str = "a", log: str = "l") -> list[ScenarioEntry]:
    """One per time [s]; tokens are in the opposite order of time."""
    return [
        ScenarioEntry(f"{1000 - round(10 * t):04x}{log}{kind}", kind, log, "town", round(t * 1e6))
        for t in times
    ]


def times(found: list[ScenarioEntry], kind: str = "a") -> list[float]:
    return [entry.time_us / 1e6 for entry in found if entry.scenario_type == kind]


def test_every_nth_of_a_type_is_taken_and_the_rest_cut() -> None:
    given = entries(*range(11)) + entries(0, 1, kind="b")
    found = thin_out(given, ScenarioFilter(per_type=3))
    assert (times(found), times(found, "b")) == ([0, 3, 6], [0, 1])


def test_a_limit_drops_those_without_a_tag_first() -> None:
    given = entries(*range(4)) + entries(*range(10), kind="unknown")
    found = thin_out(given, ScenarioFilter(limit=9))
    assert (times(found), times(found, "unknown")) == ([0, 1, 2, 3], [0, 2, 4, 6, 8])
    assert times(thin_out(given, ScenarioFilter(limit=4))) == [0, 1, 2, 3][::-1]
    assert times(thin_out(given, ScenarioFilter(limit=2))) == [3, 1]  # ordered by token
    assert len(thin_out(given, ScenarioFilter(limit=0.3))) == 5
    assert thin_out(given, ScenarioFilter(limit=20)) == given
    assert thin_out([], ScenarioFilter(limit=0.3)) == []


def test_times_are_kept_apart_over_all_logs() -> None:
    given = entries(0.0, 4.0, 9.0) + entries(3.0, 5.0, 20.0, log="m") + entries(1.0, kind="b")
    found = thin_out(given, ScenarioFilter(min_gap_s=5.0))
    assert (times(found), times(found, "b")) == ([0.0, 5.0, 20.0], [1.0])


def test_numbers_come_before_the_distance_in_time() -> None:
    given = entries(*range(10))
    found = thin_out(given, ScenarioFilter(per_type=5, limit=4, min_gap_s=3.0))
    assert times(found) == [2, 6]  # 0 2 4 6 8, of which 8 6 4 2 come first by token


def test_a_draw_at_random_is_refused_only_where_there_is_a_choice() -> None:
    drawn = ScenarioFilter(per_type=3, shuffle=True, source="f.yaml")
    assert len(thin_out(entries(0, 1, 2), drawn)) == 3
    with pytest.raises(ConfigError, match=r"f\.yaml: num_scenarios_per_type with shuffle"):
        thin_out(entries(0, 1, 2, 3), drawn)
    with pytest.raises(ConfigError, match="limit_total_scenarios with shuffle: true"):
        thin_out(entries(0, 1), ScenarioFilter(limit=0.4, shuffle=True))


# Judged one by one: what the ego of a log does, and where.


@pytest.fixture(scope="module")
def road() -> VectorMap:
    return read_map(MAPS / "fixture-town" / "1.0.0" / "map.gpkg", "fixture-town")


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    return Path(shutil.copy(GOLDEN / "logs" / "fixture_log_0001.db", tmp_path / "log.db"))


def drive(path: Path, speeds: list[float]) -> None:
    """Let the ego drive at speeds from row 60 on, of which each lasts 2 s; the last goes on."""
    connection = sqlite3.connect(path)
    poses = connection.execute(
        "SELECT ego_pose_token FROM lidar_pc ORDER BY timestamp LIMIT 400 OFFSET 60"
    ).fetchall()
    for row, (token,) in enumerate(poses):
        speed = speeds[min(row // 40, len(speeds) - 1)]
        connection.execute("UPDATE ego_pose SET vx = ?, vy = 0 WHERE token = ?", [speed, token])
    connection.commit()
    connection.close()


def taken(path: Path, road: VectorMap, **chosen: object) -> bool:
    with open_log(path) as log:
        window = cut_window(log, TOKEN, FROM_START)
        return is_taken(log, window, lambda: road, ScenarioFilter(**chosen))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("speeds", "starts", "stops"),
    [
        ([0.0, 3.0], True, False),
        ([3.0, 0.0], False, True),
        ([0.0, 3.0, 0.0], True, True),
        ([0.98, 1.05], False, False),  # within the noise
        ([0.98, 1.05, 1.5], True, False),
        ([2.0, 3.0], False, False),
        ([1.0, 2.0, 1.0], True, True),  # the threshold itself is not above it
    ],
)
def test_starts_and_stops_are_crossings_of_a_speed(
    speeds: list[float], starts: bool, stops: bool, log_path: Path, road: VectorMap
) -> None:
    drive(log_path, speeds)
    assert taken(log_path, road, start_speed=1.0) is starts
    assert taken(log_path, road, stop_speed=1.0) is stops
    assert taken(log_path, road, start_speed=1.0, stop_speed=1.0) is (starts and stops)


def test_the_way_is_that_of_the_centre_behind_the_first_sample(
    log_path: Path, road: VectorMap
) -> None:
    with open_log(log_path) as log:
        rows = cut_window(log, TOKEN, FROM_START).iteration_rows
        centers = center_poses(read_states(log)[rows[1:], :3])[:, :2]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    # 14.9 s are a little less than 149 samples, in floats
    assert taken(log_path, road, min_way=steps[:-1].sum() - 1e-6)
    assert not taken(log_path, road, min_way=steps[:-1].sum() + 1e-6)


def read_states(log: Log) -> np.ndarray:
    from shiftsim.data.nuplan.log import read_ego

    return read_ego(log, 0, len(log.time_us))


def test_rows_must_be_in_a_set(log_path: Path, road: VectorMap) -> None:
    with open_log(log_path) as log:
        own = [log.tokens[row] for row in cut_window(log, TOKEN, FROM_START).iteration_rows]
    half, whole, more = frozenset(own[::2]), frozenset(own), frozenset([*own, "0" * 16])
    assert taken(log_path, road, token_set=half, min_share=0.49)
    assert not taken(log_path, road, token_set=half, min_share=0.5)
    assert taken(log_path, road, token_set=whole, min_share=1.0)
    assert not taken(log_path, road, token_set=more, min_share=1.0)


def test_the_route_must_be_near(log_path: Path, road: VectorMap) -> None:
    assert taken(log_path, road, route_radius=30.0)
    with open_log(log_path) as log:
        window = replace(cut_window(log, TOKEN, FROM_START), route=("nowhere",))
        assert not is_taken(log, window, lambda: road, ScenarioFilter(route_radius=30.0))


def test_a_type_is_the_last_of_the_tags_that_are_asked_for(log_path: Path) -> None:
    connection = sqlite3.connect(log_path)
    for tag in ("behind_bike", "zebra"):
        row = (tag.encode()[:8], bytes.fromhex(TOKEN), tag)
        connection.execute("INSERT INTO scenario_tag VALUES (?, ?, ?, NULL)", row)
    connection.commit()
    connection.close()
    token, wanted = frozenset([TOKEN]), frozenset(["behind_bike", "near_multiple_vehicles"])
    assert [s.scenario_type for s in list_scenarios(log_path, tokens=token)] == ["zebra"]
    found = list_scenarios(log_path, tokens=token, types=wanted)
    assert [s.scenario_type for s in found] == ["near_multiple_vehicles"]
    assert list_scenarios(log_path, types=frozenset(["unknown"])) == []


# The whole way.


def test_a_filter_chooses_among_all_logs(log_path: Path, tmp_path: Path) -> None:
    (tmp_path / "filter.yaml").write_text("limit_total_scenarios: 2\ntimestamp_threshold_s: 1.0\n")
    report = convert_nuplan(
        log_path, MAPS, tmp_path / "store", filter_file=tmp_path / "filter.yaml", mapping=FROM_START
    )
    with open_log(log_path) as log:
        first = [t for t, offered in zip(log.tokens, log.is_offered, strict=True) if offered]
    untagged = [token for token in first if token != TOKEN]
    assert report.failed == {}
    assert set(report.converted) == {untagged[0], TOKEN}


def test_a_token_that_is_missing_is_told_of_the_logs_that_were_read(
    log_path: Path, tmp_path: Path
) -> None:
    missing = "0123456789abcdef"
    arguments = (tmp_path, MAPS, tmp_path / "store")
    report = convert_nuplan(*arguments, tokens=[missing])
    assert report.failed == {missing: "not offered by any of 1 logs searched (log.db)"}
    (tmp_path / "broken.db").write_bytes(b"no log")
    report = convert_nuplan(*arguments, tokens=[missing])
    assert report.failed.pop("broken")
    expected = "not offered by the 1 of 2 logs that could be read; not read: broken.db"
    assert report.failed == {missing: expected}
    log_path.unlink()
    report = convert_nuplan(*arguments, tokens=[missing])
    assert report.failed[missing] == "none of 1 logs could be read (broken.db)"


def test_the_set_of_a_filter_is_read_from_its_file(log_path: Path, tmp_path: Path) -> None:
    from shiftsim.data.nuplan.filter import read_filter

    (tmp_path / "set.json").write_text(json.dumps(["aa", "bb"]))
    path = tmp_path / "filter.yaml"
    line = f"token_set_path: {tmp_path / 'set.json'}\n"
    path.write_text(line + "fraction_in_token_set_threshold: 0.5\nspeed_noise_tolerance: null\n")
    found = read_filter(path)
    assert (found.token_set, found.min_share, found.speed_noise) == (
        frozenset(["aa", "bb"]),
        0.5,
        0.1,
    )
    path.write_text(line)  # without a share it is off
    assert read_filter(path).token_set is None


def test_a_conversion_of_all_says_how_many_there_will_be_and_what_limits_them(tmp_path, caplog):
    report = convert_nuplan(GOLDEN / "logs", MAPS, tmp_path / "all")
    said = [text for text in caplog.messages if "will be made" in text]
    count = len(report.converted) + len(report.failed)
    assert len(said) == 1
    assert said[0].startswith(f"{count} scenarios of ")
    assert "--types, --tokens or --filter takes fewer" in said[0]
    caplog.clear()
    convert_nuplan(GOLDEN / "logs", MAPS, tmp_path / "one", tokens=[report.converted[0]])
    assert not [text for text in caplog.messages if "will be made" in text]


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("scenario_types: [starting_u_turn]\nnum_scenarios_per_type: 20", [0, 0]),
        ("log_names: [another]\nmap_names: [sg-one-north]", [0, 0]),
        ("scenario_types: [near_multiple_vehicles]\nego_displacement_minimum_m: 1000000", [1, 0]),
    ],
)
def test_a_filter_that_takes_nothing_says_what_each_key_left(
    log_path: Path, tmp_path: Path, text: str, left: list[int]
) -> None:
    (tmp_path / "filter.yaml").write_text(text + "\n")
    store = tmp_path / "store"
    report = convert_nuplan(log_path, MAPS, store, filter_file=tmp_path / "filter.yaml")
    assert report.converted == [] == list(report.failed)
    offered = report.left["offered"]
    keys = [line.partition(":")[0] for line in text.splitlines()]
    assert report.left == {"offered": offered} | dict(zip(keys, left, strict=True))
    assert report.offers["types"]["near_multiple_vehicles"] == 1
    assert report.offers["types"].total() == offered > 1
    assert report.offers["logs"] == {"log": offered}
    assert len(report.offers["maps"]) == 1
    assert not store.exists()


@pytest.mark.thorough
def test_the_command_line_ends_with_3_where_a_filter_takes_nothing(
    log_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "none.yaml").write_text("scenario_types: [starting_u_turn]\n")
    arguments = (str(log_path), str(MAPS), "--store", "new", "--filter", "none.yaml")
    done = call(tmp_path, "convert", "nuplan", *arguments, "--json")
    assert json.loads(done.stdout)["offers"]["logs"].keys() == {"log"}
    done = call(tmp_path, "convert", "nuplan", *arguments)
    assert done.returncode == 3
    assert "left by scenario_types: 0" in done.stdout
    assert "there are types: unknown (" in done.stdout
    assert not (tmp_path / "new").exists()
