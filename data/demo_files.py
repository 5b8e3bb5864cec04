"""Generated recordings as files in the layout of DSC3D (dsc3d-format.md §2)."""

import json
from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.demo_scenes import SITES, DemoSite, Scene, traffic_of
from shiftsim.data.demo_traffic import SIZES, Box
from shiftsim.geometry import wrap_angles

_FRAME_RATE, _FRAME_DISTANCE = 25.0, 2
_GROUND = 512.0  # m, altitude of everything
_FLOATS = ("rotation", "dimension", "velocity", "angular_velocity", "acceleration")


def write_sites(folder: Path) -> None:
    """Write every demo site into a folder of its own below `folder`."""
    for site in SITES:
        _write_site(folder / site.name, site)


def _write_site(folder: Path, site: DemoSite) -> None:
    town = site.town()
    (folder / "map").mkdir(parents=True, exist_ok=True)
    (folder / "map/map.xodr").write_text(town.network.xml(), encoding="utf-8")
    categories: set[str] = set()
    for scene in site.scenes:
        boxes = traffic_of(scene, site.town()).record(scene.duration)
        categories |= {box.category for box in boxes}
        _write_recording(folder / "annotations" / scene.name, scene, boxes)
    meta = {
        "dataset_name": f"shiftsim demo {site.name}",
        "dataset_version": "1",
        "interface_version": "1.0",
        "reference_utm": {"zone": [site.zone, "N"], "offset": list(site.offset)},
        "frame_rate": _FRAME_RATE,
        "frame_distance": _FRAME_DISTANCE,
        "categories": sorted(categories),
        "locations": [
            {
                "id": 1,
                "latitude": site.latitude,
                "longitude": site.longitude,
                "recordings": [scene.name for scene in site.scenes],
            }
        ],
    }
    (folder / "data_meta.json").write_text(json.dumps(meta, indent=2) + "\n", encoding="utf-8")


def _write_recording(folder: Path, scene: Scene, boxes: list[Box]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    boxes = sorted(boxes, key=lambda box: (box.frame, box.track))
    names = sorted({box.category for box in boxes})
    poses = np.array([box.pose for box in boxes])
    heading = wrap_angles(poses[:, 2])
    along = np.column_stack([np.cos(heading), np.sin(heading)])
    speed = np.array([box.speed for box in boxes])[:, None] * along
    accel = np.array([box.accel for box in boxes])[:, None] * along
    sizes = np.array([SIZES[box.category] for box in boxes])
    zero = np.zeros(len(boxes))
    groups = {
        "translation": (poses[:, 0], poses[:, 1], zero + _GROUND),
        "rotation": (zero, zero, heading),
        "dimension": (sizes[:, 0], sizes[:, 1], sizes[:, 2]),
        "velocity": (speed[:, 0], speed[:, 1], zero),
        "angular_velocity": (zero, zero, np.array([box.yaw_rate for box in boxes])),
        "acceleration": (accel[:, 0], accel[:, 1], zero),
    }
    columns = {
        "frame_id": pa.array([_FRAME_DISTANCE * box.frame for box in boxes], pa.uint32()),
        "track_id": pa.array([box.track for box in boxes], pa.uint32()),
        "category": pa.DictionaryArray.from_arrays(
            pa.array([names.index(box.category) for box in boxes], pa.int32()), names
        ),
    }
    for group, values in groups.items():
        kind = pa.float32() if group in _FLOATS else pa.float64()
        for axis, column in zip("xyz", values, strict=True):
            columns[f"{group}_{axis}"] = pa.array(column, pa.float64()).cast(kind, safe=False)
    _write(pa.table(columns), folder / "annotations.parquet")
    frames = np.arange(max(box.frame for box in boxes) + 1)
    start = int(datetime.fromisoformat(scene.start + "+00:00").timestamp()) * 1_000_000
    stamps = start + np.rint(frames * _FRAME_DISTANCE / _FRAME_RATE * 1e6).astype(np.int64)
    table = pa.table(
        {
            "frame_id": pa.array(_FRAME_DISTANCE * frames, pa.uint32()),
            "time": pa.array(stamps, pa.timestamp("us", "UTC")),
        }
    )
    _write(table, folder / "frames.parquet")


def _write(table: pa.Table, path: Path) -> None:
    schema = pa.schema([field.with_nullable(False) for field in table.schema])
    pq.write_table(table.cast(schema), path, compression="zstd")
