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
import pyarrow.compute as pc
import shapely

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.lanes.lights import LightStates, states_of_lists
from shiftsim.data.lanes.map import PieceMap, build_lane_map
from shiftsim.data.lanes.pieces import MapSource, StopArea
from shiftsim.data.open_data import codes
from shiftsim.data.open_data.lane_names import LaneNames
from shiftsim.data.open_data.scenes import Scene
from shiftsim.data.open_data.source import Source, find_below, items, need
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.errors import import_extra
from shiftsim.world.state import AgentKind

HINT = "convert the log again with py123d 0.7.0"  # the version that is tested
EGO = "ego"
_LANE = LaneNames(
    left="left_boundary",
    right="right_boundary",
    center="centerline",
    successors="successor_ids",
    left_neighbor="left_lane_id",
    right_neighbor="right_lane_id",
    speed_limit="speed_limit_mps",
    line=np.ndarray,
)
_FEATURES = {  # by layer
    "lane": {**_LANE.form, "lane_type": (int,), "lane_group_id": (int,)},
    "lane group": {"intersection_id": (int,)},
    "stop zone": {"stop_zone_type": (int,)},
}
_DRIVABLE = ("lane group", "intersection", "car park", "drivable area")
_STAMP = need("timestamp_us", pa.int64())
_ABOUT = {"dataset": str, "location": (str,)}
_FILES = {  # columns and metadata by file of a log
    "sync": ([], {**_ABOUT, "split": str, "version": (str,), "map_metadata": (_ABOUT,)}),
    "ego_state_se3": (
        [_STAMP, need("imu_se3", items(pa.float64(), 7))],
        {"length": float, "width": float, "center_to_imu_se3": [float]},
    ),
    "box_detections_se3": (
        [
            _STAMP,
            need("bounding_box_se3", items(items(pa.float64(), 10))),
            need("track_token", items(pa.string())),
            need("velocity_3d", pa.list_(items(pa.float64(), 3))),  # null where it is unknown
            need("label", items(pa.uint16())),
        ],
        {"box_detection_label_class": str},
    ),
    "traffic_light_detections": (
        [_STAMP, need("lane_id", items(pa.int32())), need("status", items(pa.uint8()))],
        {},
    ),
}
_MAP: Any = (  # the same of a map
    [
        need("object_id", pa.int64()),
        need("map_layer", pa.int8()),
        *(need(name, pa.binary()) for name in ("features", "wkb")),
    ],
    {},
)


class Py123dReader:
    """Logs of py123d; a scene is named by the folder of its log."""

    def find(self, folder: Path) -> list[Path]:
        """Folders of the logs, sorted."""
        import_extra("msgpack", "py123d")
        hint = "give the folder that py123d wrote, with logs/ and maps/"
        return [path.parent for path in find_below(folder, "ego_state_se3.arrow", hint)]

    def files(self, path: Path) -> list[Path]:
        """Tracks, lights, and the map of the log or of its city."""
        files = [path / f"{name}.arrow" for name in _FILES]
        return [file for file in (*files, _map_path(path)) if file.is_file()]

    def read(self, path: Path) -> Scene:
        """One log."""
        sync = _File(path / "sync.arrow")
        dataset, split = sync.notes["dataset"], sync.notes["split"]
        if dataset.startswith("wod") and split.endswith("test"):
            raise sync.fault(f"split {split!r} hides the future", "convert train or val")
        lights, map_path = _read_lights(path), _map_path(path)
        city = path.name if map_path.parent == path else sync.notes.get("location")
        samples = _read_tracks(path)
        with Source(map_path).naming():
            lit = frozenset(lights.names if lights else ())
            lanes = _read_map(map_path, f"{dataset}-{city}", lit)
        licences = [text for name, text in codes.LICENCES.items() if dataset.startswith(name)]
        return Scene(
            samples=samples,
            map=lanes,
            egos=(EGO,),
            lights=lights,
            metadata={
                "source": f"{dataset} {split}, through py123d {sync.notes.get('version')}",
                "licence": next(iter(licences), "that of the source"),
            },
        )


class _File(Source):
    """An Arrow file: its columns, and what msgpack packed in its metadata and cells."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, HINT)
        columns, form = _FILES.get(path.stem, _MAP)
        self.table = self.columns(columns, prefix=f"{path.stem}." if path.stem in _FILES else "")
        packed = (self.table.schema.metadata or {}).get(b"metadata")
        self.notes = self.unpack(packed, form, "'metadata'")

    def unpack(self, data: bytes | None, form: Any, place: str) -> dict[Any, Any]:
        """What msgpack packed: plain values and arrays of float64, nothing else."""
        unpackb = import_extra("msgpack", "py123d").unpackb
        try:
            found: Any = data and unpackb(data, strict_map_key=False, object_hook=_array)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise self.fault(f"{place} cannot be unpacked ({error})") from error
        self.expect(found, form, place)
        return dict(found)

    def stamps(self) -> IntArray:
        """(R,) time stamps [us]."""
        return self.numbers(self.table, "timestamp_us", "time").astype(np.int64)

    def lists(self) -> tuple[IntArray, list[pa.Array]]:
        """The row of each item of the lists in all columns but the first, and the items."""
        found = [column.combine_chunks() for column in self.table.columns[1:]]
        rows = [pc.list_parent_indices(column).to_numpy() for column in found]
        for name, one in zip(self.table.column_names[1:], rows, strict=True):
            if not np.array_equal(one, rows[0]):
                raise self.fault(f"lists of {name!r} have lengths of their own")
        return rows[0], [column.flatten() for column in found]

    def boxes(self, found: FloatArray) -> FloatArray:
        """(R, 5) x, y, heading, length, width of boxes x, y, z, quaternion, length, width."""
        parts = ("position", slice(2)), ("rotation", slice(3, 7)), ("size", slice(7, 9))
        for field, part in parts:
            self.require(field, found[:, part], "box")
        return np.column_stack([found[:, :2], _yaws(found[:, 3:7]), found[:, 7:9]])


def _array(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in found:
        return found
    if found[b"dtype"] != "<f8":
        raise ValueError(f"an array of {found[b'dtype']!r}, need '<f8'")
    return np.frombuffer(found[b"data"], "<f8").reshape(found[b"shape"])


def _yaws(q: FloatArray) -> FloatArray:
    """(R,) headings of quaternions (R, 4) w, x, y, z [rad]."""
    w, x, y, z = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _vectors(column: pa.Array, count: int) -> FloatArray:
    """(R, count) the first parts of a column of vectors; NaN where there is none."""
    parts = [pc.list_element(column, i).to_numpy(zero_copy_only=False) for i in range(count)]
    return np.column_stack(parts)


def _map_path(log: Path) -> Path:
    """Where the map of a log is: beside it, or in the `maps` of the whole folder."""
    notes = _File(log / "sync.arrow").notes
    about = notes.get("map_metadata") or notes
    shared = f"maps/{about['dataset']}/{about['dataset']}_{about.get('location')}.arrow"
    beside = log / "map.arrow"
    return next((p for p in (beside, *(up / shared for up in log.parents)) if p.is_file()), beside)


def _read_tracks(log: Path) -> TrackSamples:
    """The boxes of all steps, and the box of the recording car."""
    ego_us, ego = _ego_boxes(log)
    file = _File(log / "box_detections_se3.arrow")
    rows, (boxes, tokens, velocities, labels) = file.lists()
    label_class = file.notes["box_detection_label_class"].rpartition(".")[2]
    file.known([label_class], codes.LABELS, "label class")
    kinds = codes.LABELS[label_class]
    file.known(labels.unique().to_pylist(), kinds, f"{label_class}: label")
    category = [*(kinds[label] for label in labels.to_pylist()), *[AgentKind.VEHICLE] * len(ego)]
    every = np.concatenate([file.boxes(_vectors(boxes, 9)), ego])
    names = [kind.name.lower() for kind in AgentKind]
    with Source(log).naming():
        return make_samples(
            log.name,
            time_us=np.concatenate([file.stamps()[rows], ego_us]),
            ids=np.array([*tokens.to_pylist(), *[EGO] * len(ego)]),
            category=np.array(category, np.int64),
            categories=names,
            kind_of=dict(zip(names, AgentKind, strict=True)),
            xy=every[:, :2],
            headings=every[:, 2],
            velocities=np.concatenate([_vectors(velocities, 2), np.full((len(ego), 2), np.nan)]),
            sizes=every[:, 3:],
        )


def _ego_boxes(log: Path) -> tuple[IntArray, FloatArray]:
    """Time stamps [us], and rows x, y, heading of the box centre, length, width of the ego.

    Stored velocities of egos are 0 in many rows in which the car moves, and are not used.
    """
    file = _File(log / "ego_state_se3.arrow")
    # of equal stamps the first is kept
    stamps, first = np.unique(file.stamps(), return_index=True)
    poses = _vectors(file.table["imu_se3"].combine_chunks(), 7)[first]
    sizes = np.broadcast_to([file.notes["length"], file.notes["width"]], (len(poses), 2))
    boxes = file.boxes(np.column_stack([poses, sizes]))
    center = np.array(file.notes["center_to_imu_se3"])
    if center.shape != (7,):
        raise file.fault(f"'center_to_imu_se3' has {center.size} numbers, need 7")
    cos, sin = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    boxes[:, 0] = boxes[:, 0] + cos * center[0] - sin * center[1]
    boxes[:, 1] = boxes[:, 1] + sin * center[0] + cos * center[1]
    boxes[:, 2] += _yaws(center[None, 3:])
    return stamps, boxes


def _read_lights(log: Path) -> LightStates | None:
    path = log / "traffic_light_detections.arrow"
    if not path.is_file():
        return None
    file = _File(path)
    rows, (lanes, shown) = file.lists()
    return states_of_lists(file.stamps(), rows, lanes.to_numpy(), shown.to_numpy(), codes.LIGHTS)


@lru_cache(maxsize=1)  # logs of one city follow each other
def _read_map(path: Path, name: str, lit: frozenset[str]) -> PieceMap:
    """A map; `lit` are the lanes that have a light."""
    file = _File(path)
    table = file.table.filter(pc.is_in(file.table["map_layer"], pa.array(codes.LAYERS, pa.int8())))
    numbers, layers, features, wkb = (column.to_pylist() for column in table.columns)
    found: defaultdict[str, dict[int, dict[Any, Any]]] = defaultdict(dict)
    areas: defaultdict[str, list[shapely.Polygon]] = defaultdict(list)
    stops: list[StopArea] = []
    shapes = shapely.from_wkb(wkb, on_invalid="ignore")
    for number, code, packed, shape in zip(numbers, layers, features, shapes, strict=True):
        layer = codes.LAYERS[code]
        place = f"{layer} {number}"
        if layer in _FEATURES:
            found[layer][number] = file.unpack(packed, _FEATURES[layer], place)
        if layer != "lane":
            areas[layer].append(file.area(shape, f"wkb of {place}"))
        if layer == "stop zone":
            kind = codes.STOPS.get(found[layer][number].get("stop_zone_type"), codes.OTHER_STOP)
            stops.append(StopArea(areas[layer][-1], kind))
    groups = found["lane group"].items()
    inside = {number for number, group in groups if group.get("intersection_id") is not None}
    return build_lane_map(
        MapSource(
            name=name,
            pieces=[
                _LANE.piece(
                    file,
                    lane,
                    str(number),
                    is_connector=lane.get("lane_group_id") in inside,
                    light=str(number) if str(number) in lit else None,
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
