"""Reader of logs that py123d has converted: Waymo, nuScenes, Argoverse 2 Sensor, nuPlan and others.

py123d itself is not needed: its files are Arrow tables whose objects are packed with msgpack. They
have no version of their own, so every column is checked; tested with files of py123d 0.7.0.
"""

from collections import defaultdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.lanes.lights import LightStates, states_of_lists
from shiftsim.data.lanes.map import PieceMap, build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource, StopArea
from shiftsim.data.open_data import codes
from shiftsim.data.open_data.packed import PackedTable, need_msgpack, vectors, yaws
from shiftsim.data.open_data.scenes import Scene
from shiftsim.data.open_data.source import Source, find_below, text_or_none
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.world.state import AgentKind

HINT = "convert the log again with py123d 0.7.0"  # the version that is tested
EGO = "ego"
_POSE, _BOX, _VELOCITY = (pa.list_(pa.float64(), width) for width in (7, 10, 3))
_FILES = {  # columns by file of a log; those of boxes and lights hold lists
    "sync": {},
    "ego_state_se3": {"timestamp_us": pa.int64(), "imu_se3": _POSE},
    "box_detections_se3": {
        "timestamp_us": pa.int64(),
        "bounding_box_se3": pa.list_(_BOX),
        "track_token": pa.list_(pa.string()),
        "velocity_3d": pa.list_(_VELOCITY),
        "label": pa.list_(pa.uint16()),
    },
    "traffic_light_detections": {
        "timestamp_us": pa.int64(),
        "lane_id": pa.list_(pa.int32()),
        "status": pa.list_(pa.uint8()),
    },
}
_LINES = {"left": "left_boundary", "right": "right_boundary", "center": "centerline"}
_MAP = {
    "object_id": pa.int64(),
    "map_layer": pa.int8(),
    "features": pa.binary(),
    "wkb": pa.binary(),
}
_WITH_FEATURES = ("lane", "lane group", "stop zone")
_DRIVABLE = ("lane group", "intersection", "car park", "drivable area")


class Py123dReader:
    """Logs of py123d; a scene is named by the folder of its log."""

    def find(self, folder: Path) -> list[Path]:
        """Folders of the logs, sorted."""
        need_msgpack()
        hint = "give the folder that py123d wrote, with logs/ and maps/"
        return [path.parent for path in find_below(folder, "ego_state_se3.arrow", hint)]

    def files(self, path: Path) -> list[Path]:
        """Tracks, lights, and the map of the log or of its city."""
        files = [path / f"{name}.arrow" for name in _FILES]
        files.append(_map_path(path, _open(path, "sync")[1]))
        return [file for file in files if file.is_file()]

    def read(self, path: Path) -> Scene:
        """One log."""
        notes = _open(path, "sync")[1]  # of the whole log
        dataset, split = str(notes.get("dataset", "")), str(notes.get("split", ""))
        if dataset.startswith("wod") and split.endswith("test"):
            what = f"{path}: split {split!r} hides the future"
            raise ConversionError(what, "convert train or val")
        lights = _read_lights(path)
        lit = frozenset() if lights is None else frozenset(lights.names)
        map_path = _map_path(path, notes)
        city = path.name if map_path.parent == path else str(notes.get("location", ""))
        samples = _read_tracks(path)
        with Source(map_path).naming():
            lanes = _read_map(map_path, f"{dataset}-{city}", lit)
        licences = [text for name, text in codes.LICENCES.items() if dataset.startswith(name)]
        return Scene(
            samples=samples,
            map=lanes,
            egos=(EGO,),
            lights=lights,
            metadata={
                "source": f"{dataset} {split}, through py123d {notes.get('version', '')}",
                "licence": next(iter(licences), "that of the source"),
            },
        )


def _open(log: Path, name: str) -> tuple[PackedTable, dict[Any, Any]]:
    """A file of a log, and the `metadata` of its schema."""
    file = PackedTable(log / f"{name}.arrow", _FILES[name], HINT, prefix=f"{name}.")
    return file, file.notes()


def _map_path(log: Path, notes: dict[Any, Any]) -> Path:
    """Where the map of a log is: beside it, or in the `maps` of the whole folder."""
    about = notes.get("map_metadata") or notes
    dataset = str(about.get("dataset", ""))
    shared = f"maps/{dataset}/{dataset}_{about.get('location')}.arrow"
    beside = log / "map.arrow"
    return next((p for p in (beside, *(up / shared for up in log.parents)) if p.is_file()), beside)


def _read_tracks(log: Path) -> TrackSamples:
    """The boxes of all steps, and the box of the recording car."""
    ego_us, ego = _ego_boxes(log)
    file, notes = _open(log, "box_detections_se3")
    stamps = file.stamps(file.table)
    counts, columns = file.lists(*list(_FILES["box_detections_se3"])[1:])
    label_class = str(notes.get("box_detection_label_class")).rpartition(".")[2]
    if label_class not in codes.LABELS:
        what = f"label class {label_class!r} is unknown"
        raise file.fault(what, f"known are: {', '.join(codes.LABELS)}")
    boxes, tokens, velocities, labels = columns
    kinds = codes.LABELS[label_class]
    if unknown := set(labels.to_pylist()) - set(kinds):
        raise file.fault(f"label {min(unknown)} of {label_class} is unknown")
    category = [kinds[label] for label in labels.to_pylist()]
    every = np.concatenate([file.boxes(vectors(boxes)), ego])
    moves = np.concatenate([vectors(velocities)[:, :2], np.full((len(ego), 2), np.nan)])
    names = [kind.name.lower() for kind in AgentKind]
    with file.naming():
        return make_samples(
            log.name,
            time_us=np.concatenate([np.repeat(stamps, counts), ego_us]),
            ids=np.array([*tokens.to_pylist(), *[EGO] * len(ego)]),
            category=np.array([*category, *[AgentKind.VEHICLE] * len(ego)], np.int64),
            categories=names,
            kind_of=dict(zip(names, AgentKind, strict=True)),
            xy=every[:, :2],
            headings=every[:, 2],
            velocities=moves,
            sizes=every[:, 3:],
        )


def _ego_boxes(log: Path) -> tuple[IntArray, FloatArray]:
    """Time stamps [us], and rows x, y, heading of the box centre, length, width of the ego.

    Stored velocities of egos are 0 in many rows in which the car moves, and are not used.
    """
    file, notes = _open(log, "ego_state_se3")
    poses = vectors(file.table["imu_se3"].combine_chunks())
    try:
        to_center = np.array(notes["center_to_imu_se3"], np.float64).reshape(7)
        size = np.array([notes["length"], notes["width"]], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise file.fault(f"'metadata' lacks {error}") from error
    sizes = np.broadcast_to(size, (len(poses), 2))
    boxes = file.boxes(np.column_stack([poses, sizes]))
    cos, sin = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    boxes[:, 0] = boxes[:, 0] + cos * to_center[0] - sin * to_center[1]
    boxes[:, 1] = boxes[:, 1] + sin * to_center[0] + cos * to_center[1]
    boxes[:, 2] += yaws(to_center[None, 3:])
    # of equal stamps the first is kept
    stamps, first = np.unique(file.stamps(file.table), return_index=True)
    return stamps, boxes[first]


def _read_lights(log: Path) -> LightStates | None:
    if not (log / "traffic_light_detections.arrow").is_file():
        return None
    file, _ = _open(log, "traffic_light_detections")
    lanes, shown = (file.table[name].to_pylist() for name in ("lane_id", "status"))
    return states_of_lists(file.stamps(file.table), lanes, shown, codes.LIGHT_CODES)


@lru_cache(maxsize=1)  # logs of one city follow each other
def _read_map(path: Path, name: str, lit: frozenset[str]) -> PieceMap:
    """A map; `lit` are the lanes that have a light."""
    file = PackedTable(path, _MAP, HINT)
    found: defaultdict[str, dict[str, dict[Any, Any]]] = defaultdict(dict)
    areas: defaultdict[str, list[shapely.Polygon]] = defaultdict(list)
    stops: list[StopArea] = []
    for number, code, features, wkb in zip(*(file.table[n].to_pylist() for n in _MAP), strict=True):
        layer = codes.LAYERS.get(code, "")
        place = f"{layer} {number}"
        if layer in _WITH_FEATURES:
            found[layer][str(number)] = file.unpack(features or b"", place)
        if layer and layer != "lane":
            areas[layer].append(file.polygon(wkb, place))
        if layer == "stop zone":
            kind = found[layer][str(number)].get("stop_zone_type")
            code = kind if isinstance(kind, int) else 0
            stops.append(StopArea(areas[layer][-1], codes.STOP_CODES.get(code, codes.OTHER_STOP)))
    inside = {n for n, g in found["lane group"].items() if g.get("intersection_id") is not None}
    return build_lane_map(
        MapSource(
            name=name,
            pieces=[
                LanePiece(
                    id=number,
                    **{s: file.line_of(lane, key, f"lane {number}") for s, key in _LINES.items()},
                    successors=tuple(map(str, lane.get("successor_ids") or ())),
                    left_neighbor=text_or_none(lane.get("left_lane_id")),
                    right_neighbor=text_or_none(lane.get("right_lane_id")),
                    is_connector=text_or_none(lane.get("lane_group_id")) in inside,
                    speed_limit=_limit(file, lane, number),
                    light=number if number in lit else None,
                )
                for number, lane in found["lane"].items()
                if lane.get("lane_type") != codes.BIKE_LANE
            ],
            # Waymo has no drivable areas
            drivable_areas=[a for n in _DRIVABLE for a in areas[n] if areas["drivable area"]],
            stop_areas=stops,
            crosswalks=areas["crosswalk"],
            walkways=areas["walkway"],
            car_parks=areas["car park"],
        )
    )


def _limit(file: Source, lane: dict[Any, Any], number: str) -> float | None:
    limit = lane.get("speed_limit_mps")
    return None if limit is None else file.number(limit, "speed limit", f"lane {number}")
