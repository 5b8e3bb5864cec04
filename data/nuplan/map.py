"""nuPlan's map.gpkg -> VectorMap."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import shapely

from shiftsim.data.nuplan.sqlite import REPAIR, GeoPackage, LayerTable, open_database
from shiftsim.data.polygons import shared_areas
from shiftsim.errors import DataError, MapError
from shiftsim.kernels import FloatArray
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import NUPLAN_MAP, require

_MIN_OVERLAP = 1.0  # m^2; neighbouring polygons share borders up to rounding
_BIKE_LANE = 1
_TURN_UNKNOWN = 4

# nuPlan rule 421: the drivable area is the rows of these layers, one after the other
_DRIVABLE_LAYERS = ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas")


def read_map(path: Path, name: str) -> VectorMap:
    """A nuPlan map from `map.gpkg`, in metres; its `flaws` count what nuPlan tolerates, too."""
    with open_database(Path(path)) as database:
        try:
            return _assemble(GeoPackage(database), name)
        except MapError as error:
            raise MapError(f"{path}: {error.message}", hint=REPAIR) from error
        except DataError as error:
            if error.message.startswith(str(path)):
                raise
            raise DataError(f"{path}: {error.message}", hint=error.hint) from error


def _assemble(gpkg: GeoPackage, name: str) -> VectorMap:
    flaws: Counter[str] = Counter()
    boundaries = _lines(gpkg.table("boundaries"))
    baselines = _baselines(gpkg)
    intersections = gpkg.table("intersections", extra="intersection_type_fid")
    stops = gpkg.table("stop_polygons", "stop_polygon_type_fid")
    connectors = gpkg.table(
        "lane_connectors",
        "exit_lane_fid entry_lane_fid lane_group_connector_fid speed_limit_mps"
        " traffic_light_stop_line_fids",
        extra="intersection_fid turn_type_fid",
    )
    edges = [
        *_lanes(gpkg, baselines, boundaries, connectors, flaws),
        *_connectors(gpkg, baselines, boundaries, connectors, stops, flaws),
    ]
    blocks = _blocks(gpkg, flaws)
    lanes = [spec.polygon for spec in edges if not spec.is_connector]
    flaws["overlapping lanes"] += _num_overlaps(lanes)
    roadblocks = [spec.polygon for spec in blocks if not spec.is_connector]
    flaws["overlapping roadblocks"] += _num_overlaps(roadblocks)
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
    return replace(road, flaws={**+flaws, **road.flaws})


def _lines(table: LayerTable) -> dict[str, FloatArray]:
    for fid, shape in zip(table.ids, table.shapes, strict=True):
        if shape.geom_type != "LineString":
            what = f"geometry of fid {fid} is a {shape.geom_type}"
            raise DataError(f"layer {table.name!r}: {what}", hint=REPAIR)
    return dict(zip(table.ids, map(shapely.get_coordinates, table.shapes), strict=True))


def _baselines(gpkg: GeoPackage) -> dict[str, FloatArray]:
    table = gpkg.table("baseline_paths", "lane_fid lane_connector_fid")
    lines, out = _lines(table), dict[str, FloatArray]()
    owners = table.text_ids("lane_fid"), table.text_ids("lane_connector_fid")
    for fid, *pair in zip(table.ids, *owners, strict=True):
        for owner in pair:
            if owner is not None:
                out.setdefault(owner, lines[fid])
    return out


def _lanes(
    gpkg: GeoPackage,
    baselines: dict[str, FloatArray],
    boundaries: dict[str, FloatArray],
    connectors: LayerTable,
    flaws: Counter[str],
) -> list[EdgeSpec]:
    table = gpkg.table(
        "lanes_polygons",
        "lane_fid lane_group_fid lane_index left_boundary_fid right_boundary_fid speed_limit_mps",
        extra="lane_type_fid",
    )
    outgoing = _group(connectors.text_ids("exit_lane_fid"), connectors.ids)
    incoming = _group(connectors.text_ids("entry_lane_fid"), connectors.ids)
    groups, indices = table.text_ids("lane_group_fid"), table.integers("lane_index", -1)
    borders = _Borders(boundaries, table)
    lane_at = {
        (group, index): fid for group, index, fid in zip(groups, indices, table.ids, strict=True)
    }
    different = sum(i != j for i, j in zip(table.ids, table.text_ids("lane_fid"), strict=True))
    flaws["lane_fid differs from fid"] += different
    kinds = table.integers("lane_type_fid", 0)
    return [
        EdgeSpec(
            id=fid,
            is_connector=False,
            polygon=_one_polygon(table, row, flaws),
            baseline=_find(baselines, fid, "lane"),
            block_id=groups[row] or "",
            incoming=incoming.get(fid, []),
            outgoing=outgoing.get(fid, []),
            **borders.at(row, flaws),
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
    flaws: Counter[str],
) -> list[EdgeSpec]:
    areas = gpkg.table(
        "gen_lane_connectors_scaled_width_polygons",
        "lane_connector_fid left_boundary_fid right_boundary_fid",
    )
    row_of = {fid: row for row, fid in enumerate(table.ids)}
    owners = areas.text_ids("lane_connector_fid")
    bare = set(table.ids) - set(owners)
    if bare:
        raise DataError(f"lane connector {min(bare)!r} has no polygon", hint=REPAIR)
    borders = _Borders(boundaries, areas)
    start, end = table.text_ids("exit_lane_fid"), table.text_ids("entry_lane_fid")
    groups = table.text_ids("lane_group_connector_fid")
    crossings = table.text_ids("intersection_fid")
    turns = table.integers("turn_type_fid", _TURN_UNKNOWN)
    stop_shapes = dict(zip(stops.ids, stops.shapes, strict=True))
    out = []
    # nuPlan rule 424: in the order of the polygons
    for area, fid in enumerate(owners):
        if fid is None or fid not in row_of:
            flaws["polygon of an unknown lane connector"] += 1
            continue
        row = row_of[fid]
        baseline = _find(baselines, fid, "lane connector")
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
                **borders.at(area, flaws),
                speed_limit=_speed(table, row),
                has_traffic_lights=listed != "",  # nuPlan rule 423
                stop_lines=_stop_lines(listed, baseline, stop_shapes),
                intersection_id=crossings[row],
                turn_type=turns[row],
            )
        )
    return out


def _blocks(gpkg: GeoPackage, flaws: Counter[str]) -> list[BlockSpec]:
    roadblocks = gpkg.table("lane_groups_polygons")
    ends = ("from_lane_group_fid", "to_lane_group_fid")
    links = gpkg.table("lane_group_connectors", f"{' '.join(ends)} intersection_fid")
    start, end = (links.text_ids(name) for name in ends)
    crossings = links.text_ids("intersection_fid")
    outgoing, incoming = _group(start, links.ids), _group(end, links.ids)
    out = []
    for row, fid in enumerate(roadblocks.ids):
        polygon = _one_polygon(roadblocks, row, flaws)
        out.append(BlockSpec(fid, False, polygon, incoming.get(fid, []), outgoing.get(fid, [])))
    for row, fid in enumerate(links.ids):
        joined = _known(start[row]), _known(end[row]), crossings[row]
        out.append(BlockSpec(fid, True, _one_polygon(links, row, flaws), *joined))
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


def _find(baselines: dict[str, FloatArray], fid: str, owner: str) -> FloatArray:
    if fid not in baselines:
        raise DataError(f"{owner} {fid!r} has no baseline", hint=REPAIR)
    if len(baselines[fid]) < 2:
        raise DataError(f"baseline of {owner} {fid!r} has fewer than two vertices", hint=REPAIR)
    return baselines[fid]


class _Borders:
    """The borders that the rows of a layer name."""

    def __init__(self, lines: dict[str, FloatArray], table: LayerTable) -> None:
        self.lines = lines
        self.ids = {side: table.text_ids(f"{side}_boundary_fid") for side in ("left", "right")}

    def at(self, row: int, flaws: Counter[str]) -> dict[str, Any]:
        """Both borders of a row and their ids, as `EdgeSpec` takes them."""
        out: dict[str, Any] = {}
        for side, ids in self.ids.items():
            fid = ids[row] or ""
            flaws["edge names an unknown boundary"] += fid != "" and fid not in self.lines
            out |= {side: self.lines.get(fid), f"{side}_id": fid}
        return out


def _speed(table: LayerTable, row: int) -> float | None:
    value = table.columns["speed_limit_mps"][row]
    if value is None:
        return None
    if not isinstance(value, int | float):
        what = f"speed_limit_mps of fid {table.ids[row]} is {value!r}"
        raise DataError(f"layer {table.name!r}: {what}", hint=REPAIR)
    where = f"layer {table.name!r}: fid {table.ids[row]}:"
    require(NUPLAN_MAP, "speed_limit_mps", float(value), where)
    return float(value)


def _one_polygon(table: LayerTable, row: int, flaws: Counter[str]) -> shapely.Polygon:
    parts = _polygons(table, row)
    if len(parts) > 1:
        flaws["lane or roadblock in several pieces: the largest is kept"] += 1
    return max(parts, key=lambda part: float(shapely.area(part)))


def _polygons(table: LayerTable, row: int) -> list[shapely.Polygon]:
    parts = list(shapely.get_parts(table.shapes[row]))
    if not parts or any(p.geom_type != "Polygon" or shapely.is_empty(p) for p in parts):
        what = f"geometry of fid {table.ids[row]} is a {table.shapes[row].geom_type} without area"
        raise DataError(f"layer {table.name!r}: {what}", hint=REPAIR)
    return parts


def _areas(table: LayerTable, kinds: Sequence[int] | None = None) -> list[AreaSpec]:
    return [
        AreaSpec(fid, part, 0 if kinds is None else kinds[row])
        for row, fid in enumerate(table.ids)
        for part in _polygons(table, row)
    ]


def _num_overlaps(polygons: Sequence[shapely.Polygon]) -> int:
    return sum(area > _MIN_OVERLAP for area in shared_areas(polygons).values())
