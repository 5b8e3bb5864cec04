"""Faults and habits of OpenDRIVE files from the field, one folder each, with the right reading."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from map_checks import check_map

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.opendrive.map import build_road_map, require_lanes
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.shapes import corners
from shiftsim.errors import ConversionError
from shiftsim.world.map import VectorMap

FOLDER = Path(__file__).parents[5] / "shared/reference/field_cases"
TOWN = 50 / 3.6
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"needs {FOLDER}")


class Right(NamedTuple):
    """What a file means."""

    lengths: tuple[float, ...]  # of the lanes [m]
    connectors: tuple[float, ...] = ()  # their lengths [m]
    warnings: dict[str, int] = {}  # noqa: RUF012 - count by kind
    limits: tuple[float, ...] = (TOWN,)  # of lanes and connectors, without repetition [m/s]
    start: tuple[float, float] | None = None  # where the first lane begins [m]


RIGHT = {
    "a01": Right((100, 100), (20,), {"lane link missing between linked roads, inferred": 1}),
    "a02": Right(
        (100, 100), (20,), {"contact point that names the far end, the near end taken": 1}
    ),
    "a03": Right((200,), (), {"contact point that names the far end, the near end taken": 2}),
    "a04": Right((200,)),
    "a05": Right((100, 100), (20,)),
    "a06": Right((200,)),
    "a07": Right((100, 100), (), {"link to a junction that does not exist, dropped": 2}),
    "a10": Right((200, 200)),
    "a11": Right(
        (189.520632916, 189.520632916),
        (),
        {"absurd geometry shorter than 1 mm, taken as a line": 1},
    ),
    "a13": Right(
        (100, 100), (), {"left-hand traffic, told only by vendor data": 1}, start=(100.0, -1.75)
    ),
    "a14": Right((100,) * 6, (20,), {"link to a lane that does not exist, dropped": 1}),
    "a15": Right((100, 100)),
    "a16": Right((100, 100)),
    "a18": Right((100, 100), (), {"badly written number": 8}),
    "a19": Right((100, 100)),
    "a20": Right((100, 100)),
    "a21": Right(
        (100, 100),
        (),
        {"speed limit above 45 m/s in a town, the first on road '1': is it in km/h?": 1},
        (50.0,),
    ),
    "a22": Right(
        (100,) * 4,
        (),
        {"lanes that touch end to end without a link, the first of roads '1' and '2'": 2},
    ),
    "a24": Right((95.03, 98.86, 102.75, 106.25)),
    "a25": Right((95, 95)),
    "a26": Right((100, 100), (), {"include of another file, not read": 1}),
    "a27": Right((1000, 1000), (), {}, (100 / 3.6, 130 / 3.6)),
    "a28": Right(
        (48.5, 49.5),
        (3.84,),
        {"lanes that cross without a junction, made an intersection": 1},
    ),
}
REFUSED = {
    "a08": "no drivable lane: lanes of type 'border' (1), lanes of type 'biking' (1),"
    " lanes of type 'sidewalk' (1)",
    "a09": "no drivable lane: lanes without width (2)",
    "a17": "no drivable lane: lanes of roads with junction='' (2)",
    "a23": "road '1': its id occurs twice",
}


def built(case: str) -> tuple[VectorMap, BuiltMap]:
    """The map of a case, or its refusal."""
    (path,) = FOLDER.glob(f"{case}_*/map.xodr")
    drive = read_opendrive(path)
    road, report = build_road_map(drive, name=case)
    require_lanes(drive, report)
    return road, report


@pytest.mark.parametrize("case", RIGHT)
def test_a_case_from_the_field_is_read_as_it_was_meant(case: str):
    right = RIGHT[case]
    road, report = built(case)
    lengths = [road.baselines.length(edge) for edge in range(len(road.edges))]
    found = sorted(lengths[: road.num_lanes]), sorted(lengths[road.num_lanes :])
    # seams and rounded corners are given to the centimetre
    np.testing.assert_allclose(found[0], right.lengths, atol=0.01)
    np.testing.assert_allclose(found[1], right.connectors, atol=0.01)
    assert report.warnings == right.warnings
    np.testing.assert_allclose(np.unique(road.speed_limits), right.limits, atol=1e-9)
    if right.start is not None:
        np.testing.assert_allclose(road.baselines.at(0)[0, :2], right.start, atol=1e-9)
    checks, _ = check_map(road, report.stacked)
    assert [name for name, passed in checks.items() if not passed] == []


@pytest.mark.parametrize("case", REFUSED)
def test_a_case_that_holds_no_road_says_why(case: str):
    with pytest.raises(ConversionError) as refusal:
        built(case)
    assert REFUSED[case] in str(refusal.value)


@pytest.mark.parametrize("case", ["a24", "a28"])
def test_no_lane_runs_backwards_on_the_inner_side_of_a_tight_arc(case: str):
    road, _ = built(case)
    lines = [road.baselines.at(edge)[:, :2] for edge in range(len(road.edges))]
    assert max(corners(line)[1].max() for line in lines) < 0.3  # rad between points of 0.25 m


def test_every_case_has_its_right_reading():
    folders = sorted(FOLDER.glob("a*"))
    assert {folder.name.partition("_")[0] for folder in folders} == RIGHT.keys() | REFUSED.keys()
