"""Reader of logs that py123d has converted: Waymo, nuScenes, Argoverse 2 Sensor, nuPlan and others.

py123d itself is not needed: its files are Arrow tables whose objects are packed with msgpack. They
have no version of their own, so every column is checked; tested with files of py123d 0.7.0.
"""

import csv
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.maps.build import build_lane_map
from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.lights import LightStates, states_of_lists
from shiftsim.data.maps.segments import MapSource, StopArea
from shiftsim.data.readers import codes
from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.codes import LaneNames
from shiftsim.data.readers.files import SceneFolder, SourceFile, items, vectors
from shiftsim.data.readers.reader import SourceRecording
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.data.readers.windows import Span
from shiftsim.errors import ConversionError, import_extra
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.state import AgentKind

EGO = "ego"
_LOG = ("sync", "ego_state_se3", "box_detections_se3", "traffic_light_detections")
_FILES = (*_LOG, "custom.scenario")  # the last one of nuPlan only
# columns of these files, beside their time stamps, and of maps
_EGO = dict(imu_se3=items(pa.float64(), 7))
_BOXES = dict(
    bounding_box_se3=items(items(pa.float64(), 10)),
    track_token=items(pa.string()),
    velocity_3d=pa.list_(items(pa.float64(), 3)),  # null where it is unknown
    label=items(pa.uint16()),
)
_SCENARIO = dict(data=pa.binary())
_LIGHTS = dict(lane_id=items(pa.int32()), status=items(pa.uint8()))
_MAP = dict(map_layer=pa.int8(), object_id=pa.int64(), features=pa.binary(), wkb=pa.binary())
_LANE = LaneNames(
    line=np.ndarray,
    borders=("left_boundary", "right_boundary"),
    center="centerline",
    successors="successor_ids",
    neighbors=("left_lane_id", "right_lane_id"),
    speed_limit="speed_limit_mps",
)
_FEATURES = {  # of the elements of a map, by layer
    "lane": {**_LANE.form, "lane_type": (int,), "lane_group_id": (int,)},
    "lane group": {"intersection_id": (int,)},
    "stop zone": {"stop_zone_type": (int,)},
}
_TOO_NEAR = "scenario without 3 s before and 15 s after its begin"
HISTORY_S, LENGTH_S = 3.0, 18.0  # of scenarios whose begin is given
_DRIVABLE = ("lane group", "intersection", "car park", "drivable area")


class Py123dReader(SceneFolder):
    """Logs of py123d; a scene is named by the folder of its log."""

    name = "py123d"
    pattern = "ego_state_se3.arrow"
    hint = "give the folder that py123d wrote, with logs/ and maps/"

    def __init__(
        self,
        source: Path,
        *,
        vehicles: bool = False,
        starts: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        """Logs of a folder; with `starts`, by log, the scenarios that begin at these times [us]."""
        super().__init__(source, vehicles=vehicles)
        self._starts = starts
        if starts is not None:
            self.settings = {**self.settings, "starts": {k: list(v) for k, v in starts.items()}}

    def recordings(self) -> list[str]:
        """Folders of the logs, sorted."""
        found = [str(Path(file).parent) for file in super().recordings()]
        if self._starts is None:
            return found
        missing = set(self._starts) - {Path(path).name for path in found}
        if missing:
            what = f"{self.source}: {len(missing)} logs are not there, such as {min(missing)}"
            raise ConversionError(what, "give the folder that holds them, or leave them out")
        return [path for path in found if Path(path).name in self._starts]

    def files(self, recording: str) -> list[Path]:
        """Tracks, lights, routes, and the map of the log or of its city."""
        path = Path(recording)
        files = [*(path / f"{name}.arrow" for name in _FILES), _read_sync(path)[1]]
        return [file for file in files if file.is_file()]

    def read(self, recording: str) -> SourceRecording:
        """One log."""
        path = Path(recording)
        about, map_path = _read_sync(path)
        dataset, split = about["dataset"], about["split"]
        if dataset.startswith("wod") and split.endswith("test"):
            what = f"split {split!r} hides the future"
            raise SourceFile(path).fault(what, "convert train or val")
        with SourceFile(path).naming():
            samples = _read_tracks(path)
        lights = _read_lights(path)
        city = path.name if map_path.parent == path else about.get("location")
        road, groups = _read_map(map_path, f"{dataset}-{city}", lights.names if lights else ())
        how = self.recorded_ego(EGO)
        if not self.vehicles:
            how["routes"] = _read_routes(path, groups, samples.start_us)
        if self._starts is not None:
            begins = [(us - samples.start_us) * 1e-6 for us in sorted(self._starts[path.name])]
            spans = [Span(round(begin - HISTORY_S, 2), LENGTH_S, HISTORY_S) for begin in begins]
            fits = [s for s in spans if 0.0 <= s.start_s <= samples.duration - LENGTH_S + 0.05]
            how["spans"] = fits
            how["warnings"] = {_TOO_NEAR: len(spans) - len(fits)}
        source = f"{dataset} {split}, through py123d {about.get('version')}"
        licences = (text for name, text in codes.LICENCES.items() if dataset.startswith(name))
        metadata = {"source": source, "licence": next(licences, "that of the source")}
        return SourceRecording(samples, road, lights=lights, metadata=metadata, **how)


def read_starts(path: Path) -> dict[str, list[int]]:
    """Times [us] by log of a CSV file with columns log_name and time_us; else a ConversionError."""
    starts: dict[str, list[int]] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            for row in csv.DictReader(file):
                starts.setdefault(row["log_name"], []).append(int(row["time_us"]))
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise ConversionError(
            f"{path}: {type(error).__name__}: {error}",
            "give a CSV file with columns log_name and time_us, in microseconds",
        ) from error
    return starts


class _File(SourceFile):
    """An Arrow file, and what msgpack packed in its metadata and cells."""

    remedy = "convert the log again with py123d 0.7.0"  # the version that is tested

    def steps(self, columns: dict[str, Any], form: Any) -> tuple[IntArray, pa.Table, Any]:
        """(R,) time stamps [us] of a file of a log, other columns, and its metadata."""
        kinds = {"timestamp_us": pa.int64(), **columns}
        table = self.columns({f"{self.path.stem}.{name}": kind for name, kind in kinds.items()})
        stamps = self.numbers(table, table.column_names[0], "time").astype(np.int64)
        packed = (table.schema.metadata or {}).get(b"metadata")
        return stamps, table.remove_column(0), self.unpack(packed, _load, form, "'metadata'")

    def boxes(self, found: FloatArray) -> FloatArray:
        """(R, 3 or 5) x, y, heading and sizes, if any, of rows x, y, z, quaternion and sizes."""
        for field, part in ("position", slice(2)), ("rotation", slice(3, 7)), ("size", slice(7, 9)):
            self.require(field, found[:, part], "box")
        w, x, y, z = found[:, 3:7].T
        headings = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return np.column_stack([found[:, :2], headings, found[:, 7:9]])


def _load(data: bytes) -> Any:
    """What msgpack packed: plain values and arrays of float64, nothing else."""
    msgpack = import_extra("msgpack", "py123d")
    return msgpack.unpackb(data, strict_map_key=False, object_hook=_array)


def _array(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in found:
        return found
    if found[b"dtype"] != "<f8":
        raise ValueError(f"an array of {found[b'dtype']!r}, need '<f8'")
    return np.frombuffer(found[b"data"], "<f8").reshape(found[b"shape"])


def _read_sync(log: Path) -> tuple[dict[str, Any], Path]:
    """What a log says of itself; its map, beside it or in the folder `maps`."""
    place = {"dataset": str, "location": (str,)}
    form = {**place, "split": str, "version": (str,), "map_metadata": (place,)}
    *_, about = _File(log / "sync.arrow").steps({}, form)
    city = about.get("map_metadata") or about
    shared = f"maps/{city['dataset']}/{city['dataset']}_{city.get('location')}.arrow"
    places = (log / "map.arrow", *(folder / shared for folder in log.parents))
    return about, next(filter(Path.is_file, places), places[0])


def _read_tracks(log: Path) -> TrackSamples:
    """The boxes of all steps, and the box of the recording car."""
    ego_us, ego = _read_ego(log)
    file = _File(log / "box_detections_se3.arrow")
    stamps, table, about = file.steps(_BOXES, {"box_detection_label_class": str})
    rows, (boxes, tokens, velocities, labels) = file.lists(table)
    name = about["box_detection_label_class"].rpartition(".")[2]
    kinds = codes.LABELS[file.known(name, codes.LABELS, "label class")]
    category = [kinds[file.known(i, kinds, f"{name}: label")] for i in labels.to_pylist()]
    every = np.concatenate([file.boxes(vectors(boxes, 9)), ego])
    return make_samples(
        log.name,
        time_us=np.concatenate([stamps[rows], ego_us]),
        ids=np.array([*tokens.to_pylist(), *[EGO] * len(ego)]),
        category=np.array([*category, *[AgentKind.VEHICLE] * len(ego)]),
        xy=every[:, :2],
        headings=every[:, 2],
        velocities=np.concatenate([vectors(velocities, 2), np.full((len(ego), 2), np.nan)]),
        sizes=every[:, 3:],
    )


def _read_ego(log: Path) -> tuple[IntArray, FloatArray]:
    """Time stamps [us], and rows x, y, heading of the box centre, length, width of the ego.

    Stored velocities of egos are 0 in many rows in which the car moves, and are not used.
    """
    file = _File(log / "ego_state_se3.arrow")
    form = {"center_to_imu_se3": [float], "length": float, "width": float}
    stamps, table, about = file.steps(_EGO, form)
    center, *size = (about[name] for name in form)
    if len(center) != 7:
        raise file.fault(f"'center_to_imu_se3' has {len(center)} numbers, need 7")
    ((ahead, left, turn, *size),) = file.boxes(np.array([[*center, *size]], np.float64))
    stamps, first = np.unique(stamps, return_index=True)  # of equal stamps the first is kept
    x, y, heading = file.boxes(vectors(table["ego_state_se3.imu_se3"], 7)[first]).T
    cos, sin = np.cos(heading), np.sin(heading)
    moved = x + cos * ahead - sin * left, y + sin * ahead + cos * left
    return stamps, np.column_stack([*moved, heading + turn, np.tile(size, (len(x), 1))])


def _read_routes(
    log: Path, groups: Mapping[int, list[str]], start_us: int
) -> list[tuple[float, list[list[str]]]]:
    """Routes of the log by the time since its first frame [s], where they change."""
    file = _File(log / "custom.scenario.arrow")
    if not file.path.is_file():
        return []
    stamps, table, _ = file.steps(_SCENARIO, {})
    routes: list[tuple[float, list[list[str]]]] = []
    before = None
    for time_us, packed in zip(stamps.tolist(), table.column(0).to_pylist(), strict=True):
        if packed != before:
            before, form = packed, {"route_roadblock_ids": [str]}
            found = file.unpack(packed, _load, form, f"'data' at {time_us}")
            blocks = [int(name) for name in found["route_roadblock_ids"] if name.isdecimal()]
            lanes = [groups[block] for block in blocks if block in groups]
            routes.append(((time_us - start_us) * 1e-6, lanes))
    return routes


def _read_lights(log: Path) -> LightStates | None:
    file = _File(log / "traffic_light_detections.arrow")
    if not file.path.is_file():
        return None
    stamps, table, _ = file.steps(_LIGHTS, {})
    rows, (lanes, shown) = file.lists(table)
    return states_of_lists(stamps, rows, lanes.to_numpy(), shown.to_numpy(), codes.LIGHTS)


@lru_cache(maxsize=1)  # logs of one city follow each other
def _read_map(path: Path, name: str, lit: tuple[str, ...]) -> tuple[BuiltMap, dict[int, list[str]]]:
    """A map, and the lanes of its groups; `lit` are the lanes that have a light."""
    file = _File(path)
    elements: dict[str, list[Any]] = {layer: [] for layer in _FEATURES}
    areas: dict[str, list[Any]] = {layer: [] for layer in codes.LAYERS.values() if layer != "lane"}
    for code, number, packed, wkb in zip(*file.columns(_MAP).to_pydict().values(), strict=True):
        layer = codes.LAYERS.get(code, "")
        place = f"{layer} {number}"
        if layer in elements:
            elements[layer].append((number, file.unpack(packed, _load, _FEATURES[layer], place)))
        if layer in areas:
            areas[layer].append(file.area(wkb, f"wkb of {place}"))
    inside = {n for n, group in elements["lane group"] if group.get("intersection_id") is not None}
    pieces = []
    groups: dict[int, list[str]] = {}
    for number, lane in elements["lane"]:
        groups.setdefault(lane.get("lane_group_id"), []).append(str(number))
        if lane.get("lane_type") != codes.BIKE_LANE:
            light = str(number) if str(number) in lit else None
            inner = lane.get("lane_group_id") in inside
            pieces.append(_LANE.piece(file, lane, str(number), light=light, is_connector=inner))
    drivable = _DRIVABLE if areas["drivable area"] else ()  # Waymo has none
    source = MapSource(
        name=name,
        pieces=pieces,
        drivable_areas=[area for layer in drivable for area in areas[layer]],
        stop_areas=[
            StopArea(area, codes.STOPS.get(zone.get("stop_zone_type"), codes.OTHER_STOP))
            for area, (_, zone) in zip(areas["stop zone"], elements["stop zone"], strict=True)
        ],
        crosswalks=areas["crosswalk"],
        walkways=areas["walkway"],
        car_parks=areas["car park"],
    )
    with file.naming():
        return build_lane_map(source), groups
