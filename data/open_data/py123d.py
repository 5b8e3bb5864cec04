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
from shiftsim.data.open_data.tables import naming, numbers, read_columns
from shiftsim.data.tracks.build import make_samples
from shiftsim.data.tracks.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.world.ranges import OPEN_DATA, require
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


def _vectors(length: int, *, listed: bool) -> pa.DataType:
    kind = pa.list_(pa.float64(), length)
    return pa.list_(kind) if listed else kind


class Py123dReader:
    """Logs of py123d; a scene is named by the folder of its log."""

    def find(self, folder: Path) -> list[Path]:
        """Folders of the logs, sorted."""
        need_msgpack()
        found = sorted(path.parent for path in folder.rglob("ego_state_se3.arrow"))
        if not found:
            raise ConversionError(
                f"{folder}: no ego_state_se3.arrow below it",
                "give the folder that py123d wrote, with logs/ and maps/",
            )
        return found

    def files(self, path: Path) -> list[Path]:
        """Tracks, lights, and the map of the log or of its city."""
        names = "sync", "ego_state_se3", "box_detections_se3", "traffic_light_detections"
        files = [path / f"{name}.arrow" for name in names]
        return [file for file in (*files, _map_path(path, _notes(files[0]))) if file.is_file()]

    def read(self, path: Path) -> Scene:
        """One log."""
        notes = _notes(path / "sync.arrow")
        dataset, split = str(notes.get("dataset", "")), str(notes.get("split", ""))
        if dataset.startswith("wod") and split.endswith("test"):
            raise ConversionError(
                f"{path}: split {split!r} hides the future", "convert train or val"
            )
        lights = _read_lights(path / "traffic_light_detections.arrow")
        lit = frozenset() if lights is None else frozenset(lights.names)
        map_path = _map_path(path, notes)
        city = path.name if map_path.parent == path else str(notes.get("location", ""))
        with naming(path / "box_detections_se3.arrow"):
            samples = _read_tracks(path)
        with naming(map_path):
            lanes = read_map(map_path, f"{dataset}-{city}", lit)
        return Scene(
            samples=samples,
            map=lanes,
            egos=(EGO,),
            lights=lights,
            metadata={
                "source": f"{dataset} {split}, through py123d {notes.get('version', '')}",
                "licence": next(
                    (text for name, text in _LICENCES.items() if dataset.startswith(name)),
                    "that of the source",
                ),
            },
        )


def _notes(path: Path) -> dict[Any, Any]:
    """The `metadata` in the schema of a file."""
    packed = (read_columns(path, {}, HINT).schema.metadata or {}).get(b"metadata")
    if packed is None:
        raise ConversionError(f"{path}: the schema has no 'metadata'", HINT)
    return unpack(packed, f"{path}: 'metadata'")


def _map_path(log: Path, notes: dict[Any, Any]) -> Path:
    """Where the map of a log is: beside it, or in the `maps` of the whole folder."""
    about = notes.get("map_metadata") or notes
    dataset = str(about.get("dataset", ""))
    shared = f"maps/{dataset}/{dataset}_{about.get('location')}.arrow"
    beside = log / "map.arrow"
    return next((p for p in (beside, *(up / shared for up in log.parents)) if p.is_file()), beside)


def _read_tracks(path: Path) -> TrackSamples:
    """The boxes of all steps, and the box of the recording car."""
    ego_us, ego = _ego_boxes(path / "ego_state_se3.arrow")
    file, prefix = path / "box_detections_se3.arrow", "box_detections_se3"
    wanted = {
        "timestamp_us": pa.int64(),
        "bounding_box_se3": _vectors(10, listed=True),
        "track_token": pa.list_(pa.string()),
        "label": pa.list_(pa.uint16()),
        "velocity_3d": _vectors(3, listed=True),
    }
    table = read_columns(file, {f"{prefix}.{n}": kind for n, kind in wanted.items()}, HINT)
    lists = {name: table[f"{prefix}.{name}"].combine_chunks() for name in list(wanted)[1:]}
    counts = {n: lists[n].value_lengths().fill_null(0).to_numpy() for n in lists}
    for name, count in counts.items():
        if (count != counts["label"]).any():
            raise ConversionError(f"{file}: {name!r} and 'label' differ in length", HINT)
    stamps = numbers(table, f"{prefix}.timestamp_us", "time", file).astype(np.int64)
    label_class = str(_notes(file).get("box_detection_label_class")).rpartition(".")[2]
    if label_class not in LABELS:
        what = f"{file}: label class {label_class!r} is unknown"
        raise ConversionError(what, f"known are: {', '.join(LABELS)}")
    labels = lists["label"].flatten().to_numpy().astype(np.int64)
    kinds = LABELS[label_class]
    for label in sorted(set(labels.tolist()) - set(kinds)):
        raise ConversionError(f"{file}: label {label} of {label_class} is unknown", HINT)
    boxes = _rows(lists["bounding_box_se3"].flatten(), 10)
    _check_boxes(boxes, file)
    velocities = _rows(lists["velocity_3d"].flatten(), 3)[:, :2]
    category = np.array([kinds[label] for label in labels.tolist()], np.int64)
    names = [kind.name.lower() for kind in AgentKind]
    return make_samples(
        path.name,
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


def _ego_boxes(file: Path) -> tuple[IntArray, FloatArray]:
    """Time stamps [us], and rows x, y, heading of the box centre, length, width of the ego.

    Stored velocities of egos are 0 in many rows in which the car moves, and are not used.
    """
    poses_of = "ego_state_se3.imu_se3"
    wanted = {"ego_state_se3.timestamp_us": pa.int64(), poses_of: _vectors(7, listed=False)}
    table = read_columns(file, wanted, HINT)
    notes = _notes(file)
    stamps = numbers(table, "ego_state_se3.timestamp_us", "time", file).astype(np.int64)
    poses = _rows(table[poses_of].combine_chunks(), 7)
    try:
        to_center = np.array(notes["center_to_imu_se3"], np.float64).reshape(7)
        size = np.array([notes["length"], notes["width"]], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise ConversionError(f"{file}: 'metadata' lacks {error}", HINT) from error
    _check_boxes(np.column_stack([poses, np.broadcast_to([*size, 1.0], (len(poses), 3))]), file)
    heading = _yaws(poses[:, 3:])
    cos, sin = np.cos(heading), np.sin(heading)
    x = poses[:, 0] + cos * to_center[0] - sin * to_center[1]
    y = poses[:, 1] + sin * to_center[0] + cos * to_center[1]
    heading = heading + _yaws(to_center[None, 3:])
    boxes = np.column_stack([x, y, heading, np.broadcast_to(size, (len(x), 2))])
    stamps, first = np.unique(stamps, return_index=True)  # of equal stamps the first is kept
    return stamps, boxes[first]


def _check_boxes(boxes: FloatArray, file: Path) -> None:
    for field, part in (("position", slice(2)), ("rotation", slice(3, 7)), ("size", slice(7, 9))):
        require(OPEN_DATA, field, boxes[:, part], f"{file}: box", error=ConversionError)


def _rows(column: pa.FixedSizeListArray, width: int) -> FloatArray:
    """(R, width) a column of vectors; NaN where there is none."""
    out = np.full((len(column), width), np.nan)
    values = column.drop_null().flatten()
    out[column.is_valid().to_numpy(zero_copy_only=False)] = values.to_numpy(
        zero_copy_only=False
    ).reshape(-1, width)
    return out


def _yaws(q: FloatArray) -> FloatArray:
    """(R,) headings of quaternions (R, 4) w, x, y, z [rad]."""
    w, x, y, z = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _read_lights(file: Path) -> LightStates | None:
    if not file.is_file():
        return None
    prefix = "traffic_light_detections"
    wanted = {"timestamp_us": pa.int64(), "lane_id": pa.list_(pa.int32())}
    wanted["status"] = pa.list_(pa.uint8())
    table = read_columns(file, {f"{prefix}.{n}": kind for n, kind in wanted.items()}, HINT)
    stamps = numbers(table, f"{prefix}.timestamp_us", "time", file).astype(np.int64)
    lanes, codes = (table[f"{prefix}.{n}"].to_pylist() for n in ("lane_id", "status"))
    names = sorted({lane for row in lanes for lane in row or ()})
    column = {lane: i for i, lane in enumerate(names)}
    status = np.full((len(stamps), len(names)), LightStatus.ABSENT, np.int64)
    for row, (ids, values) in enumerate(zip(lanes, codes, strict=True)):
        for lane, code in zip(ids or (), values or (), strict=False):
            status[row, column[lane]] = _LIGHTS[code] if code < 3 else LightStatus.UNKNOWN
    order = np.argsort(stamps, kind="stable")
    return LightStates(tuple(map(str, names)), stamps[order], status[order])
