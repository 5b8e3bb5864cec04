"""nuPlan's map.gpkg -> VectorMap."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.nuplan.geopackage import REPAIR, GeoPackage, LayerTable
from shiftsim.data.nuplan.sqlite import open_database
from shiftsim.errors import DataError, MapError
from shiftsim.world.map import AreaSpec, BlockSpec, EdgeSpec, VectorMap, build_map

_MIN_OVERLAP = 1.0  # m^2; neighbouring polygons share borders up to rounding
_BIKE_LANE = 1
_TURN_UNKNOWN = 4

# nuPlan rule 421: the drivable area is the rows of these layers, one after the other
_DRIVABLE_LAYERS = ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas")


def read_map(path: Path, name: str) -> VectorMap:
    """Read a nuPlan map.

    Args:
        path: The file `map.gpkg`.
        name: Name of the map (city).

    Returns:
        The map in metres. Flaws that nuPlan tolerates are counted in its `flaws`.

    Raises:
        DataError: The file is missing or broken, or lacks a layer or column.
    """
    with open_database(Path(path)) as database:
        try:
            return _assemble(GeoPackage(database), name)
        except MapError as error:
            raise MapError(f"{path}: {error}", hint=REPAIR) from error
        except DataError as error:
            if str(error).startswith(str(path)):
                raise
            raise DataError(f"{path}: {error}", hint=error.hint) from error


def _assemble(gpkg: GeoPackage, name: str) -> VectorMap:
    flaws: dict[str, int] = {}
    boundaries = _lines(gpkg.table("boundaries"))
    baselines = _baselines(gpkg)
    intersections = gpkg.table("intersections", extra=["intersection_type_fid"])
    stops = gpkg.table("stop_polygons", ["stop_polygon_type_fid"])
    connectors = gpkg.table(
        "lane_connectors",
        [
            "exit_lane_fid",
            "entry_lane_fid",
            "lane_group_connector_fid",
            "speed_limit_mps",
            "traffic_light_stop_line_fids",
        ],
        ["intersection_fid", "turn_type_fid"],
    )
    edges = [
        *_lanes(gpkg, baselines, boundaries, connectors, flaws),
        *_connectors(gpkg, baselines, boundaries, connectors, stops, flaws),
    ]
    blocks = _blocks(gpkg, flaws)
    lanes = [spec.polygon for spec in edges if not spec.is_connector]
    _count(flaws, "overlapping lanes", _num_overlaps(lanes))
    roadblocks = [spec.polygon for spec in blocks if not spec.is_connector]
    _count(flaws, "overlapping roadblocks", _num_overlaps(roadblocks))
    tables = {t: gpkg.table(t) for t in _DRIVABLE_LAYERS if t != "intersections"}
    tables["intersections"] = intersections
    road = build_map(
        name,
        epsg=gpkg.epsg,
        edges=edges,
        blocks=blocks,
        intersections=_areas(intersections, intersections.integers("intersection_type_fid", 0)),
        stop_polygons=_areas(stops, stops.integers("stop_polygon_type_fid", 5)),
        crosswalks=_areas(gpkg.table("crosswalks")),
        walkways=_areas(gpkg.table("walkways")),
        car_parks=_areas(tables["carpark_areas"]),
        drivable_areas=[area for layer in _DRIVABLE_LAYERS for area in _areas(tables[layer])],
    )
    return replace(road, flaws={**flaws, **road.flaws})


def _count(flaws: dict[str, int], flaw: str, number: int) -> None:
    if number:
        flaws[flaw] = flaws.get(flaw, 0) + number


def _lines(table: LayerTable) -> dict[str, FloatArray]:
    for fid, shape in zip(table.ids, table.shapes, strict=True):
        if shape.geom_type != "LineString":
            raise DataError(
                f"layer {table.name!r}: geometry of fid {fid} is a {shape.geom_type}", hint=REPAIR
            )
    return {
        fid: shapely.get_coordinates(shape)
        for fid, shape in zip(table.ids, table.shapes, strict=True)
    }


def _baselines(gpkg: GeoPackage) -> dict[str, FloatArray]:
    table = gpkg.table("baseline_paths", ["lane_fid", "lane_connector_fid"])
    lines = _lines(table)
    out: dict[str, FloatArray] = {}
    lanes, connectors = table.text_ids("lane_fid"), table.text_ids("lane_connector_fid")
    for fid, lane, connector in zip(table.ids, lanes, connectors, strict=True):
        for owner in (lane, connector):
            if owner is not None:
                out.setdefault(owner, lines[fid])
    return out


def _lanes(
    gpkg: GeoPackage,
    baselines: dict[str, FloatArray],
    boundaries: dict[str, FloatArray],
    connectors: LayerTable,
    flaws: dict[str, int],
) -> list[EdgeSpec]:
    table = gpkg.table(
        "lanes_polygons",
        [
            "lane_fid",
            "lane_group_fid",
            "lane_index",
            "left_boundary_fid",
            "right_boundary_fid",
            "speed_limit_mps",
        ],
        ["lane_type_fid"],
    )
    outgoing = _group(connectors.text_ids("exit_lane_fid"), connectors.ids)
    incoming = _group(connectors.text_ids("entry_lane_fid"), connectors.ids)
    groups, indices = table.text_ids("lane_group_fid"), table.integers("lane_index", -1)
    left, right = table.text_ids("left_boundary_fid"), table.text_ids("right_boundary_fid")
    lane_at = {
        (group, index): fid for group, index, fid in zip(groups, indices, table.ids, strict=True)
    }
    different = sum(i != j for i, j in zip(table.ids, table.text_ids("lane_fid"), strict=True))
    _count(flaws, "lane_fid differs from fid", different)
    kinds = table.integers("lane_type_fid", 0)
    return [
        EdgeSpec(
            id=fid,
            is_connector=False,
            polygon=_one_polygon(table, row, flaws),
            baseline=_find(baselines, fid, "lane", "baseline"),
            block_id=groups[row] or "",
            incoming=incoming.get(fid, []),
            outgoing=outgoing.get(fid, []),
            left=_optional(boundaries, left[row], flaws),
            right=_optional(boundaries, right[row], flaws),
            left_id=left[row] or "",
            right_id=right[row] or "",
            speed_limit=_speed(table, row),
            lane_index=indices[row],
            left_lane=lane_at.get((groups[row], indices[row] - 1)),
            right_lane=lane_at.get((groups[row], indices[row] + 1)),
            is_bike=kinds[row] == _BIKE_LANE,
        )
        for row, fid in enumerate(table.ids)
    ]


def _connectors(
    gpkg: GeoPackage,
    baselines: dict[str, FloatArray],
    boundaries: dict[str, FloatArray],
    table: LayerTable,
    stops: LayerTable,
    flaws: dict[str, int],
) -> list[EdgeSpec]:
    areas = gpkg.table(
        "gen_lane_connectors_scaled_width_polygons",
        ["lane_connector_fid", "left_boundary_fid", "right_boundary_fid"],
    )
    row_of = {fid: row for row, fid in enumerate(table.ids)}
    owners = areas.text_ids("lane_connector_fid")
    bare = set(table.ids) - set(owners)
    if bare:
        raise DataError(f"lane connector {min(bare)!r} has no polygon", hint=REPAIR)
    left, right = areas.text_ids("left_boundary_fid"), areas.text_ids("right_boundary_fid")
    start, end = table.text_ids("exit_lane_fid"), table.text_ids("entry_lane_fid")
    groups = table.text_ids("lane_group_connector_fid")
    crossings = table.text_ids("intersection_fid")
    turns = table.integers("turn_type_fid", _TURN_UNKNOWN)
    stop_shapes = dict(zip(stops.ids, stops.shapes, strict=True))
    out = []
    # nuPlan rule 424: in the order of the polygons
    for area, fid in enumerate(owners):
        if fid is None or fid not in row_of:
            _count(flaws, "polygon of an unknown lane connector", 1)
            continue
        row = row_of[fid]
        baseline = _find(baselines, fid, "lane connector", "baseline")
        listed = str(table.columns["traffic_light_stop_line_fids"][row] or "")
        out.append(
            EdgeSpec(
                id=fid,
                is_connector=True,
                polygon=_one_polygon(areas, area, flaws),
                baseline=baseline,
                block_id=groups[row] or "",
                incoming=_known(start[row]),
                outgoing=_known(end[row]),
                left=_optional(boundaries, left[area], flaws),
                right=_optional(boundaries, right[area], flaws),
                left_id=left[area] or "",
                right_id=right[area] or "",
                speed_limit=_speed(table, row),
                has_traffic_lights=listed != "",  # nuPlan rule 423
                stop_lines=_stop_lines(listed, baseline, stop_shapes),
                intersection_id=crossings[row],
                turn_type=turns[row],
            )
        )
    return out


def _blocks(gpkg: GeoPackage, flaws: dict[str, int]) -> list[BlockSpec]:
    roadblocks = gpkg.table("lane_groups_polygons")
    links = gpkg.table(
        "lane_group_connectors", ["from_lane_group_fid", "to_lane_group_fid", "intersection_fid"]
    )
    start, end = links.text_ids("from_lane_group_fid"), links.text_ids("to_lane_group_fid")
    crossings = links.text_ids("intersection_fid")
    outgoing, incoming = _group(start, links.ids), _group(end, links.ids)
    out = [
        BlockSpec(
            fid,
            False,
            _one_polygon(roadblocks, row, flaws),
            incoming.get(fid, []),
            outgoing.get(fid, []),
        )
        for row, fid in enumerate(roadblocks.ids)
    ]
    out += [
        BlockSpec(
            fid,
            True,
            _one_polygon(links, row, flaws),
            _known(start[row]),
            _known(end[row]),
            crossings[row],
        )
        for row, fid in enumerate(links.ids)
    ]
    return out


def _stop_lines(
    listed: str, baseline: FloatArray, polygons: dict[str, shapely.Polygon]
) -> list[str]:
    # nuPlan rule 422: those that meet the baseline, else the nearest one. Unknown ids stay, for
    # `build_map` to count them.
    ids = [part.strip() for part in listed.split(",") if part.strip()]
    unknown = [i for i in ids if i not in polygons]
    known = [i for i in ids if i in polygons]
    line = shapely.LineString(baseline)
    meeting = [i for i in known if shapely.intersects(polygons[i], line)]
    if not meeting and known:
        first = shapely.Point(baseline[0])
        meeting = [min(known, key=lambda i: float(shapely.distance(polygons[i], first)))]
    return meeting + unknown


def _group(keys: Sequence[str | None], ids: Sequence[str]) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for key, fid in zip(keys, ids, strict=True):
        if key is not None:
            out.setdefault(key, []).append(fid)
    return out


def _known(fid: str | None) -> list[str]:
    return [] if fid is None else [fid]


def _find(lines: dict[str, FloatArray], fid: str, owner: str, what: str) -> FloatArray:
    if fid not in lines:
        raise DataError(f"{owner} {fid!r} has no {what}", hint=REPAIR)
    return lines[fid]


def _optional(
    lines: dict[str, FloatArray], fid: str | None, flaws: dict[str, int]
) -> FloatArray | None:
    if fid is not None and fid not in lines:
        _count(flaws, "edge names an unknown boundary", 1)
    return None if fid is None else lines.get(fid)


def _speed(table: LayerTable, row: int) -> float | None:
    value = table.columns["speed_limit_mps"][row]
    if value is None:
        return None
    if not isinstance(value, int | float):
        raise DataError(
            f"layer {table.name!r}: speed_limit_mps of fid {table.ids[row]} is {value!r}",
            hint=REPAIR,
        )
    return float(value)


def _one_polygon(table: LayerTable, row: int, flaws: dict[str, int]) -> shapely.Polygon:
    parts = _polygons(table, row)
    if len(parts) > 1:
        _count(flaws, "lane or roadblock in several pieces: the largest is kept", 1)
    return max(parts, key=lambda part: float(shapely.area(part)))


def _polygons(table: LayerTable, row: int) -> list[shapely.Polygon]:
    parts = list(shapely.get_parts(table.shapes[row]))
    if not parts or any(p.geom_type != "Polygon" or shapely.is_empty(p) for p in parts):
        kind = table.shapes[row].geom_type
        raise DataError(
            f"layer {table.name!r}: geometry of fid {table.ids[row]} is a {kind} without area",
            hint=REPAIR,
        )
    return parts


def _areas(table: LayerTable, kinds: Sequence[int] | None = None) -> list[AreaSpec]:
    return [
        AreaSpec(fid, part, 0 if kinds is None else kinds[row])
        for row, fid in enumerate(table.ids)
        for part in _polygons(table, row)
    ]


def _num_overlaps(polygons: Sequence[shapely.Polygon]) -> int:
    shapes = np.array(polygons, object)
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    pairs = first < second
    common = [
        _common_area(a, b) for a, b in zip(shapes[first[pairs]], shapes[second[pairs]], strict=True)
    ]
    return sum(area > _MIN_OVERLAP for area in common)


def _common_area(a: shapely.Polygon, b: shapely.Polygon) -> float:
    try:
        return float(shapely.area(shapely.intersection(a, b)))
    except shapely.errors.GEOSException:  # a polygon that crosses itself
        return float(shapely.area(shapely.intersection(shapely.buffer(a, 0), shapely.buffer(b, 0))))
