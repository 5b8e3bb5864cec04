"""Writes small DSC3D folders for tests."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

START_US = 1_900_000_000_000_000


def straight_road(length: float = 400.0) -> str:
    """OpenDRIVE: one straight road along +x, one lane per direction."""
    lane = (
        '<lane id="{}" type="driving" level="false"><link/>'
        '<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
    )
    return (
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="7"/>'
        f'<road id="1" length="{length}" junction="-1"><link/><planView>'
        f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><line/></geometry></planView>'
        f'<lanes><laneSection s="0"><left>{lane.format(1)}</left>'
        f'<center><lane id="0" type="none"/></center><right>{lane.format(-1)}</right>'
        "</laneSection></lanes></road></OpenDRIVE>"
    )


def car(track, times, *, x0=20.0, y=-1.75, speed=8.0, category="car", yaw=0.0, size=(4.5, 1.9)):
    """Rows of one track that moves along +x from x0 at time 0."""
    times = np.asarray(times, np.float64)
    count = len(times)
    return {
        "track_id": np.full(count, track),
        "time": times,
        "category": [category] * count,
        "translation": np.column_stack([x0 + speed * times, np.full(count, y), np.zeros(count)]),
        "rotation": np.column_stack(
            [np.zeros(count), np.zeros(count), np.broadcast_to(yaw, count)]
        ),
        "dimension": np.tile([size[0], size[1], 1.5], (count, 1)),
        "velocity": np.tile([speed, 0.0, 0.0], (count, 1)),
    }


def frame_times(duration: float, period: float = 0.08) -> np.ndarray:
    return np.arange(int(np.floor(duration / period + 1e-9)) + 1) * period


def write_site(folder: Path, tracks, duration: float, *, period=0.08, road=None, meta=None) -> Path:
    """A whole DSC3D folder with one recording `r`."""
    (folder / "map").mkdir(parents=True)
    (folder / "annotations/r").mkdir(parents=True)
    if road != "":
        (folder / "map/map.xodr").write_text(road or straight_road())
    content = {
        "dataset_name": "test",
        "interface_version": "1.0",
        "reference_utm": {"zone": [32, "N"], "offset": [500000.0, 5300000.0, 0.0]},
        "frame_rate": 2.0 / period,
        "frame_distance": 2,
        "categories": [],
        "locations": [{"id": 1, "latitude": 0.0, "longitude": 0.0, "recordings": ["r"]}],
    }
    (folder / "data_meta.json").write_text(json.dumps({**content, **(meta or {})}))
    frames = np.arange(len(frame_times(duration, period)))
    stamps = START_US + np.rint(frames * period * 1e6).astype(np.int64)
    pq.write_table(
        pa.table(
            {
                "frame_id": pa.array(2 * frames, pa.uint32()),
                "time": pa.array(stamps, pa.timestamp("us", "UTC")),
            }
        ),
        folder / "annotations/r/frames.parquet",
    )
    write_annotations(folder, tracks, period)
    return folder


def write_annotations(folder: Path, tracks, period=0.08, drop=()) -> None:
    joined = {key: np.concatenate([t[key] for t in tracks]) for key in tracks[0]}
    columns = {
        "frame_id": pa.array(2 * np.rint(joined["time"] / period).astype(np.int64), pa.uint32()),
        "track_id": pa.array(joined["track_id"], pa.uint32()),
        "category": pa.array(joined["category"].tolist()).dictionary_encode(),
    }
    for group in ("translation", "rotation", "dimension", "velocity"):
        for axis in range(3):
            columns[f"{group}_{'xyz'[axis]}"] = pa.array(joined[group][:, axis], pa.float64())
    table = pa.table({k: v for k, v in columns.items() if k not in drop})
    pq.write_table(table, folder / "annotations/r/annotations.parquet")
