"""OpenDRIVE XML to records.

Nothing is evaluated here. Real files are seldom quite right: what can be repaired is repaired and
counted in `OpenDrive.warnings`, one count per kind; what cannot raises one error that names file,
road and element.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from shiftsim.data.maps.opendrive import elements, records
from shiftsim.data.maps.opendrive.records import OpenDrive, Road
from shiftsim.errors import ConversionError
from shiftsim.world.ranges import OPENDRIVE

MAX_BYTES = 200_000_000
TINY_LENGTH = 1e-9  # m, shorter geometry records are skipped
_PARAM_CUBIC = ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV")
_COEFFICIENTS = {
    records.ARC: ("curvature",),
    records.SPIRAL: ("curvStart", "curvEnd"),
    records.POLY3: elements.CUBIC,
    records.PARAM_POLY3: _PARAM_CUBIC,
}
_TOP_LEVEL = ("header", "road", "junction", "include")
_SIGNALS = ("signal", "signalReference")


def read_opendrive(path: Path) -> OpenDrive:
    """Read an OpenDRIVE file (1.0 to 1.8).

    Entities, document types and external references are refused: the file is data, not a program.
    It is a ConversionError if it is missing, too large, not OpenDRIVE, or broken beyond repair.
    """
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= MAX_BYTES else b""
    except OSError as error:
        what = f"{path.name}: cannot be read: {error.strerror}"
        raise ConversionError(what, "give the path of an .xodr file") from error
    if size > MAX_BYTES:
        what = f"{path.name}: {size} bytes, more than {MAX_BYTES}"
        raise ConversionError(what, "cut the map into smaller files")
    return parse_opendrive(data, path.name)


def parse_opendrive(data: bytes, source: str) -> OpenDrive:
    """Like `read_opendrive`, from the bytes of a file."""
    reader = elements.Reader(source)
    header: tuple[Any, str | None, Any] = (("", ""), None, None)  # revision, geoReference, offset
    roads: dict[str, Road] = {}
    seen: set[tuple[str, str]] = set()
    junctions: dict[str, records.Junction] = {}
    absurd: list[str] = []  # what cost roads
    without_rule: list[str] = []  # roads that do not say on which side traffic keeps

    def fault(what: str, remedy: str) -> ConversionError:
        return ConversionError(f"{source}: {what}", remedy or "give an .xodr file, exported again")

    for element in xml_elements(_strip_junk(data, reader), "OpenDRIVE", fault, _TOP_LEVEL):
        if element.tag.startswith("{"):
            _drop_namespaces(element)
        name = element.get("id", "")
        if element.tag == "header":
            reader.place = "header"
            header = _read_header(element, reader)
            continue
        for _ in element.iter("include"):
            reader.warn("include of another file, not read")
        if element.tag == "include":
            continue
        reader.place = f"{element.tag} {name!r}"
        if (element.tag, name) in seen:
            raise reader.error("its id occurs twice", f"give every {element.tag} its own id")
        seen.add((element.tag, name))
        if element.tag == "road":
            try:
                road = _read_road(element, name, reader)
            except elements.AbsurdRecordError as error:
                absurd.append(error.message.partition(", ")[2])
                continue
            if road is not None:
                roads[name] = road
                if element.get("rule") is None:
                    without_rule.append(name)
        else:
            junctions[name] = _read_junction(element, name, reader)
    left_hand = frozenset[str]()
    if absurd:
        reader.warnings[f"road left out, the first for {absurd[0]}"] += len(absurd)
    if reader.told[False] and not reader.told[True]:
        reader.warnings["left-hand traffic, told only by vendor data"] += len(without_rule)
        left_hand = frozenset(without_rule)
    elif reader.told[False]:
        what = "lane whose vendor data contradict right-hand traffic, as others do not"
        reader.warnings[what] += reader.told[False]
    return OpenDrive(source, *header, roads, junctions, dict(reader.warnings), left_hand)


def _strip_junk(data: bytes, reader: elements.Reader) -> bytes:
    start = data.find(b"<?xml")
    if start > 0 and b"<OpenDRIVE" not in data[:start]:
        if data[:start].strip(b"\xef\xbb\xbf \t\r\n"):
            reader.warn("bytes before the XML declaration")
        return data[start:]
    return data.lstrip(b" \t\r\n")


def _drop_namespaces(element: Any) -> None:
    for child in element.iter(etree.Element):
        child.tag = etree.QName(child).localname


def _read_header(element: Any, reader: elements.Reader) -> tuple[Any, str | None, Any]:
    geo = element.findtext("geoReference")
    shift = element.find("offset")
    offset = None
    if shift is not None:
        offset = tuple(reader.finite(shift, key) for key in ("x", "y", "z", "hdg"))
    revision = (element.get("revMajor", ""), element.get("revMinor", ""))
    return revision, (geo.strip() or None) if geo else None, offset


def _read_road(element: Any, name: str, reader: elements.Reader) -> Road | None:
    """One road, or None where it has no usable reference line."""
    junction = element.get("junction", "-1")
    geometries = _read_plan_view(element.findall("planView/geometry"), reader)
    stated = reader.number(element, "length", np.nan)
    found = element.findall("lanes//laneSection")
    ends = [*(reader.finite(e, "s") for e in found[1:]), stated]
    sections = [_read_section(e, end, reader) for e, end in zip(found, ends, strict=False)]
    if element.get("rule") is None:
        _note_directions(found, reader)
    if geometries is None:
        return None
    end = geometries[-1].s + geometries[-1].length
    if not np.isfinite(stated):
        reader.warn("road without a length")
        stated = end
    elif abs(stated - end) > 0.01:
        reader.warn("road length is not the end of its geometry")
    if 0.0 < geometries[0].s >= min(stated, end):
        reader.warn("road left out: its geometry begins where it ends")
        return None
    if any(a.s > b.s for a, b in pairwise(sections)):
        reader.warn("records out of order")
    placed = [e for e in element.iterfind("signals//*[@s]") if e.tag in _SIGNALS]
    return Road(
        id=name,
        length=min(stated, end),
        junction=None if junction == "-1" else junction,
        left_hand=element.get("rule") == "LHT",
        geometries=geometries,
        offsets=reader.cubics(element.findall("lanes/laneOffset"), "s", stated),
        elevation=reader.cubics(element.findall("elevationProfile/elevation"), "s", stated),
        sections=tuple(sorted(sections, key=lambda section: section.s)),
        predecessor=_read_link(element.find("link/predecessor")),
        successor=_read_link(element.find("link/successor")),
        types=_read_types(element.findall("type"), reader),
        objects=tuple(elements.read_object(e, reader) for e in element.iterfind("objects/object")),
        signals=tuple(elements.read_signal(e, reader) for e in placed),
    )


def _read_plan_view(
    found: list[Any], reader: elements.Reader
) -> tuple[records.Geometry, ...] | None:
    geometries: list[records.Geometry] = []
    tiny: list[records.Geometry] = []
    for child in found:
        shape: Any = next((e for e in child if e.tag in records.SHAPES), None)
        kind = records.LINE if shape is None else shape.tag
        length, s = (reader.number(child, k, may_be_any=True) for k in ("length", "s"))
        x, y, heading = (
            reader.number(child, k, np.nan, may_be_any=True) for k in ("x", "y", "hdg")
        )
        if shape is None:
            reader.warn("geometry without a shape taken as a line")
        if kind == records.PARAM_POLY3 and not any(k in shape.keys() for k in _PARAM_CUBIC):
            reader.warn("road left out: paramPoly3 without coefficients")
            return None
        is_crumb = TINY_LENGTH <= length < elements.CRUMB
        coefficients, fits = reader.coefficients(shape, _COEFFICIENTS.get(kind, ()), is_crumb)
        if is_crumb and not all(fits):
            reader.warn("absurd geometry shorter than 1 mm, taken as a line")
            kind, coefficients = records.LINE, []
        if not np.isfinite([s, x, y, heading, length, *coefficients]).all():
            reader.warn("road left out: geometry is not finite")
            return None
        place = {"s": s, "x": x, "y": y, "hdg": heading, "length": length}
        if not all(OPENDRIVE[f"geometry {key}"].holds(value) for key, value in place.items()):
            reader.warn("road left out: geometry is out of this world")
            return None
        if length < TINY_LENGTH:
            reader.warn("geometry without length, skipped")
            tiny.append(records.Geometry(s, x, y, heading, max(length, 0.0), records.LINE))
        else:
            is_arc_length = shape is not None and shape.get("pRange") == "arcLength"
            curve = kind, tuple(coefficients), length if is_arc_length else 1.0
            geometries.append(records.Geometry(s, x, y, heading, length, *curve))
    geometries = geometries or tiny[:1]  # a road without length still links its neighbours
    if not geometries:
        reader.warn("road left out: no geometry")
        return None
    if any(a.s > b.s for a, b in pairwise(geometries)):
        reader.warn("records out of order")
    return tuple(sorted(geometries, key=lambda record: record.s))


def _note_directions(sections: list[Any], reader: elements.Reader) -> None:
    """Count lanes whose vendor data tell the direction of right-hand traffic, and the other."""
    for lane in (lane for section in sections for lane in section.iter("lane")):
        number = reader.integer(lane, "id")
        word = next((e.get("travelDir") for e in lane.iter("vectorLane")), None)
        if number and word in ("forward", "backward") and lane.get("type") in records.DRIVABLE:
            reader.told[(word == "forward") == (number < 0)] += 1


def _read_link(found: Any) -> records.RoadLink | None:
    if found is None or found.get("elementId") is None:
        return None
    return records.RoadLink(
        found.get("elementType", "road"), found.get("elementId"), _contact(found)
    )


def _contact(element: Any) -> str | None:
    contact = element.get("contactPoint")
    return contact if contact in ("start", "end") else None


def _read_types(found: list[Any], reader: elements.Reader) -> tuple[records.RoadType, ...]:
    types = []
    for element in found:
        s, speed = reader.finite(element, "s"), element.find("speed")
        limit = None if speed is None else _read_speed(speed, reader)
        types.append(
            records.RoadType(s, element.get("type", "unknown"), element.get("country", ""), limit)
        )
    return tuple(sorted(types, key=lambda record: record.s))


def _read_speed(element: Any, reader: elements.Reader) -> records.Speed:
    unit = element.get("unit", "").lower().replace(" ", "")
    begin = reader.finite(element, "sOffset")
    text = element.get("max", "undefined")
    if text in ("no limit", "undefined"):
        return records.Speed(begin, None)
    # nuPlan rule 508: without a unit in m/s
    limit = reader.number(element, "max") * records.SPEED_UNITS.get(unit or "m/s", np.nan)
    if not (np.isfinite(limit) and limit > 0):
        reader.warn("speed limit that is not a positive number in a known unit")
        return records.Speed(begin, None)
    return records.Speed(begin, limit)


def _read_section(element: Any, end: float, reader: elements.Reader) -> records.LaneSection:
    lanes: dict[int, records.Lane] = {}
    length = end - reader.finite(element, "s")
    for child in element.iter("lane"):
        number = reader.integer(child, "id")
        if number is None:
            what = f"lane (line {child.sourceline}) has id={child.get('id', '')[:40]!r}"
            raise reader.error(what, "number the lanes")
        if number == 0:
            continue
        if number in lanes:
            reader.warn("lane id twice in a section, the first holds")
            continue
        lanes[number] = _read_lane(child, number, length, reader)
    numbers = sorted(lanes)
    steps = [b - a - (a < 0 < b) for a, b in pairwise(numbers)]
    nearest = [min((abs(n) for n in numbers if n * sign > 0), default=1) for sign in (-1, 1)]
    if any(step != 1 for step in steps) or nearest != [1, 1]:
        reader.warn("lane numbers with holes")
    return records.LaneSection(max(reader.finite(element, "s"), 0.0), lanes)


def _read_lane(element: Any, number: int, length: float, reader: elements.Reader) -> records.Lane:
    widths, borders = element.findall("width"), element.findall("border")
    kind = element.get("type", "")
    if not widths and not borders:
        reader.warn("lane without width and border")
    lane = records.Lane(
        id=number,
        type=kind or "none",
        widths=reader.cubics(widths, "sOffset", length),
        borders=reader.cubics(borders, "sOffset", length),
        predecessors=_lane_ids(element.findall("link/predecessor"), reader),
        successors=_lane_ids(element.findall("link/successor"), reader),
        speeds=tuple(
            sorted((_read_speed(e, reader) for e in element.findall("speed")), key=lambda r: r.s)
        ),
        access=tuple(
            (e.get("rule", "deny"), e.get("restriction", "")) for e in element.findall("access")
        ),
        direction=element.get("direction", "standard"),
    )
    cubics = lane.widths if len(lane.widths) else lane.borders
    if len(cubics) and cubics[0, 0] > 1e-6:
        reader.warn("lane width begins after its section")
    return lane


def _lane_ids(found: list[Any], reader: elements.Reader) -> tuple[int, ...]:
    return tuple(i for e in found if (i := reader.integer(e, "id")) is not None)


def _read_junction(element: Any, name: str, reader: elements.Reader) -> records.Junction:
    kind = element.get("type", "default")
    connections = []
    for child in element.findall("connection"):
        links = reader.pairs(child, "laneLink", ("from", "to"))
        into = child.get("connectingRoad") or child.get("linkedRoad") or ""
        connections.append(
            records.Connection(child.get("incomingRoad", ""), into, _contact(child), links)
        )
    if not connections:
        reader.warn("junction without connections")
    return records.Junction(name, kind, tuple(connections))


def xml_elements(
    data: bytes, root: str, fault: Callable[[str, str], ConversionError], names: Sequence[str] = ()
) -> list[Any]:
    """The children of the root that have one of some names, or the root itself. No comments.

    Names are those in any namespace. It is an error, made by `fault` of what is wrong and a remedy,
    if `data` are no XML, have another root, or a document type: entities and external references
    are refused.
    """
    safe = {"resolve_entities": False, "load_dtd": False, "no_network": True, "huge_tree": False}
    parser = etree.XMLParser(remove_comments=True, remove_pis=True, **safe)
    try:
        found = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise fault(f"not well-formed XML: {error.msg}", "") from error
    if found.getroottree().docinfo.doctype:
        raise fault("has a DOCTYPE", "remove it and its entities")
    if etree.QName(found).localname != root:
        raise fault(f"its first element is not {root}", "")
    return list(found.iterchildren(*[f"{{*}}{name}" for name in names])) if names else [found]
