"""Writes a log with py123d's own classes: PYTHON write_py123d.py CONTENT.json FOLDER.

Runs in an environment that holds py123d 0.7.0 and not shiftsim; `test_py123d.py` starts it with
the Python that `SHIFTSIM_PY123D_PYTHON` names. CONTENT is what `open_data_files` makes.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.datatypes import (
    Crosswalk,
    GenericDrivable,
    Intersection,
    IntersectionType,
    Lane,
    LaneGroup,
    LaneType,
    LogMetadata,
    MapMetadata,
    Timestamp,
)
from py123d.datatypes.detections import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    BoxDetectionsSE3Metadata,
    TrafficLightDetection,
    TrafficLightDetections,
    TrafficLightStatus,
)
from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
from py123d.geometry import BoundingBoxSE3, Polyline3D, PoseSE3, Vector3D
from py123d.parser.base_dataset_parser import ModalitiesSync
from py123d.parser.registry import NuPlanBoxDetectionLabel

INTERSECTION = 77


def line(points):
    return Polyline3D.from_array(np.column_stack([points, np.zeros(len(points))]))


def pose(x, y, heading):
    return PoseSE3(x, y, 0.0, float(np.cos(heading / 2)), 0.0, 0.0, float(np.sin(heading / 2)))


def write_map(content, folder, about):
    writer = ArrowMapWriter(True, folder / "maps", folder / "logs")
    writer.reset(about)
    groups = defaultdict(list)
    for lane in content["lanes"]:
        groups[lane["group"]].append(lane)
        writer.write_map_object(
            Lane(
                object_id=lane["id"],
                lane_type=LaneType.SURFACE_STREET,
                left_boundary=line(lane["left"]),
                right_boundary=line(lane["right"]),
                centerline=line(lane["center"]),
                lane_group_id=lane["group"],
                left_lane_id=lane["left_lane"],
                right_lane_id=lane["right_lane"],
                predecessor_ids=lane["predecessors"],
                successor_ids=lane["successors"],
                speed_limit_mps=lane["limit"],
            )
        )
    inside = [number for number, lanes in groups.items() if lanes[0]["inside"]]
    for number, lanes in groups.items():
        writer.write_map_object(
            LaneGroup(
                object_id=number,
                lane_ids=[lane["id"] for lane in lanes],
                left_boundary=line(lanes[0]["left"]),
                right_boundary=line(lanes[-1]["right"]),
                intersection_id=INTERSECTION if number in inside else None,
            )
        )
    hull = content["drivable"][0]
    kind = IntersectionType.DEFAULT
    writer.write_map_object(Intersection(INTERSECTION, kind, inside, outline=line(hull)))
    for number, ring in enumerate(content["crosswalks"]):
        writer.write_map_object(Crosswalk(number, outline=line(ring)))
    for number, ring in enumerate(content["drivable"]):
        writer.write_map_object(GenericDrivable(number, outline=line(ring)))
    writer.close()


def write_log(content, folder, about):
    length, width = content["ego"]["size"]
    ego = EgoStateSE3Metadata(
        vehicle_name="demo",
        width=width,
        length=length,
        height=1.6,
        wheel_base=2.8,
        center_to_imu_se3=pose(content["center_to_imu"], 0.0, 0.0),
        rear_axle_to_imu_se3=pose(0.0, 0.0, 0.0),
    )
    labels = BoxDetectionsSE3Metadata(box_detection_label_class=NuPlanBoxDetectionLabel)
    frames = defaultdict(list)
    for track in content["tracks"]:
        for t, x, y, heading, speed in track["rows"]:
            along = Vector3D(speed * np.cos(heading), speed * np.sin(heading), 0.0)
            box = BoundingBoxSE3(pose(x, y, heading), *track["size"], 1.5)
            label = content["labels"].get(track["category"], 6)
            attributes = BoxDetectionAttributes(NuPlanBoxDetectionLabel(label), track["id"])
            frames[round(t * 1e6)].append(BoxDetectionSE3(attributes, box, along))
    writer = ArrowLogWriter(
        LogWriterConfig(force_log_conversion=True), folder / "logs", folder / "sensors", "zstd"
    )
    writer.reset(about)
    for t, x, y, heading, _ in content["ego"]["rows"]:
        time = Timestamp.from_us(content["start_us"] + round(t * 1e6))
        back = content["center_to_imu"]
        at = pose(x - back * np.cos(heading), y - back * np.sin(heading), heading)
        state = EgoStateSE3.from_imu(at, metadata=ego, timestamp=time)
        status = TrafficLightStatus.RED if t < 2.95 else TrafficLightStatus.GREEN
        light = TrafficLightDetection(content["lit_lane"], status)
        parts = [
            state,
            BoxDetectionsSE3(frames.get(round(t * 1e6), []), time, labels),
            TrafficLightDetections([light], time),
        ]
        writer.write_sync(ModalitiesSync(time, parts))
    writer.close()


def main():
    content = json.loads(Path(sys.argv[1]).read_text())
    folder = Path(sys.argv[2])
    names = {"dataset": "demo", "split": "demo_val", "log_name": "log-1", "location": "here"}
    map_about = MapMetadata(map_has_z=False, map_is_per_log=True, **names)
    write_map(content, folder, map_about)
    write_log(content, folder, LogMetadata(map_metadata=map_about, **names))


if __name__ == "__main__":
    main()
