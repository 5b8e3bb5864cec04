"""A synthetic town: its recordings in the layout of DSC3D, and their conversion into a store.

DSC3D has no traffic lights, so they join the recordings after the conversion.
"""

import json
import shutil
import tempfile
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from hashlib import blake2b
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.readers.samples import ROW_S
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.data.recording import Window
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.writing import StoreWriter
from shiftsim.data.synthetic.agents import SIZES
from shiftsim.data.synthetic.layouts import random_town
from shiftsim.data.synthetic.population import random_traffic
from shiftsim.data.synthetic.town import Town
from shiftsim.data.synthetic.traffic import DT, Box, Traffic
from shiftsim.errors import ConversionError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray
from shiftsim.world.state import TrafficLights

DURATION = 42.08  # s, of a recording
_FIRST = datetime(2032, 1, 1, 8, 0, tzinfo=UTC)
_SPACING = 2000.0  # m between the origins of towns
_UTM_ZONE, _LATITUDE, _LONGITUDE = 32, 48.7, 9.0
_FRAME_RATE, _FRAME_DISTANCE = 25.0, 2
_GROUND = 512.0  # m, altitude of everything
_FLOATS = ("rotation", "dimension", "velocity", "angular_velocity", "acceleration")
_TRIES = 8
_SAME_PLACE = 0.5  # m, both ends together
_MIN_BLOCKS = 2  # of a route; who drives out of town from the first moment on has one


@dataclass(frozen=True)
class TownSpec:
    """What a town is generated from, and nothing else."""

    name: str  # also keys its random numbers
    kind: str  # one of `layouts.KINDS`
    number: int  # places it on the map, and its recordings in time
    num_recordings: int = 1
    overlap_s: float = 12.0  # of consecutive scenarios [s]
    min_scenarios: int = 6  # a town with fewer is drawn again
    crowd: float = 1.0  # times as many pedestrians and cyclists as elsewhere

    @property
    def offset(self) -> FloatArray:
        """(2,) UTM position of its origin [m]."""
        row, column = divmod(self.number, 100)
        return np.array([400_000.0 + _SPACING * column, 5_400_000.0 + _SPACING * row])

    @property
    def starts(self) -> list[datetime]:
        """Time of the first frame of each recording."""
        begin = _FIRST + timedelta(hours=self.number)
        return [begin + timedelta(minutes=5 * k) for k in range(self.num_recordings)]

    def generator(self, attempt: int) -> np.random.Generator:
        """Random numbers that depend on nothing but the town."""
        digest = blake2b(f"{self.name}\n{attempt}".encode(), digest_size=16).digest()
        return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


def make_town(folder: Path, spec: TownSpec) -> None:
    """Make the store of one town, in a folder of its name below `folder`."""
    for attempt in range(_TRIES):
        with tempfile.TemporaryDirectory(prefix="shiftsim-town-") as scratch:
            source, store = Path(scratch) / spec.name, Path(scratch) / "store"
            town, traffics = generate_town(spec, attempt)
            write_recordings(source, spec, town, traffics)
            try:
                count = _convert(source, store, spec, town)
            except ConversionError:  # such as traffic that is not on the road
                continue
            if count >= spec.min_scenarios:
                shutil.move(store, folder / spec.name)
                return
    raise AssertionError(
        f"no town {spec.name!r} with {spec.min_scenarios} scenarios in {_TRIES} tries"
    )


def generate_town(spec: TownSpec, attempt: int = 0) -> tuple[Town, list[Traffic]]:
    """A town, and the traffic of each of its recordings."""
    rng = spec.generator(attempt)
    town = random_town(spec.kind, spec.name, rng)
    return town, [random_traffic(town, rng, DURATION, crowd=spec.crowd) for _ in spec.starts]


def write_recordings(folder: Path, spec: TownSpec, town: Town, traffics: list[Traffic]) -> None:
    """Write a town and its traffic as one DSC3D folder, always the same bytes."""
    (folder / "map").mkdir(parents=True, exist_ok=True)
    (folder / "map/map.xodr").write_text(town.xml(), encoding="utf-8")
    categories: set[str] = set()
    for start, traffic in zip(spec.starts, traffics, strict=True):
        table = _annotations(traffic.record(DURATION), town.parked())
        categories |= set(table["category"].combine_chunks().dictionary.to_pylist())
        _write_recording(folder / "annotations" / _name(start), start, table)
    location = {"id": 1, "latitude": _LATITUDE, "longitude": _LONGITUDE}
    meta = {
        "dataset_name": f"shiftsim {spec.name}",
        "dataset_version": "1",
        "interface_version": "1.0",
        "reference_utm": {"zone": [_UTM_ZONE, "N"], "offset": [*spec.offset.tolist(), 0.0]},
        "frame_rate": _FRAME_RATE,
        "frame_distance": _FRAME_DISTANCE,
        "categories": sorted(categories),
        "locations": [{**location, "recordings": list(map(_name, spec.starts))}],
    }
    (folder / "data_meta.json").write_text(json.dumps(meta, indent=2) + "\n", encoding="utf-8")


def _name(start: datetime) -> str:
    """Name of a recording, as DSC3D forms them."""
    return start.strftime("%Y-%m-%dT%H-%M-%S")


def _convert(source: Path, store: Path, spec: TownSpec, town: Town) -> int:
    """Convert a town; the number of its scenarios."""
    config = ConversionConfig(overlap_s=spec.overlap_s)
    report = convert_dsc3d(source, store, site=spec.name, options=config)
    if not report.accepted:
        return 0
    windows = usable(ScenarioStore(store))
    for recording in sorted({window.log_name for window in windows} if town.lights else ()):
        _add_lights(store, recording, town, spec.offset)
    return len(windows)


def usable(store: ScenarioStore) -> list[Window]:
    """Scenarios of a town whose route all planners can follow."""
    windows = map(store.window, store.tokens)
    return [window for window in windows if len(window.route) >= _MIN_BLOCKS]


def _annotations(boxes: list[Box], parked: FloatArray) -> pa.Table:
    """Rows of `annotations.parquet`, by frame and track; cars parked at (n, 3) stay throughout."""
    names = sorted({*(box[2] for box in boxes), *(("car", "van") if len(parked) else ())})
    free = max(box[1] for box in boxes) + 1  # the first number that no track has
    still = [
        (frame, free + place, "van" if place % 7 == 5 else "car", *pose, 0.0, 0.0, 0.0)
        for frame in range(boxes[-1][0] + 1)
        for place, pose in enumerate(parked.tolist())
    ]
    every = sorted([*boxes, *still])
    rows = np.array([(*box[:2], names.index(box[2]), *box[3:]) for box in every])
    kinds = rows[:, 2].astype(np.int32)
    heading = wrap_angles(rows[:, 5])
    along = np.column_stack([np.cos(heading), np.sin(heading)])
    speed, accel = rows[:, 6, None] * along, rows[:, 7, None] * along
    sizes = np.array([SIZES[name] for name in names])[kinds]
    zero = np.zeros(len(rows))
    groups = {
        "translation": (rows[:, 3], rows[:, 4], zero + _GROUND),
        "rotation": (zero, zero, heading),
        "dimension": (sizes[:, 0], sizes[:, 1], sizes[:, 2]),
        "velocity": (speed[:, 0], speed[:, 1], zero),
        "angular_velocity": (zero, zero, rows[:, 8]),
        "acceleration": (accel[:, 0], accel[:, 1], zero),
    }
    columns = {
        "frame_id": pa.array(_FRAME_DISTANCE * rows[:, 0].astype(np.int64), pa.uint32()),
        "track_id": pa.array(rows[:, 1].astype(np.int64), pa.uint32()),
        "category": pa.DictionaryArray.from_arrays(pa.array(kinds), names),
    }
    for group, values in groups.items():
        kind = pa.float32() if group in _FLOATS else pa.float64()
        for axis, column in zip("xyz", values, strict=True):
            columns[f"{group}_{axis}"] = pa.array(column, pa.float64()).cast(kind, safe=False)
    return pa.table(columns)


def _write_recording(folder: Path, start: datetime, table: pa.Table) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    frames = np.arange(round(DURATION / DT) + 1)
    begin = int(start.timestamp()) * 1_000_000
    stamps = begin + np.rint(frames * _FRAME_DISTANCE / _FRAME_RATE * 1e6).astype(np.int64)
    ids = pa.array(_FRAME_DISTANCE * frames, pa.uint32())
    clock = pa.table({"frame_id": ids, "time": pa.array(stamps, pa.timestamp("us", "UTC"))})
    for name, columns in (("annotations", table), ("frames", clock)):
        schema = pa.schema([field.with_nullable(False) for field in columns.schema])
        pq.write_table(columns.cast(schema), folder / f"{name}.parquet", compression="zstd")


def _add_lights(store: Path, recording: str, town: Town, offset: FloatArray) -> None:
    """Write what the traffic lights showed into a recording."""
    opened = ScenarioStore(store)
    road, stored = opened.map(town.name), opened.recording(recording)
    found = stored.read(0, stored.num_rows)
    seconds = (np.arange(stored.num_rows) * ROW_S).tolist()
    specs, lit = list(town.connectors.values()), town.lit()
    ends = [spec.center_of(-1, np.array([0.0, spec.length]))[:, :2] + offset for spec in specs]
    shown: dict[str, list[int]] = {}  # by connector
    for edge in range(road.num_lanes, len(road.edges)):
        gaps = np.hypot(*(np.array(ends) - road.baselines.at(edge)[[0, -1]]).T).sum(0)
        name, number = road.edges.ids[edge], specs[int(gaps.argmin())].id
        assert gaps.min() < _SAME_PLACE, f"{road.name}: connector {name}"
        if number in lit:
            lights, phase = lit[number]
            shown[name] = [int(lights.status(phase, time)) for time in seconds]
    with StoreWriter(store) as writer:
        status = np.array(list(shown.values()), np.int8).T
        writer.add_recording(replace(found, lights=TrafficLights(tuple(shown), status)))
