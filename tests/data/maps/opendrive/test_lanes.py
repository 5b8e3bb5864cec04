"""Borders of lanes, and which lane leads to which."""

from collections import Counter

import numpy as np
import pytest
from opendrive_xml import connection, geometry, lane, parse, road, section, touches

from shiftsim.data.maps.opendrive.graph import build_lane_graph, is_drivable
from shiftsim.data.maps.opendrive.lanes import LaneKey, lane_links, runs_forward, section_borders
from shiftsim.data.maps.opendrive.records import OpenDrive


def borders(od: OpenDrive, number: int, *s: float, repair: bool = False) -> np.ndarray:
    """(2, K) inner and outer border of a lane of the first section of road 1."""
    found = section_borders(od.roads["1"], 0, np.array(s), repair=repair)
    return np.stack([found.inner[number], found.outer[number]])


def links(od: OpenDrive) -> set[tuple[tuple[str, int, int], tuple[str, int, int]]]:
    """Lane links as plain tuples."""
    return {(tuple(a), tuple(b)) for a, b in lane_links(od, Counter())}


def test_lanes_stack_outward_from_the_centre():
    od = parse(road(sections=section(lane(2, width=2), lane(1), lane(-1), lane(-2, width=1))))
    np.testing.assert_allclose(borders(od, 2, 50)[:, 0], [3.5, 5.5])
    np.testing.assert_allclose(borders(od, -2, 50)[:, 0], [-3.5, -4.5])


def test_lane_offset_shifts_all_lanes():
    od = parse(road(offsets='<laneOffset s="0" a="1"/><laneOffset s="40" a="1" b="0.1"/>'))
    np.testing.assert_allclose(borders(od, -1, 10, 60), [[1, 3], [-2.5, -0.5]])


def test_width_records_are_cubics_from_their_own_start():
    inner = '<width sOffset="10" a="1" b="0.5" c="0.25" d="0.125"/>'
    od = parse(road(sections=section(lane(-1, inner=inner))))
    np.testing.assert_allclose(borders(od, -1, 5, 12)[1], [-3.5, -(1 + 1 + 1 + 1)])


def test_width_before_its_first_record_is_zero_and_counted():
    od = parse(road(sections=section(lane(-1, width=0, inner='<width sOffset="10" a="3"/>'))))
    np.testing.assert_allclose(borders(od, -1, 5, 20)[1], [0, -3])
    assert od.warnings == {"lane width begins after its section": 1}


def test_border_is_measured_from_the_reference_line():
    sections = section(
        lane(1, width=0, inner='<border sOffset="0" a="3"/>'),
        lane(2, width=0, inner='<border sOffset="0" a="5"/>'),
    )
    od = parse(road(sections=sections))
    np.testing.assert_allclose(borders(od, 2, 50)[:, 0], [3, 5])


def test_width_wins_over_border():
    od = parse(road(sections=section(lane(1, inner='<border sOffset="0" a="9"/>'))))
    np.testing.assert_allclose(borders(od, 1, 50)[1], [3.5])


def test_negative_width_counts_as_zero_when_mended():
    od = parse(road(sections=section(lane(-1, width=-1), lane(-2, width=2))))
    np.testing.assert_allclose(borders(od, -2, 50)[:, 0], [1, -1])
    np.testing.assert_allclose(borders(od, -2, 50, repair=True)[:, 0], [0, -2])


def test_right_border_given_on_the_left_is_mirrored_when_mended():
    od = parse(road(sections=section(lane(-1, width=0, inner='<border sOffset="0" a="3"/>'))))
    np.testing.assert_allclose(borders(od, -1, 50, repair=True)[1], [-3])


@pytest.mark.parametrize(("rule", "forward"), [("RHT", -1), ("LHT", 1)])
def test_direction_of_travel_follows_the_rule_of_the_road(rule: str, forward: int):
    found = parse(road(rule=rule)).roads["1"]
    assert runs_forward(found, 0, forward)
    assert not runs_forward(found, 0, -forward)


def test_reversed_lane_runs_against_its_side():
    lane_xml = lane(-1).replace('type="driving"', 'type="driving" direction="reversed"')
    found = parse(road(sections=section(lane_xml))).roads["1"]
    assert not runs_forward(found, 0, -1)


def test_sections_link_in_the_direction_of_travel():
    od = parse(
        road(
            sections=section(lane(1, after=1), lane(-1, after=-1))
            + section(lane(1, before=1), lane(-1, before=-1), s=50)
        )
    )
    assert links(od) == {(("1", 0, -1), ("1", 1, -1)), (("1", 1, 1), ("1", 0, 1))}


def test_roads_link_end_to_end_by_contact_point():
    one = road(
        "1",
        sections=section(lane(-1, after=1)),
        link=touches("successor", "road", "2", "end"),
    )
    two = road("2", sections=section(lane(1)), plan=geometry("<line/>", x=200, hdg=np.pi))
    assert links(parse(one, two)) == {(("1", 0, -1), ("2", 0, 1))}


def test_missing_contact_point_means_the_nearer_end():
    one = road("1", sections=section(lane(-1, after=1)), link=touches("successor", "road", "2"))
    two = road("2", sections=section(lane(1)), plan=geometry("<line/>", x=200, hdg=np.pi))
    assert links(parse(one, two)) == {(("1", 0, -1), ("2", 0, 1))}


def test_lane_link_of_the_opposite_direction_is_dropped():
    one = road("1", link=touches("successor", "junction", "5"))
    two = road("2", junction="5", plan=geometry("<line/>", x=100))
    junction = (
        '<junction id="5">' + connection("1", "2", "start", (-1, -1), (-1, 1)) + "</junction>"
    )
    warnings: Counter[str] = Counter()
    found = lane_links(parse(one, two, junction), warnings)
    assert found == [(LaneKey("1", 0, -1), LaneKey("2", 0, -1))]
    assert warnings == {"lane link against the direction of travel, dropped": 1}


def test_direct_junction_links_roads_without_a_connecting_road():
    one = road("1", link=touches("successor", "junction", "5"))
    two = road("2", plan=geometry("<line/>", x=100), link=touches("predecessor", "junction", "5"))
    junction = connection("1", "2", "start", (-1, -1)).replace("connectingRoad", "linkedRoad")
    od = parse(one, two, f'<junction id="5" type="direct">{junction}</junction>')
    assert links(od) == {(("1", 0, -1), ("2", 0, -1))}


def test_virtual_junction_is_named_and_left_out():
    warnings: Counter[str] = Counter()
    junction = connection("1", "1", "start", (-1, -1))
    lane_links(parse(road(), f'<junction id="5" type="virtual">{junction}</junction>'), warnings)
    assert warnings == {"virtual junction: its side connections are left out": 1}


@pytest.mark.parametrize(
    ("link", "kind"),
    [
        (
            touches("successor", "road", "99", "start"),
            "link to a road that does not exist, dropped",
        ),
        (touches("successor", "junction", "99"), "link to a junction that does not exist, dropped"),
    ],
)
def test_link_to_nowhere_is_dropped_and_counted(link: str, kind: str):
    warnings: Counter[str] = Counter()
    assert lane_links(parse(road(link=link)), warnings) == []
    assert warnings == {kind: 1}


def test_link_to_a_missing_lane_is_dropped_and_counted():
    warnings: Counter[str] = Counter()
    sections = section(lane(-1, after=-4)) + section(lane(-1), s=50)
    assert lane_links(parse(road(sections=sections)), warnings) == []
    assert warnings == {"link to a lane that does not exist, dropped": 1}


def test_forgotten_link_between_sections_is_inferred():
    warnings: Counter[str] = Counter()
    graph = build_lane_graph(
        parse(road(sections=section(lane(-1)) + section(lane(-1), s=50))), warnings
    )
    assert [len(lane.segments) for lane in graph.lanes] == [2]
    assert warnings == {"lane link missing between sections, inferred": 1}


def test_section_without_length_is_linked_through():
    sections = "".join(
        section(lane(-1, before=-1 if s else None, after=-1 if s < 60 else None), s=s)
        for s in (0, 50, 50.0, 60)
    )
    warnings: Counter[str] = Counter()
    graph = build_lane_graph(parse(road(sections=sections)), warnings)
    assert len(graph.lanes) == 1
    assert sum(piece.length for piece in graph.lanes[0].segments) == 100


def test_roads_that_do_not_meet_are_not_linked():
    one = road(
        "1", sections=section(lane(-1, after=-1)), link=touches("successor", "road", "2", "start")
    )
    two = road("2", sections=section(lane(-1)), plan=geometry("<line/>", x=103))
    warnings: Counter[str] = Counter()
    assert build_lane_graph(parse(one, two), warnings).connectors == []
    assert "more than 2 m" in next(iter(warnings))


@pytest.mark.parametrize(
    ("rule", "restriction", "drivable"),
    [
        ("deny", "car", False),
        ("deny", "bus", True),
        ("allow", "bus", False),
        ("allow", "car", True),
    ],
)
def test_access_decides_who_may_drive(rule: str, restriction: str, drivable: bool):
    access = f'<access sOffset="0" rule="{rule}" restriction="{restriction}"/>'
    od = parse(road(sections=section(lane(-1, inner=access))))
    assert is_drivable(od.roads["1"].sections[0].lanes[-1]) is drivable


def test_ring_of_roads_ends_in_a_seam():
    half = 10 * np.pi
    parts = [
        road(
            name,
            length=half,
            plan=geometry('<arc curvature="0.1"/>', y=y, hdg=hdg, length=half),
            sections=section(lane(-1, before=-1, after=-1)),
            link=touches("predecessor", "road", other, "end")
            + touches("successor", "road", other, "start"),
        )
        for name, other, y, hdg in (("1", "2", 0.0, 0.0), ("2", "1", 20.0, np.pi))
    ]
    graph = build_lane_graph(parse(*parts), Counter())
    assert [len(lane.segments) for lane in graph.lanes] == [2]
    assert [(c.source, c.target) for c in graph.connectors] == [(0, 0)]


def test_maze_of_lanes_in_a_junction_does_not_hang():
    names = [str(i) for i in range(2, 16)]
    rooms = [
        road(
            name,
            junction="5",
            length=1,
            plan=geometry("<line/>", x=100, length=1),
            link=touches("successor", "junction", "5"),
        )
        for name in names
    ]
    pairs = [(a, b) for a in names for b in names if a != b]
    links = [connection("1", name, "start", (-1, -1)) for name in names]
    links += [connection(a, b, "start", (-1, -1)) for a, b in pairs]
    entry = road("1", link=touches("successor", "junction", "5"))
    warnings: Counter[str] = Counter()
    build_lane_graph(
        parse(entry, *rooms, f'<junction id="5">{"".join(links)}</junction>'), warnings
    )
    assert warnings["intersection with too many ways through, the rest left out"] == 1
