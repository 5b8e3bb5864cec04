"""Reading OpenDRIVE files: what is in them, what is wrong with them, what is refused."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from opendrive_xml import connection, document, geometry, lane, parse, road, section, touches

from shiftsim.data.maps.opendrive.reading import MAX_BYTES, parse_opendrive, read_opendrive
from shiftsim.errors import ConversionError


def refused(data: bytes) -> ConversionError:
    """The error that reading these bytes raises."""
    with pytest.raises(ConversionError) as caught:
        parse_opendrive(data, "bad.xodr")
    assert "bad.xodr" in str(caught.value)
    assert caught.value.hint
    return caught.value


def test_header_holds_reference_and_offset():
    header = (
        '<header revMajor="1" revMinor="8"><geoReference><![CDATA[ +proj=tmerc ]]></geoReference>'
        '<offset x="1" y="2" z="3" hdg="0.5"/></header>'
    )
    od = parse_opendrive(document(road(), header=header), "a.xodr")
    assert od.revision == ("1", "8")
    assert od.geo_reference == "+proj=tmerc"
    assert od.offset == (1.0, 2.0, 3.0, 0.5)


def test_ids_may_be_any_text():
    od = parse(road("abc"), road("3f-e2"))
    assert list(od.roads) == ["abc", "3f-e2"]


@pytest.mark.parametrize(
    ("unit", "speed"), [("km/h", 10.0), ("mph", 36 * 0.44704), ("m/s", 36.0), (None, 36.0)]
)
def test_speed_units(unit: str | None, speed: float):
    attribute = "" if unit is None else f' unit="{unit}"'
    od = parse(road(inner=f'<type s="0" type="town"><speed max="36"{attribute}/></type>'))
    record = od.roads["1"].types[0].speed
    assert record is not None
    assert record.limit == pytest.approx(speed, abs=1e-12)


@pytest.mark.parametrize("text", ["no limit", "undefined"])
def test_no_limit_is_none(text: str):
    od = parse(road(inner=f'<type s="0" type="town"><speed max="{text}"/></type>'))
    assert od.roads["1"].types[0].speed.limit is None
    assert od.warnings == {}


@pytest.mark.parametrize("text", ["-1", "0", "nan"])
def test_absurd_limit_is_none_and_counted(text: str):
    od = parse(road(inner=f'<type s="0" type="town"><speed max="{text}"/></type>'))
    assert od.roads["1"].types[0].speed.limit is None
    assert sum(od.warnings.values()) == 1


@pytest.mark.parametrize(
    "junk", [b"\xef\xbb\xbf", b"\n\n", b"<!-- a town -->\n", b"\xef\xbb\xbf\n"]
)
def test_bytes_before_the_declaration_are_skipped(junk: bytes):
    assert list(parse_opendrive(junk + document(road()), "a.xodr").roads) == ["1"]


def test_namespaces_are_ignored():
    data = document(road()).replace(b"<OpenDRIVE>", b'<OpenDRIVE xmlns="http://www.opendrive.org">')
    assert list(parse_opendrive(data, "a.xodr").roads) == ["1"]


@pytest.mark.parametrize("text", ["4.000+0", "4,0", "4.0 m"])
def test_badly_written_number_is_rescued_with_a_warning(text: str):
    od = parse(road(sections=section(lane(-1, inner=f'<width sOffset="50" a="{text}"/>'))))
    assert od.roads["1"].sections[0].lanes[-1].widths[1, 1] == 4.0
    assert od.warnings == {"badly written number": 1}


@pytest.mark.parametrize("text", ["", "wide", "--3"])
def test_number_that_is_none_names_road_and_element(text: str):
    data = document(
        road("17", sections=section(lane(-1, inner=f'<width sOffset="50" a="{text}"/>')))
    )
    error = refused(data)
    assert "road '17'" in str(error)
    assert "width" in str(error)


def test_polynomial_that_is_not_finite_is_left_out():
    od = parse(road(sections=section(lane(-1, inner='<width sOffset="5" a="nan"/>'))))
    assert len(od.roads["1"].sections[0].lanes[-1].widths) == 1
    assert sum(od.warnings.values()) == 1


@pytest.mark.parametrize("value", ["nan", "inf", "1e300"])
def test_pose_that_is_no_place_drops_the_road_only(value: str):
    bad = road("1", plan=geometry("<line/>").replace('x="0"', f'x="{value}"'))
    od = parse(bad, road("2"))
    assert list(od.roads) == ["2"]
    assert sum(od.warnings.values()) == 1


def test_missing_curvatures_are_zero():
    od = parse(road(plan=geometry('<spiral curvEnd="0.5"/>')))
    assert od.roads["1"].geometries[0].coefficients == (0.0, 0.5)


def test_curve_without_coefficients_drops_the_road_only():
    od = parse(road("1", plan=geometry("<paramPoly3/>")), road("2"))
    assert list(od.roads) == ["2"]
    assert "paramPoly3 without coefficients" in next(iter(od.warnings))


def test_geometry_without_length_is_skipped():
    plan = [geometry("<line/>", length=0), geometry("<line/>", length=100)]
    od = parse(road(plan=plan))
    assert len(od.roads["1"].geometries) == 1
    assert od.warnings == {"geometry without length, skipped": 1}


def test_records_out_of_order_are_sorted():
    plan = [geometry("<line/>", s=60, x=60, length=40), geometry("<line/>", length=60)]
    od = parse(road(plan=plan))
    assert [g.s for g in od.roads["1"].geometries] == [0.0, 60.0]
    assert od.warnings == {"records out of order": 1}


def test_road_is_as_long_as_the_shorter_of_statement_and_geometry():
    od = parse(
        road("1", length=80, plan=geometry("<line/>")),
        road("2", length=120, plan=geometry("<line/>")),
    )
    assert [r.length for r in od.roads.values()] == [80.0, 100.0]
    assert od.warnings == {"road length is not the end of its geometry": 2}


def test_holes_in_lane_numbers_and_missing_widths_are_counted():
    od = parse(road(sections=section(lane(-1), lane(-3, width=0))))
    assert od.warnings == {"lane numbers with holes": 1, "lane without width and border": 1}


def test_numbers_far_apart_cost_no_memory():
    od = parse(road(sections=section(lane(-1), lane(-(10**15)))))
    assert od.warnings == {"lane numbers with holes": 1}


def test_two_roads_of_one_id_are_an_error():
    assert "'7'" in str(refused(document(road("7"), road("7"))))


def test_junction_keeps_connections_and_lane_links():
    od = parse('<junction id="5">' + connection("1", "2", "end", (-1, -2)) + "</junction>")
    assert od.junctions["5"].connections[0].lane_links == ((-1, -2),)
    assert od.junctions["5"].type == "default"


def test_junction_without_connections_is_counted():
    assert parse('<junction id="5"/>').warnings == {"junction without connections": 1}


def test_links_of_roads_are_read():
    od = parse(road(link=touches("successor", "road", "x", "end")))
    link = od.roads["1"].successor
    assert (link.kind, link.id, link.contact) == ("road", "x", "end")


def test_objects_and_signals_are_read():
    inner = (
        '<objects><object id="a" type="crosswalk" s="5" t="1" hdg="0.5"><outlines><outline>'
        '<cornerLocal u="1" v="2"/><cornerLocal u="3" v="4"/></outline></outlines>'
        '<validity fromLane="-1" toLane="-3"/></object></objects>'
        '<signals><signal id="b" dynamic="yes" type="1000001" subtype="-1" s="9" t="0"'
        ' orientation="+" value="-1"/></signals>'
    )
    found = parse(road(inner=inner)).roads["1"]
    assert found.objects[0].outlines[0].corners.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert found.objects[0].lanes == ((-3, -1),)
    assert found.signals[0].dynamic
    assert found.signals[0].subtype == ""


def test_entity_bomb_is_refused():
    data = (
        b'<?xml version="1.0"?><!DOCTYPE o [<!ENTITY a "aaaaaaaaaa">'
        b'<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]><OpenDRIVE>&b;</OpenDRIVE>'
    )
    assert "DOCTYPE" in str(refused(data))


def test_external_entity_is_refused(tmp_path: Path):
    secret = tmp_path / "secret"
    secret.write_text("classified")
    data = (
        f'<?xml version="1.0"?><!DOCTYPE o [<!ENTITY x SYSTEM "{secret.as_uri()}">]>'
        "<OpenDRIVE><header><geoReference>&x;</geoReference></header></OpenDRIVE>"
    ).encode()
    error = refused(data)
    assert "classified" not in str(error)


def test_truncated_file_is_an_error():
    data = document(road())
    assert "not well-formed" in str(refused(data[: len(data) // 2]))


@pytest.mark.parametrize(
    "data", [b"", b"<html/>", b"not xml", b'<?xml version="1.0"?><a><OpenDRIVE/></a>']
)
def test_what_is_not_opendrive_is_an_error(data: bytes):
    refused(data)


def test_attribute_of_ten_megabytes_is_refused():
    refused(document(f'<road id="{"9" * 10_000_001}"/>'))


def test_file_too_large_is_refused_unread(tmp_path: Path):
    path = tmp_path / "huge.xodr"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(ConversionError, match="huge"):
        read_opendrive(path)


def test_missing_file_is_one_clear_error(tmp_path: Path):
    with pytest.raises(ConversionError, match=r"none\.xodr"):
        read_opendrive(tmp_path / "none.xodr")


def test_empty_town_has_no_roads():
    od = parse()
    assert od.roads == {}
    assert od.junctions == {}


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_files_give_records_or_one_clear_error(data: st.DataObject):
    original = document(road(inner='<type s="0" type="town"><speed max="30"/></type>'))
    start = data.draw(st.integers(0, len(original) - 1))
    stop = data.draw(st.integers(start, min(start + 12, len(original))))
    filler = data.draw(st.binary(max_size=6))
    with contextlib.suppress(ConversionError):  # any other error, or a hang, fails the test
        od = parse_opendrive(original[:start] + filler + original[stop:], "fuzzed.xodr")
        assert all(np.isfinite(found.length) for found in od.roads.values())


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (road("1").replace('length="100" junction', 'length="1e9" junction'), "road .* length="),
        (road(inner='<type s="0"><speed max="1e9"/></type>'), "speed .* max='1e9'"),
        (road(inner='<objects><object s="0" t="nan"/></objects>'), "object .* t=nan"),
    ],
)
def test_a_number_outside_of_its_range_names_road_element_and_value(part: str, message: str):
    error = refused(document(part))
    assert re.search(f"road '1': {message}", str(error))


@pytest.mark.parametrize(
    ("part", "what"),
    [
        (
            road(plan=geometry('<arc curvature="1e6"/>')),
            "arc .* curvature='1e6', not within -100 …",
        ),
        (road(sections=section(lane(-1, width=1e5))), "width .* a='100000.0', not within"),
    ],
)
def test_an_absurd_record_costs_its_road_and_is_named(part: str, what: str):
    od = parse(part, road("2"))
    assert list(od.roads) == ["2"]
    ((kind, count),) = od.warnings.items()
    assert count == 1
    assert re.search(f"road left out, the first for road '1': {what}", kind)


def test_an_absurd_record_shorter_than_a_millimetre_costs_nothing():
    crumb = '<width sOffset="99.9999" a="3.5" b="1e7" c="0" d="0"/>'
    od = parse(road(sections=section(lane(-1, inner=crumb))))
    assert od.roads["1"].sections[0].lanes[-1].widths[1].tolist() == [99.9999, 3.5, 0, 0, 0]
    assert od.warnings == {"absurd record shorter than 1 mm, ignored": 1}
    plan = [geometry("<line/>"), geometry('<spiral curvEnd="1e5"/>', s=100, x=100, length=5e-4)]
    od = parse(road(plan=plan, length=100.0005))
    assert [found.kind for found in od.roads["1"].geometries] == ["line", "line"]
