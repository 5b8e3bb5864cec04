"""The OpenDRIVE reader against sampled reference lines, lanes, links and counts of real maps."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import etree
from numpy.polynomial.polynomial import polyval
from parity_cases import Cases, change_column, change_json, name_unknown, noticed, read_file

from shiftsim.data.maps.opendrive.areas import is_crosswalk, object_rings
from shiftsim.data.maps.opendrive.curves import ReferenceLine, curve_length, evaluate_local
from shiftsim.data.maps.opendrive.lanes import LaneKey, lane_links, section_borders
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.records import (
    PARAM_POLY3,
    SHAPES,
    Geometry,
    Lane,
    OpenDrive,
    Road,
)

pytestmark = [pytest.mark.golden, pytest.mark.reference("opendrive")]

EXACT = 1e-6  # m, rad: tolerance of the folder's README
CUBIC, CUBIC_HEADING = 2e-3, 1e-3  # m, rad: paramPoly3
LENGTH_SHARE, LENGTH = 1e-3, 0.05  # of a length, or m
TALLIES = ("junction type", "lane type", "geometry", "speed", "object", "signal")
ENDS = ("road", "section", "lane", "type")  # columns of either end of a lane link
CENTER_STEP = 0.25  # m, spacing of the summary's centre lines

read_map = lru_cache(maxsize=1)(read_opendrive)


def open_map(path: Path, maps: Path, cases: Cases) -> tuple[OpenDrive, Path] | None:
    """The map that a file `<map>.<kind>` is about."""
    name = path.name.partition(".")[0]
    found = sorted(maps.rglob(f"{name}.xodr"))
    if not found:
        cases.skip(f"map {name}.xodr not found")
        return None
    return read_map(found[0]), found[0]


def kinds(line: ReferenceLine, s: np.ndarray) -> list[str]:
    """Kind of the record at road distances [m]; at a joint the later one."""
    starts = [geometry.s for geometry in line.geometries]
    index = np.maximum(np.searchsorted(starts, s, side="right") - 1, 0)
    return [line.geometries[i].kind for i in index]


def bounds(line: ReferenceLine, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tolerances of places [m] and headings [rad] at road distances."""
    is_cubic = np.array([kind == "paramPoly3" for kind in kinds(line, s)])
    return np.where(is_cubic, CUBIC, EXACT), np.where(is_cubic, CUBIC_HEADING, EXACT)


@pytest.mark.files("*.refline.parquet")
def test_reference_lines(path: Path, maps: Path, cases: Cases) -> None:
    if (found := open_map(path, maps, cases)) is None:
        return
    (od, source), file = found, read_file(path, cases)
    roads = file.groups("road")
    cases.compare(
        "roads with a reference line", source.stem, sorted(od.roads), [n for (n,) in sorted(roads)]
    )
    for (name,), rows in roads.items():
        where, road, s = f"{source.stem} road {name}", od.roads[name], rows["s"]
        line = ReferenceLine(road.geometries)
        poses, (gap, turn) = line.evaluate(s), bounds(line, s)
        ours = {"x": poses.x, "y": poses.y, "hdg": poses.heading, "kind": kinds(line, s)}
        atol = {"": gap, "hdg": turn}
        rows.match(where, ours, atol, quantity="reference line", angles=("hdg",))
        extent = [0.0, stated_length(source, road)]
        cases.compare("road extent", where, extent, s[[0, -1]], atol=EXACT)
        cases.compare("heading is wrapped", where, np.abs(rows["hdg"]).max() <= np.pi, True)
    file.finish()


@pytest.mark.files("*.lanes.parquet")
def test_lanes(path: Path, maps: Path, cases: Cases) -> None:
    if (found := open_map(path, maps, cases)) is None:
        return
    (od, source), file = found, read_file(path, cases)
    lanes = lanes_of(od)
    for (name, section, number), rows in file.groups("road", "section", "lane").items():
        key = LaneKey(name, int(section), int(number))
        where = f"{source.stem} road {name} section {section} lane {number}"
        if not cases.compare("lane exists", where, key in lanes, True):
            continue
        road, s = od.roads[name], rows["s"]
        begin, end = road.sections[key.section].s, road.section_end(key.section)
        inside = begin - 1e-9 <= s.min() and s.max() <= end + 1e-9
        cases.compare("lane rows lie in their section", where, inside, True)
        line, borders = ReferenceLine(road.geometries), section_borders(road, key.section, s)
        inner, outer, poses = borders.inner[key.lane], borders.outer[key.lane], line.evaluate(s)
        ours: dict[str, Any] = {"type": [lanes[key].type] * len(s)}
        ours |= {"t_inner": inner, "t_outer": outer}
        for letter, offset in (("c", 0.5 * (inner + outer)), ("i", inner), ("o", outer)):
            ours[f"{letter}x"], ours[f"{letter}y"] = poses.offset(offset).T
        atol = {"": bounds(line, s)[0], "t_inner": EXACT, "t_outer": EXACT}
        rows.match(where, ours, atol, quantity="lane")
    file.finish()


def lanes_of(od: OpenDrive) -> dict[LaneKey, Lane]:
    return {
        LaneKey(road.id, index, number): lane
        for road in od.roads.values()
        for index, section in enumerate(road.sections)
        for number, lane in section.lanes.items()
    }


@pytest.mark.files("*.topology.parquet")
def test_topology(path: Path, maps: Path, cases: Cases) -> None:
    if (found := open_map(path, maps, cases)) is None:
        return
    (od, source), file = found, read_file(path, cases)
    lanes, links = lanes_of(od), lane_links(od, Counter())
    theirs = zip(*(file[f"{end}_{what}"] for end in ("from", "to") for what in ENDS), strict=True)
    ours = [[part for key in link for part in (*key, lanes[key].type)] for link in links]
    known, listed = ({" ".join(map(str, row)) for row in rows} for rows in (ours, theirs))
    cases.compare("number of lane links", source.stem, len(links), file.num_rows)
    cases.compare("lane links", source.stem, sorted(known), sorted(listed))
    file.finish()


@pytest.mark.files("*.crosswalks.json")
def test_crosswalks(path: Path, maps: Path, cases: Cases) -> None:
    if (found := open_map(path, maps, cases)) is None:
        return
    (od, source), file = found, read_file(path, cases)
    pairs = [(r, thing) for r in od.roads.values() for thing in r.objects if is_crosswalk(thing)]
    known = {f"{road.id} {thing.id}": (road, thing) for road, thing in pairs}
    rows = {f"{row['road']} {row['object']}": row for row in file.each("rows")}
    cases.compare("crosswalks", source.stem, sorted(known), sorted(rows))
    for key in sorted(set(known) & set(rows)):
        road, thing = known[key]
        line, outline = ReferenceLine(road.geometries), "box"
        if thing.outlines:
            outline = "cornerRoad" if thing.outlines[0].on_road else "cornerLocal"
        ours = {
            "outline": outline,
            "centre": line.evaluate(np.array([thing.s])).offset(np.array([thing.t]))[0],
        }
        ours["polygon"] = object_rings(line, thing)[0]
        gap, _ = bounds(line, np.array([thing.s]))
        rows[key].match(f"{source.stem} object {key}", ours, {"": gap}, quantity="crosswalk")
    file.finish()


@pytest.mark.files("*.summary.json")
def test_summary(path: Path, maps: Path, cases: Cases) -> None:
    if (found := open_map(path, maps, cases)) is None:
        return
    (od, source), file = found, read_file(path, cases)
    where, roads = source.stem, od.roads.values()
    ours, bound = summarize(od, source)
    ours |= {"map": source.name, "bytes": source.stat().st_size}
    gaps = ("max_geometry_gap_m", "max_geometry_heading_gap_rad")
    atol = dict.fromkeys((*gaps, "parampoly3_arc_vs_linear_param_max_m"), bound)
    file.match(where, ours, atol, quantity="summary")
    along, center = np.sum([(0.0, 0.0), *map(driving_lengths, roads)], axis=0)
    lengths = {"driving_s_length_m": along, "driving_centreline_length_m": center}
    lengths["road_length_sum_m"] = sum(stated_length(source, road) for road in roads)
    for key, length in lengths.items():
        near = max(LENGTH_SHARE * abs(file[key]), LENGTH)
        file.match(where, {key: float(length)}, near, quantity="summary")
    # of the largest gap; where many gaps are rounding noise, one as large as ours
    gap, place, where = 0.0, file["max_geometry_gap_at"], f"{where} max_geometry_gap_at"
    if place is not None:
        geometries = od.roads[place[0]].geometries
        distance = np.abs([geometry.s - place[1] for geometry in geometries[1:]])
        cases.compare("place of the largest gap", where, distance.min(), 0.0, atol=1e-9)
        gap = ReferenceLine(geometries).joints()[0][distance.argmin()]
    cases.compare("largest gap", where, gap, file["max_geometry_gap_m"], atol=EXACT)
    file.finish()


def summarize(od: OpenDrive, path: Path) -> tuple[dict[str, Any], float]:
    """The fields of a summary but for lengths; the tolerance of gaps between geometries."""
    roads, links, counts = od.roads.values(), lane_links(od, Counter()), count_records(path)
    lanes = lanes_of(od)
    joints = [np.array(ReferenceLine(road.geometries).joints()) for road in roads]
    gap, turn = np.concatenate([np.zeros((2, 1)), *joints], axis=1).max(axis=1)
    cubics = [g for road in roads for g in road.geometries if g.kind == "paramPoly3"]
    driving = [pair for pair in links if {lanes[key].type for key in pair} == {"driving"}]
    tallies: dict[str, dict[str, int]] = {kind: {} for kind in TALLIES}
    for name, count in counts.items():
        for kind in (kind for kind in TALLIES if name.startswith(f"{kind} ")):
            tallies[kind][name.removeprefix(f"{kind} ")] = count
    num_driving = tallies["lane type"].get("driving", 0)
    summary = {
        "revision": od.revision,
        "geoReference": od.geo_reference,
        "header_offset": od.offset,
        "junctions": len(od.junctions),
        "roads": counts["road"],
        "roads_in_junctions": counts["road in a junction"],
        "connections": counts["connection"],
        "lane_links_in_junctions": counts["lane link in a junction"],
        "lane_sections": counts["lane section"],
        "left_hand_roads": counts["road with left-hand traffic"],
        "width_records": counts["width"],
        "border_records": counts["border"],
        "lane_offset_records": counts["laneOffset"],
        "junction_types": tallies["junction type"],
        "lane_types": tallies["lane type"],
        "geometry_kinds": tallies["geometry"],
        "speed_records": tallies["speed"],
        "objects": tallies["object"],
        "signals": tallies["signal"],
        "lanes": sum(tallies["lane type"].values()),
        "driving_lanes": num_driving,
        "crosswalk_objects": sum(is_crosswalk(item) for road in roads for item in road.objects),
        "lane_edges_all_types": len(links),
        "lane_edges_driving_to_driving": len(driving),
        "driving_lanes_without_successor": num_driving - len({start for start, _ in driving}),
        "max_geometry_gap_m": gap,
        "max_geometry_heading_gap_rad": turn,
        "parampoly3_arc_vs_linear_param_max_m": max(map(arc_length_deviation, cubics), default=0.0),
    }
    return summary, CUBIC if cubics else EXACT


@lru_cache(maxsize=1)
def read_root(path: Path) -> Any:
    data = path.read_bytes()
    root = etree.fromstring(data[max(data.find(b"<?xml"), 0) :])
    for element in root.iter(etree.Element):
        element.tag = etree.QName(element).localname
    return root


def stated_length(path: Path, road: Road) -> float:
    """Length of a road as its file has it [m]."""
    (element,) = read_root(path).findall(f"road[@id='{road.id}']")
    return float(element.get("length", road.length))


def count_records(path: Path) -> Counter[str]:
    """How many records of each kind a file holds, those that are left out included."""
    root = read_root(path)
    counts = Counter[str]()
    for kind, found in (
        ("laneOffset", "road/lanes/laneOffset"),
        ("lane section", "road/lanes/laneSection"),
        ("connection", "junction/connection"),
        ("lane link in a junction", "junction/connection/laneLink"),
        ("road", "road"),
    ):
        counts[kind] = len(root.findall(found))
    for road in root.findall("road"):
        counts["road in a junction"] += road.get("junction", "-1") != "-1"
        counts["road with left-hand traffic"] += road.get("rule") == "LHT"
        for geometry in road.findall("planView/geometry"):
            shape = next((e.tag for e in geometry if e.tag in SHAPES), "line")
            counts[f"geometry {shape}"] += 1
        for lane in road.findall("lanes/laneSection/*/lane"):
            if lane.get("id") != "0":
                counts[f"lane type {lane.get('type') or 'none'}"] += 1
                counts["width"] += len(lane.findall("width"))
                counts["border"] += len(lane.findall("border"))
                counts.update(f"speed {e.get('unit') or 'm/s'}" for e in lane.findall("speed"))
        counts.update(f"speed {e.get('unit') or 'm/s'}" for e in road.findall("type/speed"))
        counts.update(f"object {e.get('type', '')}" for e in road.findall("objects/object"))
        for signal in road.findall("signals/signal"):
            name = f"signal {signal.get('country', '')}:{signal.get('type', '')}"
            subtype = signal.get("subtype", "")
            counts[name + ("" if subtype in ("", "-1", "none") else f".{subtype}")] += 1
    counts.update(f"junction type {e.get('type', 'default')}" for e in root.findall("junction"))
    return counts


def arc_length_deviation(record: Geometry) -> float:
    """How far a paramPoly3 read by arc length lies from one read by its parameter [m].

    The largest distance at the quarters of its length.
    """
    d = record.length * np.array([0.25, 0.5, 0.75])
    p, (u, v) = d * (record.p_end / record.length), np.reshape(record.coefficients, (2, 4))
    by_arc = evaluate_local(cut_off(record), d)
    return float(np.hypot(by_arc[0] - polyval(p, u), by_arc[1] - polyval(p, v)).max())


def cut_off(record: Geometry) -> Geometry:
    """A paramPoly3 that ends where its stated length is used up, instead of being stretched."""
    return replace(record, length=curve_length(record)) if record.kind == PARAM_POLY3 else record


def driving_lengths(road: Road) -> tuple[float, float]:
    """Section length times driving lanes, and length of the centre lines of driving lanes [m]."""
    along, center, line = 0.0, 0.0, ReferenceLine(tuple(map(cut_off, road.geometries)))
    for index, section in enumerate(road.sections):
        numbers = [n for n, lane in section.lanes.items() if lane.type == "driving"]
        begin, end = section.s, road.section_end(index)
        if not numbers or end <= begin:
            continue
        s = np.linspace(begin, end, max(int(np.ceil((end - begin) / CENTER_STEP)), 1) + 1)
        borders, poses = section_borders(road, index, s), line.evaluate(s)
        for number in numbers:
            xy = poses.offset(0.5 * (borders.inner[number] + borders.outer[number]))
            center += float(np.hypot(*np.diff(xy, axis=0).T).sum())
        along += (end - begin) * len(numbers)
    return along, center


@pytest.mark.files("crosscheck_libopendrive.json")
def test_crosscheck(path: Path, cases: Cases) -> None:
    """Row counts of the reference's own comparison; its errors are those of another reader."""
    file, folder = read_file(path, cases), path.parent
    cases.note(f"errors of libOpenDRIVE in {path.name}")
    for name in file:
        entry = file[name]
        tables = [folder / f"{name}.{kind}.parquet" for kind in ("refline", "lanes")]
        status = "compared" if tables[0].is_file() else "no golden"
        cases.compare("status", name, status, entry["status"])
        for table, count in zip(tables, entry.get("rows", ()), strict=False):
            rows = read_file(table, cases).num_rows if table.is_file() else None
            cases.compare("rows of the reference", name, rows, count)
        summary = folder / f"{name}.summary.json"
        if "roads_junctions" in entry and summary.is_file():
            ours = [json.loads(summary.read_text())[thing] for thing in ("roads", "junctions")]
            cases.compare("roads and junctions", name, ours, entry["roads_junctions"])


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    kinds = "refline.parquet lanes.parquet topology.parquet summary.json crosswalks.json".split()
    name_unknown(folder, cases, "crosscheck_libopendrive.json", *(f"*.{kind}" for kind in kinds))


@pytest.mark.parametrize(
    ("test", "file", "name"),
    [
        *((test_reference_lines, "refline", name) for name in ("road", "s", "y", "hdg", "kind")),
        *((test_lanes, "lanes", name) for name in ("lane", "s", "t_inner", "cx", "oy", "type")),
        *((test_topology, "topology", name) for name in ("from_lane", "to_section", "to_type")),
        *((test_summary, "summary", name) for name in ("lane_types", "max_geometry_gap_m")),
        *((test_summary, "summary", name) for name in ("roads", "road_length_sum_m", "revision")),
        (test_crosswalks, "crosswalks", "outline"),
        (test_crosswalks, "crosswalks", "polygon"),
    ],
)
def test_a_changed_value_is_noticed(
    test: Any, file: str, name: str, shared: Path, tmp_path: Path
) -> None:
    kind = "json" if file in ("summary", "crosswalks") else "parquet"
    path, cases = tmp_path / f"crosswalk_object.{file}.{kind}", Cases()
    source = shared / "reference" / "opendrive" / path.name
    if kind == "json":
        change_json(source, path, *((0,) if file == "crosswalks" else ()), name, amount=15.0)
    else:
        change_column(source, path, name, row=1, amount=0.1)
    assert noticed(test, path, shared / "maps", cases)


def test_unknown_columns_and_maps_are_named(shared: Path, tmp_path: Path) -> None:
    cases = Cases()
    source = shared / "reference" / "opendrive" / "crosswalk_object.summary.json"
    shutil.copyfile(source, tmp_path / "nowhere.summary.json")
    test_summary(tmp_path / "nowhere.summary.json", shared / "maps", cases)
    content = json.loads(source.read_text()) | {"trams": 1}
    (tmp_path / source.name).write_text(json.dumps(content))
    test_summary(tmp_path / source.name, shared / "maps", cases)
    assert len(cases.not_covered) == 2
