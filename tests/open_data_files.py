"""Writes a demo town and its traffic as the files of open data sets, for tests.

`demo_content` gives plain values; `data/readers/write_py123d.py` hands them to py123d.
"""

import json
from functools import cache
from itertools import groupby
from xml.sax.saxutils import escape

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import parse_opendrive
from shiftsim.data.readers.av2 import Av2Reader
from shiftsim.data.readers.commonroad import CommonRoadReader
from shiftsim.data.readers.py123d import Py123dReader
from shiftsim.data.synthetic.agents import SIZES
from shiftsim.data.synthetic.recordings import DURATION, generate_town
from shiftsim.data.synthetic.store import DEMO_TOWNS
from shiftsim.data.synthetic.traffic import DT

AV2_NAME = "00000000-aaaa-bbbb-cccc-000000000001"
START_US = 1_900_000_000_000_000
EGO_SIZE = (4.8, 1.9)
CENTER_TO_IMU = 1.3  # m, of the ego's box


@cache
def demo_map(site="avenue"):
    """The map of a town of the demo, as OpenDRIVE gives it."""
    xml = _generated(site)[0].xml()
    return build_road_map(parse_opendrive(xml.encode(), site), name=site)[0]


@cache
def _generated(name):
    return generate_town(next(town for town in DEMO_TOWNS if town.name == name))


@cache
def demo_content(site="avenue", seconds=11.0):
    """Lanes, areas and tracks of a town of the demo, in plain JSON values.

    Tracks are (T, 5) t [s], x, y, heading, speed every 0.1 s; `ego` is the car that gets farthest.
    """
    road = demo_map(site)
    ids = road.edges.ids
    lanes = [
        {
            "id": int(ids[edge]),
            "left": road.left_boundaries.at(edge).tolist(),
            "right": road.right_boundaries.at(edge).tolist(),
            "center": road.baselines.at(edge).tolist(),
            "successors": [int(ids[e]) for e in road.outgoing.at(edge)],
            "predecessors": [int(ids[e]) for e in road.incoming.at(edge)],
            "left_lane": _id(ids, road.left_lane[edge]),
            "right_lane": _id(ids, road.right_lane[edge]),
            "group": 100_000 + int(road.block_of[edge]),
            "inside": road.is_connector(edge),
            "limit": float(np.nan_to_num(road.speed_limits[edge], nan=13.9)),
        }
        for edge in range(len(road.edges))
    ]
    tracks = _tracks(_generated(site)[1][0], seconds)
    ego = max((t for t in tracks if t["category"] == "car"), key=lambda t: _way(t, seconds))
    others = [track for track in tracks if track is not ego]
    return {
        "lanes": lanes,
        "crosswalks": _rings(road.crosswalks),
        "drivable": _rings(road.drivable_areas),
        "ego": {**ego, "size": EGO_SIZE},
        "tracks": others,
        "center_to_imu": CENTER_TO_IMU,
        "start_us": START_US,
    }


def _id(ids, edge):
    return int(ids[edge]) if edge >= 0 else None


def _rings(layer):
    return [list(map(list, layer.shape(i).exterior.coords)) for i in range(len(layer))]


def _way(track, seconds):
    rows = np.array(track["rows"])
    whole = rows[0, 0] == 0.0 and rows[-1, 0] >= seconds - 0.11
    return np.hypot(*np.diff(rows[:, 1:3], axis=0).T).sum() if whole else 0.0


def _tracks(traffic, seconds):
    boxes = sorted(traffic.record(DURATION), key=lambda box: box[1])
    out = []
    for number, group in groupby(boxes, key=lambda box: box[1]):
        group = list(group)
        values = np.array([(*box[:1], *box[3:7]) for box in group], np.float64)
        values[:, 0] *= DT
        at = np.arange(np.ceil(values[0, 0] * 10) / 10, min(values[-1, 0], seconds - 0.09), 0.1)
        if len(at) < 2:
            continue
        values[:, 3] = np.unwrap(values[:, 3])
        rows = [at, *(np.interp(at, values[:, 0], column) for column in values.T[1:])]
        category = group[0][2]
        out.append(
            {
                "id": str(int(number)),
                "category": category,
                "size": list(SIZES[category][:2]),
                "rows": np.round(np.stack(rows, axis=1), 6).tolist(),
            }
        )
    return out


# --- Argoverse 2


def write_av2(folder, name=AV2_NAME, site="avenue"):
    """One scene of Argoverse 2 motion forecasting; returns the Parquet file."""
    content = demo_content(site)
    folder.mkdir(parents=True, exist_ok=True)
    segments = {str(lane["id"]): _segment(lane) for lane in content["lanes"]}
    areas = {
        str(i): {"area_boundary": _points(ring[:-1]), "id": i}
        for i, ring in enumerate(content["drivable"])
    }
    crossings = {
        str(i): {"edge1": _points(ring[:2]), "edge2": _points(ring[3:1:-1]), "id": i}
        for i, ring in enumerate(content["crosswalks"])
    }
    found = {"lane_segments": segments, "drivable_areas": areas, "pedestrian_crossings": crossings}
    (folder / f"log_map_archive_{name}.json").write_text(json.dumps(found))
    types = dict.fromkeys(("car", "van", "pickup", "truck"), "vehicle")
    types |= {"bicycle": "cyclist", "motorcycle": "motorcyclist", "e_scooter": "cyclist"}
    rows = [
        {
            "observed": step < 50,
            "track_id": track_id,
            "object_type": types.get(track["category"], track["category"]),
            "object_category": 2,
            "timestep": step,
            "position_x": x,
            "position_y": y,
            "heading": heading,
            "velocity_x": speed * np.cos(heading),
            "velocity_y": speed * np.sin(heading),
            "scenario_id": name,
            "start_timestamp": START_US * 1e3,
            "end_timestamp": START_US * 1e3 + 10.9e9,
            "num_timestamps": 110,
            "focal_track_id": "AV",
            "city": "austin",
        }
        for track_id, track in [("AV", content["ego"]), *((t["id"], t) for t in content["tracks"])]
        for t, x, y, heading, speed in track["rows"]
        if (step := round(t * 10)) < 110
    ]
    path = folder / f"scenario_{name}.parquet"
    pq.write_table(pa.Table.from_pylist(rows), path)
    return path


def _points(line):
    return [{"x": x, "y": y, "z": 0.0} for x, y in line]


def _segment(lane):
    return {
        "id": lane["id"],
        "is_intersection": lane["inside"],
        "lane_type": "VEHICLE",
        "left_lane_boundary": _points(lane["left"]),
        "right_lane_boundary": _points(lane["right"]),
        "centerline": _points(lane["center"]),
        "left_neighbor_id": lane["left_lane"],
        "right_neighbor_id": lane["right_lane"],
        "predecessors": [],  # older maps list them one-sidedly
        "successors": [*lane["successors"], 999_999],
    }


# --- CommonRoad


def write_commonroad(folder, version="2020a", site="avenue"):
    """One CommonRoad scenario; returns the file."""
    content = demo_content(site)
    folder.mkdir(parents=True, exist_ok=True)
    is_new = version == "2020a"
    inside = [lane for lane in content["lanes"] if lane["inside"]]
    lit = sorted({p for lane in inside for p in lane["predecessors"]})[:1]
    parts = [_lanelet(lane, is_new, lit) for lane in content["lanes"]]
    if is_new:
        parts += [
            '<trafficSign id="7"><trafficSignElement><trafficSignID>274</trafficSignID>'
            "<additionalValue>8.5</additionalValue></trafficSignElement></trafficSign>",
            '<trafficLight id="8"><cycle><cycleElement><duration>30</duration><color>green</color>'
            "</cycleElement><cycleElement><duration>50</duration><color>red</color></cycleElement>"
            "<timeOffset>10</timeOffset></cycle></trafficLight>",
            '<intersection id="9"><incoming id="10">'
            + "".join(f'<successorsStraight ref="{lane["id"]}"/>' for lane in inside)
            + "</incoming></intersection>",
        ]
    parts += [_obstacle(track, is_new) for track in [content["ego"], *content["tracks"]]]
    path = folder / f"demo-{version}.xml"
    path.write_text(
        f'<?xml version="1.0"?><commonRoad commonRoadVersion="{version}" benchmarkID="DEU_Demo-1"'
        f' timeStepSize="0.1" author="a &amp; b" source="{escape(site)}">{"".join(parts)}'
        "</commonRoad>"
    )
    return path


def _lanelet(lane, is_new, lit):
    bounds = "".join(
        f"<{tag}>{''.join(f'<point><x>{x}</x><y>{y}</y></point>' for x, y in lane[side])}</{tag}>"
        for tag, side in (("leftBound", "left"), ("rightBound", "right"))
    )
    links = "".join(f'<successor ref="{s}"/>' for s in lane["successors"])
    for tag, side in (("adjacentLeft", "left_lane"), ("adjacentRight", "right_lane")):
        if lane[side] is not None:
            links += f'<{tag} ref="{lane[side]}" drivingDir="same"/>'
    if not is_new:
        kind = "intersection" if lane["inside"] else "urban"
        links += f"<laneletType>{kind}</laneletType><speedLimit>{lane['limit']}</speedLimit>"
        return f'<lanelet id="{lane["id"]}">{bounds}{links}</lanelet>'
    if lane["id"] in lit:
        links += '<stopLine><lineMarking>solid</lineMarking></stopLine><trafficLightRef ref="8"/>'
    links += '<laneletType>urban</laneletType><trafficSignRef ref="7"/>'
    return f'<lanelet id="{lane["id"]}">{bounds}{links}</lanelet>'


def _obstacle(track, is_new):
    states = [
        f"<position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>{heading}"
        f"</exact></orientation><time><exact>{round(t * 10)}</exact></time><velocity><exact>{speed}"
        "</exact></velocity>"
        for t, x, y, heading, speed in track["rows"]
    ]
    tag = "dynamicObstacle" if is_new else "obstacle"
    role = "" if is_new else "<role>dynamic</role>"
    length, width = track["size"]
    return (
        f'<{tag} id="{track["id"]}">{role}<type>{track["category"]}</type><shape><rectangle>'
        f"<length>{length}</length><width>{width}</width></rectangle></shape><initialState>"
        f"{states[0]}</initialState><trajectory>"
        f"{''.join(f'<state>{state}</state>' for state in states[1:])}</trajectory></{tag}>"
    )


# --- py123d


def write_py123d(folder, split="demo_val", site="avenue", labels="NuPlanBoxDetectionLabel"):
    """One log as py123d writes it, with a map of its own; returns the folder of the log."""
    content = demo_content(site)
    log = folder / "logs" / split / "log-1"
    log.mkdir(parents=True)
    about = {"dataset": split.split("_")[0], "split": split, "log_name": "log-1"}
    about |= {"location": "here", "version": "0.7.0", "map_metadata": None}
    _write(log / "sync.arrow", pa.table({"sync.timestamp_us": pa.array([0], pa.int64())}), about)
    frames = frames_of(content)
    _write_ego(log / "ego_state_se3.arrow", content)
    _write_boxes(log / "box_detections_se3.arrow", frames, labels)
    _write_lights(log / "traffic_light_detections.arrow", content, frames)
    _write_map(log / "map.arrow", content)
    _write_routes(log / "custom.scenario.arrow", content, frames)
    return log


def known_route(content):
    """Groups of lanes along which the route of the files leads: the first lane and what follows."""
    lanes = {lane["id"]: lane for lane in content["lanes"]}
    lane = next(lane for lane in content["lanes"] if lane["successors"] and not lane["inside"])
    after = lanes[lane["successors"][0]]
    return [lane["group"], after["group"], lanes[after["successors"][0]]["group"]]


def _write_routes(path, content, frames):
    """The true route from 3 s on, as py123d has it of nuPlan; before it there is none."""
    routes = [[] if t < START_US + 1_000_000 else known_route(content) for t in frames]
    packed = [
        msgpack.packb({"lidar_token": "00ff", "route_roadblock_ids": list(map(str, route))})
        for route in routes
    ]
    table = pa.table(
        {
            "custom.scenario.timestamp_us": pa.array(list(frames), pa.int64()),
            "custom.scenario.data": pa.array(packed, pa.binary()),
        }
    )
    _write(path, table, {"modality_id": "scenario", "metadata": {}})


def frames_of(content):
    """Boxes by time [us]: (id, category, x, y, heading, length, width, speed)."""
    frames = {}
    for track in content["tracks"]:
        for t, x, y, heading, speed in track["rows"]:
            row = (track["id"], track["category"], x, y, heading, *track["size"], speed)
            frames.setdefault(START_US + round(t * 1e6), []).append(row)
    return dict(sorted(frames.items()))


def _write(path, table, metadata):
    table = table.replace_schema_metadata({b"metadata": msgpack.packb(metadata)})
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)


def _turn(heading):
    return [float(np.cos(heading / 2)), 0.0, 0.0, float(np.sin(heading / 2))]


def _write_ego(path, content):
    rows = [(START_US + round(r[0] * 1e6), *r[1:4]) for r in content["ego"]["rows"]]
    poses = [
        [x - CENTER_TO_IMU * np.cos(h), y - CENTER_TO_IMU * np.sin(h), 0.0, *_turn(h)]
        for _, x, y, h in rows
    ]
    pose = pa.list_(pa.float64(), 7)
    table = pa.table(
        {
            "ego_state_se3.timestamp_us": pa.array([r[0] for r in rows], pa.int64()),
            "ego_state_se3.imu_se3": pa.array(poses, pose),
            "ego_state_se3.dynamic_state_se3": pa.nulls(len(rows), pa.list_(pa.float64(), 9)),
        }
    )
    frame = [CENTER_TO_IMU, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    length, width = EGO_SIZE
    about = {"length": length, "width": width, "wheel_base": 2.8, "center_to_imu_se3": frame}
    _write(path, table, about)


LABELS = dict.fromkeys(("car", "van", "pickup", "bus", "truck"), 0)
LABELS |= {"bicycle": 1, "motorcycle": 1, "pedestrian": 2}


def _write_boxes(path, frames, labels):
    name = "box_detections_se3"
    boxes = [
        [[x, y, 0.0, *_turn(h), length, width, 1.5] for _, _, x, y, h, length, width, _ in rows]
        for rows in frames.values()
    ]
    moves = [[[r[7] * np.cos(r[4]), r[7] * np.sin(r[4]), 0.0] for r in f] for f in frames.values()]
    kinds = [[LABELS.get(row[1], 6) for row in rows] for rows in frames.values()]
    columns = {
        "timestamp_us": pa.array(list(frames), pa.int64()),
        "bounding_box_se3": pa.array(boxes, pa.list_(pa.list_(pa.float64(), 10))),
        "track_token": pa.array([[r[0] for r in f] for f in frames.values()]),
        "label": pa.array(kinds, pa.list_(pa.uint16())),
        "velocity_3d": pa.array(moves, pa.list_(pa.list_(pa.float64(), 3))),
    }
    table = pa.table({f"{name}.{column}": values for column, values in columns.items()})
    _write(path, table, {"box_detection_label_class": labels})


def lit_lane(content):
    """The lane whose light the files show: red for 3 s, then green."""
    return next(lane["id"] for lane in content["lanes"] if lane["inside"])


def _write_lights(path, content, frames):
    name, lane = "traffic_light_detections", lit_lane(content)
    status = [[2 if time < START_US + 3_000_000 else 0] for time in frames]
    table = pa.table(
        {
            f"{name}.timestamp_us": pa.array(list(frames), pa.int64()),
            f"{name}.lane_id": pa.array([[lane]] * len(frames), pa.list_(pa.int32())),
            f"{name}.status": pa.array(status, pa.list_(pa.uint8())),
        }
    )
    _write(path, table, {})


def _write_map(path, content):
    lanes, groups = content["lanes"], {}
    for lane in lanes:
        groups.setdefault(lane["group"], []).append(lane)
    rows = [
        (lane["id"], 0, _lane_features(lane), lane["left"] + lane["right"][::-1]) for lane in lanes
    ]
    for number, members in groups.items():
        inside = 5 if members[0]["inside"] else None
        features = {"lane_ids": [lane["id"] for lane in members], "intersection_id": inside}
        rows.append((number, 1, features, members[0]["left"] + members[0]["right"][::-1]))
    rows += [(i, 3, {}, ring) for i, ring in enumerate(content["crosswalks"])]
    rows += [(i, 6, {}, ring) for i, ring in enumerate(content["drivable"])]
    table = pa.table(
        {
            "object_id": pa.array([row[0] for row in rows], pa.int64()),
            "map_layer": pa.array([row[1] for row in rows], pa.int8()),
            "features": pa.array([msgpack.packb(row[2]) for row in rows], pa.binary()),
            "wkb": pa.array([shapely.Polygon(row[3]).buffer(0).wkb for row in rows], pa.binary()),
        }
    )
    _write(path, table, {"dataset": "demo"})


def _lane_features(lane):
    lines = {"left_boundary": "left", "right_boundary": "right", "centerline": "center"}
    return {
        "lane_type": 2,
        "lane_group_id": lane["group"],
        **{name: _packed(lane[key]) for name, key in lines.items()},
        "left_lane_id": lane["left_lane"],
        "right_lane_id": lane["right_lane"],
        "predecessor_ids": lane["predecessors"],
        "successor_ids": lane["successors"],
        "speed_limit_mps": lane["limit"],
    }


def _packed(line):
    array = np.column_stack([line, np.zeros(len(line))])
    return {
        b"__ndarray__": True,
        b"dtype": array.dtype.str,
        b"shape": array.shape,
        b"data": array.tobytes(),
    }


WRITERS = {
    "av2": (Av2Reader, write_av2),
    "commonroad": (CommonRoadReader, write_commonroad),
    "commonroad-2018b": (CommonRoadReader, lambda folder: write_commonroad(folder, "2018b")),
    "py123d": (Py123dReader, write_py123d),
}
COMMANDS = ("av2", "commonroad", "py123d")
