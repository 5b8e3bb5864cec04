"""Writing a store, or adding to one."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa

from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store import schema, tables
from shiftsim.data.store.map import write_map
from shiftsim.data.store.reading import require_goals, require_rows, window_of
from shiftsim.data.store.recordings import write_ego, write_recording
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap


def window_row(window: Window, city: str) -> dict[str, Any]:
    """A window as a row of `schema.SCENARIOS`, JSON values only."""
    goal = window.mission_goal
    cut = zip(("duration_s", "offset_s", "subsample_ratio"), window.mapping, strict=True)
    return {
        **{name: getattr(window, name) for name in schema.SAME},
        "type": window.scenario_type,
        "city": city,
        "log": window.log_name.partition("@")[0],
        "recording": window.log_name,
        "iteration_rows": window.iteration_rows.tolist(),
        "route": list(window.route),
        "goal_pose": [] if goal is None else goal.tolist(),
        **dict(cut),
        "metadata": json.dumps(window.metadata, sort_keys=True),
    }


@contextmanager
def _to_be_written() -> Iterator[None]:
    try:
        yield
    except DataError as error:
        raise DataError(error.message, "correct what is given; it is not written") from error


class StoreWriter:
    """Writes a store, or adds to one. Use it in a `with` block; it is complete at the end.

    What is added again replaces what is there. Equal content gives equal bytes. Numbers are in the
    ranges in which they can be read (docs/input_ranges.md), or an error says which is not.
    """

    def __init__(self, path: str | Path, generator: dict[str, Any] | None = None) -> None:
        """`generator` says what made all the content up; a store of recordings has none.

        What is added without one to a generated store makes it a store of recordings.
        """
        self.path = Path(path)
        self._generator = generator
        self._rows: dict[str, dict[str, Any]] = {}
        self._files: dict[str, str] = {}
        self._cities: dict[str, str] = {}
        if (self.path / tables.MANIFEST).exists():
            self._files = dict(tables.read_manifest(self.path)["files"])
            table = tables.Table(self.path / tables.SCENARIOS, schema.SCENARIOS).read()
            self._rows = {row["token"]: row for row in table.to_pylist()}
            self._cities = {row["recording"]: row["city"] for row in self._rows.values()}
        self.path.mkdir(parents=True, exist_ok=True)
        is_partial = (self.path / tables.PARTIAL).is_dir()
        others = {path.name for path in self.path.iterdir()} - {tables.REPORTS}
        if not self._files and not is_partial and others:
            what = f"{self.path}: the folder is not empty and not a store"
            raise DataError(what, "give a new folder, or a store to add to")

    def __enter__(self) -> "StoreWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()

    @property
    def tokens(self) -> frozenset[str]:
        """Tokens of the scenarios that the store holds so far."""
        return frozenset(self._rows)

    def window(self, token: str) -> Window:
        """The window of a scenario that the store holds so far."""
        return window_of(self._rows[token])

    def add_map(self, road: VectorMap) -> None:
        """Write a map; a DataError where it is not sound."""
        path = tables.map_file(self.path, road.name)
        with _to_be_written():
            write_map(path, road)
        self._note(path)

    def add_recording(self, recording: Recording) -> None:
        """Write a recording; a DataError where its arrays or numbers do not fit."""
        folder = tables.recording_folder(self.path, recording.log_name)
        with _to_be_written():
            write_recording(folder, recording)
        for name in (tables.FRAMES, tables.LIGHTS, tables.TRACKS):
            self._note(folder / name)
        self._cities[recording.log_name] = recording.city

    def add_ego(self, ego: EgoTrace) -> None:
        """Write the states of an ego; a DataError where a number is outside of its range."""
        folder = tables.recording_folder(self.path, ego.log_name)
        with _to_be_written():
            write_ego(folder, ego)
        self._note(tables.ego_file(folder, ego.name))

    def add_window(self, window: Window) -> None:
        """Add a scenario whose recording and ego were added before; else a DataError."""
        folder = tables.recording_folder(self.path, window.log_name)
        for path in (folder / tables.FRAMES, tables.ego_file(folder, window.ego)):
            if self._name(path) not in self._files:
                what = f"scenario {window.token!r}: the store does not have {self._name(path)}"
                raise DataError(what, "add the recording and the ego before the window")
        row, file = window_row(window, self._cities[window.log_name]), self.path / tables.SCENARIOS
        table = pa.Table.from_pylist([row], schema=schema.SCENARIOS)
        with _to_be_written():
            require_rows(window, str(file))
            tables.require_ranges(table, f"{file}: scenario {window.token!r}")
            require_goals(table, f"{file}: scenario {window.token!r}")
        self._rows[window.token] = row

    def take_recording(self, folder: Path, log_name: str, rows: list[dict[str, Any]]) -> None:
        """Move a recording that was written elsewhere into the store, with all its scenarios.

        What the store has of it is replaced; `rows` are the `window_row` of its scenarios.
        """
        target = self.forget_recording(log_name)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(folder, target)
        for path in sorted(target.iterdir()):
            self._note(path)
        self._rows |= {row["token"]: row for row in rows}

    def take_map(self, file: Path, city: str) -> None:
        """Move a map that was written elsewhere into the store, in place of the one it has."""
        path = tables.map_file(self.path, city)
        path.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, path)
        self._note(path)

    def forget_recording(self, log_name: str) -> Path:
        """Remove a recording with all its scenarios, if there is one; the folder it had or will."""
        target = tables.recording_folder(self.path, log_name)
        below = f"{self._name(target)}/"
        self._files = {n: d for n, d in self._files.items() if not n.startswith(below)}
        self._rows = {t: row for t, row in self._rows.items() if row["recording"] != log_name}
        shutil.rmtree(target, ignore_errors=True)
        return target

    def add_report(self, city: str, content: dict[str, Any]) -> None:
        """Write what is to be known about the conversion of a city."""
        path = tables.report_file(self.path, city)
        tables.write_json(path, content)
        self._note(path)

    def close(self) -> None:
        """Write the list of scenarios and the manifest."""
        rows = [self._rows[token] for token in sorted(self._rows)]
        table = pa.Table.from_pylist(rows, schema=schema.SCENARIOS)
        tables.write_blocks(self.path / tables.SCENARIOS, [table])
        self._note(self.path / tables.SCENARIOS)
        files = dict(sorted(self._files.items()))
        content = hashlib.sha256(json.dumps(files).encode()).hexdigest()
        kind: dict[str, Any] = {"format": schema.FORMAT, "version": schema.VERSION}
        if self._generator is not None:
            kind["generator"] = self._generator
        tables.write_json(self.path / tables.MANIFEST, kind | {"hash": content, "files": files})

    def _name(self, path: Path) -> str:
        return path.relative_to(self.path).as_posix()

    def _note(self, path: Path) -> None:
        self._files[self._name(path)] = tables.digest(path)
