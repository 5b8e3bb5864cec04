"""Map objects, lines and point queries of our maps against the official ones."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.geometry.polylines import point_on_polyline
from shiftsim.verify.report import Report
from shiftsim.verify.tables import Group, read_groups
from shiftsim.world.layers import Layer, Lists, Polylines, distance_to, in_any, nearest
from shiftsim.world.map import NONE, VectorMap

_METRES, _RADIANS = 1e-6, 1e-7
_CURVATURE = 1e-9  # 1/m; follows from coordinates, not stored in the map
_NEAR = 20.0  # m, half width of the square of the `near20` columns
_HEADING_REACH = 0.5  # m, nuPlan's probe for the heading at an arc length
_CURVATURE_REACH = 2.0  # m, nuPlan's spacing of the three points of a curvature
_FLAT = 1e-6  # m^4, nuPlan: 16 times the squared triangle area below which a curvature is 0


def verify_maps(folder: Path, maps: dict[str, VectorMap], report: Report) -> None:
    """Compare map_objects, map_lines and map_queries."""
    tables: dict[str, tuple[tuple[str, ...], Callable[..., None]]] = {
        "map_objects": (("map", "layer"), _verify_objects),
        "map_lines": (("map", "layer", "id", "line"), _verify_line),
        "map_queries": (("map",), _verify_queries),
    }
    for name, (key, check) in tables.items():
        path = folder / "expected" / f"{name}.parquet"
        if not path.exists():
            report.skip(f"expected/{name}.parquet is missing")
            continue
        groups = read_groups(path, key)
        for values, group in groups.items():
            if values[0] not in maps:
                report.skip(f"{name}: map {values[0]} is not among the maps")
                continue
            check(maps[values[0]], values, group, report)
        for missing in sorted(set(maps) - {values[0] for values in groups}):
            report.skip(f"{name}: no row of map {missing}")
        if name == "map_lines":
            _verify_completeness(maps, set(groups), report)
        elif name == "map_objects":
            _verify_layers(maps, set(groups), report)


def _layer(road: VectorMap, name: str) -> tuple[Layer, int, int] | None:
    """A layer of nuPlan as a range of one of ours: layer, first index, one past the last."""
    edges, blocks = road.edges, road.blocks
    whole = {
        "STOP_LINE": road.stop_polygons,
        "INTERSECTION": road.intersections,
        "CROSSWALK": road.crosswalks,
        "WALKWAYS": road.walkways,
        "CARPARK_AREA": road.car_parks,
        "DRIVABLE_AREA": road.drivable_areas,
    }
    parts = {
        "LANE": (edges, 0, road.num_lanes),
        "LANE_CONNECTOR": (edges, road.num_lanes, len(edges)),
        "ROADBLOCK": (blocks, 0, road.num_roadblocks),
        "ROADBLOCK_CONNECTOR": (blocks, road.num_roadblocks, len(blocks)),
    }
    if name in whole:
        return whole[name], 0, len(whole[name])
    return parts.get(name)


_LAYERS = (
    "LANE", "LANE_CONNECTOR", "ROADBLOCK", "ROADBLOCK_CONNECTOR", "STOP_LINE", "INTERSECTION",
    "CROSSWALK", "WALKWAYS", "CARPARK_AREA", "DRIVABLE_AREA",
)  # fmt: skip


def _verify_layers(
    maps: dict[str, VectorMap], listed: set[tuple[str, ...]], report: Report
) -> None:
    for name, road in maps.items():
        for layer in _LAYERS:
            found = _layer(road, layer)
            if found and (name, layer) not in listed:
                count = found[2] - found[1]
                report.compare("map_objects", f"{name}: {layer}: number", count, 0)


def _verify_objects(road: VectorMap, key: tuple[str, ...], group: Group, report: Report) -> None:
    found = _layer(road, key[1])
    if found is None:
        report.skip(f"map_objects: layer {key[1]!r}", len(group["id"]))
        return
    for column in set(group) - {"map", "layer", "id", "attributes", "polygon_wkb"}:
        report.skip(f"map_objects: column {column!r}")
    layer, first, last = found
    where = f"{key[0]}: {key[1]}"
    # Rows may come in another order than in the map; nothing reads the order of this table.
    order = np.argsort(group["id"].astype(str), kind="stable")
    ours = np.argsort(np.array(layer.ids[first:last], str), kind="stable") + first
    ids = [layer.ids[i] for i in ours.tolist()]
    if not report.compare("map_objects", f"{where}: ids", ids, group["id"][order].tolist()):
        return
    for index, row in zip(ours.tolist(), order.tolist(), strict=True):
        what = f"{where} {layer.ids[index]}"
        _verify_polygon(layer, index, what, group["polygon_wkb"][row], report)
        _verify_attributes(road, key[1], index, what, json.loads(group["attributes"][row]), report)


def _verify_polygon(layer: Layer, index: int, where: str, wkb: bytes, report: Report) -> None:
    try:
        polygon = shapely.from_wkb(wkb)
        theirs = [np.asarray(r.coords) for r in (polygon.exterior, *polygon.interiors)]
    except (shapely.errors.GEOSException, AttributeError) as error:
        report.fail("map_objects", f"{where}: polygon", f"unreadable: {error}")
        return
    ours = layer.rings(index)
    report.compare("map_objects", f"{where}: rings", len(ours), len(theirs))
    for number, (a, b) in enumerate(zip(ours, theirs, strict=False)):
        closed = np.concatenate([a, a[:1]])
        report.compare("map_objects", f"{where}: ring {number}", closed, b, atol=_METRES)


def _verify_attributes(
    road: VectorMap, layer: str, index: int, where: str, theirs: dict[str, Any], report: Report
) -> None:
    ours = _attributes(road, layer, index)
    for name, value in theirs.items():
        if name not in ours:
            report.skip(f"map_objects: attribute {name!r} of {layer}")
            continue
        atol = _METRES if name == "baseline_length" else 0.0
        report.compare(
            "map_objects", f"{where}: {name}", _known(ours[name]), _known(value), atol=atol
        )
    for name in sorted(set(ours) - set(theirs)):
        report.skip(f"map_objects: attribute {name!r} of {layer} is missing")


def _known(value: Any) -> Any:
    return "none" if value is None else value


def _names(layer: Layer, indices: Any) -> list[str]:
    return [layer.ids[i] for i in indices.tolist()]


def _name(layer: Layer, index: int) -> str | None:
    return None if index == NONE else layer.ids[index]


def _attributes(road: VectorMap, layer: str, index: int) -> dict[str, Any]:
    if layer in ("LANE", "LANE_CONNECTOR"):
        return _edge_attributes(road, layer, index)
    if layer in ("ROADBLOCK", "ROADBLOCK_CONNECTOR"):
        return _block_attributes(road, layer, index)
    if layer == "STOP_LINE":
        return {"stop_line_type": int(road.stop_kinds[index])}
    return {}


def _edge_attributes(road: VectorMap, layer: str, index: int) -> dict[str, Any]:
    edges, limit = road.edges, float(road.speed_limits[index])
    out: dict[str, Any] = {
        "roadblock_id": _name(road.blocks, int(road.block_of[index])),
        "speed_limit_mps": None if np.isnan(limit) else limit,
        "incoming": _names(edges, road.incoming.at(index)),
        "outgoing": _names(edges, road.outgoing.at(index)),
        "baseline_length": road.baselines.length(index),
    }
    if layer == "LANE":
        out["index"] = int(road.lane_index[index])
        out["left_lane"] = _name(edges, int(road.left_lane[index]))
        out["right_lane"] = _name(edges, int(road.right_lane[index]))
    else:
        out["has_traffic_lights"] = bool(road.has_traffic_lights[index])
        out["stop_lines"] = _names(road.stop_polygons, road.stop_lines.at(index))
    return out


def _block_attributes(road: VectorMap, layer: str, index: int) -> dict[str, Any]:
    def ids(lists: Lists, of: Layer) -> list[str]:
        return _names(of, lists.at(index))

    out: dict[str, Any] = {
        "incoming": ids(road.block_incoming, road.blocks),
        "outgoing": ids(road.block_outgoing, road.blocks),
        "interior": ids(road.block_edges, road.edges),
    }
    if layer == "ROADBLOCK_CONNECTOR":
        edge = int(road.block_edges.at(index)[0]) if len(road.block_edges.at(index)) else NONE
        inside = NONE if edge == NONE else int(road.intersection_of[edge])
        out["intersection"] = _name(road.intersections, inside)
    return out


_LINES = {
    "baseline": "baselines",
    "left_boundary": "left_boundaries",
    "right_boundary": "right_boundaries",
}


def _verify_completeness(
    maps: dict[str, VectorMap], listed: set[tuple[str, ...]], report: Report
) -> None:
    for name, road in maps.items():
        for edge, edge_id in enumerate(road.edges.ids):
            layer = "LANE" if edge < road.num_lanes else "LANE_CONNECTOR"
            for line in _LINES:
                if (name, layer, edge_id, line) not in listed:
                    report.skip(f"map_lines: {name}: {layer} {edge_id}: {line} is missing")


def _verify_line(road: VectorMap, key: tuple[str, ...], group: Group, report: Report) -> None:
    name, layer, edge_id, line = key
    where = f"{name}: {layer} {edge_id}: {line}"
    for column in set(group) - {"map", "layer", "id", "line", "index", "x", "y", "heading"}:
        report.skip(f"map_lines: column {column!r}")
    if line not in _LINES or edge_id not in road.edges.index:
        report.fail("map_lines", where, "there is no such line")
        return
    edge = road.edges.index[edge_id]
    kind = "LANE_CONNECTOR" if road.is_connector(edge) else "LANE"
    report.compare("map_lines", f"{where}: layer", kind, layer)
    xy = getattr(road, _LINES[line]).at(edge)
    report.compare("map_lines", f"{where}: index", np.arange(len(xy)), group["index"])
    report.compare("map_lines", f"{where}: x", xy[:, 0], group["x"], atol=_METRES)
    report.compare("map_lines", f"{where}: y", xy[:, 1], group["y"], atol=_METRES)
    report.compare("map_lines", f"{where}: heading", _headings(xy), group["heading"], atol=_RADIANS)


def _headings(xy: FloatArray) -> FloatArray:
    """Direction to the next vertex; the last one repeats [rad]."""
    step = np.diff(xy, axis=0)
    angles = np.arctan2(step[:, 1], step[:, 0])
    return np.append(angles, angles[-1:])


def _verify_queries(road: VectorMap, key: tuple[str, ...], group: Group, report: Report) -> None:
    answers = [_answer(road, x, y) for x, y in zip(group["x"], group["y"], strict=True)]
    tolerance = {
        "drivable_area_distance": _METRES,
        "nearest_lane_distance": _METRES,
        "lane_arc_length": _METRES,
        "lane_pose_x": _METRES,
        "lane_pose_y": _METRES,
        "lane_pose_heading": _RADIANS,
        "lane_curvature": _CURVATURE,
    }
    for column in group:
        if column in ("map", "x", "y"):
            continue
        if column not in answers[0]:
            report.skip(f"map_queries: column {column!r}")
            continue
        ours = [answer[column] for answer in answers]
        atol = tolerance.get(column, 0.0)
        where = f"{key[0]}: {column}"
        report.compare("map_queries", where, ours, group[column].tolist(), atol=atol)
    for column in sorted(set(answers[0]) - set(group)):
        report.skip(f"map_queries: column {column!r} is missing")


def _answer(road: VectorMap, x: float, y: float) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name in (
        "LANE", "LANE_CONNECTOR", "ROADBLOCK", "ROADBLOCK_CONNECTOR", "INTERSECTION", "CROSSWALK"
    ):  # fmt: skip
        layer, first, last = _require_layer(road, name)
        found = layer.containing(x, y)
        out[name] = _join(layer, found[(found >= first) & (found < last)])
    near = road.edges.within_box(x, y, _NEAR)
    out["near20_LANE"] = _join(road.edges, near[near < road.num_lanes])
    out["near20_LANE_CONNECTOR"] = _join(road.edges, connectors_near(road, x, y, _NEAR))
    stops = road.stop_polygons
    out["near20_STOP_LINE"] = _join(stops, stops.within_box(x, y, _NEAR))
    areas = road.drivable_areas.polygons
    out["in_DRIVABLE_AREA"] = bool(in_any(areas, x, y))
    out["in_INTERSECTION"] = bool(in_any(road.intersections.polygons, x, y))
    out["drivable_area_distance"] = float(nearest(areas, x, y, np.inf)[1])
    out.update(_nearest_lane(road, x, y))
    return out


def connectors_near(road: VectorMap, x: float, y: float, half_width: float) -> IntArray:
    """Lane connectors whose centre line meets an axis-parallel square around (x, y).

    nuPlan: its table of lane connectors holds lines, and searches by distance run over that one.
    """
    square = shapely.box(x - half_width, y - half_width, x + half_width, y + half_width)
    lines = road.baselines
    found = [
        edge
        for edge in range(road.num_lanes, len(road.edges))
        if shapely.intersects(shapely.LineString(lines.at(edge)), square)
    ]
    return np.array(found, np.int64)


def _require_layer(road: VectorMap, name: str) -> tuple[Layer, int, int]:
    found = _layer(road, name)
    assert found is not None
    return found


def _join(layer: Layer, indices: Any) -> str:
    return ",".join(sorted(layer.ids[i] for i in indices.tolist()))


def _nearest_lane(road: VectorMap, x: float, y: float) -> dict[str, Any]:
    polygons = road.edges.polygons
    distances = [float(distance_to(polygons, lane, x, y)) for lane in range(road.num_lanes)]
    lane = int(np.argmin(distances))
    arc = road.progress_on(lane, x, y)
    point = _at(road.baselines, lane, arc)
    return {
        "nearest_lane": road.edges.ids[lane],
        "nearest_lane_distance": distances[lane],
        "lane_arc_length": arc,
        "lane_pose_x": point[0],
        "lane_pose_y": point[1],
        "lane_pose_heading": _heading_at(road.baselines, lane, arc),
        "lane_curvature": _curvature_at(road.baselines, lane, arc),
    }


def _at(lines: Polylines, line: int, arc: float) -> tuple[float, float]:
    first, last = int(lines.ptr[line]), int(lines.ptr[line + 1])
    return point_on_polyline(lines.xy, lines.arc, first, last, arc)[:2]


def _heading_at(lines: Polylines, line: int, arc: float) -> float:
    # nuPlan: towards a point half a metre ahead; from half a metre behind where the line ends.
    x, y = _at(lines, line, arc)
    ahead_x, ahead_y = _at(lines, line, arc + _HEADING_REACH)
    if ahead_x == x and ahead_y == y:
        ahead_x, ahead_y = x, y
        x, y = _at(lines, line, arc - _HEADING_REACH)
    return float(np.arctan2(ahead_y - y, ahead_x - x))


def _curvature_at(lines: Polylines, line: int, arc: float) -> float:
    reach, length = _CURVATURE_REACH, lines.length(line)
    middle = length / 2.0 if length < 2.0 * reach else min(max(arc, reach), length - reach)
    reach = min(reach, length / 2.0)
    points = np.array([_at(lines, line, middle + d) for d in (-reach, 0.0, reach)])
    ab, ac = points[1] - points[0], points[2] - points[0]
    a, b, c = (float(np.hypot(*v)) for v in (ab, points[2] - points[1], ac))
    # Heron's formula: 16 times the squared area of the triangle.
    square = (a + (b + c)) * (c - (a - b)) * (c + (a - b)) * (a + (b - c))
    if square < _FLAT:
        return 0.0
    return float(np.sign(ab[0] * ac[1] - ab[1] * ac[0]) * np.sqrt(square) / (a * b * c))
