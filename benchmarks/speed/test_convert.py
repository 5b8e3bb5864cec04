"""Conversion of a crowded recording: pytest benchmarks/speed/test_convert.py.

Ten minutes at 12.5 Hz with 200 tracks that are there all the time: 100 vehicles in stop-and-go, 60
parked ones and 40 pedestrians. Each moving vehicle is an ego in every window: that makes more
scenarios than any real recording of that length has.
"""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest

from shiftsim.data.readers.dsc3d import convert_dsc3d

DURATION, PERIOD = 600, 0.08
ROADS, LENGTH, SPACING = 20, 500.0, 20.0
PER_LANE, GAP = 5, 25.0
START_US = 1_900_000_000_000_000


def _road(number: int) -> str:
    lane = (
        '<lane id="{}" type="driving" level="false"><link/>'
        '<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
    )
    return (
        f'<road id="{number}" length="{LENGTH}" junction="-1"><link/><planView>'
        f'<geometry s="0" x="0" y="{SPACING * number}" hdg="0" length="{LENGTH}"><line/></geometry>'
        f'</planView><lanes><laneSection s="0"><left>{lane.format(1)}</left>'
        f'<center><lane id="0" type="none"/></center><right>{lane.format(-1)}</right>'
        "</laneSection></lanes></road>"
    )


def write_crowd(folder: Path, duration: float) -> Path:
    """A DSC3D folder with one recording of 200 tracks over so many seconds."""
    (folder / "map").mkdir(parents=True)
    (folder / "annotations/crowd").mkdir(parents=True)
    roads = "".join(map(_road, range(ROADS)))
    (folder / "map/map.xodr").write_text(
        f'<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="7"/>{roads}</OpenDRIVE>'
    )
    meta = {
        "interface_version": "1.0",
        "reference_utm": {"zone": [32, "N"], "offset": [500000.0, 5300000.0, 0.0]},
        "frame_rate": 25.0,
        "frame_distance": 2,
        "locations": [{"id": 1, "recordings": ["crowd"]}],
    }
    (folder / "data_meta.json").write_text(json.dumps(meta))
    count = round(duration / PERIOD) + 1
    ids = pa.array(2 * np.arange(count), pa.uint32())
    stamps = START_US + np.rint(np.arange(count) * PERIOD * 1e6).astype(np.int64)
    times = pa.array(stamps, pa.timestamp("us", "UTC"))
    frames = folder / "annotations/crowd/frames.parquet"
    pq.write_table(pa.table({"frame_id": ids, "time": times}), frames)
    pq.write_table(_boxes(count), folder / "annotations/crowd/annotations.parquet")
    return folder


def _boxes(count: int, period: float = PERIOD) -> pa.Table:
    track = np.arange(2 * ROADS * PER_LANE)
    frame, track = (part.ravel() for part in np.meshgrid(np.arange(count), track, indexing="ij"))
    road, side, place = track // 10, np.where(track % 2, 1.0, -1.0), track // 2 % PER_LANE
    time = frame * period
    kind = np.array([0] * 5 + [1] * 3 + [2] * 2)[track // 2 % 10]  # drives, parks, walks
    moves = kind != 1
    speed = moves * (0.6 + 0.6 * np.sin(0.4 * time + track))
    driven = moves * (0.6 * time + 1.5 * (np.cos(track) - np.cos(0.4 * time + track)))
    beside = np.array([1.75, 5.5, 8.0])[kind] * side
    along = 5.0 + GAP * place + driven
    along = np.where(side > 0, LENGTH - along, along)
    zero = np.zeros(len(track))
    columns = {
        "frame_id": pa.array(2 * frame, pa.uint32()),
        "track_id": pa.array(track, pa.uint32()),
        "category": pa.array(np.array(["car", "car", "pedestrian"])[kind]).dictionary_encode(),
    }
    groups = {
        "translation": (along, SPACING * road + beside, zero),
        "rotation": (zero, zero, np.where(side > 0, np.pi - 1e-9, 0.0)),
        "dimension": (*np.array([[4.5, 1.9], [4.5, 1.9], [0.6, 0.6]])[kind].T, zero + 1.5),
        "velocity": (-speed * side, zero, zero),
    }
    for name, values in groups.items():
        for axis, column in zip("xyz", values, strict=True):
            columns[f"{name}_{axis}"] = pa.array(column)
    return pa.table(columns)


@pytest.fixture(scope="module")
def duration(size) -> int:
    return size(DURATION, 40)


@pytest.fixture(scope="module")
def crowd(duration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_crowd(tmp_path_factory.mktemp("crowd") / "site", duration)


def test_conversion_of_ten_crowded_minutes(crowd, duration, tmp_path):
    convert_dsc3d(crowd, tmp_path / "warm")  # kernels
    began, work = perf_counter(), process_time()
    report = convert_dsc3d(crowd, tmp_path / "store")
    seconds, work = perf_counter() - began, process_time() - work
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    print(f"\n{report.accepted} scenarios in {seconds:.1f} s", end="")
    print(f": {duration / seconds:.0f} x real time, {duration / work:.0f} x by CPU time", end="")
    print(f", peak {peak:.2f} GB", end="")
    assert report.accepted == (4900 if duration == DURATION else 200)
    assert peak <= 2.0


def write_table(folder: Path, duration: float, hz: float = 25.0) -> Path:
    """The same crowd as a CSV file with a row per object and frame, and its map beside it."""
    write_crowd(folder, 1.0)
    boxes = _boxes(round(duration * hz) + 1, 1.0 / hz)
    names = {
        "track_id": "trackId",
        "category": "class",
        "translation_x": "xCenter",
        "translation_y": "yCenter",
        "rotation_z": "heading",
        "dimension_x": "length",
        "dimension_y": "width",
        "velocity_x": "xVelocity",
        "velocity_y": "yVelocity",
    }
    columns = {"frame": boxes["frame_id"].to_numpy() // 2}
    columns |= {theirs: boxes[ours] for ours, theirs in names.items()}
    pc.write_csv(pa.table(columns).cast(_plain(columns)), folder / "crowd.csv")
    return folder


def _plain(columns) -> pa.Schema:
    """Names as text, numbers as they are."""
    kinds = {
        name: pa.array(values[:1]).type if name == "frame" else values.type
        for name, values in columns.items()
    }
    return pa.schema({**kinds, "class": pa.string()})


@pytest.mark.parametrize(("ego", "limit"), [("0", 10), ("all", 60)])
def test_conversion_of_ten_minutes_of_tracks(ego, limit, duration, tmp_path):
    """200 tracks at 25 Hz as a command of its own: seconds and memory of one process."""
    folder = write_table(tmp_path / "crowd", duration)
    words = [sys.executable, "-m", "shiftsim", "convert", "tracks", folder / "crowd.csv"]
    words += [folder / "map/map.xodr", "--hz", "25", "--ego", ego, "--store", tmp_path / "store"]
    began = perf_counter()
    child = subprocess.Popen(list(map(str, words)), stdout=subprocess.PIPE)
    shown = child.stdout.read().decode()
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    peak = used.ru_maxrss / 1024**2
    print(f"\n--ego {ego}: {perf_counter() - began:.1f} s", end="")
    work = used.ru_utime + used.ru_stime
    print(f", by CPU time {work:.1f} s (limit {limit}), peak {peak:.2f} GB (1.2)", end="")
    assert child.returncode == 0, shown
    assert peak <= 1.2
