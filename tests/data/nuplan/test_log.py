"""nuPlan logs: what is offered, how it is cut, and what is refused."""

import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import places
import pytest
from nuplan_logs import list_scenarios, read_scenario
from recordings import require_plausible

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.log import open_log, read_boxes, read_ego
from shiftsim.data.nuplan.map import read_map
from shiftsim.data.nuplan.scenarios import (
    NAMED_TYPES,
    cut_window,
    mapping_of,
    parse_mapping,
)
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, ConversionError, DataError
from shiftsim.planners.basic import LogFuture
from shiftsim.sim.planner import observe_log, past_rows, scene_info
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, LightStatus

GOLDEN = places.GOLDEN / "nuplan_format"
TOKEN = "000000012a05f23c"
FROM_START = (15.0, -3.0, 0.5)


@pytest.fixture(scope="module")
def road() -> VectorMap:
    return read_map(GOLDEN / "maps" / "fixture-town" / "1.0.0" / "map.gpkg", "fixture-town")


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    return Path(shutil.copy(GOLDEN / "logs" / "fixture_log_0001.db", tmp_path / "log.db"))


def edit(path: Path, *statements: str) -> None:
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


def read(path: Path, road: VectorMap, flaws: Counter[str] | None = None) -> Scenario:
    return read_scenario(path, TOKEN, road, FROM_START, flaws)


def test_only_the_middle_scene_of_five_is_offered(log_path: Path) -> None:
    assert len(list_scenarios(log_path)) == 360


def test_a_log_with_four_scenes_offers_nothing(log_path: Path) -> None:
    edit(log_path, "DELETE FROM scene WHERE name = 'scene-004'")
    assert list_scenarios(log_path) == []


def test_types_tokens_and_goals_choose_scenarios(log_path: Path) -> None:
    assert [
        s.token for s in list_scenarios(log_path, types=frozenset(["near_multiple_vehicles"]))
    ] == [TOKEN]
    assert [s.scenario_type for s in list_scenarios(log_path, tokens=frozenset([TOKEN]))] == [
        "near_multiple_vehicles"
    ]
    edit(log_path, "UPDATE scene SET goal_ego_pose_token = NULL")
    assert list_scenarios(log_path, remove_invalid_goals=True) == []


def test_window_follows_duration_offset_and_ratio(log_path: Path) -> None:
    with open_log(log_path) as log:
        window = cut_window(log, TOKEN, (15.0, 0.0, 0.5))
    assert window.iteration_rows.tolist() == list(range(60, 360, 2))
    assert (window.first_row, window.last_row) == (0, 360)
    assert window.is_short


def test_rows_are_kept_three_seconds_before_and_eight_after(log_path: Path) -> None:
    with open_log(log_path) as log:
        window = cut_window(log, TOKEN, (2.0, 2.0, 0.5))
    assert window.iteration_rows.tolist() == list(range(100, 141, 2))
    assert (window.first_row, window.last_row) == (40, 302)


def test_nuplan_table_names_73_types_with_their_own_window() -> None:
    assert len(NAMED_TYPES) == 73
    assert mapping_of("starting_left_turn") == (15.0, -3.0, 0.5)
    assert mapping_of("unknown") == (20.0, 0.0, 0.5)


@pytest.mark.parametrize("text", ["15,0", "a,b,c", "15,0,0", "0,0,0.5", "15,0,2", "nan,0,0.5", ""])
def test_a_senseless_mapping_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="mapping"):
        parse_mapping(text)


def test_mapping_is_read_from_text() -> None:
    assert parse_mapping("15,-3,0.5") == (15.0, -3.0, 0.5)


def test_scenario_arrays_are_read_only(log_path: Path, road: VectorMap) -> None:
    scene = read(log_path, road)
    assert not scene.ego.flags.writeable
    assert not scene.tracks.poses.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        scene.ego[0, 0] = 0.0


def test_static_objects_have_no_velocity(log_path: Path, road: VectorMap) -> None:
    tracks = read(log_path, road).tracks
    static = tracks.kinds > AgentKind.BICYCLE
    assert np.isnan(tracks.velocities[:, static]).all()
    assert np.isfinite(tracks.velocities[:, ~static][tracks.valid[:, ~static]]).all()


def test_heading_has_the_sign_of_nuplans_quaternion_library(log_path: Path) -> None:
    half = 0.05
    w, x, y = (float(v) for v in (np.cos(half), 0.6 * np.sin(half), 0.8 * np.sin(half)))
    edit(log_path, f"UPDATE ego_pose SET qw = {w!r}, qx = {x!r}, qy = {y!r}, qz = 0")
    with open_log(log_path) as log:
        heading = read_ego(log, 0, 1)[0, 2]
    assert heading == pytest.approx(np.arctan2(-2 * x * y, 1 - 2 * y * y), abs=1e-15)


def test_a_track_listed_twice_in_a_frame_is_counted_and_the_last_kept(
    log_path: Path, road: VectorMap
) -> None:
    edit(
        log_path,
        "INSERT INTO lidar_box SELECT x'ff', lidar_pc_token, track_token, next_token, prev_token,"
        " x + 1, y, z, width, length, height, vx, vy, vz, yaw, confidence FROM lidar_box LIMIT 1",
    )
    flaws: Counter[str] = Counter()
    changed = read(log_path, road, flaws).tracks
    assert +flaws == {"track listed twice in a frame: the last one is kept": 1}
    original = read_scenario(
        GOLDEN / "logs" / "fixture_log_0001.db", TOKEN, road, FROM_START
    ).tracks
    assert np.nansum(changed.poses - original.poses) == pytest.approx(1.0)


def test_a_light_with_two_states_at_once_keeps_both(log_path: Path, road: VectorMap) -> None:
    original, flaws = read(log_path, road).traffic_lights, Counter[str]()
    edit(
        log_path,
        "INSERT INTO traffic_light_status SELECT randomblob(8), lidar_pc_token, lane_connector_id,"
        " 'yellow' FROM traffic_light_status WHERE rowid <= 2",
    )
    lights = read(log_path, road, flaws).traffic_lights
    row, code = int(original.status.max(axis=1).argmax()), LightStatus.YELLOW
    name, first = original.listed(row)[0]
    assert [status for other, status in lights.listed(row) if other == name] == [first, code]
    assert lights.at(row)[name] == code
    assert lights.connector_ids[: len(original.connector_ids)] == original.connector_ids
    assert +flaws == {"traffic light listed several times in a frame": 2}


def repeat_stamp(path: Path, row: int) -> None:
    """Give a row the time stamp of the one before."""
    place = f"(SELECT rowid FROM lidar_pc ORDER BY timestamp LIMIT 1 OFFSET {row})"
    before = f"(SELECT timestamp FROM lidar_pc ORDER BY timestamp LIMIT 1 OFFSET {row - 1})"
    edit(path, f"UPDATE lidar_pc SET timestamp = {before} WHERE rowid = {place}")


def test_a_repeated_time_stamp_changes_that_time_and_nothing_else(
    log_path: Path, road: VectorMap
) -> None:
    original, flaws = read(log_path, road), Counter[str]()
    repeat_stamp(log_path, 101)
    found = read(log_path, road, flaws)
    assert +flaws == {"lidar_pc: time stamp repeated": 1}
    assert np.flatnonzero(found.time_us != original.time_us).tolist() == [101]
    np.testing.assert_array_equal(found.ego, original.ego)
    np.testing.assert_array_equal(found.iteration_rows, original.iteration_rows)
    np.testing.assert_array_equal(found.tracks.poses, original.tracks.poses)
    np.testing.assert_array_equal(found.traffic_lights.status, original.traffic_lights.status)


@pytest.mark.parametrize("index", [False, True])
def test_rows_with_one_time_stamp_are_counted_as_nuplans_queries_do(
    log_path: Path, road: VectorMap, index: bool
) -> None:
    edit(log_path, *["DROP INDEX IF EXISTS lidar_pc_timestamp_idx"] * (not index))
    edit(log_path, *["CREATE INDEX IF NOT EXISTS stamps ON lidar_pc (timestamp)"] * index)
    for row in (101, 104):  # of which the former is the first of two, the latter the second
        repeat_stamp(log_path, row if row == 104 else row + 1)
    scenario = read(log_path, road)
    with closing(sqlite3.connect(log_path)) as connection:
        for row in (101, 104):
            stamp = int(scenario.time_us[row])
            ahead, back = (
                [
                    r[0]
                    for r in connection.execute(
                        "SELECT timestamp FROM lidar_pc WHERE timestamp"
                        f" {sign} ? ORDER BY timestamp {order}",
                        [stamp],
                    )
                ]
                for sign, order in ((">=", ""), ("<=", "DESC"))
            )
            cut = replace(scenario, iteration_rows=np.array([row, row + 2, row + 4]))
            past = scenario.time_us[past_rows(cut, 0)]
            assert past.tolist() == [stamp, *back[2:43:2]][::-1]
            planner = LogFuture()
            planner.reset(scene_info(cut, planner=planner))
            plan = planner.plan(observe_log(cut, 0, samples=1))
            assert plan.time_us.tolist() == [stamp, *ahead[10:161:10]]


BROKEN = {
    "merged point cloud": ("UPDATE lidar SET channel = 'other'", "MergedPointCloud"),
    "table": ("DROP TABLE lidar_box", "'lidar_box' is missing"),
    "column": ("ALTER TABLE ego_pose DROP COLUMN qw", "no column 'qw'"),
    "category": ("UPDATE category SET name = 'unicorn'", "unknown category 'unicorn'"),
    "pose": ("UPDATE ego_pose SET x = NULL", "not finite"),
    "box pose": ("UPDATE lidar_box SET yaw = NULL", "not finite"),
    "text": ("UPDATE lidar_box SET x = 'abc'", "no number"),
    "endless box": ("UPDATE lidar_box SET length = 9e999", "no finite length or width"),
    "box without a length": ("UPDATE lidar_box SET width = NULL", "no finite length or width"),
    "box without a place": ("UPDATE lidar_box SET x = NULL", "a pose that is not finite"),
    "all stamps equal": ("UPDATE lidar_pc SET timestamp = 1600000000000000", "two iterations at"),
    "unordered": (
        "UPDATE lidar_pc SET next_token = (SELECT token FROM lidar_pc ORDER BY timestamp LIMIT 1)",
        "earlier time stamp",
    ),
    "ego pose": ("DELETE FROM ego_pose", "unknown ego_pose"),
    "no map": ("DELETE FROM log", "names no map"),
    "two rows": ("DELETE FROM lidar_pc WHERE timestamp != 1600000003000000", "1 iterations"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_log_gives_one_error_that_names_the_file(
    case: str, log_path: Path, road: VectorMap
) -> None:
    statement, message = BROKEN[case]
    edit(log_path, statement)
    with pytest.raises(DataError, match=message) as caught:
        read(log_path, road)
    assert str(log_path) in str(caught.value)
    assert caught.value.hint


def test_an_unknown_token_is_named(log_path: Path, road: VectorMap) -> None:
    with pytest.raises(ConversionError, match="0123456789abcdef"):
        read_scenario(log_path, "0123456789abcdef", road)


@pytest.mark.parametrize("size", [0, 100, 5000, 200_000])
def test_a_truncated_log_gives_one_error(size: int, log_path: Path, road: VectorMap) -> None:
    log_path.write_bytes(log_path.read_bytes()[:size])
    with pytest.raises(DataError, match=r"log\.db"):
        read(log_path, road)


def test_a_missing_log_is_named(tmp_path: Path, road: VectorMap) -> None:
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "nothing.db", road)


def test_a_view_in_place_of_a_table_is_refused(log_path: Path, road: VectorMap) -> None:
    edit(
        log_path,
        "ALTER TABLE lidar_box RENAME TO hidden",
        "CREATE VIEW lidar_box AS SELECT * FROM hidden",
    )
    with pytest.raises(DataError, match="'lidar_box' is missing"):
        read(log_path, road)


def test_a_log_is_never_written_to(log_path: Path, road: VectorMap) -> None:
    edit(log_path, "CREATE TRIGGER t AFTER INSERT ON log BEGIN DELETE FROM lidar_box; END")
    before = log_path.read_bytes()
    log_path.chmod(0o444)
    read(log_path, road)
    assert log_path.read_bytes() == before
    assert [p.name for p in log_path.parent.iterdir()] == ["log.db"]


def test_pickled_columns_are_never_read(log_path: Path, road: VectorMap) -> None:
    edit(log_path, "UPDATE lidar SET translation = x'8004', rotation = NULL")
    assert read(log_path, road).num_iterations == 151


def test_an_implausible_number_is_a_warning(log_path: Path, road: VectorMap) -> None:
    edit(log_path, "UPDATE lidar_box SET vx = 1000 WHERE rowid = 1", "UPDATE ego_pose SET vx = 999")
    flaws: Counter[str] = Counter()
    assert read(log_path, road, flaws).ego[0, 3] == 999
    assert flaws["lidar_box: vx beyond -150 … 150 m/s"] == 1
    assert flaws["ego_pose: vx beyond -150 … 150 m/s"] == 360


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ("length = 0", "without length or width"),
        ("width = 0.0", "without length or width"),
        ("x = 9e999", "off the earth"),
        ("y = -2e9", "off the earth"),
    ],
)
def test_a_box_that_nothing_can_touch_is_left_out_with_one_warning(
    log_path: Path, road: VectorMap, change: str, what: str
) -> None:
    before = read(log_path, road).tracks
    with closing(sqlite3.connect(log_path)) as base:
        token = base.execute(
            "SELECT track_token, COUNT(*) FROM lidar_box GROUP BY 1 ORDER BY 2 DESC"
        ).fetchone()[0]
    edit(log_path, f"UPDATE lidar_box SET {change} WHERE track_token = x'{token.hex()}'")
    flaws: Counter[str] = Counter()
    after = read(log_path, road, flaws).tracks
    (flaw,) = +flaws
    assert flaw.startswith(f"lidar_box: boxes {what}")
    assert flaw.endswith(f"; first of track {token.hex()!r}")
    index = before.tokens.index(token.hex())
    assert flaws[flaw] == before.valid[:, index].sum() > 1
    rest = np.arange(before.num_tracks) != index
    np.testing.assert_array_equal(after.poses, before.select(rest).poses)
    assert token.hex() not in after.tokens


def test_a_box_of_negative_size_is_taken_as_positive(log_path: Path, road: VectorMap) -> None:
    before = read(log_path, road).tracks
    edit(log_path, "UPDATE lidar_box SET length = -length")
    flaws: Counter[str] = Counter()
    np.testing.assert_array_equal(read(log_path, road, flaws).tracks.sizes, before.sizes)
    assert [flaw for flaw in +flaws if "negative length" in flaw]


def test_a_log_of_many_parts_is_warned_of_once(log_path: Path) -> None:
    edit(log_path, "UPDATE lidar_box SET length = 0")
    flaws: Counter[str] = Counter()
    with open_log(log_path) as log:
        for first in (0, 100):
            assert not read_boxes(log, first, first + 100, flaws).token
    assert len(+flaws) == 1


@pytest.mark.parametrize(
    ("change", "field", "column", "kept"),
    [
        ("yaw = 7.0e6", "heading", "poses", np.arctan2(np.sin(7.0e6), np.cos(7.0e6))),
        ("vx = -3e200", "vx", "velocities", -1e6),
        ("width = 2e7", "width", "sizes", 1e6),
    ],
)
def test_a_box_that_a_store_could_not_hold_is_brought_into_its_range(
    log_path: Path, road: VectorMap, change: str, field: str, column: str, kept: float
) -> None:
    edit(log_path, f"UPDATE lidar_box SET {change}")
    flaws: Counter[str] = Counter()
    scene = read(log_path, road, flaws)
    (flaw,) = +flaws
    assert flaw.startswith(f"lidar_box: {field} beyond")
    found = getattr(scene.tracks, column)[scene.tracks.valid]
    assert (found == kept).any(axis=1).sum() > 100
    require_plausible(scene)


def test_a_goal_off_the_earth_is_left_out_with_one_warning(log_path: Path, tmp_path: Path) -> None:
    with closing(sqlite3.connect(log_path)) as base:
        names = ", ".join(row[1] for row in base.execute("PRAGMA table_info(ego_pose)"))
    others = names.replace("token", "x'0f'", 1).replace(" x,", " 2e9,", 1)
    edit(
        log_path,
        f"INSERT INTO ego_pose ({names}) SELECT {others} FROM ego_pose LIMIT 1",
        "UPDATE scene SET goal_ego_pose_token = x'0f'",
    )
    report = convert_nuplan(log_path, GOLDEN / "maps", tmp_path / "store", tokens=[TOKEN])
    assert report.flaws == {"log log: scene: goals off the earth are left out": 1}
    assert ScenarioStore(tmp_path / "store").read(TOKEN).mission_goal is None


def test_an_infinite_velocity_is_refused(log_path: Path, road: VectorMap) -> None:
    edit(log_path, "UPDATE lidar_box SET vy = 9e999")
    with pytest.raises(ConversionError, match="has an infinite velocity"):
        read(log_path, road)


def test_a_number_that_no_store_can_hold_is_refused(log_path: Path, road: VectorMap) -> None:
    edit(log_path, "UPDATE ego_pose SET x = 1e300")
    with pytest.raises(ConversionError, match="'x_m', row 0: 1e\\+300 is beyond"):
        read(log_path, road)
