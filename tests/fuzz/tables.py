"""Fuzzed readers of tables that other programs wrote: tracks, and results of nuPlan's devkit."""

import shutil
from pathlib import Path
from typing import Any

import dsc3d_writer
import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
from places import GOLDEN

RESULTS = GOLDEN / "nuplan_experiment/closed_loop_nonreactive_agents/simple_planner"
LOGGED = "a00a065c00000032"  # the scenario whose log is there
COLUMNS_TOML = """\
hz = 12.5
reference = "center"
[columns]
x = "east"
y = "north"
kind = "what"
[units]
position = "m"
heading = "deg"
[kinds]
van = "car"
"""


def write_track_tables(folder: Path) -> None:
    """The same tracks as CSV with names of others, as levelXdata names them, and as Parquet."""
    frames = np.arange(63)
    seconds, one = frames * 0.08, np.ones(len(frames))
    cars = [
        (1, 20.0 + 8.0 * seconds, -1.75, 0.0, 8.0, "car", 4.5),
        (7, 120.0 - 6.0 * seconds, 1.75, np.pi, -6.0, "car", 4.2),
        (9, 40.0 + 1.2 * seconds, -6.0, 0.0, 1.2, "pedestrian", 0.6),
    ]
    rows = [
        {
            "frame": frames,
            "time": seconds,
            "id": np.full(len(frames), track),
            "kind": [kind] * len(frames),
            "x": x,
            "y": one * y,
            "heading": one * heading,
            "vx": one * speed,
            "vy": 0.0 * one,
            "length": one * length,
            "width": one * min(1.9, length),
        }
        for track, x, y, heading, speed, kind, length in cars
    ]
    table = pa.concat_tables([pa.table(part) for part in rows])
    for name in ("named", "levelx", "parquet"):
        (folder / name).mkdir()
        (folder / name / "road.xodr").write_bytes(dsc3d_writer.straight_road().encode())
    degrees = pa.array(np.degrees(table["heading"].to_numpy()))
    named = table.set_column(table.column_names.index("heading"), "heading", degrees)
    named = named.drop_columns(["time"]).rename_columns({"x": "east", "y": "north", "kind": "what"})
    pc.write_csv(named, folder / "named/tracks.csv")
    (folder / "named/columns.toml").write_text(COLUMNS_TOML)
    level = table.drop_columns(["time", "kind"]).rename_columns(
        {"id": "trackId", "x": "xCenter", "y": "yCenter", "vx": "xVelocity", "vy": "yVelocity"}
    )
    pc.write_csv(level, folder / "levelx/01_tracks.csv")
    pc.write_csv(pa.table({"frameRate": [12.5]}), folder / "levelx/01_recordingMeta.csv")
    kinds = pa.table({"trackId": [1, 7, 9], "class": ["car", "van", "pedestrian"]})
    pc.write_csv(kinds, folder / "levelx/01_tracksMeta.csv")
    pq.write_table(table.drop_columns(["frame"]), folder / "parquet/tracks.parquet")


def read_track_table(folder: Path) -> Any:
    """As `shiftsim convert tracks` does it."""
    from fuzz.targets import read_store

    from shiftsim.data.readers.scenarios import EGO_CATEGORIES
    from shiftsim.data.readers.tracks.reader import TracksReader, convert_tracks
    from shiftsim.data.readers.windows import ConversionConfig
    from shiftsim.errors import ConfigError, ConversionError
    from shiftsim.files import read_toml

    said = folder / "columns.toml"
    tracks = next(
        path
        for name in ("tracks.csv", "01_tracks.csv", "tracks.parquet")
        if (path := folder / name).exists()
    )
    short = ConversionConfig(
        ego_categories=EGO_CATEGORIES, window_s=4.0, overlap_s=1.0, history_s=1.0
    )
    words = read_toml(said) if said.exists() else {}
    try:
        inspection = TracksReader(tracks, folder / "road.xodr", overrides=words, config=short)
        convert_tracks(inspection, folder / "store")
    except ConfigError as error:  # the command names the file
        raise ConfigError(f"{tracks}: {error.message}", error.hint) from error
    except ConversionError as error:  # as it does with what it doubts
        if tracks.stem in error.message:
            raise
        raise ConversionError(f"{tracks}: {error.message}", error.hint) from error
    return read_store(folder / "store")


def write_results(folder: Path) -> None:
    """A table of scores, one of a metric, and a log of two samples by themselves; all together."""
    shutil.copytree(RESULTS, folder / "whole" / RESULTS.parent.name / RESULTS.name)
    for name in ("scores", "metric", "log"):
        (folder / name).mkdir()
    shutil.copy(next(RESULTS.glob("aggregator_metric/*")), folder / "scores/scores.parquet")
    shutil.copy(RESULTS / "metrics/ego_jerk.parquet", folder / "metric/metric.parquet")
    shutil.copy(next(RESULTS.rglob("*.xz")), folder / "log/log.msgpack.xz")


def read_results(folder: Path) -> Any:
    """As `shiftsim verify --experiment` does it; what is found there is compared, not used."""
    from worlds import cruise_scenario

    from shiftsim.verify.experiment import _read, verify_experiment
    from shiftsim.verify.report import Report
    from shiftsim.verify.simulation_log import read_simulation_log

    if (folder / RESULTS.parent.name).is_dir():
        scene = cruise_scenario()
        verify_experiment(folder, lambda token: scene if token == LOGGED else None)
        return None
    report = Report()
    _read(folder, "scores", "scenario", report)
    _read(folder, "metric", "scenario_name", report)
    for path in folder.glob("*.xz"):
        read_simulation_log(path, report)
