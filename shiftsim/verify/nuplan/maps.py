"""Objects, lines and points of maps: what nuPlan's own map said, and what ours says to planners.

Our side is the map interface of `compat`; the objects' fields stand in `compared.toml`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.compat import nuplan as compat
from shiftsim.verify.files import COMPARED, Groups, Source, fields_of, open_tables
from shiftsim.verify.report import Report
from shiftsim.world.map import VectorMap

_NEAR = 20.0  # m, half width of the square of the `near20` columns
_POSE = ("x", "y", "heading")
_EDGES = ("LANE", "LANE_CONNECTOR")
_HOLDING = (*_EDGES, "ROADBLOCK", "ROADBLOCK_CONNECTOR", "INTERSECTION", "CROSSWALK")  # points
_NEARBY = (*_EDGES, "STOP_LINE")  # lie there


def verify_maps(expected: Path, maps: dict[str, VectorMap], report: Report) -> None:
    """Compare map_objects, map_lines and map_queries with maps by name."""
    for name, table in open_tables(expected, report, *_TABLES).items():
        for city, road in maps.items() if len(table) else ():
            with report.attempt(name, city):
                _TABLES[name](nuplan_map(road), city, table)
        table.finish()


def nuplan_map(road: VectorMap) -> Any:
    """A map behind nuPlan's interface."""
    compat.install()
    from shiftsim.compat.nuplan.bridge.map import BridgeMap

    return BridgeMap(road)


def layer(name: str) -> Any:
    """A layer of nuPlan's maps."""
    from nuplan.common.maps.maps_datatypes import SemanticMapLayer

    return SemanticMapLayer[name]


def point(x: float, y: float) -> Any:
    """A point to ask nuPlan's maps at."""
    from nuplan.common.actor_state.state_representation import Point2D

    return Point2D(x, y)


def _compare_objects(road: Any, city: str, objects: Groups) -> None:
    for name, fields in COMPARED["map_objects"].items():
        found, where, rows = road.objects(layer(name)), f"{city} {name}", objects[city, name]
        # rows may come in another order than in the map; nothing reads the order of this table
        rows = rows.at(np.argsort(rows["id"].astype(str), kind="stable"))
        if not rows.match(where, {"id": sorted(thing.id for thing in found)}):
            continue
        found.sort(key=lambda thing: thing.id)
        details = zip(found, rows["polygon_wkb"], rows["attributes"], strict=True)
        for thing, polygon, attributes in details:
            theirs = json.loads(attributes) | _outline(shapely.from_wkb(polygon))
            given = Source("map_objects", "attribute", theirs, objects.table.report)
            ours = fields_of(thing, fields) | _outline(thing.polygon)
            given.match(f"{where} {thing.id}", ours, objects.atol)
            given.finish()


def _outline(shape: shapely.Polygon) -> dict[str, Any]:
    rings = [np.asarray(ring.coords) for ring in (shape.exterior, *shape.interiors)]
    return {"rings": [len(ring) for ring in rings], "outline": np.concatenate(rings)}


def _compare_lines(road: Any, city: str, lines: Groups) -> None:
    for name in _EDGES:
        for edge in road.objects(layer(name)):
            for line, poses in fields_of(edge, COMPARED["map_lines"]).items():
                ours = {"layer": [name] * len(poses), "index": np.arange(len(poses))}
                ours |= {axis: [getattr(pose, axis) for pose in poses] for axis in _POSE}
                lines.match((city, edge.id, line), ours)


def _compare_queries(road: Any, city: str, queries: Groups) -> None:
    rows = queries[city,]
    answers = [_answer(road, point(x, y)) for x, y in zip(rows["x"], rows["y"], strict=True)]
    ours = {column: [answer[column] for answer in answers] for column in answers[0]}
    queries.match((city,), ours)


def _answer(road: Any, place: Any) -> dict[str, Any]:
    found = {name: road.get_all_map_objects(place, layer(name)) for name in _HOLDING}
    near = road.get_proximal_map_objects(place, _NEAR, list(map(layer, _NEARBY)))
    found |= {f"near20_{kind.name}": things for kind, things in near.items()}
    area = road.get_distance_to_nearest_map_object(place, layer("DRIVABLE_AREA"))
    lane, distance = road.get_distance_to_nearest_map_object(place, layer("LANE"))
    line = road.get_map_object(lane, layer("LANE")).baseline_path
    pose = line.get_nearest_pose_from_position(place)
    arc = line.get_nearest_arc_length_from_position(place)
    return {
        **{column: ",".join(sorted(thing.id for thing in found[column])) for column in found},
        "in_DRIVABLE_AREA": road.is_in_layer(place, layer("DRIVABLE_AREA")),
        "in_INTERSECTION": road.is_in_layer(place, layer("INTERSECTION")),
        "drivable_area_distance": area[1],
        "nearest_lane": lane,
        "nearest_lane_distance": distance,
        "lane_arc_length": road.source.progress_on(road.source.edge(lane), place.x, place.y),
        **{f"lane_pose_{axis}": getattr(pose, axis) for axis in _POSE},
        "lane_curvature": line.get_curvature_at_arc_length(arc),
    }


_TABLES = {
    "map_objects": _compare_objects,
    "map_lines": _compare_lines,
    "map_queries": _compare_queries,
}
