"""ScenarioStore: a folder with recordings, scenarios as windows into them, and maps.

The layout and every column are described in `shiftsim.data.store.schema`.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.recording import scenario as make_scenario
from shiftsim.data.store import schema
from shiftsim.data.store.files import MEND, Table, digest, file_name, write_blocks, write_json
from shiftsim.data.store.map import read_map_file, write_map
from shiftsim.data.store.review import REVIEW, read_reviews, require_blocks
from shiftsim.data.store.tracks import (
    StoredRecording,
    ego_file,
    ego_states,
    open_ego,
    open_recording,
    write_ego,
    write_recording,
)
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

MANIFEST, SCENARIOS = "store.json", "scenarios.parquet"
PARTIAL = ".partial"  # folder of a conversion under way
_OPEN_FILES = 64  # recordings and egos whose files stay open


class ScenarioStore:
    """A store, open for reading. Made by `open_store`.

    Attributes:
        path: Its folder.
        source: Where others find it: the folder, or the URL it is copied from.
        tokens: Tokens of all scenarios, sorted.
        hash: Digest of the content; equal content has an equal hash.
        reviews: What people say of the scenarios; an overlay that is not part of the hash.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.source = str(path.resolve())
        manifest = read_manifest(path)
        self.hash = str(manifest["hash"])
        self._table = Table(path / SCENARIOS, schema.SCENARIOS).read()
        self.tokens: tuple[str, ...] = tuple(self._table["token"].to_pylist())
        self.reviews = read_reviews(path)
        self._row_of = {token: row for row, token in enumerate(self.tokens)}
        self._maps: dict[str, VectorMap] = {}
        self._recordings: dict[str, StoredRecording] = {}
        self._egos: dict[tuple[str, str], Table] = {}

    def __len__(self) -> int:
        return len(self.tokens)

    def __contains__(self, token: object) -> bool:
        return token in self._row_of

    def __iter__(self) -> Iterator[Scenario]:
        return (self.read(token) for token in self.tokens)

    @property
    def cities(self) -> tuple[str, ...]:
        """Names of the maps that scenarios use, sorted."""
        return tuple(sorted(set(self._table["city"].to_pylist())))

    def summary(self) -> pa.Table:
        """One row per scenario: every column of `schema.SCENARIOS` that is not a list of rows."""
        return self._table.drop_columns(["iteration_rows"])

    def window(self, token: str) -> Window:
        """The window of a scenario.

        Raises:
            DataError: The store has no such scenario.
        """
        if token not in self._row_of:
            raise DataError(
                f"store {self.path.name!r} has no scenario {token!r}",
                hint="its `tokens` are the scenarios it has",
            )
        return _window(self._table.slice(self._row_of[token], 1).to_pylist()[0])

    def read(self, token: str) -> Scenario:
        """One scenario with its map; nothing of other scenarios is read. Arrays are read-only.

        A route that was corrected in the review takes the place of the recorded one.

        Raises:
            DataError: The store has no such scenario, or a file is missing or damaged.
        """
        scenario = self.read_recorded(token)
        review = self.reviews.get(token)
        if review is None or review.route is None:
            return scenario
        require_blocks(scenario.map, review, str(self.path / REVIEW))
        return replace(scenario, route=review.route)

    def read_recorded(self, token: str) -> Scenario:
        """As `read`, without the review."""
        window = self.window(token)
        stored = self._recording(window.log_name)
        first, last = window.first_row, window.last_row
        recording = stored.read(first, last)
        states = ego_states(self._ego(window.log_name, window.ego), first, last)
        # The span starts at the window's first row, and so do the ego states.
        ego = EgoTrace(window.log_name, window.ego, 0, states)
        road = self.map(recording.city)
        return make_scenario(recording, ego, window, road, offset=first)

    def map(self, city: str) -> VectorMap:
        """A map; kept for the next scenario of that city.

        Raises:
            DataError: The store has no such map, or its file is damaged.
        """
        if city not in self._maps:
            self._maps[city] = read_map_file(self.map_file(city))
        return self._maps[city]

    def map_file(self, city: str) -> Path:
        """File of a map."""
        return map_file(self.path, city)

    def recording_folder(self, name: str) -> Path:
        """Folder of a recording."""
        return recording_folder(self.path, name)

    def _recording(self, name: str) -> StoredRecording:
        if name not in self._recordings:
            _make_room(self._recordings)
            self._recordings[name] = open_recording(self.recording_folder(name))
        return self._recordings[name]

    def _ego(self, recording: str, name: str) -> Table:
        key = (recording, name)
        if key not in self._egos:
            _make_room(self._egos)
            self._egos[key] = open_ego(self.recording_folder(recording), name)
        return self._egos[key]


def _make_room(kept: dict[Any, Any]) -> None:
    if len(kept) >= _OPEN_FILES:
        kept.pop(next(iter(kept)))


def open_store(path: str | Path) -> ScenarioStore:
    """Open a store.

    Args:
        path: Its folder, or the URL of one.

    Raises:
        DataError: There is no store, or it is damaged or of another version.
    """
    if "://" in str(path):
        from shiftsim.data.store.remote import RemoteStore

        return RemoteStore(str(path))
    return ScenarioStore(Path(path))


def map_file(store: Path, city: str) -> Path:
    """File of a map."""
    return store / "maps" / f"{file_name(city)}.parquet"


def recording_folder(store: Path, recording: str) -> Path:
    """Folder of a recording."""
    return store / "recordings" / file_name(recording)


def read_manifest(store: Path) -> dict[str, Any]:
    """Content of `store.json`.

    Raises:
        DataError: It is missing or broken, or of another version.
    """
    path = store / MANIFEST
    if not path.is_file():
        if (store / PARTIAL).is_dir():
            raise DataError(
                f"{store}: the conversion of this store was interrupted",
                hint="start the same shiftsim convert again, it goes on",
            )
        raise DataError(
            f"{store}: not a scenario store: {MANIFEST} is missing",
            hint="give the folder that `shiftsim convert` wrote",
        )
    try:
        manifest = json.loads(path.read_text("utf-8"))
        kind, version = manifest["format"], manifest["version"]
        files, content = manifest["files"], manifest["hash"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: damaged: {error!r}", hint=MEND) from error
    if kind != schema.FORMAT or version != schema.VERSION:
        raise DataError(
            f"{path}: format {kind!r}, version {version!r}, not {schema.FORMAT!r} version"
            f" {schema.VERSION}",
            hint="convert the data again with this version of shiftsim",
        )
    if not isinstance(files, dict) or not isinstance(content, str):
        raise DataError(f"{path}: damaged: no list of files", hint=MEND)
    return manifest


def _window(row: dict[str, Any]) -> Window:
    goal = row["goal_pose"]
    return Window(
        token=row["token"],
        scenario_type=row["type"],
        log_name=row["recording"],
        ego=row["ego"],
        first_row=row["first_row"],
        last_row=row["last_row"],
        iteration_rows=np.array(row["iteration_rows"], np.int64),
        row_step=row["row_step"],
        route=tuple(row["route"]),
        mission_goal=np.array(goal) if goal else None,
        mapping=(row["duration_s"], row["offset_s"], row["subsample_ratio"]),
        is_short=row["is_short"],
        metadata=json.loads(row["metadata"]),
    )


def read_report(store: Path, city: str) -> dict[str, Any]:
    """What a store says about the conversion of a city; empty where it says nothing."""
    path = _report_file(store, city)
    try:
        manifest = read_manifest(store)
        if manifest["files"].get(path.relative_to(store).as_posix()) != digest(path):
            return {}
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (DataError, OSError, ValueError):
        return {}
    return content


def _report_file(store: Path, city: str) -> Path:
    return store / "reports" / f"{file_name(city)}.json"


def window_row(window: Window, city: str) -> dict[str, Any]:
    """A window as a row of `schema.SCENARIOS`, JSON values only."""
    goal = window.mission_goal
    return {
        "token": window.token,
        "type": window.scenario_type,
        "city": city,
        "log": window.log_name.partition("@")[0],
        "recording": window.log_name,
        "ego": window.ego,
        "first_row": window.first_row,
        "last_row": window.last_row,
        "row_step": window.row_step,
        "iteration_rows": window.iteration_rows.tolist(),
        "route": list(window.route),
        "goal_pose": [] if goal is None else goal.tolist(),
        "duration_s": window.mapping[0],
        "offset_s": window.mapping[1],
        "subsample_ratio": window.mapping[2],
        "is_short": window.is_short,
        "metadata": json.dumps(window.metadata, sort_keys=True),
    }


class StoreWriter:
    """Writes a store, or adds to one. Use it in a `with` block; it is complete at the end.

    What is added again replaces what is there. Equal content gives equal bytes.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._rows: dict[str, dict[str, Any]] = {}
        self._files: dict[str, str] = {}
        self._cities: dict[str, str] = {}
        if (self.path / MANIFEST).exists():
            self._files = dict(read_manifest(self.path)["files"])
            table = Table(self.path / SCENARIOS, schema.SCENARIOS).read()
            self._rows = {row["token"]: row for row in table.to_pylist()}
            self._cities = {row["recording"]: row["city"] for row in self._rows.values()}
        elif self.path.is_dir() and any(self.path.iterdir()) and not self._is_unfinished():
            raise DataError(
                f"{self.path}: the folder is not empty and not a store",
                hint="give a new folder, or a store to add to",
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> "StoreWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()

    @property
    def tokens(self) -> frozenset[str]:
        """Tokens of the scenarios that the store holds so far."""
        return frozenset(self._rows)

    def window(self, token: str) -> Window:
        """The window of a scenario that the store holds so far."""
        return _window(self._rows[token])

    def add_map(self, road: VectorMap) -> None:
        """Write a map."""
        path = map_file(self.path, road.name)
        write_map(path, road)
        self._note(path)

    def add_recording(self, recording: Recording) -> None:
        """Write a recording."""
        folder = recording_folder(self.path, recording.log_name)
        write_recording(folder, recording)
        self._note(folder / "frames.parquet")
        self._note(folder / "tracks.parquet")
        self._cities[recording.log_name] = recording.city

    def add_ego(self, ego: EgoTrace) -> None:
        """Write the states of an ego."""
        folder = recording_folder(self.path, ego.log_name)
        write_ego(folder, ego)
        self._note(ego_file(folder, ego.name))

    def add_window(self, window: Window) -> None:
        """Add a scenario; its recording and ego are added before.

        Raises:
            DataError: The recording or the ego is not in the store.
        """
        folder = recording_folder(self.path, window.log_name)
        for path in (folder / "frames.parquet", ego_file(folder, window.ego)):
            if self._name(path) not in self._files:
                raise DataError(
                    f"scenario {window.token!r}: the store lacks {self._name(path)}",
                    hint="add the recording and the ego before the window",
                )
        self._rows[window.token] = window_row(window, self._cities[window.log_name])

    def take_recording(self, folder: Path, log_name: str, rows: list[dict[str, Any]]) -> None:
        """Move a recording that was written elsewhere into the store, with all its scenarios.

        What the store has of that recording is replaced.

        Args:
            folder: Written by `write_recording` and `write_ego`.
            log_name: Name of the recording.
            rows: `window_row` of its scenarios.
        """
        target = recording_folder(self.path, log_name)
        below = f"{self._name(target)}/"
        self._files = {n: d for n, d in self._files.items() if not n.startswith(below)}
        self._rows = {t: row for t, row in self._rows.items() if row["recording"] != log_name}
        shutil.rmtree(target, ignore_errors=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(folder, target)
        for path in sorted(target.iterdir()):
            self._note(path)
        self._rows |= {row["token"]: row for row in rows}

    def add_report(self, city: str, content: dict[str, Any]) -> None:
        """Write what is to be known about the conversion of a city."""
        path = _report_file(self.path, city)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, content)
        self._note(path)

    def close(self) -> None:
        """Write the list of scenarios and the manifest."""
        rows = [self._rows[token] for token in sorted(self._rows)]
        table = pa.Table.from_pylist(rows, schema=schema.SCENARIOS)
        write_blocks(self.path / SCENARIOS, [table])
        self._note(self.path / SCENARIOS)
        files = dict(sorted(self._files.items()))
        content = hashlib.sha256(json.dumps(files).encode()).hexdigest()
        write_json(
            self.path / MANIFEST,
            {
                "format": schema.FORMAT,
                "version": schema.VERSION,
                "hash": content,
                "files": files,
            },
        )

    def _is_unfinished(self) -> bool:
        return (self.path / PARTIAL).is_dir()

    def _name(self, path: Path) -> str:
        return path.relative_to(self.path).as_posix()

    def _note(self, path: Path) -> None:
        self._files[self._name(path)] = digest(path)
