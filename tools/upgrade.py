"""Convert a store or a run folder of an earlier format: python tools/upgrade.py STORE|RUN.

The folder takes the new content when all of it is written; the numbers stay the same to the last
bit (plans of rollouts in single precision). A run knows its store by the hash of the content:
convert the store first, then its runs.
"""

import argparse
import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.data.store import schema, tables
from shiftsim.data.store.reading import window_of
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import DataError
from shiftsim.files import store_path
from shiftsim.geometry.polylines import arc_lengths
from shiftsim.kernels import readonly
from shiftsim.runs.filter import RESULTS, SCHEMA
from shiftsim.runs.results import FORMAT_VERSION, Run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import (
    COMMAND_COLUMNS,
    FOLDER,
    NOISE_COLUMNS,
    rollout_rows,
    write_rollouts,
)
from shiftsim.runs.scenarios import open_run_store
from shiftsim.sim.log import NUM_KEPT, SimulationLog
from shiftsim.world.layers import Layer, Lists, Polylines, index_polygons
from shiftsim.world.map import LAYERS, VectorMap
from shiftsim.world.state import Tracks, TrafficLights

FORMER = "former_hash"  # in store.json: the hash of the content before
LINES = ("baselines", "left_boundaries", "right_boundaries")
LISTS = ("incoming", "outgoing", "stop_lines", "block_edges", "block_incoming", "block_outgoing")


def upgrade(folder: Path, store: str | None = None) -> str:
    """Convert a folder; returns what was done. `store` is that of a run, where it has moved.

    Raises:
        DataError: It is neither a store nor a run.
    """
    if (folder / tables.MANIFEST).is_file():
        return upgrade_store(folder)
    if (folder / "manifest.json").is_file():
        return upgrade_run(folder, store)
    raise DataError(f"{folder}: neither a store nor a run folder", hint="name one of them")


# --- stores


def upgrade_store(folder: Path) -> str:
    """Write the store anew, with filter, review and splits as they are."""
    manifest = _manifest(folder)
    if manifest["version"] == schema.VERSION:
        return f"{folder} has format {schema.VERSION} already"
    partial = folder.with_name(f".{folder.name}.upgrade")
    shutil.rmtree(partial, ignore_errors=True)
    scenarios = pq.read_table(folder / tables.SCENARIOS).to_pylist()
    egos = sorted({(row["recording"], row["ego"]) for row in scenarios})
    with StoreWriter(partial, manifest.get("generator")) as writer:
        for city in sorted({row["city"] for row in scenarios}):
            writer.add_map(read_map(folder / f"maps/{tables.file_name(city)}.parquet"))
        for recording in sorted({name for name, _ in egos}):
            writer.add_recording(read_recording(tables.recording_folder(folder, recording)))
        for recording, name in egos:
            path = tables.ego_file(tables.recording_folder(folder, recording), name)
            writer.add_ego(read_ego(path, recording, name))
        for row in scenarios:
            writer.add_window(window_of(row))
        for path in sorted((folder / tables.REPORTS).glob("*.json")):
            writer.add_report(unquote(path.stem), json.loads(path.read_text("utf-8")))
    content = _manifest(partial)
    tables.write_json(partial / tables.MANIFEST, content | {FORMER: manifest["hash"]})
    for path in sorted(folder.rglob("*")):
        target = partial / path.relative_to(folder)
        is_overlay = path.relative_to(folder).parts[0] not in ("maps", "recordings")
        if path.is_file() and is_overlay and not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
    if (partial / RESULTS).is_file():
        _rename_store_of_verdicts(partial / RESULTS, content["hash"])
    shutil.rmtree(folder)
    partial.rename(folder)
    return f"{folder}: {len(scenarios)} scenarios now have format {schema.VERSION}"


def _rename_store_of_verdicts(path: Path, store_hash: str) -> None:
    """Verdicts of the filter are of the converted content, too."""
    table = tables.Table(path, SCHEMA)
    conditions = {**table.footer, "store": store_hash}
    conditions.pop("hash", None)
    text = json.dumps(conditions, sort_keys=True)
    conditions["hash"] = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
    tables.write_blocks(path, [table.read()], conditions)


def restored(codes: np.ndarray) -> np.ndarray:
    """Numbers of which second differences of their bits are stored."""
    bits = codes.view(np.uint64)
    steps = (bits >> np.uint64(1)) ^ (np.uint64(0) - (bits & np.uint64(1)))
    return np.cumsum(np.cumsum(steps, dtype=np.uint64), dtype=np.uint64).view(np.float64)


def _items(column: pa.ChunkedArray | pa.Array) -> np.ndarray:
    """The numbers of a column, those of its lists one after the other."""
    flat = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    flat = flat.flatten() if pa.types.is_list(flat.type) else flat
    return np.array(flat.to_numpy(zero_copy_only=False))


def _footer(file: pq.ParquetFile) -> dict[str, Any]:
    return dict(json.loads(file.metadata.metadata[b"shiftsim"]))


def read_recording(folder: Path) -> Recording:
    """A recording of format 1 to 3."""
    frames, boxes = (pq.ParquetFile(folder / name) for name in (tables.FRAMES, tables.TRACKS))
    head, names = _footer(frames), _footer(boxes)
    table = frames.read()
    time_us, connectors = _items(table["time_us"]), tuple(head["connectors"])
    status = _items(table["light_status"]).astype(np.int8).reshape(len(time_us), len(connectors))
    tokens = tuple(names["tokens"])
    dense = np.full((len(time_us), len(tokens), len(schema.BOX)), np.nan)
    valid = np.zeros(dense.shape[:2], np.bool_)
    for block in range(boxes.num_row_groups):
        part = boxes.read_row_group(block)
        row, track = _items(part["row"]), _items(part["track"])
        valid[row, track] = True
        for at, name in enumerate(schema.BOX):
            coded = f"{name}_diff2" in part.column_names
            numbers = _items(part[f"{name}_diff2" if coded else name])
            dense[row, track, at] = restored(numbers) if coded else numbers
    kinds = np.array(names["kinds"], np.int64)
    parts = (np.ascontiguousarray(part) for part in np.split(dense, [3, 5], axis=2))
    tracks = Tracks(valid, *parts, kinds, tokens)
    return Recording(head["log"], head["city"], time_us, tracks, TrafficLights(connectors, status))


def read_ego(path: Path, recording: str, name: str) -> EgoTrace:
    """The states of an ego of format 1 to 3."""
    file = pq.ParquetFile(path)
    if "x_m" in file.schema_arrow.names:
        states = np.column_stack([_items(file.read()[column]) for column in schema.EGO_COLUMNS])
    else:
        blocks = [file.read_row_group(block) for block in range(file.num_row_groups)]
        count = len(schema.EGO_COLUMNS)
        parts = [restored(_items(block.column(0))).reshape(count, -1).T for block in blocks]
        states = np.concatenate(parts)
    return EgoTrace(recording, name, int(_footer(file)["first_row"]), np.ascontiguousarray(states))


def read_map(path: Path) -> VectorMap:
    """A map of format 1 to 3, one row of Parquet with what cannot be computed from the rest."""
    file = pq.ParquetFile(path)
    table = file.read()
    parts: dict[str, Any] = _footer(file)
    for name in (*LAYERS, *LINES):
        if f"{name}_xy_m" in table.column_names:  # format 1
            xy = _items(table[f"{name}_xy_m"]).reshape(-1, 2)
        else:
            xy = np.column_stack([_items(table[f"{name}_{axis}"]) for axis in ("x_m", "y_m")])
        pointers = ("ptr",) if name in LINES else ("ring_ptr", "poly_ptr")
        given = [np.ascontiguousarray(xy), *(_items(table[f"{name}_{part}"]) for part in pointers)]
        if name in LINES:
            parts[name] = Polylines(*map(readonly, (*given, arc_lengths(*given))))
        else:
            parts[name] = index_polygons(*given)
    for name in LAYERS:
        parts[name] = Layer(tuple(table[f"{name}_ids"][0].as_py()), parts[name])
    for name in LISTS:
        parts[name] = Lists(*(_items(table[f"{name}_{part}"]) for part in Lists._fields))
    pairs = (table[f"{side}_boundary_ids"][0].as_py() for side in ("left", "right"))
    parts["boundary_ids"] = tuple(zip(*pairs, strict=True))
    parts["speed_limits"] = _items(table["speed_limits_mps"])
    for name in VectorMap.__dataclass_fields__:
        if name not in parts:
            parts[name] = _items(table[name])
    return VectorMap(**parts)


# --- runs


def upgrade_run(folder: Path, store: str | None = None) -> str:
    """Write the rollouts of a run anew, and its bundle; scores and metrics stay as they are."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text("utf-8"))
    if manifest["format"] == FORMAT_VERSION:
        return f"{folder} has format {FORMAT_VERSION} already"
    if manifest["state"] != "finished":
        raise DataError(f"{folder}: the run is not finished", hint="make the run again")
    bundle = folder / "store"
    if bundle.is_dir():
        upgrade_store(bundle)
        manifest["bundle"]["hash"] = _manifest(bundle)["hash"]
    place = store_path(store or manifest["store"])
    if (place / tables.MANIFEST).is_file():
        content = _manifest(place)
        if content.get(FORMER) == manifest["determining"]["store"]:
            manifest["determining"]["store"] = content["hash"]
    manifest["format"] = FORMAT_VERSION
    count = _rewrite_rollouts(Run(folder, manifest), store)
    path.write_text(json.dumps(manifest, indent=2, ensure_ascii=False) + "\n", "utf-8")
    return f"{folder}: {count} rollouts now have format {FORMAT_VERSION}"


def _manifest(store: Path) -> dict[str, Any]:
    return dict(json.loads((store / tables.MANIFEST).read_text("utf-8")))


def _rewrite_rollouts(run: Run, store: str | None) -> int:
    """Write the rollouts of a run in their order, and their new places into `tasks.parquet`."""
    path, partial = run.path / "tasks.parquet", run.path / f".{FOLDER}.upgrade"
    tasks = pq.read_table(path)
    rows = tasks.to_pylist()
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    stored = sorted(
        (row["rollout"], row["rollout_row"], at) for at, row in enumerate(rows) if row["rollout"]
    )

    def rollouts() -> Iterator[tuple[Task, pa.RecordBatch]]:
        opened: dict[str, pa.Table] = {}
        scenarios = None
        for name, first, at in stored:
            if name not in opened:
                opened = {name: pq.read_table(run.path / FOLDER / name)}
            table = opened[name].slice(first, rows[at]["rollout_rows"]).combine_chunks()
            task = task_of(rows[at])
            tracks = Tracks.empty(len(table))
            if "track_valid" in table.column_names:
                scenarios = scenarios or open_run_store(run, store)
                tracks = read_tracks(table, scenarios.read(task.token).tracks.tokens)
            yield task, read_rollout(table, tracks)

    locations = write_rollouts(partial, rollouts())
    for row in rows:
        if location := locations.get(task_of(row)):
            row |= {"rollout": location.file.name, "rollout_row": location.row}
    shutil.rmtree(run.path / FOLDER)
    partial.rename(run.path / FOLDER)
    pq.write_table(pa.Table.from_pylist(rows, tasks.schema), path, compression="zstd")
    return len(stored)


def task_of(row: dict[str, Any]) -> Task:
    """The task of a row of `tasks.parquet`."""
    return Task(*(row[name] for name in Task._fields))


def read_rollout(table: pa.Table, tracks: Tracks) -> pa.RecordBatch:
    """The rows of a rollout of an earlier format, as they are stored now."""
    ego, commands, noise = (
        np.column_stack([_items(table[name]) for name in names])
        for names in (schema.EGO_COLUMNS, COMMAND_COLUMNS, NOISE_COLUMNS)
    )
    time_us = _items(table["time_us"])
    log = SimulationLog(
        token="",
        time_us=time_us,
        ego=ego,
        tracks=tracks,
        traffic_lights=TrafficLights.empty(len(table)),
        expert_time_us=time_us,
        expert_ego=ego,
        route=(),
        commands=commands,
        noise=noise,
        plans=read_plans(table, ego),
        planning_seconds=_items(table["planning_seconds"]),
        degraded=_items(table["degraded"]).astype(np.bool_),
    )
    with_noise = not table[NOISE_COLUMNS[0]].null_count
    return rollout_rows(log, with_tracks="track_valid" in table.column_names, with_noise=with_noise)


def read_plans(table: pa.Table, ego: np.ndarray) -> np.ndarray:
    """(K, 18, 3) poses of the plans: as numbers, or as second differences of whole numbers."""
    if "plan_poses" in table.column_names:
        plans = _items(table["plan_poses"]).reshape(len(table), -1, 3)
        return np.pad(
            plans, ((0, 0), (0, NUM_KEPT - plans.shape[1]), (0, 0)), constant_values=np.nan
        )
    column = table["plan_steps"].combine_chunks()
    known = np.arange(NUM_KEPT) < np.diff(column.offsets.to_numpy())[:, None] // 3
    steps, bends = _items(column), np.zeros((*known.shape, 3), np.int64)
    bends[known] = ((steps >> 1) ^ -(steps & 1)).reshape(-1, 3)
    offsets = np.cumsum(np.cumsum(bends, axis=1), axis=1) / np.array([1e3, 1e3, 1e4])
    return np.where(known[..., None], ego[:, None, :3] + offsets, np.nan)


def read_tracks(table: pa.Table, tokens: tuple[str, ...]) -> Tracks:
    """Tracks that reacted: in lists per row, or all boxes of a track, then of the next, in one."""
    valid = _items(table["track_valid"]).astype(np.bool_).reshape(len(table), len(tokens))
    parts = {"poses": 3, "velocities": 2, "sizes": 2}
    kinds = np.zeros(len(tokens), np.int64)
    if "track_poses" in table.column_names:
        arrays = [
            _items(table[f"track_{name}"]).reshape(*valid.shape, n) for name, n in parts.items()
        ]
        return Tracks(valid, *arrays, kinds, tokens)
    boxes = np.full((len(schema.BOX), *valid.T.shape), np.nan)
    for values, name in zip(boxes, schema.BOX, strict=True):
        is_coded = name in schema.MOTION
        numbers = _items(table[f"track_{name}{'_diff2' * is_coded}"])
        values[valid.T] = restored(numbers) if is_coded else numbers
    arrays = [np.ascontiguousarray(part.T) for part in np.split(boxes, [3, 5])]
    return Tracks(valid, *arrays, kinds, tokens)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="a store or a run folder")
    parser.add_argument("--store", help="where the store of a run is now, if it has moved")
    given = parser.parse_args()
    try:
        print(upgrade(given.folder, given.store))
    except DataError as error:
        raise SystemExit(str(error)) from error
