"""Export to nuPlan's formats: what comes back is what went out, and nuPlan's queries find it."""

import json
import shutil
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import shapely
import stores
from worlds import straight_road

from shiftsim.data.nuplan.export import export_nuplan
from shiftsim.data.nuplan.export_log import cut_of
from shiftsim.data.nuplan.export_map import write_nuplan_map
from shiftsim.data.nuplan.map import read_map
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConversionError, DataError
from shiftsim.world.layers import make_lists


@pytest.fixture(scope="module")
def log(trip):
    """A connection to the exported log with traffic lights."""
    with closing(sqlite3.connect(next(trip[2].logs.glob("*s04*.db")))) as connection:
        yield connection


def test_an_export_has_the_same_bytes_again(trip, tmp_path):
    first, _, report = trip
    again = export_nuplan(first, tmp_path)
    folder = report.token_file.parent
    names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert all((folder / name).read_bytes() == (tmp_path / name).read_bytes() for name in names)
    assert again.token_file.read_text().split() == list(first.tokens)


# What nuPlan's own readers ask a log, nuplan-formats.md §2.

SENSOR = "JOIN lidar AS l ON pc.lidar_token = l.token WHERE l.channel = 'MergedPointCloud'"
ANCHOR = "(SELECT lidar_pc_token FROM scenario_tag LIMIT 1)"


def test_the_log_names_its_map(log, trip):
    assert log.execute("SELECT map_version, location FROM log").fetchall() == [
        ("us-ma-boston", "us-ma-boston")
    ]
    index = json.loads((trip[2].maps / "nuplan-maps-v1.0.json").read_text())
    version = index["us-ma-boston"]["version"]
    assert (trip[2].maps / "us-ma-boston" / version / "map.gpkg").is_file()


def test_tokens_are_blobs_of_eight_bytes(log):
    for table in ("log", "lidar", "lidar_pc", "ego_pose", "scene", "category", "track"):
        query = f"SELECT COUNT(*), SUM(typeof(token) = 'blob' AND length(token) = 8) FROM {table}"
        count, good = log.execute(query).fetchone()
        assert count == good > 0
        assert log.execute(f"SELECT COUNT(DISTINCT token) FROM {table}").fetchone() == (count,)


def test_the_rows_of_the_sensor_are_an_ordered_clock(log, trip):
    rows = log.execute(
        f"SELECT pc.token, pc.next_token, pc.prev_token, pc.timestamp FROM lidar_pc AS pc {SENSOR}"
        " ORDER BY pc.timestamp"
    ).fetchall()
    scene = trip[0].read(next(t for t in trip[0].tokens if "a004" in t))
    assert [row[3] for row in rows] == scene.time_us.tolist()
    assert [row[1] for row in rows] == [row[0] for row in rows[1:]] + [None]
    assert [row[2] for row in rows] == [None] + [row[0] for row in rows[:-1]]


def test_all_rows_are_in_the_middle_of_five_scenes(log):
    ordered = [row[0] for row in log.execute("SELECT token FROM scene ORDER BY name ASC")]
    used = {row[0] for row in log.execute("SELECT DISTINCT scene_token FROM lidar_pc")}
    assert len(ordered) == 5
    assert used == {ordered[2]}


def test_scenarios_are_found_by_type_and_with_a_valid_goal(log):
    found = log.execute(
        "WITH ordered AS (SELECT token, ROW_NUMBER() OVER (ORDER BY name ASC) AS place FROM scene),"
        " valid AS (SELECT s.token FROM scene AS s JOIN ordered AS o ON o.token = s.token"
        "  JOIN ego_pose AS g ON g.token = s.goal_ego_pose_token"
        "  WHERE o.place >= 3 AND o.place < (SELECT COUNT(*) - 1 FROM ordered))"
        " SELECT lower(hex(pc.token)), MAX(st.type) FROM lidar_pc AS pc"
        " JOIN valid ON pc.scene_token = valid.token"
        " JOIN scenario_tag AS st ON st.lidar_pc_token = pc.token"
        " WHERE st.type IN ('starting_left_turn') GROUP BY pc.token"
    ).fetchall()
    assert found == [("a004065c00000032", "starting_left_turn")]


def test_the_ego_is_the_rear_axle_with_motion_in_its_own_frame(log, trip):
    rows = log.execute(
        "SELECT e.x, e.y, e.qw, e.qx, e.qy, e.qz, e.vx, e.vy, e.acceleration_x, e.acceleration_y,"
        " e.epsg FROM ego_pose AS e JOIN lidar_pc AS pc ON pc.ego_pose_token = e.token"
        " ORDER BY pc.timestamp"
    ).fetchall()
    scene = trip[0].read("a004065c00000032")
    values = np.array(rows)
    np.testing.assert_array_equal(values[:, :2], scene.ego[:, :2])
    np.testing.assert_array_equal(values[:, 6:10], scene.ego[:, 3:7])
    heading = 2.0 * np.arctan2(values[:, 5], values[:, 2])
    np.testing.assert_allclose(np.cos(heading - scene.ego[:, 2]), 1.0)
    np.testing.assert_array_equal(values[:, 3:5], 0.0)
    assert set(values[:, 10]) == {32619}


def test_the_objects_of_a_row_have_centre_size_type_and_map_velocity(log, trip):
    rows = log.execute(
        "SELECT c.name, b.x, b.y, b.yaw, b.length, b.width, b.vx, b.vy, lower(hex(t.token))"
        " FROM lidar_box AS b JOIN track AS t ON t.token = b.track_token"
        " JOIN category AS c ON c.token = t.category_token"
        f" WHERE b.lidar_pc_token = {ANCHOR} ORDER BY b.rowid"
    ).fetchall()
    scene = trip[0].read("a004065c00000032")
    row = int(scene.iteration_rows[0])
    valid = scene.tracks.valid[row]
    expected = np.column_stack(
        [scene.tracks.poses[row], scene.tracks.sizes[row], scene.tracks.velocities[row]]
    )[valid]
    np.testing.assert_array_equal([r[1:8] for r in rows], expected)
    tokens = np.array(scene.tracks.tokens)[valid]
    assert [r[8] for r in rows] == tokens.tolist()
    assert {r[0] for r in rows} <= {"vehicle", "bicycle", "pedestrian"}


def test_boxes_of_a_track_are_chained_in_time(log):
    broken = log.execute(
        "SELECT COUNT(*) FROM lidar_box AS b JOIN lidar_box AS n ON n.token = b.next_token"
        " JOIN lidar_pc AS p ON p.token = b.lidar_pc_token"
        " JOIN lidar_pc AS q ON q.token = n.lidar_pc_token"
        " WHERE n.prev_token != b.token OR n.track_token != b.track_token"
        " OR q.timestamp <= p.timestamp"
    ).fetchone()
    ends = log.execute("SELECT COUNT(*) FROM lidar_box WHERE next_token IS NULL").fetchone()
    assert broken == (0,)
    assert ends == log.execute("SELECT COUNT(*) FROM track").fetchone()


def test_lights_route_and_goal_are_found_at_the_anchor(log, trip):
    scene = trip[0].read("a004065c00000032")
    lights = log.execute(
        "SELECT lane_connector_id, status FROM traffic_light_status"
        f" WHERE lidar_pc_token = {ANCHOR}"
    ).fetchall()
    listed = scene.traffic_lights.at(int(scene.iteration_rows[0]))
    assert {str(c): s for c, s in lights} == {c: s.name.lower() for c, s in listed.items()} != {}
    route, goal_x, goal_y = log.execute(
        "SELECT s.roadblock_ids, g.x, g.y FROM scene AS s"
        " JOIN lidar_pc AS pc ON pc.scene_token = s.token"
        f" JOIN ego_pose AS g ON g.token = s.goal_ego_pose_token WHERE pc.token = {ANCHOR}"
    ).fetchone()
    assert tuple(route.split(" ")) == scene.route
    assert (goal_x, goal_y) == tuple(scene.mission_goal[:2])


def test_past_and_future_rows_are_counted_from_the_anchor(log):
    base = (
        "SELECT COUNT(*) FROM lidar_pc WHERE timestamp {} "
        f"(SELECT timestamp FROM lidar_pc WHERE token = {ANCHOR})"
    )
    assert log.execute(base.format("<")).fetchone()[0] >= 42  # 2.1 s before
    assert log.execute(base.format(">")).fetchone()[0] >= 300  # 15 s after


def test_queries_by_row_and_by_time_have_an_index(log):
    for table, column in (
        ("lidar_pc", "timestamp"),
        ("lidar_box", "lidar_pc_token"),
        ("scenario_tag", "lidar_pc_token"),
        ("traffic_light_status", "lidar_pc_token"),
    ):
        plan = log.execute(
            f"EXPLAIN QUERY PLAN SELECT * FROM {table} WHERE {column} = 1"
        ).fetchall()
        assert "USING INDEX" in plan[0][3]


def test_sensors_that_nobody_reads_are_empty_tables(log):
    assert log.execute("SELECT COUNT(*) FROM camera").fetchone() == (0,)
    assert log.execute("SELECT COUNT(*) FROM image").fetchone() == (0,)


def test_tables_and_columns_are_those_of_a_nuplan_log(log, nuplan_reference):
    with closing(sqlite3.connect(nuplan_reference / "logs/s04_left_turn.db")) as genuine:
        tables = {
            r[0] for r in genuine.execute("SELECT name FROM sqlite_master WHERE type='table'")
        }
        for table in tables:
            query = f"SELECT name, type FROM pragma_table_info('{table}')"
            assert log.execute(query).fetchall() == genuine.execute(query).fetchall()
    assert tables == {
        r[0] for r in log.execute("SELECT name FROM sqlite_master WHERE type='table'")
    }


# The map as nuPlan reads it, nuplan-formats.md §3.


@pytest.fixture(scope="module")
def gpkg(trip):
    with closing(sqlite3.connect(trip[2].maps / "us-ma-boston/1.0.0/map.gpkg")) as connection:
        yield connection


def test_the_map_is_a_geopackage(gpkg):
    assert gpkg.execute("PRAGMA application_id").fetchone() == (1196444487,)
    assert gpkg.execute("PRAGMA user_version").fetchone() == (10200,)
    systems = gpkg.execute("SELECT srs_id, organization, definition FROM gpkg_spatial_ref_sys")
    found = {row[0]: row[1:] for row in systems}
    assert found[-1] == ("NONE", "undefined")
    assert found[0] == ("NONE", "undefined")
    assert found[4326][0] == found[32619][0] == "EPSG"
    assert found[4326][1].startswith('GEOGCS["WGS 84"')
    assert found[32619][1].startswith('PROJCS["WGS 84 / UTM zone 19N"')


def test_every_layer_is_described_and_bounded(gpkg):
    rows = gpkg.execute(
        "SELECT c.table_name, c.last_change, c.srs_id, g.column_name, g.geometry_type_name, g.z,"
        " g.m"
        " FROM gpkg_contents AS c JOIN gpkg_geometry_columns AS g ON g.table_name = c.table_name"
        " WHERE c.data_type = 'features'"
    ).fetchall()
    assert {(row[2], row[3], row[5], row[6]) for row in rows} == {(32619, "geom", 0, 0)}
    assert len({row[1] for row in rows}) == 1
    for name, *_, kind, _, _ in rows:
        query = "SELECT min_x, max_x, min_y, max_y FROM gpkg_contents WHERE table_name = ?"
        bounds = gpkg.execute(query, [name]).fetchone()
        blobs = [row[0] for row in gpkg.execute(f'SELECT geom FROM "{name}"')]
        heads = [struct.unpack("<2sBBi4d", blob[:40]) for blob in blobs]
        assert {head[:4] for head in heads} <= {(b"GP", 0, 3, 32619)}
        shapes = shapely.from_wkb([blob[40:] for blob in blobs])
        assert {shape.geom_type.upper() for shape in shapes} <= {kind}
        for head, shape in zip(heads, shapes, strict=True):
            low_x, low_y, high_x, high_y = shape.bounds
            assert head[4:] == (low_x, high_x, low_y, high_y)
            assert 1e5 < bounds[0] <= low_x <= high_x <= bounds[1] < 1e6  # metres
    contents = "SELECT data_type, srs_id FROM gpkg_contents WHERE table_name = 'meta'"
    assert gpkg.execute(contents).fetchone() == ("attributes", None)
    meta = dict(gpkg.execute("SELECT key, value FROM meta"))
    assert meta["projectedCoordSystem"] == "epsg:32619"
    assert meta["geographicCoordSystem"] == "epsg:4326"


def test_layers_and_columns_are_those_of_a_nuplan_map(gpkg, nuplan_reference):
    path = next((nuplan_reference / "maps/us-ma-boston").glob("*/map.gpkg"))
    with closing(sqlite3.connect(path)) as genuine:
        for (table,) in genuine.execute("SELECT table_name FROM gpkg_contents").fetchall():
            query = f"SELECT name FROM pragma_table_info('{table}')"
            assert set(gpkg.execute(query)) == set(genuine.execute(query)), table


def test_links_of_the_map_join(gpkg):
    for column in ("exit_lane_fid", "entry_lane_fid"):
        query = (
            "SELECT COUNT(*) FROM lane_connectors AS c"
            f" JOIN lanes_polygons AS l ON l.lane_fid = c.{column}"
            " JOIN lane_groups_polygons AS g ON g.fid = l.lane_group_fid"
        )
        total = gpkg.execute("SELECT COUNT(*) FROM lane_connectors").fetchone()
        assert gpkg.execute(query).fetchone() == total
    queries = (
        "SELECT COUNT(*) FROM lanes_polygons WHERE lane_fid != fid",
        "SELECT COUNT(*) FROM lane_connectors WHERE traffic_light_stop_line_fids IS NULL",
        "SELECT COUNT(*) FROM baseline_paths"
        " WHERE (lane_fid IS NULL) = (lane_connector_fid IS NULL)",
        "SELECT COUNT(*) FROM gen_lane_connectors_scaled_width_polygons WHERE"
        " lane_connector_fid NOT IN (SELECT fid FROM lane_connectors)",
        "SELECT COUNT(*) FROM lanes_polygons WHERE left_boundary_fid NOT IN"
        " (SELECT fid FROM boundaries) OR right_boundary_fid NOT IN (SELECT fid FROM boundaries)",
        "SELECT COUNT(*) FROM lane_group_connectors WHERE from_lane_group_fid NOT IN"
        " (SELECT fid FROM lane_groups_polygons) OR to_lane_group_fid NOT IN"
        " (SELECT fid FROM lane_groups_polygons)",
        "SELECT COUNT(*) FROM lane_connectors WHERE lane_group_connector_fid NOT IN"
        " (SELECT fid FROM lane_group_connectors)",
        "SELECT COUNT(*) FROM lane_connectors WHERE intersection_fid NOT IN"
        " (SELECT fid FROM intersections)",
        "SELECT COUNT(*) FROM lanes_polygons AS a JOIN lanes_polygons AS b ON a.fid < b.fid AND"
        " a.lane_group_fid = b.lane_group_fid AND a.lane_index = b.lane_index",
    )
    assert [gpkg.execute(query).fetchone()[0] for query in queries] == [0] * len(queries)
    for layer in ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas"):
        query = f"SELECT COUNT(*) FROM {layer} WHERE geom IS NULL"
        assert gpkg.execute(query).fetchone() == (0,)


# Other stores.


def test_only_the_tokens_asked_for_are_written(trip, tmp_path):
    report = export_nuplan(trip[0], tmp_path, tokens=trip[0].tokens[:1])
    assert len(list(report.logs.glob("*.db"))) == 1
    assert len(report.cities) == 1
    assert report.missing_maps == sorted(set(report.missing_maps) - set(report.cities))


def test_maps_already_in_the_folder_stay_listed_and_are_never_replaced(trip, tmp_path):
    index = tmp_path / "maps/nuplan-maps-v1.0.json"
    index.parent.mkdir()
    index.write_text('{"elsewhere": {"version": "9.1"}}')
    export_nuplan(trip[0], tmp_path, tokens=trip[0].tokens[:1])
    assert "elsewhere" in json.loads(index.read_text())
    index.write_text(json.dumps({city: {"version": "9.1"} for city in trip[0].cities}))
    with pytest.raises(ConversionError, match=r"lists another map .*9\.1"):
        export_nuplan(trip[0], tmp_path)


def test_a_map_that_nuplan_cannot_hold_is_refused_by_name(trip, tmp_path):
    road = trip[0].map(trip[0].cities[0])
    renamed = replace(road, edges=replace(road.edges, ids=("lane-1", *road.edges.ids[1:])))
    with pytest.raises(ConversionError, match="'lane-1' cannot be exported"):
        write_nuplan_map(tmp_path / "map.gpkg", renamed, "1")
    links = [road.outgoing.at(edge).tolist() for edge in range(len(road.edges))]
    direct = replace(road, outgoing=make_lists([[1], *links[1:]]))
    with pytest.raises(ConversionError, match="without a connector"):
        write_nuplan_map(tmp_path / "map.gpkg", direct, "1")


def test_pieces_of_one_area_are_one_row(trip, tmp_path):
    road = trip[0].map("sg-one-north")
    walks = road.walkways
    doubled = replace(road, walkways=replace(walks, ids=(walks.ids[0],) * len(walks.ids)))
    write_nuplan_map(tmp_path / "map.gpkg", doubled, "1")
    assert read_map(tmp_path / "map.gpkg", "x").walkways.ids == doubled.walkways.ids


def test_iterations_that_no_mapping_gives_are_refused(trip):
    scene = trip[0].read(trip[0].tokens[0])
    odd = replace(scene, iteration_rows=np.delete(scene.iteration_rows, 5))
    with pytest.raises(ConversionError, match="not every n-th row"):
        cut_of(odd)


def test_layers_in_several_or_unknown_systems_are_refused(trip, tmp_path):
    path = tmp_path / "map.gpkg"
    for other, message in ((4326, "several coordinate systems"), (32632, "neither 4326 nor 32619")):
        shutil.copy(trip[2].maps / "us-ma-boston/1.0.0/map.gpkg", path)
        with closing(sqlite3.connect(path)) as gpkg:
            blob = bytearray(gpkg.execute("SELECT geom FROM boundaries LIMIT 1").fetchone()[0])
            blob[4:8] = struct.pack("<i", other)
            gpkg.execute(
                "UPDATE boundaries SET geom = ? WHERE rowid IN (SELECT rowid FROM"
                " boundaries LIMIT 1)",
                [bytes(blob)],
            )
            gpkg.commit()
        with pytest.raises(DataError, match=message):
            read_map(path, "us-ma-boston")


class ShortWindows(StoreWriter):
    """Writes windows that end with their last iteration."""

    def add_window(self, window):
        super().add_window(replace(window, last_row=int(window.iteration_rows[-1]) + 1))


def test_logs_that_go_on_behind_the_window_are_counted(tmp_path):
    with ShortWindows(tmp_path / "short") as writer:
        writer.add_map(straight_road())
        stores._add(writer, 0, stores.ITERATIONS)
    stores.write_toy_store(tmp_path / "toy", count=1)
    longer = [
        export_nuplan(ScenarioStore(tmp_path / name), tmp_path / f"out-{name}").longer
        for name in ("toy", "short")
    ]
    assert longer == [0, 1]
