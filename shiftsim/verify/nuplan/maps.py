"""Objects, lines and points of maps: what nuPlan's own map said, and what ours says to planners.

Our side is the map interface of `compat`; what objects say of themselves stands in `maps.toml`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.compat import nuplan as compat
from shiftsim.verify.files import Groups, Source, open_tables
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.world.map import VectorMap

TABLES = read_tables(__file__)
_NEAR = 20.0  # m, half width of the square of the `near20` columns
_POSE = ("x", "y", "heading")
_LINES = ("baseline", "left_boundary", "right_boundary")
_EDGES = ("LANE", "LANE_CONNECTOR")
_HOLDING = (*_EDGES, "ROADBLOCK", "ROADBLOCK_CONNECTOR", "INTERSECTION", "CROSSWALK")  # points
_NEARBY = (*_EDGES, "STOP_LINE")  # lie there
_ASKED = ("DRIVABLE_AREA", "INTERSECTION")  # whether a point lies in one


def verify_maps(expected: Path, maps: dict[str, VectorMap], report: Report) -> None:
    """Compare map_objects, map_lines and map_queries with maps by name."""
    parts = {
        "map_objects": _compare_objects,
        "map_lines": _compare_lines,
        "map_queries": _compare_queries,
    }
    for name, table in open_tables(expected, report, *parts).items():
        for city, road in maps.items() if len(table) else ():
            with report.attempt(name, city):
                parts[name](*nuplan_map(road), city, table)
        table.finish()


def nuplan_map(road: VectorMap) -> tuple[Any, Any]:
    """A map behind nuPlan's interface, and its layers by name."""
    compat.install()
    from nuplan.common.maps.maps_datatypes import SemanticMapLayer

    from shiftsim.compat.nuplan.bridge.map import BridgeMap

    return BridgeMap(road), SemanticMapLayer


def _compare_objects(road: Any, layers: Any, city: str, objects: Groups) -> None:
    for name in (name for name in TABLES if name != "outline"):
        found = sorted(road.objects(layers[name]), key=lambda thing: thing.id)
        # rows may come in another order than in the map; nothing reads the order of this table
        rows, where = objects[city, name], f"{city} {name}"
        rows = rows.at(np.argsort(rows["id"].astype(str), kind="stable"))
        if not rows.match(where, {"id": [thing.id for thing in found]}):
            continue
        details = zip(found, rows["polygon_wkb"], rows["attributes"], strict=True)
        for thing, polygon, attributes in details:
            theirs = json.loads(attributes) | _outline(shapely.from_wkb(polygon))
            given = Source("map_objects", "attribute", theirs, objects.table.report)
            TABLES[name].match(given, f"{where} {thing.id}", object=thing)
            TABLES["outline"].match(given, f"{where} {thing.id}", **_outline(thing.polygon))
            given.finish()


def _outline(shape: shapely.Polygon) -> dict[str, Any]:
    rings = [np.asarray(ring.coords) for ring in (shape.exterior, *shape.interiors)]
    return {"rings": [len(ring) for ring in rings], "outline": np.concatenate(rings)}


def _compare_lines(road: Any, layers: Any, city: str, lines: Groups) -> None:
    for name in _EDGES:
        for edge in road.objects(layers[name]):
            sides = edge.baseline_path, edge.left_boundary, edge.right_boundary
            for line, side in zip(_LINES, sides, strict=True):
                poses = side.discrete_path
                ours = {"layer": [name] * len(poses), "index": np.arange(len(poses))}
                ours |= {axis: [getattr(pose, axis) for pose in poses] for axis in _POSE}
                lines.match((city, edge.id, line), ours)


def _compare_queries(road: Any, layers: Any, city: str, queries: Groups) -> None:
    rows = queries[city,]
    points = map(shapely.Point, rows["x"], rows["y"])
    answers = [_answer(road, layers, point) for point in points]
    queries.match((city,), {name: [answer[name] for answer in answers] for name in answers[0]})


def _answer(road: Any, layers: Any, point: shapely.Point) -> dict[str, Any]:
    found = {name: road.get_all_map_objects(point, layers[name]) for name in _HOLDING}
    near = road.get_proximal_map_objects(point, _NEAR, [layers[name] for name in _NEARBY])
    found |= {f"near20_{kind.name}": things for kind, things in near.items()}
    _, away = road.get_distance_to_nearest_map_object(point, layers.DRIVABLE_AREA)
    lane, distance = road.get_distance_to_nearest_map_object(point, layers.LANE)
    line = road.get_map_object(lane, layers.LANE).baseline_path
    pose = line.get_nearest_pose_from_position(point)
    arc = line.get_nearest_arc_length_from_position(point)
    return {
        **{name: ",".join(sorted(thing.id for thing in found[name])) for name in found},
        **{f"in_{name}": road.is_in_layer(point, layers[name]) for name in _ASKED},
        "drivable_area_distance": away,
        "nearest_lane": lane,
        "nearest_lane_distance": distance,
        "lane_arc_length": road.source.progress_on(road.source.edge(lane), point.x, point.y),
        **{f"lane_pose_{axis}": getattr(pose, axis) for axis in _POSE},
        "lane_curvature": line.get_curvature_at_arc_length(arc),
    }
