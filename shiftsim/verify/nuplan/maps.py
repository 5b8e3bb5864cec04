"""Map objects, lines and point queries of our maps against the official ones."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.geometry.polylines import point_on_polyline
from shiftsim.verify.files import Groups, Source
from shiftsim.verify.report import Report
from shiftsim.world.layers import Layer, Polylines, distance_to, in_any, nearest
from shiftsim.world.map import NONE, VectorMap

METRES, RADIANS = 1e-6, 1e-7
_OBJECT = dict.fromkeys(("baseline_length", "outline"), METRES)
_LINE = {"x": METRES, "y": METRES, "heading": RADIANS}
_QUERY = {
    **dict.fromkeys(("drivable_area_distance", "nearest_lane_distance", "lane_arc_length"), METRES),
    **dict.fromkeys(("lane_pose_x", "lane_pose_y"), METRES),
    "lane_pose_heading": RADIANS,
    "lane_curvature": 1e-9,  # 1/m; follows from coordinates, not stored in the map
}
_NEAR = 20.0  # m, half width of the square of the `near20` columns
_HEADING_REACH = 0.5  # m, distance of the probe for a heading
_CURVATURE_REACH = 2.0  # m, spacing of the three points of a curvature
_FLAT = 1e-6  # m^4, 16 times the squared area of their triangle below which it is 0
_LINES = {
    "baseline": "baselines",
    "left_boundary": "left_boundaries",
    "right_boundary": "right_boundaries",
}
_LAYERS = {  # of nuPlan: layer of ours
    **dict.fromkeys(("LANE", "LANE_CONNECTOR"), "edges"),
    **dict.fromkeys(("ROADBLOCK", "ROADBLOCK_CONNECTOR"), "blocks"),
    "INTERSECTION": "intersections",
    "CROSSWALK": "crosswalks",
    "STOP_LINE": "stop_polygons",
    "WALKWAYS": "walkways",
    "CARPARK_AREA": "car_parks",
    "DRIVABLE_AREA": "drivable_areas",
}
_HOLDING, _NEARBY = tuple(_LAYERS)[:6], ("LANE", "LANE_CONNECTOR", "STOP_LINE")  # asked at points


def layer_of(road: VectorMap, name: str) -> tuple[Layer, range]:
    """A layer of nuPlan as a range of one of ours."""
    layer: Layer = getattr(road, _LAYERS[name])
    count = road.num_lanes if layer is road.edges else road.num_roadblocks
    if name in ("LANE", "ROADBLOCK"):
        return layer, range(count)
    return layer, range(count if name.endswith("_CONNECTOR") else 0, len(layer))


def verify_maps(expected: Path, maps: dict[str, VectorMap], report: Report) -> None:
    """Compare map_objects, map_lines and map_queries with maps by name."""
    for name, (key, compare) in _TABLES.items():
        table = Groups(expected / f"{name}.parquet", report, key)
        for city, road in maps.items() if len(table) else ():
            with report.attempt(name, city):
                compare(road, city, table)
        table.finish()


def _compare_lines(road: VectorMap, city: str, lines: Groups) -> None:
    for edge, edge_id in enumerate(road.edges.ids):
        layer = "LANE_CONNECTOR" if road.is_connector(edge) else "LANE"
        for line, attribute in _LINES.items():
            xy = getattr(road, attribute).at(edge)
            columns = zip(_LINE, (*xy.T, _headings(xy)), strict=True)
            ours = {"layer": [layer] * len(xy), "index": np.arange(len(xy)), **dict(columns)}
            lines.match((city, edge_id, line), ours, _LINE)


def _compare_queries(road: VectorMap, city: str, queries: Groups) -> None:
    rows = queries[city,]
    answers = [_answer(road, x, y) for x, y in zip(rows["x"], rows["y"], strict=True)]
    ours = {column: [answer[column] for answer in answers] for column in answers[0]}
    rows.match(city, ours, _QUERY)


def _compare_objects(road: VectorMap, city: str, objects: Groups) -> None:
    for name in _LAYERS:
        (layer, part), where, rows = layer_of(road, name), f"{city} {name}", objects[city, name]
        # rows may come in another order than in the map; nothing reads the order of this table
        rows = rows.at(np.argsort(rows["id"].astype(str), kind="stable"))
        ours = sorted(part, key=lambda index: layer.ids[index])
        if not rows.match(where, {"id": [layer.ids[index] for index in ours]}):
            continue
        details = zip(ours, rows["polygon_wkb"], rows["attributes"], strict=True)
        for index, polygon, attributes in details:
            rings = [np.concatenate([ring, ring[:1]]) for ring in layer.rings(index)]
            theirs = json.loads(attributes) | _outline(_rings(shapely.from_wkb(polygon)))
            given = Source("map_objects", "attribute", theirs, objects.table.report)
            found = attributes_of(road, name, index) | _outline(rings)
            given.match(f"{where} {layer.ids[index]}", found, _OBJECT)
            given.finish()


def _rings(shape: shapely.Polygon) -> list[FloatArray]:
    return [np.asarray(ring.coords) for ring in (shape.exterior, *shape.interiors)]


def _outline(rings: list[FloatArray]) -> dict[str, Any]:
    return {"rings": [len(ring) for ring in rings], "outline": np.concatenate(rings)}


_TABLES = {  # key columns, what compares them
    "map_objects": (("map", "layer"), _compare_objects),
    "map_lines": (("map", "id", "line"), _compare_lines),
    "map_queries": (("map",), _compare_queries),
}


def attributes_of(road: VectorMap, layer: str, index: int) -> dict[str, Any]:
    """What the official stack says of an object besides its shape."""
    edges, blocks = road.edges, road.blocks
    if _LAYERS[layer] == "edges":
        out: dict[str, Any] = {
            "roadblock_id": _name(blocks, road.block_of[index]),
            "speed_limit_mps": road.speed_limits[index],
            "incoming": _names(edges, road.incoming.at(index)),
            "outgoing": _names(edges, road.outgoing.at(index)),
            "baseline_length": road.baselines.length(index),
        }
        if layer == "LANE":
            out["index"] = road.lane_index[index]
            out["left_lane"] = _name(edges, road.left_lane[index])
            out["right_lane"] = _name(edges, road.right_lane[index])
        else:
            out["has_traffic_lights"] = road.has_traffic_lights[index]
            out["stop_lines"] = _names(road.stop_polygons, road.stop_lines.at(index))
        return out
    if _LAYERS[layer] == "blocks":
        inside = road.block_edges.at(index)
        out = {
            "incoming": _names(blocks, road.block_incoming.at(index)),
            "outgoing": _names(blocks, road.block_outgoing.at(index)),
            "interior": _names(edges, inside),
        }
        if layer == "ROADBLOCK_CONNECTOR":
            crossed = road.intersection_of[inside[0]] if len(inside) else NONE
            out["intersection"] = _name(road.intersections, crossed)
        return out
    return {"stop_line_type": road.stop_kinds[index]} if layer == "STOP_LINE" else {}


def _names(layer: Layer, indices: Iterable[int]) -> list[str]:
    return [layer.ids[index] for index in indices]


def _name(layer: Layer, index: int) -> str | None:
    return None if index == NONE else layer.ids[index]


def _headings(xy: FloatArray) -> FloatArray:
    """Direction to the next vertex; the last one repeats [rad]."""
    step = np.diff(xy, axis=0)
    angles = np.arctan2(step[:, 1], step[:, 0])
    return np.append(angles, angles[-1:])


def _answer(road: VectorMap, x: float, y: float) -> dict[str, Any]:
    found: dict[str, tuple[Layer, list[int]]] = {}
    for name in _HOLDING:
        layer, part = layer_of(road, name)
        found[name] = layer, [index for index in layer.containing(x, y) if index in part]
    for name in _NEARBY:
        found[f"near20_{name}"] = layer_of(road, name)[0], near_square(road, name, x, y, _NEAR)
    areas, polygons = road.drivable_areas.polygons, road.edges.polygons
    distances = [float(distance_to(polygons, lane, x, y)) for lane in range(road.num_lanes)]
    lane = int(np.argmin(distances))
    arc, lines = road.progress_on(lane, x, y), road.baselines
    point = _at(lines, lane, arc)
    return {
        **{column: ",".join(sorted(_names(*objects))) for column, objects in found.items()},
        "in_DRIVABLE_AREA": bool(in_any(areas, x, y)),
        "in_INTERSECTION": bool(in_any(road.intersections.polygons, x, y)),
        "drivable_area_distance": float(nearest(areas, x, y, np.inf)[1]),
        "nearest_lane": road.edges.ids[lane],
        "nearest_lane_distance": distances[lane],
        "lane_arc_length": arc,
        "lane_pose_x": point[0],
        "lane_pose_y": point[1],
        "lane_pose_heading": _heading_at(lines, lane, arc),
        "lane_curvature": _curvature_at(lines, lane, arc),
    }


def near_square(road: VectorMap, name: str, x: float, y: float, half_width: float) -> list[int]:
    """Objects of a layer that meet an axis-parallel square around (x, y)."""
    layer, part = layer_of(road, name)
    if name != "LANE_CONNECTOR":
        return [index for index in layer.within_box(x, y, half_width).tolist() if index in part]
    # nuPlan rule 600: connectors are searched by distance in a table that holds centre lines
    square = shapely.box(x - half_width, y - half_width, x + half_width, y + half_width)
    return [i for i in part if square.intersects(shapely.LineString(road.baselines.at(i)))]


def _at(lines: Polylines, line: int, arc: float) -> tuple[float, float]:
    first, last = int(lines.ptr[line]), int(lines.ptr[line + 1])
    return point_on_polyline(lines.xy, lines.arc, first, last, arc)[:2]


def _heading_at(lines: Polylines, line: int, arc: float) -> float:
    # nuPlan rule 601: towards a point half a metre ahead; at the end of the line, from one behind
    here, ahead = _at(lines, line, arc), _at(lines, line, arc + _HEADING_REACH)
    if ahead == here:
        here, ahead = _at(lines, line, arc - _HEADING_REACH), here
    return float(np.arctan2(ahead[1] - here[1], ahead[0] - here[0]))


def _curvature_at(lines: Polylines, line: int, arc: float) -> float:
    # nuPlan rule 605: of a circle through three points, the middle one kept off the ends
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
