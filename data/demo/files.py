"""Generated recordings as files in the layout of DSC3D."""

import json
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.demo.agents import SIZES
from shiftsim.data.demo.network import Town
from shiftsim.data.demo.scenes import DemoSite, Scene, demo_sites, traffic_of
from shiftsim.data.demo.traffic import DT, Box, Traffic
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray

_FRAME_RATE, _FRAME_DISTANCE = 25.0, 2
_GROUND = 512.0  # m, altitude of everything
_FLOATS = ("rotation", "dimension", "velocity", "angular_velocity", "acceleration")


def write_demo(folder: Path, only: str = "") -> None:
    """Write the recordings of the demo, one DSC3D folder per town, always the same bytes.

    All towns are written, or the one named.
    """
    for site in demo_sites():
        if only in ("", site.name):
            town = site.town()
            traffics = [traffic_of(scene, town) for scene in site.scenes]
            write_site(folder / site.name, site, town, traffics)


def write_site(folder: Path, site: DemoSite, town: Town, traffics: Iterable[Traffic]) -> None:
    """Write a town with the traffic of each of its scenes as one DSC3D folder."""
    (folder / "map").mkdir(parents=True, exist_ok=True)
    (folder / "map/map.xodr").write_text(town.network.xml(), encoding="utf-8")
    categories: set[str] = set()
    for scene, traffic in zip(site.scenes, traffics, strict=True):
        boxes = traffic.record(scene.duration)
        table = _annotations(boxes, town.parked())
        categories |= set(table["category"].combine_chunks().dictionary.to_pylist())
        _write_recording(folder / "annotations" / scene.name, scene, table)
    place = {"latitude": site.latitude, "longitude": site.longitude}
    meta = {
        "dataset_name": f"shiftsim demo {site.name}",
        "dataset_version": "1",
        "interface_version": "1.0",
        "reference_utm": {"zone": [site.zone, "N"], "offset": site.offset},
        "frame_rate": _FRAME_RATE,
        "frame_distance": _FRAME_DISTANCE,
        "categories": sorted(categories),
        "locations": [{"id": 1, **place, "recordings": [scene.name for scene in site.scenes]}],
    }
    (folder / "data_meta.json").write_text(json.dumps(meta, indent=2) + "\n", encoding="utf-8")


def _annotations(boxes: list[Box], parked: FloatArray) -> pa.Table:
    """Rows of `annotations.parquet`, by frame and track; cars parked at (n, 3) stay throughout."""
    names = sorted({*(box[2] for box in boxes), *(("car", "van") if len(parked) else ())})
    moving = np.array([(*box[:2], names.index(box[2]), *box[3:]) for box in boxes])
    rows = np.concatenate([moving, _parked_rows(moving, parked, names)])
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
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


def _parked_rows(moving: FloatArray, parked: FloatArray, names: list[str]) -> FloatArray:
    if not len(parked):
        return np.zeros((0, moving.shape[1]))
    frames = round(float(moving[:, 0].max())) + 1
    tracks = moving[:, 1].max() + 1.0 + np.arange(len(parked))
    kinds = np.where(np.arange(len(parked)) % 7 == 5, names.index("van"), names.index("car"))
    still = np.column_stack([tracks, kinds, parked, np.zeros((len(parked), 3))])
    return np.column_stack([np.repeat(np.arange(frames), len(parked)), np.tile(still, (frames, 1))])


def _write_recording(folder: Path, scene: Scene, table: pa.Table) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    _write(table, folder / "annotations.parquet")
    frames = np.arange(round(scene.duration / DT) + 1)
    start = int(datetime.fromisoformat(scene.start + "+00:00").timestamp()) * 1_000_000
    stamps = start + np.rint(frames * _FRAME_DISTANCE / _FRAME_RATE * 1e6).astype(np.int64)
    ids = pa.array(_FRAME_DISTANCE * frames, pa.uint32())
    times = pa.array(stamps, pa.timestamp("us", "UTC"))
    _write(pa.table({"frame_id": ids, "time": times}), folder / "frames.parquet")


def _write(table: pa.Table, path: Path) -> None:
    schema = pa.schema([field.with_nullable(False) for field in table.schema])
    pq.write_table(table.cast(schema), path, compression="zstd")
