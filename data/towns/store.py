"""Stores of random towns to train in, as many as wanted."""

import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from shiftsim.data.readers.convert import Executor
from shiftsim.data.store.reading import ScenarioStore, read_report
from shiftsim.data.store.tables import MANIFEST
from shiftsim.data.store.writing import StoreWriter, window_row
from shiftsim.data.towns.recordings import MakeTown, town_names, usable
from shiftsim.errors import ConfigError, DataError

GENERATOR = "towns"  # as `store.json` names it


def write_towns(
    path: Path,
    *,
    towns: int,
    seed: int,
    spread: Executor,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> ScenarioStore:
    """A store of random towns, the same bytes for the same number and seed.

    Args:
        path: Its folder, which must not exist, or hold that store already.
        towns: How many towns; a store of more holds those of fewer.
        seed: Of everything that is random.
        spread: How towns are spread over processes.
        progress: Called with towns done, towns in all and the name of the last one.

    Raises:
        ConfigError: The folder holds something else.
        DataError: A process died.
    """
    generator = {"name": GENERATOR, "seed": seed, "towns": towns}
    if path.exists():
        if (path / MANIFEST).is_file() and (found := ScenarioStore(path)).generator == generator:
            return found
        raise ConfigError(
            f"{str(path)!r} holds something else", hint="name a new folder with --out"
        )
    names = town_names(towns, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    progress(0, towns, "")
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as scratch:
        parts = Path(scratch) / "parts"
        parts.mkdir()
        for done, outcome in enumerate(spread(partial(MakeTown, parts.resolve()), names), start=1):
            if outcome.death:
                raise DataError(f"town {outcome.task!r}: {outcome.death}", hint="start again")
            progress(done, towns, outcome.task)
        store = Path(scratch) / "store"
        with StoreWriter(store, generator) as writer:
            for name in names:
                _add(parts / name, name, writer)
        store.rename(path)
    return ScenarioStore(path)


def _add(part: Path, city: str, writer: StoreWriter) -> None:
    """Move the store of one town into that of all."""
    store = ScenarioStore(part)
    writer.add_map(store.map(city))
    rows: dict[str, list[dict[str, Any]]] = {}
    for window in usable(store):
        rows.setdefault(window.log_name, []).append(window_row(window, city))
    for recording, windows in sorted(rows.items()):
        writer.take_recording(store.recording_folder(recording), recording, windows)
    writer.add_report(city, read_report(part, city))
    shutil.rmtree(part)
