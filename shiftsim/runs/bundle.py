"""The scenarios of a run: in the store it was made with, or in a copy inside the run folder.

A run knows its store by hash. A bundled run holds a store of its own with the scenarios it used and
their maps, so that the folder alone is enough to score, view and plot it anywhere.
"""

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from shiftsim.data.store.reading import ScenarioStore, open_store
from shiftsim.data.store.review import REVIEW
from shiftsim.data.store.writing import StoreWriter, window_row
from shiftsim.errors import DataError
from shiftsim.files import store_path
from shiftsim.runs.results import Run

BUNDLE = "store"  # folder below that of the run


def open_run_store(run: Run, store: str | None = None) -> ScenarioStore:
    """The store that a run was made with, or its bundle, which then has the hash of that store.

    Args:
        run: The run.
        store: Name or path, where the store has moved.

    Raises:
        DataError: It is not there, or is another one.
    """
    bundle = run.path / BUNDLE
    if store is None and bundle.is_dir():
        found = open_store(bundle)
        wanted = run.manifest.get("bundle", {}).get("hash")
    else:
        found = _open(run, store)
        wanted = run.manifest["determining"]["store"]
    if found.hash != wanted:
        raise DataError(
            f"store {str(found.path)!r} is not the one run {run.path.name!r} was made with",
            hint="name the right one with --store, or run again",
        )
    found.hash = run.manifest["determining"]["store"]
    return found


def _open(run: Run, store: str | None) -> ScenarioStore:
    place = store or run.manifest["store"]
    if "://" in place:
        return open_store(place)
    path = store_path(place)
    if not path.exists():
        raise DataError(
            f"the store of run {run.path.name!r} is not at {str(path)!r}",
            hint="say where it is with --store",
        )
    return open_store(path)


def write_bundle(store: ScenarioStore, folder: Path, tokens: Iterable[str]) -> dict[str, Any]:
    """Copy scenarios with their recordings and maps into a run folder.

    Args:
        store: The store.
        folder: The run folder.
        tokens: The scenarios.

    Returns:
        What the manifest says about it.
    """
    target = folder / BUNDLE
    if not target.exists():
        partial = folder / f".{BUNDLE}.tmp"
        shutil.rmtree(partial, ignore_errors=True)
        _copy(store, partial, set(tokens))
        partial.rename(target)
    return {"hash": open_store(target).hash}


def _copy(store: ScenarioStore, target: Path, tokens: set[str]) -> None:
    columns = (store.summary()[name].to_pylist() for name in ("token", "recording", "city"))
    used = [row for row in zip(*columns, strict=True) if row[0] in tokens]
    with StoreWriter(target) as writer:
        for city in sorted({city for _, _, city in used}):
            writer.add_map(store.map(city))
        for recording in sorted({recording for _, recording, _ in used}):
            rows = [
                window_row(store.window(token), city)
                for token, name, city in used
                if name == recording
            ]
            copied = target / ".recording"
            shutil.copytree(store.recording_folder(recording), copied)
            writer.take_recording(copied, recording, rows)
    if (store.path / REVIEW).is_file():
        (target / REVIEW).parent.mkdir()
        shutil.copyfile(store.path / REVIEW, target / REVIEW)
