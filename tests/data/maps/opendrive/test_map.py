"""The semantic map made of an OpenDRIVE file."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from map_checks import check_map
from opendrive_xml import crossroads, document, geometry, lane, parse, road, section, touches

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import parse_opendrive
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.world.map import VectorMap


def make(od: OpenDrive, **options: object) -> tuple[VectorMap, BuiltMap]:
    """The map of a file; all self-checks must pass."""
    built, report = build_road_map(od, name="test", **options)
    assert [
        name for name, passed in check_map(built, report.stacked)[0].items() if not passed
    ] == []
    return built, report


def town(turn: float = 0.0, x: float = 0.0, y: float = 0.0) -> OpenDrive:
    """The crossroads, turned and moved."""
    return parse_opendrive(crossroads(turn, x, y), "town.xodr")


def limit_of(inner: str, lane_inner: str = "", country: str = "DE") -> float:
    """Speed limit of a lane along x on a road with this XML."""
    od = parse(road(inner=inner, sections=section(lane(-1, inner=lane_inner))))
    return float(make(od, country=country)[0].speed_limits[0])


def test_straight_road_gives_one_roadblock_per_direction():
    built, _ = make(parse(road()))
    assert (built.num_lanes, built.num_roadblocks, len(built.edges)) == (2, 2, 2)
    np.testing.assert_allclose([built.edges.shape(e).area for e in (0, 1)], 350.0)
    ends = sorted((*built.baselines.at(e)[0], *built.baselines.at(e)[-1]) for e in (0, 1))
    np.testing.assert_allclose(ends, [[0, -1.75, 100, -1.75], [100, 1.75, 0, 1.75]], atol=1e-8)


def test_left_hand_traffic_drives_on_the_left():
    built, _ = make(parse(road(rule="LHT")))
    starts = sorted(tuple(built.baselines.at(e)[0].round(6)) for e in (0, 1))
    assert starts == [(0.0, 1.75), (100.0, -1.75)]


def test_lanes_of_a_roadblock_count_from_the_left_and_share_borders():
    built, _ = make(parse(road(sections=section(lane(-1), lane(-2), lane(-3)))))
    assert built.lane_index.tolist() == [0, 1, 2]
    assert built.left_lane.tolist() == [-1, 0, 1]
    assert built.right_lane.tolist() == [1, 2, -1]
    assert built.boundary_ids[0][1] == built.boundary_ids[1][0]
    np.testing.assert_array_equal(built.right_boundaries.at(0), built.left_boundaries.at(1))


def test_equal_sections_join_to_one_lane():
    sections = section(lane(-1, after=-1)) + section(lane(-1, before=-1), s=40)
    built, report = make(parse(road(sections=sections)))
    assert built.num_lanes == 1
    assert built.baselines.length(0) == pytest.approx(100, abs=1e-6)
    (segments,) = report.segments.values()
    assert [(s.key.section, s.begin, s.end) for s in segments] == [(0, 0, 40), (1, 40, 100)]


def test_lane_that_is_added_gives_seam_connectors_of_three_metres():
    sections = section(lane(-1, after=-1)) + section(lane(-1, before=-1), lane(-2), s=50)
    built, _ = make(parse(road(sections=sections)))
    assert (built.num_lanes, len(built.edges) - built.num_lanes) == (3, 1)
    assert built.baselines.length(3) == pytest.approx(3.0, abs=1e-6)
    assert built.intersection_kinds.tolist() == [5]


def test_lane_that_splits_leads_to_both():
    sections = section(lane(-1, after=-1)) + section(lane(-1, before=-1), lane(-2, before=-1), s=50)
    built, _ = make(parse(road(sections=sections)))
    assert len(built.edges) - built.num_lanes == 2
    first = built.edge(built.edges.ids[0])
    assert len(built.outgoing.at(first)) == 2


def test_junction_gives_connectors_roadblock_connectors_and_one_intersection():
    built, _ = make(town())
    assert built.num_lanes == 6
    assert sorted(built.turn_type[built.num_lanes :].tolist()) == [0, 0, 2]
    assert len(built.blocks) - built.num_roadblocks == 3
    assert (len(built.intersections), set(built.intersection_of[6:].tolist())) == (1, {0})
    assert built.speed_limits[0] == pytest.approx(50 / 3.6)


def test_ids_are_numbers_disjoint_across_layers_and_stable():
    first, second = make(town())[0], make(town())[0]
    ids = [*first.edges.ids, *first.blocks.ids, *first.intersections.ids, *first.drivable_areas.ids]
    assert len(ids) == len(set(ids))
    assert all(i.isdecimal() for i in ids)
    assert first.edges.ids == second.edges.ids
    np.testing.assert_array_equal(first.baselines.xy, second.baselines.xy)


@settings(max_examples=10, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-500, 500), st.floats(-500, 500))
def test_rigid_motion_of_the_file_moves_the_map(turn: float, x: float, y: float):
    still, moved = make(town())[0], make(town(turn, x, y))[0]
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, sin], [-sin, cos]])
    expected = still.baselines.xy @ rotation + [x, y]
    np.testing.assert_allclose(moved.baselines.xy, expected, atol=1e-7)
    np.testing.assert_array_equal(moved.outgoing.items, still.outgoing.items)
    areas = [[m.edges.shape(e).area for e in range(len(m.edges))] for m in (still, moved)]
    np.testing.assert_allclose(areas[0], areas[1], atol=1e-3)


def test_offset_places_the_map_without_losing_precision():
    local, _ = make(town())
    utm, _ = make(town(), offset=(691_000.0, 5_336_000.0), epsg=25832)
    assert utm.epsg == 25832
    shifted = local.baselines.xy + np.array([691_000.0, 5_336_000.0])
    np.testing.assert_allclose(utm.baselines.xy, shifted, rtol=0, atol=2e-9)


def test_header_offset_turns_and_moves_the_map():
    header = '<header><offset x="10" y="20" z="0" hdg="1.5707963267948966"/></header>'
    od = parse_opendrive(document(road(sections=section(lane(-1))), header=header), "a.xodr")
    np.testing.assert_allclose(make(od)[0].baselines.at(0)[0], [11.75, 20], atol=1e-8)


def test_baselines_have_a_vertex_every_quarter_metre():
    built, _ = make(town())
    for edge in range(len(built.edges)):
        steps = np.hypot(*np.diff(built.baselines.at(edge), axis=0).T)
        assert 0.2 < steps.min() <= steps.max() < 0.3


def test_borders_stay_within_five_centimetres_of_the_curve():
    od = parse(road(plan=geometry('<arc curvature="0.05"/>'), sections=section(lane(-1, width=4))))
    built, _ = make(od)
    outer = shapely.LineString(built.right_boundaries.at(0))
    angle = np.linspace(0, 5, 2001)
    truth = shapely.points(np.stack([24 * np.sin(angle), 20 - 24 * np.cos(angle)], axis=1))
    assert shapely.distance(truth, outer).max() < 0.05


@pytest.mark.parametrize("bend", [0.5, -0.5])
def test_borders_inside_of_a_sharp_bend_neither_fold_nor_leave_the_lane(bend: float):
    turn, end = 0.5 * np.pi, 1.0 / abs(bend)
    plan = [
        geometry("<line/>", length=20),
        geometry(f'<arc curvature="{bend}"/>', s=20, x=20, length=turn * end),
        geometry(
            "<line/>",
            s=20 + turn * end,
            x=20 + end,
            y=np.copysign(end, bend),
            hdg=np.copysign(turn, bend),
            length=20,
        ),
    ]
    number = 1 if bend > 0 else -1  # the lane inside, wider than the bend
    lanes = section(lane(number, width=3.5))
    od = parse(road(plan=plan, length=40 + turn * end, sections=lanes))
    built, _ = build_road_map(od, name="test")  # the centre line turns within half a metre
    area = built.edges.shape(0)
    sides = [
        shapely.LineString(side.at(0)[:, :2])
        for side in (built.left_boundaries, built.right_boundaries)
    ]
    assert all(side.is_simple and area.exterior.distance(side) < 1e-9 for side in sides)
    assert all(area.buffer(1e-6).covers(side) for side in sides)
    assert not sides[0].intersects(sides[1])
    inner = min(sides, key=lambda side: side.length)
    assert inner.length == pytest.approx(2 * (20 + end - 3.5), abs=0.05)


def test_crossing_without_a_junction_becomes_an_intersection():
    across = road("2", plan=geometry("<line/>", x=50, y=-50, hdg=np.pi / 2))
    built, report = make(parse(road("1"), across))
    assert (built.num_lanes, len(built.edges) - built.num_lanes) == (8, 4)
    assert built.intersection_kinds.tolist() == [0]
    assert report.warnings["lanes that cross without a junction, made an intersection"] == 4
    assert built.lanes_at(50.0, -1.0) == []
    assert len(built.connectors_at(50.5, -1.0)) == 2


def test_bridge_is_no_intersection():
    high = '<elevationProfile><elevation s="0" a="6"/></elevationProfile>'
    across = road("2", plan=geometry("<line/>", x=50, y=-50, hdg=np.pi / 2), inner=high)
    built, _ = make(parse(road("1"), across))
    assert (built.num_lanes, len(built.edges)) == (4, 4)


def test_merging_road_gives_its_overlap_to_the_shorter_lane():
    beside = road("2", length=30, plan=geometry("<line/>", x=20, y=-3, hdg=0.05, length=30))
    built, report = make(parse(road("1"), beside))
    assert report.warnings["overlap of two lanes, taken from the longer one"] > 0
    assert all(
        len(built.lanes_at(x, y)) <= 1 for x in (21.0, 35.0, 49.0) for y in (-4.0, -2.0, 1.0)
    )


def test_crossing_at_the_end_of_a_road_lengthens_the_connectors_there():
    od = parse_opendrive(crossroads(), "town.xodr")
    across = parse(
        road("7", length=60, plan=geometry("<line/>", x=48, y=-30, hdg=np.pi / 2, length=60))
    )
    both = OpenDrive(**{**vars(od), "roads": od.roads | across.roads})
    built, _ = make(both)
    assert not any(built.lanes_at(x, y) for x in (46.6, 49.5) for y in (-1.0, 1.0))


def test_speed_of_the_lane_wins_over_the_road():
    kind = '<type s="0" type="town"><speed max="30" unit="km/h"/></type>'
    own = '<speed sOffset="0" max="10" unit="m/s"/>'
    assert limit_of(kind, own) == 10.0
    assert limit_of(kind) == pytest.approx(30 / 3.6)


def test_speed_is_the_one_that_covers_most_of_the_lane():
    records = '<speed sOffset="0" max="5" unit="m/s"/><speed sOffset="30" max="9" unit="m/s"/>'
    assert limit_of("", records) == 9.0
    assert limit_of("", records.replace('"30"', '"50"')) == 5.0


@pytest.mark.parametrize(
    ("kind", "country", "limit"),
    [
        ("town", "DE", 50 / 3.6),
        ("rural", "DE", 100 / 3.6),
        ("lowSpeed", "DE", 30 / 3.6),
        ("motorway", "DE", np.nan),
        ("town", "US", 25 * 0.44704),
        ("motorway", "US", 65 * 0.44704),
    ],
)
def test_default_speed_by_kind_of_road(kind: str, country: str, limit: float):
    found = limit_of(f'<type s="0" type="{kind}"/>', country=country)
    np.testing.assert_allclose(found, limit)


def test_speed_sign_counts_where_there_is_no_record():
    sign = '<signal id="a" s="1" t="0" orientation="+" type="274" subtype="{}" value="{}"/>'
    for text in (sign.format("-1", "30"), sign.format("53", "-1"), sign.format("30", "-1")):
        assert limit_of(f"<signals>{text}</signals>") == pytest.approx(30 / 3.6)
    against = sign.format("-1", "30").replace('"+"', '"-"')
    assert limit_of(f"<signals>{against}</signals>") == pytest.approx(50 / 3.6)


def crossing(corners: str, **attributes: str) -> list[np.ndarray]:
    """Crosswalk polygons of a road along x with one object."""
    text = " ".join(
        f'{k}="{v}"' for k, v in ({"type": "crosswalk", "hdg": "0"} | attributes).items()
    )
    inner = f'<objects><object id="a" s="50" t="1" {text}>{corners}</object></objects>'
    built, _ = make(parse(road(inner=inner)))
    return [built.crosswalks.rings(i)[0] for i in range(len(built.crosswalks))]


def test_crosswalk_from_local_corners_turns_with_its_heading():
    corners = "".join(
        f'<cornerLocal u="{u}" v="{v}"/>' for u, v in ((-2, 0), (2, 0), (2, 1), (-2, 1))
    )
    (ring,) = crossing(f"<outline>{corners}</outline>", hdg=str(np.pi / 2))
    np.testing.assert_allclose(
        sorted(ring.round(9).tolist()), [[49, -1], [49, 3], [50, -1], [50, 3]]
    )


def test_crosswalk_from_road_corners():
    corners = "".join(
        f'<cornerRoad s="{s}" t="{t}"/>' for s, t in ((40, 3), (40, -3), (43, -3), (43, 3))
    )
    (ring,) = crossing(f"<outlines><outline>{corners}</outline></outlines>")
    np.testing.assert_allclose(sorted(ring.tolist()), [[40, -3], [40, 3], [43, -3], [43, 3]])


def test_crosswalk_without_outline_is_its_box():
    (ring,) = crossing("", length="4", width="6")
    np.testing.assert_allclose(ring.min(axis=0), [48, -2])
    np.testing.assert_allclose(ring.max(axis=0), [52, 4])


@pytest.mark.parametrize(
    ("kind", "name", "found"),
    [("roadMark", "ZebraCrossing", 1), ("roadMark", "arrow", 0), ("pole", "crosswalk_pole", 0)],
)
def test_road_mark_is_a_crosswalk_by_its_name(kind: str, name: str, found: int):
    assert len(crossing("", type=kind, name=name, length="4", width="6")) == found


def test_repeated_object_stands_at_every_distance():
    repeat = '<repeat s="10" length="40" distance="20" tStart="0" tEnd="0"/>'
    assert len(crossing(repeat, length="2", width="3")) == 3


def test_walkways_parking_and_shoulders_have_their_layers():
    lanes = [lane(-1), lane(-2, "parking", 2), lane(-3, "curb", 0.2), lane(-4, "sidewalk", 2)]
    built, _ = make(parse(road(sections=section(*lanes))))
    assert built.walkways.shape(0).area == pytest.approx(220, rel=1e-3)
    assert built.car_parks.shape(0).area == pytest.approx(200, rel=1e-3)
    assert len(built.drivable_areas.containing(50.0, -4.5)) > 0
    assert len(built.drivable_areas.containing(50.0, -6.5)) == 0


def with_signal(attributes: str) -> VectorMap:
    """The crossroads with a signal on the road that leads in from the left."""
    text = crossroads().decode()
    signal = f'<signals><signal id="s" s="49" t="-4" {attributes}/></signals></road>'
    return make(parse_opendrive(text.replace("</road>", signal, 1).encode(), "town.xodr"))[0]


def test_light_governs_the_connectors_behind_it_and_gets_a_stop_line():
    built = with_signal('dynamic="yes" type="1000001" orientation="+"')
    assert built.has_traffic_lights[built.num_lanes :].sum() == 2
    assert built.intersection_kinds.tolist() == [1]
    assert built.stop_kinds.tolist() == [2]
    line = built.stop_polygons.shape(0)
    assert line.bounds == pytest.approx((49, -3.5, 50, 0), abs=1e-6)
    lit = built.num_lanes + np.flatnonzero(built.has_traffic_lights[built.num_lanes :])
    assert [built.stop_lines.at(e).tolist() for e in lit] == [[0], [0]]


def test_stop_sign_makes_an_intersection_of_its_kind():
    built = with_signal('dynamic="no" type="206" orientation="+"')
    assert built.intersection_kinds.tolist() == [2]
    assert built.stop_kinds.tolist() == [1]


def test_light_for_the_other_direction_governs_nothing():
    built = with_signal('dynamic="yes" type="1000001" orientation="-"')
    assert not built.has_traffic_lights.any()
    assert len(built.stop_polygons) == 0


def test_drawn_stop_line_is_used_where_it_lies():
    text = crossroads().decode()
    drawn = (
        '<objects><object id="o" type="-1" name="StopLine" s="47" t="-1.75"'
        f' hdg="{np.pi / 2}" length="3.5" width="0"/></objects></road>'
    )
    built, _ = make(parse_opendrive(text.replace("</road>", drawn, 1).encode(), "town.xodr"))
    assert built.stop_polygons.shape(0).centroid.x == pytest.approx(47, abs=1e-6)


def test_connector_without_an_end_is_dropped_but_stays_drivable():
    one = road("1", length=50, link=touches("successor", "junction", "9"))
    blind = road("2", length=30, junction="9", plan=geometry("<line/>", x=50, length=30))
    built, report = make(parse(one, blind))
    assert report.warnings["connector without both ends, dropped"] == 2
    assert len(built.drivable_areas.containing(60.0, -1.0)) > 0
    assert built.lanes_at(60.0, -1.0) == []


def test_file_without_lanes_gives_an_empty_map_and_says_so():
    built, report = build_road_map(parse(), name="empty")
    assert len(built.edges) == 0
    assert not check_map(built, report.stacked)[0]["has lanes"]


def test_gaps_and_unknown_lanes_are_counted_once_per_kind():
    plan = [geometry("<line/>", length=50), geometry("<line/>", s=50, x=50.1, length=50)]
    sections = section(lane(-1), lane(-2, "hyperloop"), lane(-3, "tram"))
    _, report = make(parse(road(plan=plan, sections=sections)))
    assert report.warnings == {
        "gap of more than 0.01 m between geometries": 1,
        "lane of unknown type left out": 1,
        "tram or rail lane left out": 1,
    }


def test_absurd_widths_neither_fail_nor_fill_the_memory():
    od = parse(road(sections=section(lane(-1), lane(1))))
    od.roads["1"].sections[0].lanes[-1].widths[:, 1:] = 1e308  # no file can say so
    built, _ = build_road_map(od, name="absurd")
    assert np.isfinite(built.baselines.xy).all()


@pytest.mark.parametrize(
    ("shape", "length", "kept"),
    [
        ('<arc curvature="1"/>', 9.4, True),
        ('<arc curvature="1"/>', 60, False),
        ('<arc curvature="-0.05"/>', 200, False),
        ('<spiral curvStart="0" curvEnd="0.1"/>', 180, True),
        ('<spiral curvStart="-0.1" curvEnd="0.1"/>', 180, True),
        ('<spiral curvStart="0" curvEnd="1"/>', 60, False),
    ],
)
def test_a_geometry_of_several_turns_costs_its_road(shape: str, length: float, kept: bool):
    plan, far = geometry(shape, length=length), road("2", plan=geometry("<line/>", x=1000))
    drive = parse(road(plan=plan, sections=section(lane(-1)), length=length), far)
    built, report = build_road_map(drive, name="turns")
    assert built.num_lanes == 2 + kept
    what = "road left out: one geometry turns more than one and a half times"
    assert report.warnings.get(what, 0) == (0 if kept else 1)
