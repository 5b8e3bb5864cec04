"""The map interface answers as nuPlan's own code did, on four small maps."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely

from shiftsim.compat.nuplan.bridge.map import BridgeMap
from shiftsim.data.nuplan.map import read_map

from nuplan.common.actor_state.state_representation import Point2D  # isort: skip  # exists now
from nuplan.common.maps.maps_datatypes import SemanticMapLayer  # isort: skip

pytestmark = pytest.mark.golden

HOLDING = (
    "LANE",
    "LANE_CONNECTOR",
    "ROADBLOCK",
    "ROADBLOCK_CONNECTOR",
    "INTERSECTION",
    "CROSSWALK",
)
NEAR = ("LANE", "LANE_CONNECTOR", "STOP_LINE")


@pytest.fixture(scope="module")
def maps(nuplan_reference):
    files = sorted((nuplan_reference / "maps").glob("*/*/map.gpkg"))
    names = [file.parent.parent.name for file in files]
    return {name: BridgeMap(read_map(file, name)) for name, file in zip(names, files, strict=True)}


def _rows(folder, name):
    return pq.read_table(folder / f"expected/{name}.parquet").to_pylist()


def _joined(objects):
    return ",".join(sorted(item.id for item in objects))


def test_questions_about_points_get_the_same_answers(maps, nuplan_reference):
    rows = _rows(nuplan_reference, "map_queries")
    assert len(rows) == 1560
    for row in rows:
        road, point = maps[row["map"]], Point2D(row["x"], row["y"])
        for name in HOLDING:
            found = road.get_all_map_objects(point, SemanticMapLayer[name])
            assert _joined(found) == ",".join(sorted(filter(None, row[name].split(","))))
        layers = [SemanticMapLayer[name] for name in NEAR]
        near = road.get_proximal_map_objects(point, 20.0, layers)
        for name, layer in zip(NEAR, layers, strict=True):
            wanted = ",".join(sorted(filter(None, row[f"near20_{name}"].split(","))))
            assert _joined(near[layer]) == wanted
        for name in ("DRIVABLE_AREA", "INTERSECTION"):
            assert road.is_in_layer(point, SemanticMapLayer[name]) == row[f"in_{name}"]


def test_distances_and_projections_are_the_same(maps, nuplan_reference):
    found, wanted = [], []
    for row in _rows(nuplan_reference, "map_queries"):
        road, point = maps[row["map"]], Point2D(row["x"], row["y"])
        _, area = road.get_distance_to_nearest_map_object(point, SemanticMapLayer.DRIVABLE_AREA)
        name, away = road.get_distance_to_nearest_map_object(point, SemanticMapLayer.LANE)
        line = road.get_map_object(row["nearest_lane"], SemanticMapLayer.LANE).baseline_path
        arc = line.get_nearest_arc_length_from_position(point)
        pose = line.get_nearest_pose_from_position(point)
        curvature = line.get_nearest_curvature_from_position(point)
        # nuPlan: any one of several lanes that hold the point
        assert name == row["nearest_lane"] or away == 0.0
        found.append([area, away, arc, pose.x, pose.y, pose.heading, curvature])
        keys = ("arc_length", "pose_x", "pose_y", "pose_heading", "curvature")
        distances = [row["drivable_area_distance"], row["nearest_lane_distance"]]
        wanted.append([*distances, *(row[f"lane_{key}"] for key in keys)])
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


def test_objects_are_the_same(maps, nuplan_reference):
    rows = [
        row for row in _rows(nuplan_reference, "map_objects") if row["layer"] != "DRIVABLE_AREA"
    ]
    assert len(rows) == 210
    for row in rows:
        road, layer = maps[row["map"]], SemanticMapLayer[row["layer"]]
        thing = road.get_map_object(row["id"], layer)
        wanted = json.loads(row["attributes"])
        found = {key: _attribute(thing, key) for key in wanted}
        lengths = [values.pop("baseline_length", 0.0) for values in (found, wanted)]
        assert lengths[0] == pytest.approx(lengths[1], abs=1e-9)
        assert found == wanted
        shape = shapely.from_wkb(row["polygon_wkb"])
        assert thing.polygon.equals(shape)


def _attribute(thing, key):
    ids = {"incoming": "incoming_edges", "outgoing": "outgoing_edges", "interior": "interior_edges"}
    if key in ids:
        return [item.id for item in getattr(thing, ids[key])]
    if key in ("left_lane", "right_lane"):
        lane = thing.adjacent_edges[key == "right_lane"]
        return None if lane is None else lane.id
    readers = {
        "roadblock_id": lambda: thing.get_roadblock_id(),
        "baseline_length": lambda: thing.baseline_path.length,
        "has_traffic_lights": lambda: thing.has_traffic_lights(),
        "stop_lines": lambda: [line.id for line in thing.stop_lines],
        "intersection": lambda: thing.intersection.id,
        "stop_line_type": lambda: int(thing.stop_line_type),
    }
    return readers[key]() if key in readers else getattr(thing, key)


def test_lines_are_the_same(maps, nuplan_reference):
    columns = {"baseline": "baseline_path"}
    lines = {}
    for row in _rows(nuplan_reference, "map_lines"):
        key = (row["map"], row["layer"], row["id"], row["line"])
        lines.setdefault(key, []).append([row["x"], row["y"], row["heading"]])
    assert len(lines) > 250
    for (city, layer, name, line), wanted in lines.items():
        thing = maps[city].get_map_object(name, SemanticMapLayer[layer])
        path = getattr(thing, columns.get(line, line)).discrete_path
        np.testing.assert_allclose([[*pose] for pose in path], wanted, rtol=0, atol=1e-9)
