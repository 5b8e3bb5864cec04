"""The OpenDRIVE reader against sampled reference lines, lanes, links and counts of real maps."""

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.arrays import FloatArray
from shiftsim.data.opendrive.areas import is_crosswalk, object_origin, object_rings
from shiftsim.data.opendrive.curves import ReferenceLine, arc_length_deviation
from shiftsim.data.opendrive.lanes import LaneKey, lane_links, section_borders
from shiftsim.data.opendrive.reading import read_opendrive
from shiftsim.data.opendrive.records import OpenDrive, Road, RoadObject
from shiftsim.errors import ShiftsimError
from shiftsim.verify.report import Report

POSITION, HEADING = 1e-6, 1e-6  # m, rad: tolerances of the folder's README
CUBIC_POSITION, CUBIC_HEADING = 2e-3, 1e-3  # m, rad: paramPoly3
LENGTH_SHARE, LENGTH = 1e-3, 0.05  # of a length, or m
_CENTER_STEP = 0.25  # m, spacing of the summary's centre lines
_KINDS = ("refline.parquet", "lanes.parquet", "topology.parquet", "summary.json", "crosswalks.json")
_CROSSCHECK = "crosscheck_libopendrive.json"


def verify_opendrive(folder: Path, report: Report, maps: Path | None = None) -> None:
    """Compare our reading of the maps with every reference file of a folder.

    Args:
        folder: Reference files, named `<map>.<kind>`.
        report: Takes the comparisons.
        maps: Folder with the .xodr files, at any depth; by default the folder `maps` beside the
            parent of `folder`.
    """
    place = maps or folder.resolve().parent.parent / "maps"
    by_name = {path.stem: path for path in sorted(place.rglob("*.xodr"))}
    files: dict[str, dict[str, Path]] = defaultdict(dict)
    for path in sorted(folder.iterdir()):
        name, _, kind = path.name.partition(".")
        if kind in _KINDS:
            files[name][kind] = path
        elif path.name not in (_CROSSCHECK, "README.md"):
            report.skip(f"unknown file {path.name}")
    for name, found in files.items():
        if name not in by_name:
            report.skip(f"map {name}.xodr not found", len(found))
            continue
        try:
            _verify_map(by_name[name], found, report)
        except ShiftsimError as error:
            report.fail("map", name, str(error))
    if (folder / _CROSSCHECK).is_file():
        _verify_crosscheck(folder, report)


def _verify_map(path: Path, files: dict[str, Path], report: Report) -> None:
    od = read_opendrive(path)
    checks: dict[str, Callable[[OpenDrive, Any, str, Report], None]] = {
        "refline.parquet": _verify_reference_lines,
        "lanes.parquet": _verify_lanes,
        "topology.parquet": _verify_topology,
        "crosswalks.json": _verify_crosswalks,
    }
    for kind, file in files.items():
        try:
            content = json.loads(file.read_text()) if kind.endswith("json") else pq.read_table(file)
        except (OSError, ValueError, pa.ArrowException) as error:
            report.fail("file", file.name, str(error))
            continue
        try:
            if kind == "summary.json":
                _verify_summary(od, path, content, report)
            else:
                checks[kind](od, content, path.stem, report)
        except (KeyError, TypeError, IndexError, ValueError) as error:
            report.fail("file", file.name, f"not in the form of the reference: {error!r}")


def _columns(table: pa.Table, wanted: Sequence[str], where: str, report: Report) -> dict[str, Any]:
    for extra in sorted(set(table.column_names) - set(wanted)):
        report.skip(f"{where}: column {extra}")
    return {name: table.column(name).to_pylist() for name in wanted}


def _tolerances(line: ReferenceLine, s: FloatArray, *, heading: bool = False) -> FloatArray:
    exact, cubic = (HEADING, CUBIC_HEADING) if heading else (POSITION, CUBIC_POSITION)
    return np.where([kind == "paramPoly3" for kind in line.kinds(s)], cubic, exact)


def _compare_rows(
    report: Report, quantity: str, where: str, actual: FloatArray, expected: Any, atol: FloatArray
) -> None:
    """Compare rows of different tolerance, each set as one case."""
    for bound in np.unique(atol):
        here = atol == bound
        report.compare(
            f"{quantity} within {bound:g}",
            where,
            actual[here],
            np.asarray(expected, np.float64)[here],
            atol=float(bound),
        )


def _verify_reference_lines(od: OpenDrive, table: pa.Table, name: str, report: Report) -> None:
    rows = _columns(table, ("road", "s", "x", "y", "hdg", "kind"), f"{name}.refline", report)
    by_road: dict[str, list[int]] = defaultdict(list)
    for index, road in enumerate(rows["road"]):
        by_road[road].append(index)
    report.compare("roads with a reference line", name, sorted(od.roads), sorted(by_road))
    for road_id, indices in by_road.items():
        if road_id not in od.roads:
            continue
        where, line = f"{name} road {road_id}", ReferenceLine(od.roads[road_id].geometries)
        pick = {key: np.array([values[i] for i in indices]) for key, values in rows.items()}
        s = pick["s"].astype(np.float64)
        poses = line.evaluate(s)
        report.compare(
            "road extent", where, s[[0, -1]], [0.0, od.roads[road_id].stated_length], atol=1e-6
        )
        report.compare("geometry kind", where, line.kinds(s), pick["kind"].tolist())
        atol = _tolerances(line, s)
        _compare_rows(report, "reference line", where, poses.x, pick["x"], atol)
        _compare_rows(report, "reference line", where, poses.y, pick["y"], atol)
        turn = (poses.heading - pick["hdg"] + np.pi) % (2 * np.pi) - np.pi
        report.compare(
            "heading is wrapped", where, np.abs(pick["hdg"]) <= np.pi, np.full(len(s), True)
        )
        atol = _tolerances(line, s, heading=True)
        _compare_rows(report, "heading", where, turn, np.zeros(len(s)), atol)


def _verify_lanes(od: OpenDrive, table: pa.Table, name: str, report: Report) -> None:
    points = ("cx", "cy", "ix", "iy", "ox", "oy")
    rows = _columns(
        table,
        ("road", "section", "lane", "type", "s", "t_inner", "t_outer", *points),
        f"{name}.lanes",
        report,
    )
    by_lane: dict[LaneKey, list[int]] = defaultdict(list)
    for index, key in enumerate(zip(rows["road"], rows["section"], rows["lane"], strict=True)):
        by_lane[LaneKey(*key)].append(index)
    known = {
        LaneKey(road.id, index, lane)
        for road in od.roads.values()
        for index, section in enumerate(road.sections)
        for lane in section.lanes
    }
    report.compare("lanes of the reference exist", name, [], sorted(set(by_lane) - known))
    for key in sorted(set(by_lane) & known):
        where = f"{name} road {key.road} section {key.section} lane {key.lane}"
        pick = {column: [values[i] for i in by_lane[key]] for column, values in rows.items()}
        road, s = od.roads[key.road], np.array(pick["s"], np.float64)
        line = ReferenceLine(road.geometries)
        lane_type = road.sections[key.section].lanes[key.lane].type
        report.compare("lane type", where, [lane_type] * len(s), pick["type"])
        begin, end = road.sections[key.section].s, road.section_end(key.section)
        inside = (s >= begin - 1e-9) & (s <= end + 1e-9)
        report.compare("lane row lies in its section", where, inside, np.full(len(s), True))
        borders, poses = section_borders(road, key.section, s), line.evaluate(s)
        inner, outer = borders.inner[key.lane], borders.outer[key.lane]
        report.compare("lane border t", where, inner, pick["t_inner"], atol=POSITION)
        report.compare("lane border t", where, outer, pick["t_outer"], atol=POSITION)
        atol = _tolerances(line, s)
        for letter, t in (("c", 0.5 * (inner + outer)), ("i", inner), ("o", outer)):
            xy = poses.offset(t)
            for axis, column in enumerate((f"{letter}x", f"{letter}y")):
                _compare_rows(report, "lane points", where, xy[:, axis], pick[column], atol)


def _verify_topology(od: OpenDrive, table: pa.Table, name: str, report: Report) -> None:
    names = [
        f"{side}_{what}" for side in ("from", "to") for what in ("road", "section", "lane", "type")
    ]
    rows = _columns(table, names, f"{name}.topology", report)

    def entry(key: LaneKey) -> list[str]:
        lane = od.roads[key.road].sections[key.section].lanes[key.lane]
        return [key.road, str(key.section), str(key.lane), lane.type]

    ours = sorted(" ".join(entry(a) + entry(b)) for a, b in lane_links(od, Counter()))
    theirs = sorted(" ".join(map(str, row)) for row in zip(*(rows[n] for n in names), strict=True))
    report.compare("number of lane links", name, len(ours), len(theirs))
    for missing in sorted(set(theirs) - set(ours)):
        report.fail("lane links", name, f"we lack {missing}")
    for extra in sorted(set(ours) - set(theirs)):
        report.fail("lane links", name, f"the reference lacks {extra}")


def _crosswalks(od: OpenDrive) -> list[tuple[Road, RoadObject]]:
    return [(r, thing) for r in od.roads.values() for thing in r.objects if is_crosswalk(thing)]


def _verify_crosswalks(od: OpenDrive, rows: Any, name: str, report: Report) -> None:
    things = {(road.id, thing.id): (road, thing) for road, thing in _crosswalks(od)}
    keys = [(row["road"], row["object"]) for row in rows]
    report.compare("crosswalks", name, sorted(map(str, things)), sorted(map(str, keys)))
    for key, row in zip(keys, rows, strict=True):
        if key not in things:
            continue
        for extra in sorted(set(row) - {"road", "object", "outline", "centre", "polygon"}):
            report.skip(f"{name}.crosswalks: {extra}")
        road, thing = things[key]
        where, line = f"{name} object {key[1]}", ReferenceLine(road.geometries)
        outline = "box"
        if thing.outlines:
            outline = "cornerRoad" if thing.outlines[0].on_road else "cornerLocal"
        report.compare("outline kind", where, outline, row["outline"])
        atol = float(_tolerances(line, np.array([thing.s]))[0])
        report.compare("crosswalk", where, object_origin(line, thing), row["centre"], atol=atol)
        report.compare("crosswalk", where, object_rings(line, thing)[0], row["polygon"], atol=atol)


def _verify_summary(od: OpenDrive, path: Path, summary: dict[str, Any], report: Report) -> None:
    ours = summarize(od, path)
    for key, expected in summary.items():
        where = f"{path.stem} {key}"
        if key == "max_geometry_gap_at":
            _verify_gap_place(od, summary, where, report)
        elif key not in ours:
            report.skip(where)
        elif isinstance(expected, dict) or expected is None or ours[key] is None:
            same = ours[key] == expected
            report.compare(
                "summary",
                where,
                repr(ours[key]) if not same else "",
                repr(expected) if not same else "",
            )
        elif isinstance(expected, float) and "length" in key:
            atol = max(LENGTH_SHARE * abs(expected), LENGTH)
            report.compare("length", where, ours[key], expected, atol=atol)
        elif isinstance(expected, float):
            cubic = any(road_has(road, "paramPoly3") for road in od.roads.values())
            atol = CUBIC_POSITION if cubic else POSITION
            report.compare("largest gap or deviation", where, ours[key], expected, atol=atol)
        else:
            report.compare("summary", where, ours[key], expected)
    for key in sorted(set(ours) - set(summary)):
        report.fail("summary", path.stem, f"the reference lacks {key}")


def road_has(road: Road, kind: str) -> bool:
    """Whether a reference line has a record of a kind."""
    return any(geometry.kind == kind for geometry in road.geometries)


def _verify_gap_place(od: OpenDrive, summary: dict[str, Any], where: str, report: Report) -> None:
    """The place of the largest gap; where many gaps are rounding noise, one as large as ours."""
    place, largest = summary["max_geometry_gap_at"], summary["max_geometry_gap_m"]
    if place is None:
        report.compare("largest gap", where, largest, 0.0)
        return
    road = od.roads[place[0]]
    joints = np.array([geometry.s for geometry in road.geometries[1:]])
    index = int(np.argmin(np.abs(joints - place[1])))
    report.compare("place of the largest gap", where, joints[index], place[1], atol=1e-9)
    gap = float(ReferenceLine(road.geometries).joints()[0][index])
    report.compare("largest gap", where, gap, largest, atol=POSITION)


def _counts(od: OpenDrive, prefix: str) -> dict[str, int]:
    start = prefix + " "
    return {k[len(start) :]: n for k, n in od.counts.items() if k.startswith(start)}


def summarize(od: OpenDrive, path: Path) -> dict[str, Any]:
    """Counts and lengths of a file, as in the reference summaries."""
    gaps, turns, deviation = [0.0], [0.0], [0.0]
    s_length, center_length = 0.0, 0.0
    for road in od.roads.values():
        line = ReferenceLine(road.geometries)
        joints = line.joints()
        gaps += joints[0].tolist()
        turns += joints[1].tolist()
        deviation += [arc_length_deviation(g) for g in road.geometries if g.kind == "paramPoly3"]
        lengths = _driving_lengths(road, ReferenceLine(road.geometries, stretched=False))
        s_length += lengths[0]
        center_length += lengths[1]
    links = [(_type(od, a), _type(od, b), a) for a, b in lane_links(od, Counter())]
    left = {a for start, end, a in links if start == end == "driving"}
    lane_types = _counts(od, "lane type")
    return {
        "map": path.name,
        "bytes": path.stat().st_size,
        "revision": list(od.revision),
        "geoReference": od.geo_reference,
        "header_offset": None if od.offset is None else list(od.offset),
        "roads": od.counts.get("road", 0),
        "roads_in_junctions": od.counts.get("road in a junction", 0),
        "junctions": len(od.junctions),
        "junction_types": _counts(od, "junction type"),
        "connections": od.counts.get("connection", 0),
        "lane_links_in_junctions": od.counts.get("lane link in a junction", 0),
        "lane_sections": od.counts.get("lane section", 0),
        "lanes": sum(lane_types.values()),
        "lane_types": lane_types,
        "geometry_kinds": _counts(od, "geometry"),
        "driving_lanes": lane_types.get("driving", 0),
        "driving_s_length_m": s_length,
        "driving_centreline_length_m": center_length,
        "road_length_sum_m": float(sum(road.stated_length for road in od.roads.values())),
        "left_hand_roads": od.counts.get("road with left-hand traffic", 0),
        "width_records": od.counts.get("width", 0),
        "border_records": od.counts.get("border", 0),
        "lane_offset_records": od.counts.get("laneOffset", 0),
        "speed_records": _counts(od, "speed"),
        "objects": _counts(od, "object"),
        "signals": _counts(od, "signal"),
        "max_geometry_gap_m": max(gaps),
        "max_geometry_heading_gap_rad": max(turns),
        "parampoly3_arc_vs_linear_param_max_m": max(deviation),
        "crosswalk_objects": len(_crosswalks(od)),
        "lane_edges_all_types": len(links),
        "lane_edges_driving_to_driving": sum(a == b == "driving" for a, b, _ in links),
        "driving_lanes_without_successor": lane_types.get("driving", 0) - len(left),
    }


def _type(od: OpenDrive, key: LaneKey) -> str:
    return od.roads[key.road].sections[key.section].lanes[key.lane].type


def _driving_lengths(road: Road, line: ReferenceLine) -> tuple[float, float]:
    """Section length times driving lanes, and length of the centre lines of driving lanes [m]."""
    along, center = 0.0, 0.0
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


def _verify_crosscheck(folder: Path, report: Report) -> None:
    """Row counts of the reference's own comparison; its errors are those of another reader."""
    try:
        rows = json.loads((folder / _CROSSCHECK).read_text()).items()
    except (OSError, ValueError) as error:
        report.fail("file", _CROSSCHECK, str(error))
        return
    report.note("errors of libOpenDRIVE in crosscheck_libopendrive.json")
    for name, entry in rows:
        for part, number in zip(("refline", "lanes"), entry.get("rows", ()), strict=False):
            path = folder / f"{name}.{part}.parquet"
            count = pq.read_metadata(path).num_rows if path.is_file() else None
            report.compare("rows of the reference", f"{name}.{part}", count, number)
        summary = folder / f"{name}.summary.json"
        if "roads_junctions" in entry and summary.is_file():
            values = json.loads(summary.read_text())
            ours = [values["roads"], values["junctions"]]
            report.compare("roads and junctions", name, ours, entry["roads_junctions"])
        has_golden = (folder / f"{name}.refline.parquet").is_file()
        report.compare("status", name, "compared" if has_golden else "no golden", entry["status"])
