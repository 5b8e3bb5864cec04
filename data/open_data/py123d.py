"""Reader of logs that py123d has converted: Waymo, nuScenes, Argoverse 2 Sensor, nuPlan and others.

py123d itself is not needed: its files are Arrow tables whose objects are packed with msgpack. They
have no version of their own, so every column is checked; tested with files of py123d 0.7.0.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.open_data.py123d_map import HINT, need_msgpack, read_map, unpack
from shiftsim.data.open_data.scenes import LightStates, Scene
from shiftsim.data.open_data.source import Source, find_below
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.world.state import AgentKind, LightStatus

EGO = "ego"


def _codes(count: int, **groups: str) -> dict[int, AgentKind]:
    out = dict.fromkeys(range(count), AgentKind.GENERIC_OBJECT)
    for kind, codes in groups.items():
        out |= dict.fromkeys(map(int, codes.split()), AgentKind[kind.upper()])
    return out


# by class of labels: kind of every label
LABELS = {
    "DefaultBoxDetectionLabel": _codes(
        12, vehicle="0 1 2", bicycle="3", pedestrian="4", traffic_cone="7", barrier="9"
    ),
    "WODMotionBoxDetectionLabel": _codes(5, vehicle="1", pedestrian="2", bicycle="3"),
    "WODPerceptionBoxDetectionLabel": _codes(5, vehicle="1", pedestrian="2", bicycle="4"),
    "NuScenesBoxDetectionLabel": _codes(
        23,
        vehicle="0 1 2 3 4 5 6 7",
        bicycle="8 9",
        pedestrian="10 11 12 13 14 15 16",
        traffic_cone="17",
        barrier="18",
    ),
    "AV2SensorBoxDetectionLabel": _codes(
        30,
        vehicle="1 5 6 10 17 18 19 24 25 26",
        bicycle="3 14 29",
        pedestrian="15 16 22 27",
        traffic_cone="7 8",
        czone_sign="12",
    ),
    "NuPlanBoxDetectionLabel": _codes(
        7, vehicle="0", bicycle="1", pedestrian="2", traffic_cone="3", barrier="4", czone_sign="5"
    ),
}
_LICENCES = {
    "av2": "CC BY-NC-SA 4.0",
    "nuscenes": "CC BY-NC-SA 4.0",
    "wod": "Waymo Open Dataset License Agreement for Non-Commercial Use",
}
_LIGHTS = (LightStatus.GREEN, LightStatus.YELLOW, LightStatus.RED)  # others: unknown
_POSE, _BOX, _VELOCITY = (pa.list_(pa.float64(), width) for width in (7, 10, 3))
_EGO_COLUMNS = {"timestamp_us": pa.int64(), "imu_se3": _POSE}
_BOX_COLUMNS = {
    "timestamp_us": pa.int64(),
    "bounding_box_se3": pa.list_(_BOX),
    "track_token": pa.list_(pa.string()),
    "label": pa.list_(pa.uint16()),
    "velocity_3d": pa.list_(_VELOCITY),
}
_LIGHT_COLUMNS = {
    "timestamp_us": pa.int64(),
    "lane_id": pa.list_(pa.int32()),
    "status": pa.list_(pa.uint8()),
}


class Py123dReader:
    """Logs of py123d; a scene is named by the folder of its log."""

    def find(self, folder: Path) -> list[Path]:
        """Folders of the logs, sorted."""
        need_msgpack()
        hint = "give the folder that py123d wrote, with logs/ and maps/"
        return [path.parent for path in find_below(folder, "ego_state_se3.arrow", hint)]

    def files(self, path: Path) -> list[Path]:
        """Tracks, lights, and the map of the log or of its city."""
        names = "sync", "ego_state_se3", "box_detections_se3", "traffic_light_detections"
        files = [path / f"{name}.arrow" for name in names]
        return [file for file in (*files, _map_path(path, _notes(path))) if file.is_file()]

    def read(self, path: Path) -> Scene:
        """One log."""
        notes = _notes(path)
        dataset, split = str(notes.get("dataset", "")), str(notes.get("split", ""))
        if dataset.startswith("wod") and split.endswith("test"):
            raise ConversionError(
                f"{path}: split {split!r} hides the future", "convert train or val"
            )
        lights = _read_lights(path)
        lit = frozenset() if lights is None else frozenset(lights.names)
        map_path = _map_path(path, notes)
        city = path.name if map_path.parent == path else str(notes.get("location", ""))
        samples = _read_tracks(path)
        with Source(map_path).naming():
            lanes = read_map(map_path, f"{dataset}-{city}", lit)
        licences = [text for name, text in _LICENCES.items() if dataset.startswith(name)]
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


def _open(
    log: Path, name: str, columns: dict[str, pa.DataType]
) -> tuple[Source, pa.Table, dict[Any, Any]]:
    """A file of a log, some columns of it, and the `metadata` of its schema."""
    source = Source(log / f"{name}.arrow", HINT)
    table = source.columns(columns, prefix=f"{name}.")
    packed = (table.schema.metadata or {}).get(b"metadata")
    if packed is None:
        raise source.fault("the schema has no 'metadata'")
    return source, table, unpack(source, packed, "'metadata'")


def _notes(log: Path) -> dict[Any, Any]:
    """What py123d says of a whole log."""
    return _open(log, "sync", {})[2]


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
    source, table, notes = _open(log, "box_detections_se3", _BOX_COLUMNS)
    stamps = source.numbers(table, "timestamp_us", "time").astype(np.int64)
    lists = {name: table[name].combine_chunks() for name in list(_BOX_COLUMNS)[1:]}
    counts = {n: lists[n].value_lengths().fill_null(0).to_numpy() for n in lists}
    for name, count in counts.items():
        if (count != counts["label"]).any():
            raise source.fault(f"{name!r} and 'label' differ in length")
    label_class = str(notes.get("box_detection_label_class")).rpartition(".")[2]
    if label_class not in LABELS:
        what = f"label class {label_class!r} is unknown"
        raise source.fault(what, f"known are: {', '.join(LABELS)}")
    labels, kinds = lists["label"].flatten().to_pylist(), LABELS[label_class]
    for label in sorted(set(labels) - set(kinds)):
        raise source.fault(f"label {label} of {label_class} is unknown")
    category = np.array([kinds[label] for label in labels], np.int64)
    boxes = _vectors(lists["bounding_box_se3"].flatten())
    _require_boxes(source, boxes)
    velocities = _vectors(lists["velocity_3d"].flatten())[:, :2]
    names = [kind.name.lower() for kind in AgentKind]
    with source.naming():
        return make_samples(
            log.name,
            time_us=np.concatenate([np.repeat(stamps, counts["label"]), ego_us]),
            ids=np.array([*lists["track_token"].flatten().to_pylist(), *[EGO] * len(ego)]),
            category=np.concatenate([category, np.full(len(ego), AgentKind.VEHICLE)]),
            categories=names,
            kind_of=dict(zip(names, AgentKind, strict=True)),
            xy=np.concatenate([boxes[:, :2], ego[:, :2]]),
            headings=np.concatenate([_yaws(boxes[:, 3:7]), ego[:, 2]]),
            velocities=np.concatenate([velocities, np.full((len(ego), 2), np.nan)]),
            sizes=np.concatenate([boxes[:, 7:9], ego[:, 3:]]),
        )


def _ego_boxes(log: Path) -> tuple[IntArray, FloatArray]:
    """Time stamps [us], and rows x, y, heading of the box centre, length, width of the ego.

    Stored velocities of egos are 0 in many rows in which the car moves, and are not used.
    """
    source, table, notes = _open(log, "ego_state_se3", _EGO_COLUMNS)
    stamps = source.numbers(table, "timestamp_us", "time").astype(np.int64)
    poses = _vectors(table["imu_se3"].combine_chunks())
    try:
        to_center = np.array(notes["center_to_imu_se3"], np.float64).reshape(7)
        size = np.array([notes["length"], notes["width"]], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise source.fault(f"'metadata' lacks {error}") from error
    sizes = np.broadcast_to(size, (len(poses), 2))
    _require_boxes(source, np.column_stack([poses, sizes]))
    heading = _yaws(poses[:, 3:])
    cos, sin = np.cos(heading), np.sin(heading)
    x = poses[:, 0] + cos * to_center[0] - sin * to_center[1]
    y = poses[:, 1] + sin * to_center[0] + cos * to_center[1]
    boxes = np.column_stack([x, y, heading + _yaws(to_center[None, 3:]), sizes])
    stamps, first = np.unique(stamps, return_index=True)  # of equal stamps the first is kept
    return stamps, boxes[first]


def _require_boxes(source: Source, boxes: FloatArray) -> None:
    for field, part in (("position", slice(2)), ("rotation", slice(3, 7)), ("size", slice(7, 9))):
        source.require(field, boxes[:, part], "box")


def _vectors(column: pa.FixedSizeListArray) -> FloatArray:
    """(R, width) a column of vectors; NaN where there is none."""
    out = np.full((len(column), column.type.list_size), np.nan)
    found = column.drop_null().flatten().to_numpy(zero_copy_only=False)
    out[column.is_valid().to_numpy(zero_copy_only=False)] = found.reshape(-1, out.shape[1])
    return out


def _yaws(q: FloatArray) -> FloatArray:
    """(R,) headings of quaternions (R, 4) w, x, y, z [rad]."""
    w, x, y, z = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _read_lights(log: Path) -> LightStates | None:
    if not (log / "traffic_light_detections.arrow").is_file():
        return None
    source, table, _ = _open(log, "traffic_light_detections", _LIGHT_COLUMNS)
    stamps = source.numbers(table, "timestamp_us", "time").astype(np.int64)
    lanes, codes = (table[name].to_pylist() for name in ("lane_id", "status"))
    names = sorted({lane for row in lanes for lane in row or ()})
    column = {lane: i for i, lane in enumerate(names)}
    status = np.full((len(stamps), len(names)), LightStatus.ABSENT, np.int64)
    for row, (ids, values) in enumerate(zip(lanes, codes, strict=True)):
        for lane, code in zip(ids or (), values or (), strict=False):
            status[row, column[lane]] = _LIGHTS[code] if code < 3 else LightStatus.UNKNOWN
    order = np.argsort(stamps, kind="stable")
    return LightStates(tuple(map(str, names)), stamps[order], status[order])
