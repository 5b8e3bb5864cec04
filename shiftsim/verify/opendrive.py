"""The OpenDRIVE reader against sampled reference lines, lanes, links and counts of real maps."""

from collections import Counter
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.opendrive.areas import is_crosswalk, object_origin, object_rings
from shiftsim.data.opendrive.curves import ReferenceLine, arc_length_deviation
from shiftsim.data.opendrive.lanes import LaneKey, lane_links, section_borders
from shiftsim.data.opendrive.reading import read_opendrive
from shiftsim.data.opendrive.records import Lane, OpenDrive, Road
from shiftsim.verify.files import COMPARED, Source, read_json, read_table, verify_files
from shiftsim.verify.report import Report

EXACT = 1e-6  # m, rad: tolerance of the folder's README
CUBIC, CUBIC_HEADING = 2e-3, 1e-3  # m, rad: paramPoly3
LENGTH_SHARE, LENGTH = 1e-3, 0.05  # of a length, or m
COUNTS, TALLIES = (COMPARED["summary.json"][name] for name in ("counts", "tallies"))
_CENTER_STEP = 0.25  # m, spacing of the summary's centre lines


def verify_opendrive(folder: Path, report: Report, maps: Path | None = None) -> None:
    """Compare our reading of the maps with the files `<map>.<kind>` of a folder.

    The .xodr files lie at any depth of `maps`, by default of the one beside the parent of `folder`.
    """
    place = maps or folder.resolve().parent.parent / "maps"
    by_name = {path.stem: path for path in sorted(place.rglob("*.xodr"))}
    read = lru_cache(maxsize=1)(read_opendrive)

    def part(compare: Callable[[OpenDrive, Source, Path], None], path: Path) -> None:
        name = path.name.partition(".")[0]
        if name not in by_name:
            report.skip(f"map {name}.xodr not found")
            return
        if path.suffix == ".parquet":
            file = read_table(path, report)
        else:
            content = read_json(path)  # crosswalks are a list
            content = content if isinstance(content, dict) else {"rows": content}
            file = Source(path.stem, "field", content, report)
        compare(read(by_name[name]), file, by_name[name])
        if path.suffix == ".json" or file.num_rows:
            file.finish()

    parts: dict[str, Callable[[Path], object]] = {
        "crosscheck_libopendrive.json": partial(_verify_crosscheck, report),
        "*.refline.parquet": partial(part, _verify_reference_lines),
        "*.lanes.parquet": partial(part, _verify_lanes),
        "*.topology.parquet": partial(part, _verify_topology),
        "*.summary.json": partial(part, _verify_summary),
        "*.crosswalks.json": partial(part, _verify_crosswalks),
    }
    verify_files(folder, report, parts)


def _tolerance(line: ReferenceLine, s: FloatArray, cubic: float = CUBIC) -> FloatArray:
    return np.where([kind == "paramPoly3" for kind in line.kinds(s)], cubic, EXACT)


def _verify_reference_lines(od: OpenDrive, file: Source, path: Path) -> None:
    compare, roads = file.report.compare, file.groups("road")
    compare(
        "roads with a reference line", path.stem, sorted(od.roads), [r for (r,) in sorted(roads)]
    )
    for (name,), rows in roads.items():
        where, road, s = f"{path.stem} road {name}", od.roads[name], rows["s"]
        line = ReferenceLine(road.geometries)
        poses, atol = line.evaluate(s), _tolerance(line, s)
        ours = {"x": poses.x, "y": poses.y, "hdg": poses.heading, "kind": line.kinds(s)}
        bounds = {"": atol, "hdg": _tolerance(line, s, CUBIC_HEADING)}
        rows.match(where, ours, bounds, quantity="reference line", angles={"hdg"})
        compare("road extent", where, [0.0, road.stated_length], s[[0, -1]], atol=EXACT)
        compare("heading is wrapped", where, np.abs(rows["hdg"]).max() <= np.pi, True)


def _verify_lanes(od: OpenDrive, file: Source, path: Path) -> None:
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
        ours = {"type": [lanes[key].type] * len(s), "t_inner": inner, "t_outer": outer}
        for letter, t in {"c": 0.5 * (inner + outer), "i": inner, "o": outer}.items():
            ours |= dict(zip((f"{letter}x", f"{letter}y"), poses.offset(t).T, strict=True))
        atol: dict[str, Any] = {"t_inner": EXACT, "t_outer": EXACT, "": _tolerance(line, s)}
        rows.match(where, ours, atol, quantity="lane")


def _lanes(od: OpenDrive) -> dict[LaneKey, Lane]:
    return {
        LaneKey(road.id, index, number): lane
        for road in od.roads.values()
        for index, section in enumerate(road.sections)
        for number, lane in section.lanes.items()
    }


def _verify_topology(od: OpenDrive, file: Source, path: Path) -> None:
    lanes, links = _lanes(od), lane_links(od, Counter())
    ends = [
        f"{end}_{what}" for end in ("from", "to") for what in ("road", "section", "lane", "type")
    ]
    theirs = {" ".join(map(str, row)) for row in zip(*map(file.__getitem__, ends), strict=True)}
    ours = {
        " ".join(f"{k.road} {k.section} {k.lane} {lanes[k].type}" for k in link) for link in links
    }
    file.report.compare("number of lane links", path.stem, len(links), file.num_rows)
    file.report.compare("lane links", path.stem, sorted(ours), sorted(theirs))


def _verify_crosswalks(od: OpenDrive, file: Source, path: Path) -> None:
    pairs = [(r, thing) for r in od.roads.values() for thing in r.objects if is_crosswalk(thing)]
    known = {f"{road.id} {thing.id}": (road, thing) for road, thing in pairs}
    rows = {f"{row['road']} {row['object']}": row for row in file.each("rows")}
    file.report.compare("crosswalks", path.stem, sorted(known), sorted(rows))
    for key in set(known) & set(rows):
        road, thing = known[key]
        line, outline = ReferenceLine(road.geometries), "box"
        if thing.outlines:
            outline = "cornerRoad" if thing.outlines[0].on_road else "cornerLocal"
        centre, polygon = object_origin(line, thing), object_rings(line, thing)[0]
        ours = {"outline": outline, "centre": centre, "polygon": polygon}
        atol = {"": float(_tolerance(line, np.array([thing.s]))[0])}
        rows[key].match(f"{path.stem} object {key}", ours, atol, quantity="crosswalk")


def _verify_summary(od: OpenDrive, file: Source, path: Path) -> None:
    gap = CUBIC if od.counts.get("geometry paramPoly3") else EXACT
    for key, value in summarize(od, path).items():
        length = max(LENGTH_SHARE * abs(file[key]), LENGTH) if "length" in key else 0.0
        atol = gap if key.startswith(("max_", "parampoly3_")) else length
        file.match(f"{path.stem} {key}", {key: value}, atol, quantity="summary")
    # of the largest gap; where many gaps are rounding noise, one as large as ours
    place, gaps, where = (
        file["max_geometry_gap_at"],
        np.zeros(1),
        f"{path.stem} max_geometry_gap_at",
    )
    if place is not None:
        geometries = od.roads[place[0]].geometries
        distance = np.abs([geometry.s - place[1] for geometry in geometries[1:]])
        file.report.compare("place of the largest gap", where, distance.min(), 0.0, atol=1e-9)
        gaps = ReferenceLine(geometries).joints()[0][[distance.argmin()]]
    file.report.compare("largest gap", where, gaps[0], file["max_geometry_gap_m"], atol=EXACT)


def summarize(od: OpenDrive, path: Path) -> dict[str, Any]:
    """Counts and lengths of a file, as in the reference summaries."""
    lanes, roads, links = _lanes(od), od.roads.values(), lane_links(od, Counter())
    joints = [np.array(ReferenceLine(road.geometries).joints()) for road in roads]
    gaps, turns = np.concatenate([np.zeros((2, 1)), *joints], axis=1)
    cubics = [g for road in roads for g in road.geometries if g.kind == "paramPoly3"]
    lengths = np.sum([(0.0, 0.0), *map(_driving_lengths, roads)], axis=0).tolist()
    driving = [pair for pair in links if {lanes[key].type for key in pair} == {"driving"}]
    tallies = {
        key: {k.removeprefix(start): n for k, n in od.counts.items() if k.startswith(start)}
        for key, start in TALLIES.items()
    }
    num_driving = tallies["lane_types"].get("driving", 0)
    return {
        **{key: od.counts.get(name, 0) for key, name in COUNTS.items()},
        **tallies,
        "map": path.name,
        "bytes": path.stat().st_size,
        "revision": list(od.revision),
        "geoReference": od.geo_reference,
        "header_offset": None if od.offset is None else list(od.offset),
        "junctions": len(od.junctions),
        "lanes": sum(tallies["lane_types"].values()),
        "driving_lanes": num_driving,
        "driving_s_length_m": lengths[0],
        "driving_centreline_length_m": lengths[1],
        "road_length_sum_m": float(sum(road.stated_length for road in roads)),
        "max_geometry_gap_m": gaps.max(),
        "max_geometry_heading_gap_rad": turns.max(),
        "parampoly3_arc_vs_linear_param_max_m": max(map(arc_length_deviation, cubics), default=0.0),
        "crosswalk_objects": sum(is_crosswalk(thing) for road in roads for thing in road.objects),
        "lane_edges_all_types": len(links),
        "lane_edges_driving_to_driving": len(driving),
        "driving_lanes_without_successor": num_driving - len({start for start, _ in driving}),
    }


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


def _verify_crosscheck(report: Report, path: Path) -> None:
    """Row counts of the reference's own comparison; its errors are those of another reader."""
    report.note(f"errors of libOpenDRIVE in {path.name}")
    for name, entry in read_json(path).items():
        tables = [path.with_name(f"{name}.{kind}.parquet") for kind in ("refline", "lanes")]
        status = "compared" if tables[0].is_file() else "no golden"
        report.compare("status", name, status, entry["status"])
        for table, count in zip(tables, entry.get("rows", ()), strict=False):
            rows = read_table(table, report).num_rows if table.is_file() else None
            report.compare("rows of the reference", name, rows, count)
        summary = path.with_name(f"{name}.summary.json")
        if "roads_junctions" in entry and summary.is_file():
            values = read_json(summary)
            ours = [values["roads"], values["junctions"]]
            report.compare("roads and junctions", name, ours, entry["roads_junctions"])
