"""The OpenDRIVE reader against sampled reference lines, lanes, links and counts of real maps."""

from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.maps.opendrive.areas import is_crosswalk, object_origin, object_rings
from shiftsim.data.maps.opendrive.curves import ReferenceLine, arc_length_deviation
from shiftsim.data.maps.opendrive.lanes import LaneKey, lane_links, section_borders
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.records import Lane, OpenDrive, Road
from shiftsim.kernels import FloatArray
from shiftsim.verify.files import Compare, Source, read_file, read_json, verify_files
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables

TABLES = read_tables(__file__)
EXACT = 1e-6  # m, rad: tolerance of the folder's README
CUBIC, CUBIC_HEADING = 2e-3, 1e-3  # m, rad: paramPoly3
LENGTH_SHARE, LENGTH = 1e-3, 0.05  # of a length, or m
_TALLIES = ("junction type", "lane type", "geometry", "speed", "object", "signal")
_ENDS = ("road", "section", "lane", "type")  # columns of either end of a lane link
_CENTER_STEP = 0.25  # m, spacing of the summary's centre lines


def verify_opendrive(folder: Path, report: Report, maps: Path | None = None) -> None:
    """Compare our reading of the maps with the files `<map>.<kind>` of a folder.

    The .xodr files lie at any depth of `maps`, by default of the one beside the parent of `folder`.
    """
    place = maps or folder.resolve().parent.parent / "maps"
    by_name = {path.stem: path for path in sorted(place.rglob("*.xodr"))}
    read = lru_cache(maxsize=1)(read_opendrive)

    def compare(file: Source, where: str) -> None:
        name, _, kind = where.partition(".")
        if name in by_name:
            _COMPARE[kind](read(by_name[name]), file, by_name[name])
        else:
            report.skip(f"map {name}.xodr not found")
            file.used.update(file)

    files: dict[str, Compare] = {f"*.{kind}.*": compare for kind in _COMPARE}
    files["crosscheck_libopendrive.json"] = lambda file, where: _compare_rows(file, folder)
    verify_files(folder, report, {}, files)


def _bounds(line: ReferenceLine, s: FloatArray) -> dict[str, FloatArray]:
    """Tolerances of places [m] and headings [rad] at road distances."""
    is_cubic = np.array([kind == "paramPoly3" for kind in line.kinds(s)])
    cubic = {"gap": CUBIC, "turn": CUBIC_HEADING}
    return {name: np.where(is_cubic, bound, EXACT) for name, bound in cubic.items()}


def _compare_reference_lines(od: OpenDrive, file: Source, path: Path) -> None:
    compare, roads = file.report.compare, file.groups("road")
    names = [name for (name,) in sorted(roads)]
    compare("roads with a reference line", path.stem, sorted(od.roads), names)
    for (name,), rows in roads.items():
        where, road, s = f"{path.stem} road {name}", od.roads[name], rows["s"]
        line = ReferenceLine(road.geometries)
        ours = {"poses": line.evaluate(s), "kinds": line.kinds(s), **_bounds(line, s)}
        TABLES["refline"].match(rows, where, **ours)
        compare("road extent", where, [0.0, road.stated_length], s[[0, -1]], atol=EXACT)
        compare("heading is wrapped", where, np.abs(rows["hdg"]).max() <= np.pi, True)


def _compare_lanes(od: OpenDrive, file: Source, path: Path) -> None:
    compare, lanes = file.report.compare, _lanes(od)
    for (name, section, number), rows in file.groups("road", "section", "lane").items():
        key = LaneKey(name, int(section), int(number))
        where = f"{path.stem} road {name} section {section} lane {number}"
        if not compare("lane exists", where, key in lanes, True):
            continue
        road, s = od.roads[name], rows["s"]
        begin, end = road.sections[key.section].s, road.section_end(key.section)
        inside = begin - 1e-9 <= s.min() and s.max() <= end + 1e-9
        compare("lane rows lie in their section", where, inside, True)
        line, borders = ReferenceLine(road.geometries), section_borders(road, key.section, s)
        inner, outer, poses = borders.inner[key.lane], borders.outer[key.lane], line.evaluate(s)
        offsets = {"inner": inner, "outer": outer, "center": 0.5 * (inner + outer)}
        places = {name: poses.offset(offset) for name, offset in offsets.items()}
        names = {"types": [lanes[key].type] * len(s), "offsets": offsets, "places": places}
        TABLES["lanes"].match(rows, where, **names, **_bounds(line, s))


def _lanes(od: OpenDrive) -> dict[LaneKey, Lane]:
    return {
        LaneKey(road.id, index, number): lane
        for road in od.roads.values()
        for index, section in enumerate(road.sections)
        for number, lane in section.lanes.items()
    }


def _compare_topology(od: OpenDrive, file: Source, path: Path) -> None:
    lanes, links = _lanes(od), lane_links(od, Counter())
    theirs = zip(*(file[f"{end}_{what}"] for end in ("from", "to") for what in _ENDS), strict=True)
    ours = [[part for key in link for part in (*key, lanes[key].type)] for link in links]
    known, listed = ({" ".join(map(str, row)) for row in rows} for rows in (ours, theirs))
    file.report.compare("number of lane links", path.stem, len(links), file.num_rows)
    file.report.compare("lane links", path.stem, sorted(known), sorted(listed))


def _compare_crosswalks(od: OpenDrive, file: Source, path: Path) -> None:
    pairs = [(r, thing) for r in od.roads.values() for thing in r.objects if is_crosswalk(thing)]
    known = {f"{road.id} {thing.id}": (road, thing) for road, thing in pairs}
    rows = {f"{row['road']} {row['object']}": row for row in file.each("rows")}
    file.report.compare("crosswalks", path.stem, sorted(known), sorted(rows))
    for key in set(known) & set(rows):
        road, thing = known[key]
        line, outline = ReferenceLine(road.geometries), "box"
        if thing.outlines:
            outline = "cornerRoad" if thing.outlines[0].on_road else "cornerLocal"
        names = {"origin": object_origin(line, thing), "polygon": object_rings(line, thing)[0]}
        names |= _bounds(line, np.array([thing.s]))
        TABLES["crosswalk"].match(rows[key], f"{path.stem} object {key}", outline=outline, **names)


def _compare_summary(od: OpenDrive, file: Source, path: Path) -> None:
    where, compare, roads = path.stem, file.report.compare, od.roads.values()
    TABLES["summary"].match(file, where, od=od, path=path, **_summarize(od))
    along, center = np.sum([(0.0, 0.0), *map(_driving_lengths, roads)], axis=0)
    lengths = {"driving_s_length_m": along, "driving_centreline_length_m": center}
    lengths["road_length_sum_m"] = sum(road.stated_length for road in roads)
    for key, length in lengths.items():
        atol = max(LENGTH_SHARE * abs(file[key]), LENGTH)
        file.match(where, {key: float(length)}, atol, quantity="summary")
    # of the largest gap; where many gaps are rounding noise, one as large as ours
    gap, place, where = 0.0, file["max_geometry_gap_at"], f"{where} max_geometry_gap_at"
    if place is not None:
        geometries = od.roads[place[0]].geometries
        distance = np.abs([geometry.s - place[1] for geometry in geometries[1:]])
        compare("place of the largest gap", where, distance.min(), 0.0, atol=1e-9)
        gap = ReferenceLine(geometries).joints()[0][distance.argmin()]
    compare("largest gap", where, gap, file["max_geometry_gap_m"], atol=EXACT)


def _summarize(od: OpenDrive) -> dict[str, Any]:
    lanes, roads, links = _lanes(od), od.roads.values(), lane_links(od, Counter())
    joints = [np.array(ReferenceLine(road.geometries).joints()) for road in roads]
    gap, turn = np.concatenate([np.zeros((2, 1)), *joints], axis=1).max(axis=1)
    cubics = [g for road in roads for g in road.geometries if g.kind == "paramPoly3"]
    driving = [pair for pair in links if {lanes[key].type for key in pair} == {"driving"}]
    tallies: dict[str, dict[str, int]] = {kind: {} for kind in _TALLIES}
    for name, count in od.counts.items():
        for kind in (kind for kind in _TALLIES if name.startswith(f"{kind} ")):
            tallies[kind][name.removeprefix(f"{kind} ")] = count
    num_driving = tallies["lane type"].get("driving", 0)
    names = {"counts": Counter(od.counts), "tallies": tallies, "links": links, "driving": driving}
    names |= {"num_driving": num_driving, "num_lanes": sum(tallies["lane type"].values())}
    names["num_ends"] = num_driving - len({start for start, _ in driving})
    names["crosswalks"] = [item for road in roads for item in road.objects if is_crosswalk(item)]
    names["stretch"] = max(map(arc_length_deviation, cubics), default=0.0)
    return {**names, "gap": gap, "turn": turn, "bound": CUBIC if cubics else EXACT}


def _driving_lengths(road: Road) -> tuple[float, float]:
    """Section length times driving lanes, and length of the centre lines of driving lanes [m]."""
    along, center, line = 0.0, 0.0, ReferenceLine(road.geometries, stretched=False)
    for index, section in enumerate(road.sections):
        numbers = [n for n, lane in section.lanes.items() if lane.type == "driving"]
        begin, end = section.s, road.section_end(index)
        if not numbers or end <= begin:
            continue
        s = np.linspace(begin, end, max(int(np.ceil((end - begin) / _CENTER_STEP)), 1) + 1)
        borders, poses = section_borders(road, index, s), line.evaluate(s)
        for number in numbers:
            xy = poses.offset(0.5 * (borders.inner[number] + borders.outer[number]))
            center += float(np.hypot(*np.diff(xy, axis=0).T).sum())
        along += (end - begin) * len(numbers)
    return along, center


def _compare_rows(file: Source, folder: Path) -> None:
    """Row counts of the reference's own comparison; its errors are those of another reader."""
    compare = file.report.compare
    file.report.note(f"errors of libOpenDRIVE in {file.name}.json")
    for name in file:
        entry = file[name]
        tables = [folder / f"{name}.{kind}.parquet" for kind in ("refline", "lanes")]
        compare("status", name, "compared" if tables[0].is_file() else "no golden", entry["status"])
        for table, count in zip(tables, entry.get("rows", ()), strict=False):
            rows = read_file(table, file.report).num_rows if table.is_file() else None
            compare("rows of the reference", name, rows, count)
        summary = folder / f"{name}.summary.json"
        if "roads_junctions" in entry and summary.is_file():
            ours = [read_json(summary)[thing] for thing in ("roads", "junctions")]
            compare("roads and junctions", name, ours, entry["roads_junctions"])


_COMPARE = {
    "refline": _compare_reference_lines,
    "lanes": _compare_lanes,
    "topology": _compare_topology,
    "summary": _compare_summary,
    "crosswalks": _compare_crosswalks,
}
