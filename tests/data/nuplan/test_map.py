"""nuPlan maps: links, flaws that are tolerated, and files that are refused."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import places
import pytest

from shiftsim.data.nuplan.map import read_map
from shiftsim.errors import DataError
from shiftsim.world.map import NONE

GOLDEN = places.GOLDEN / "nuplan_format"


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    source = GOLDEN / "maps" / "fixture-town" / "1.0.0" / "map.gpkg"
    return Path(shutil.copy(source, tmp_path / "map.gpkg"))


def edit(path: Path, *statements: str) -> None:
    """Change a map as plain SQLite; its spatial triggers need functions that are not there."""
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA recursive_triggers = OFF")
    names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for (name,) in names:
        connection.execute(f'DROP TRIGGER "{name}"')
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


def test_connectors_link_the_lane_that_is_left_to_the_lane_that_is_entered(map_path: Path) -> None:
    road = read_map(map_path, "town")
    connector = road.edge("38")
    assert [road.edges.ids[i] for i in road.incoming.at(connector)] == ["8"]
    assert [road.edges.ids[i] for i in road.outgoing.at(connector)] == ["17"]
    assert road.blocks.ids[road.block_of[connector]] == "31"
    assert bool(road.has_traffic_lights[connector])
    assert road.flaws == {}


def test_neighbours_are_the_lanes_beside_in_the_group(map_path: Path) -> None:
    road = read_map(map_path, "town")
    lane = road.edge("8")
    assert road.edges.ids[road.left_lane[lane]] == "5"
    assert road.right_lane[lane] == NONE


def test_arrays_of_a_map_are_read_only(map_path: Path) -> None:
    road = read_map(map_path, "town")
    assert not road.baselines.xy.flags.writeable
    assert not road.speed_limits.flags.writeable


def test_tolerated_flaws_are_counted(map_path: Path) -> None:
    edit(
        map_path,
        "UPDATE lane_connectors SET entry_lane_fid = 9999 WHERE fid = 38",
        "UPDATE lanes_polygons SET left_boundary_fid = 9999 WHERE fid = 8",
        "UPDATE lanes_polygons SET geom = (SELECT geom FROM lanes_polygons WHERE fid = 5)"
        " WHERE fid = 8",
    )
    flaws = read_map(map_path, "town").flaws
    assert flaws["edge names an unknown edge"] == 1
    assert flaws["edge names an unknown boundary"] == 1
    assert flaws["overlapping lanes"] == 1


def test_a_lane_without_speed_limit_has_none(map_path: Path) -> None:
    edit(map_path, "UPDATE lanes_polygons SET speed_limit_mps = NULL WHERE fid = 8")
    road = read_map(map_path, "town")
    assert np.isnan(road.speed_limits[road.edge("8")])


def test_columns_that_nuplan_does_not_need_may_be_missing(map_path: Path) -> None:
    edit(map_path, "ALTER TABLE lane_connectors DROP COLUMN turn_type_fid")
    assert (read_map(map_path, "town").turn_type == 4).all()


def test_empty_layers_are_fine(map_path: Path) -> None:
    edit(map_path, "DELETE FROM carpark_areas", "DELETE FROM walkways", "DELETE FROM crosswalks")
    road = read_map(map_path, "town")
    assert len(road.car_parks) == len(road.walkways) == len(road.crosswalks) == 0


BROKEN = {
    "layer": ("DROP TABLE lanes_polygons", "'lanes_polygons' is missing"),
    "column": ("ALTER TABLE lane_connectors DROP COLUMN exit_lane_fid", "'exit_lane_fid'"),
    "system": ("DELETE FROM meta", "projectedCoordSystem"),
    "unknown system": ("UPDATE meta SET value = 'epsg:999999'", "999999"),
    "header": ("UPDATE lanes_polygons SET geom = x'00'", "not a GeoPackage geometry"),
    "wkb": ("UPDATE lanes_polygons SET geom = substr(geom, 1, 60)", "broken geometry"),
    "null": ("UPDATE boundaries SET geom = NULL", "not a GeoPackage geometry"),
    "id": ("UPDATE lanes_polygons SET lane_group_fid = 'abc'", "not an integer"),
    "speed": ("UPDATE lanes_polygons SET speed_limit_mps = 'fast'", "speed_limit_mps"),
    "baseline": ("DELETE FROM baseline_paths WHERE lane_fid = 8", "'8' has no baseline"),
    "connector": ("DELETE FROM gen_lane_connectors_scaled_width_polygons", "has no polygon"),
    "kind": (
        "UPDATE lanes_polygons SET geom = (SELECT geom FROM baseline_paths LIMIT 1)",
        "without area",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_map_gives_one_error_that_names_the_file(case: str, map_path: Path) -> None:
    statement, message = BROKEN[case]
    edit(map_path, statement)
    with pytest.raises(DataError, match=message) as caught:
        read_map(map_path, "town")
    assert str(map_path) in str(caught.value)
    assert caught.value.hint


@pytest.mark.parametrize("size", [0, 50, 3000, 60_000])
def test_a_truncated_map_gives_one_error(size: int, map_path: Path) -> None:
    map_path.write_bytes(map_path.read_bytes()[:size])
    with pytest.raises(DataError, match=r"map\.gpkg"):
        read_map(map_path, "town")
