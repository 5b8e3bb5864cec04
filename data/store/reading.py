"""ScenarioStore: a folder with recordings, scenarios as windows into them, and maps.

The layout and every column are described in `shiftsim.data.store.schema`.
"""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shiftsim.data.recording import EgoTrace, Window
from shiftsim.data.recording import scenario as make_scenario
from shiftsim.data.store import schema, tables
from shiftsim.data.store.map import read_map_file
from shiftsim.data.store.recordings import StoredRecording, ego_states
from shiftsim.errors import FAILED, ConfigError, DataError, beginning, listed
from shiftsim.files import safe_join
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

if TYPE_CHECKING:
    from shiftsim.data.store.review import Reviews

_MOST_MAPPED = 64  # recordings, and egos, whose files stay mapped


class ScenarioStore:
    """A store, open for reading. Made by `open_store`.

    Attributes:
        path: Its folder.
        source: Where others find it: the folder, or the URL it is copied from.
        tokens: Tokens of all scenarios, sorted.
        hash: Digest of the content; equal content has an equal hash.
        generator: What made the content up, such as `{"name": "towns", "seed": 1}`; empty where it
            was recorded.
        is_reviewed: Whether people said something of the scenarios, in `reviews`.
    """

    def __init__(
        self, path: Path, source: str = "", fetch: Callable[[str], None] = lambda name: None
    ) -> None:
        """`fetch` is called with the name of a file or folder before it is opened."""
        self.path = path
        self.source = source or str(path.resolve())
        self._fetch = fetch
        manifest = tables.read_manifest(path)
        self.hash = str(manifest["hash"])
        self.generator: dict[str, Any] = dict(manifest.get("generator", {}))
        self._file = path / tables.SCENARIOS
        self._table = tables.Table(self._file, schema.SCENARIOS).read()
        if tables.digest(self._file) != manifest["files"].get(tables.SCENARIOS):
            what = f"{self._file}: the content is not what {tables.MANIFEST} says"
            raise DataError(what, tables.REPAIR)
        self.tokens: tuple[str, ...] = tuple(self._table["token"].to_pylist())
        self._row_of = {token: row for row, token in enumerate(self.tokens)}
        if len(self._row_of) != len(self.tokens):
            raise DataError(f"{self._file}: column 'token' holds one twice", tables.REPAIR)
        require_goals(self._table, str(self._file))
        self.is_reviewed = (path / tables.REVIEW).is_file()
        if self.is_reviewed:
            len(self.reviews)  # a damaged file is noticed now
        self._maps: dict[str, VectorMap] = {}
        self._recordings: dict[str, StoredRecording] = {}
        self._egos: dict[tuple[str, str], tables.Table] = {}

    # attached by shiftsim.api: filter(), check(), stats() and export_nuplan(out)
    filter: ClassVar[Callable[..., Any]]
    check: ClassVar[Callable[..., Any]]
    stats: ClassVar[Callable[..., Any]]
    export_nuplan: ClassVar[Callable[..., Any]]

    def __repr__(self) -> str:
        return f"<ScenarioStore {self.path.name}: {len(self)} scenarios in {len(self.cities)} maps>"

    def __reduce__(self) -> Any:
        return open_store, (self.source,)

    def __len__(self) -> int:
        return len(self.tokens)

    def __getitem__(self, token: str) -> Scenario:
        """The scenario of a token, or of an unambiguous beginning of one, as `read` gives it.

        Raises:
            ConfigError: There is no such scenario, or there are several.
        """
        if not isinstance(token, str):
            raise ConfigError(
                f"a scenario is named by its token, not by {token!r}",
                hint="store[store.tokens[0]] is the first one; all: `for scenario in store`",
            )
        return self.read(beginning(f"store {self.path.name!r}", "scenario", token, self.tokens))

    def __contains__(self, token: object) -> bool:
        return token in self._row_of

    def __iter__(self) -> Iterator[Scenario]:
        return (self.read(token) for token in self.tokens)

    @cached_property
    def reviews(self) -> "Reviews":
        """What people say of the scenarios; an overlay that is not part of the hash."""
        from shiftsim.data.store.review import read_reviews

        return read_reviews(self.path)

    @property
    def cities(self) -> tuple[str, ...]:
        """Names of the maps that scenarios use, sorted."""
        return tuple(sorted(set(self._table["city"].to_pylist())))

    def summary(self) -> pa.Table:
        """One row per scenario: every column of `schema.SCENARIOS` that is not a list of rows."""
        return self._table.drop_columns(["iteration_rows"])

    def window(self, token: str) -> Window:
        """The window of a scenario; a DataError where the store has none of that token."""
        if token not in self._row_of:
            what = f"store {self.path.name!r} has no scenario {token!r}"
            raise DataError(what, "its `tokens` are the scenarios it has")
        (row,) = self._table.slice(self._row_of[token], 1).to_pylist()
        try:
            window = window_of(row)
        except (ValueError, RecursionError) as error:
            what = f"{self._file}: scenario {token!r}: metadata is not JSON: {error}"
            raise DataError(what, tables.REPAIR) from error
        require_rows(window, str(self._file))
        return window

    def read(self, token: str, *, validate: bool = True) -> Scenario:
        """One scenario with its map; nothing of other scenarios is read. Arrays are read-only.

        A route that was corrected in the review takes the place of the recorded one.

        Raises:
            DataError: The store has no such scenario, or a file is missing or damaged, or, where
                `validate` is asked for, holds a number outside of its range.
        """
        scenario = self.read_recorded(token, validate=validate)
        review = self.reviews.get(token) if self.is_reviewed else None
        if review is None or review.route is None:
            return scenario
        from shiftsim.data.store.review import require_blocks

        require_blocks(scenario.map, review, str(self.path / tables.REVIEW))
        return replace(scenario, route=review.route)

    def read_recorded(self, token: str, *, validate: bool = True) -> Scenario:
        """As `read`, without the review."""
        window = self.window(token)
        log, first, last = window.log_name, window.first_row, window.last_row
        stored, table = self.recording(log), self.ego(log, window.ego)
        recording = stored.read_window(window, validate=validate)
        # the span starts at the window's first row, and so do the ego states
        ego = EgoTrace(log, window.ego, 0, ego_states(table, first, last, validate=validate))
        road = self.map(recording.city)
        scene = make_scenario(recording, ego, window, road, offset=first, is_chosen=True)
        if validate and (np.diff(scene.iteration_times) <= 0).any():
            what = f"{stored.frames.path}: column 'time_us' does not increase"
            raise DataError(what, tables.REPAIR)
        return scene

    def map(self, city: str) -> VectorMap:
        """A map, kept for the next scenario of that city; a DataError if missing or damaged."""
        if city not in self._maps:
            path = self.map_file(city)
            if city not in self.cities and not os.path.exists(path):
                what = f"store {self.path.name!r}: map {city!r} is missing"
                raise DataError(what, f"there are: {listed(self.cities)}")
            self._maps[city] = read_map_file(path)
        return self._maps[city]

    def failed_checks(self) -> Iterator[tuple[Path, dict[str, int]]]:
        """Reports of maps that failed checks when they were made, and which: count by kind."""
        for name in tables.read_manifest(self.path)["files"]:
            if not name.startswith(f"{tables.REPORTS}/"):
                continue
            path = self._fetched(safe_join(self.path, name))
            try:
                found = json.loads(path.read_text("utf-8")).get("map_warnings", {})
                failed = {what: int(n) for what, n in found.items() if what.startswith(FAILED)}
            except (OSError, ValueError, AttributeError, TypeError) as error:
                raise DataError(f"{path}: damaged: {error}"[:400], tables.REPAIR) from error
            if failed:
                yield path, failed

    def map_file(self, city: str) -> Path:
        """File of a map."""
        return self._fetched(tables.map_file(self.path, city))

    def recording_folder(self, name: str) -> Path:
        """Folder of a recording."""
        return self._fetched(tables.recording_folder(self.path, name))

    def _fetched(self, place: Path) -> Path:
        self._fetch(place.relative_to(self.path).as_posix())
        return place

    def recording(self, name: str) -> StoredRecording:
        """A whole recording, open; its rows are read when asked for."""
        if name not in self._recordings:
            _limit(self._recordings)
            place = self._table["recording"].index(name).as_py()
            if place < 0:
                what = f"store {self.path.name!r} has no scenario of recording {name!r}"
                raise DataError(what, "`summary` names the recordings")
            city = self._table["city"][place].as_py()
            self._recordings[name] = StoredRecording(self.recording_folder(name), name, city)
        return self._recordings[name]

    def ego(self, recording: str, name: str) -> tables.Table:
        """The states of an ego of a recording, open."""
        key = (recording, name)
        if key not in self._egos:
            _limit(self._egos)
            file = tables.ego_file(self.recording_folder(recording), name)
            self._egos[key] = tables.Table(file, schema.EGO)
        return self._egos[key]


def _limit(opened: dict[Any, Any]) -> None:
    """Forget the oldest of too many mapped files."""
    if len(opened) >= _MOST_MAPPED:
        opened.pop(next(iter(opened)))


def open_store(path: str | Path) -> ScenarioStore:
    """Open the store in a folder, or behind the URL of one, or a DataError."""
    if "://" in str(path):
        from shiftsim.data.store.remote import RemoteFiles

        remote = RemoteFiles(str(path))
        return ScenarioStore(remote.path, remote.url, remote.need)
    return ScenarioStore(Path(path))


def window_of(row: dict[str, Any]) -> Window:
    """The window that a row of `schema.SCENARIOS` tells of."""
    goal = row["goal_pose"]
    return Window(
        **{name: row[name] for name in schema.SAME},
        scenario_type=row["type"],
        log_name=row["recording"],
        iteration_rows=np.array(row["iteration_rows"], np.int64),
        route=tuple(row["route"]),
        mission_goal=np.array(goal) if goal else None,
        mapping=(row["duration_s"], row["offset_s"], row["subsample_ratio"]),
        metadata=json.loads(row["metadata"]),
    )


def require_rows(window: Window, where: str) -> None:
    """Refuse a window whose iterations are not increasing rows of it."""
    rows = window.iteration_rows
    inside = len(rows) and window.first_row <= rows[0] and rows[-1] < window.last_row
    if not inside or (rows[1:] <= rows[:-1]).any():
        what = f"{where}: scenario {window.token!r}: iteration_rows do not increase within its rows"
        raise DataError(what, tables.REPAIR)


def require_goals(scenarios: pa.Table, where: str) -> None:
    """Refuse scenarios with a goal that is no pose."""
    lengths = pc.list_value_length(scenarios["goal_pose"]).unique().to_pylist()
    if not set(lengths) <= {0, 3}:
        raise DataError(f"{where}: column 'goal_pose' holds no pose", tables.REPAIR)


def read_report(store: Path, city: str) -> dict[str, Any]:
    """What a store says about the conversion of a city; empty where it says nothing."""
    path = tables.report_file(store, city)
    try:
        manifest = tables.read_manifest(store)
        if manifest["files"].get(path.relative_to(store).as_posix()) != tables.digest(path):
            return {}
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (DataError, OSError, ValueError, RecursionError):
        return {}
    return content
