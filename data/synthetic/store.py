"""Stores of synthetic towns: the demo, and as many random towns to train in as wanted."""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain, count, cycle, islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.store.reading import ScenarioStore, read_report
from shiftsim.data.store.tables import MANIFEST
from shiftsim.data.store.writing import StoreWriter, window_row
from shiftsim.data.synthetic import recordings
from shiftsim.data.synthetic.layouts import KINDS
from shiftsim.errors import ConfigError, DataError

# what networks may be trained on, and what is kept back from them to test a semantic shift: other
# kinds of layout, with more pedestrians and cyclists
DOMAINS = ("all", "home", "foreign")
FOREIGN, CROWD = ("roundabout", "shared"), 2.0

DEMO_SPLIT = "demo-mini"
_SPLIT_SIZE = 16
_SPLIT_PATH = 40.0  # m, shortest way of the ego in a scenario of the split
# names of the towns of the demo, and their kinds: those with traffic lights are `lights`
_DEMO = {
    "avenue": "avenue",
    "junction": "lights",
    "parking": "parking",
    "roundabout": "roundabout",
    "shared": "shared",
    "street": "street",
}
DEMO_TOWNS = tuple(
    recordings.TownSpec(name, kind, number, num_recordings=2, overlap_s=0.0, min_scenarios=6)
    for number, (name, kind) in enumerate(_DEMO.items(), start=1)
)


def demo_store(path: Path) -> Path:
    """The store of the demo at `path`, which is returned; made anew unless it is there."""
    if (path / MANIFEST).is_file():
        return path
    with _made_in_place(path) as (parts, store):
        for town in DEMO_TOWNS:
            recordings.make_town(parts, town)
        _join(parts, DEMO_TOWNS, store, {"name": "demo"})
        (store / "splits").mkdir(exist_ok=True)
        listed = "".join(f'    "{token}",\n' for token in _sample(ScenarioStore(store)))
        text = f'name = "{DEMO_SPLIT}"\ntokens = [\n{listed}]\n'
        (store / f"splits/{DEMO_SPLIT}.toml").write_text(text, encoding="utf-8")
    return path


@contextmanager
def _made_in_place(path: Path) -> Iterator[tuple[Path, Path]]:
    """Folders for the parts of a store and for the store, which is at `path` in the end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as scratch:
        parts, store = Path(scratch).resolve() / "parts", Path(scratch) / "store"
        parts.mkdir()
        yield parts, store
        try:
            store.rename(path)
        except OSError:  # another process has made the same in the meantime
            if not (path / MANIFEST).is_file():
                raise


def town_specs(towns: int, seed: int, domain: str = "all") -> list[recordings.TownSpec]:
    """The random towns of a seed and a domain, of every kind in turn."""
    name, crowd = ("foreign", CROWD) if domain == "foreign" else ("town", 1.0)
    kinds = {"home": [kind for kind in KINDS if kind not in FOREIGN], "foreign": list(FOREIGN)}
    numbered = zip(count(1), cycle(KINDS))  # the same town in every store that has it
    specs = (
        recordings.TownSpec(f"{name}-{seed}-{number:03d}", kind, number, crowd=crowd)
        for number, kind in numbered
        if kind in kinds.get(domain, KINDS)
    )
    return list(islice(specs, towns))


def write_towns(
    path: Path,  # its folder, which must not exist, or hold that store already
    *,
    towns: int,  # how many; a store of more holds those of fewer
    seed: int,
    domain: str = "all",
    spread: Callable[[Any, Sequence[recordings.TownSpec]], Iterable[Any]],  # over processes
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> ScenarioStore:
    """A store of random towns, the same bytes for the same number and seed.

    It is a ConfigError if the folder holds something else, or if there is no such domain, a
    DataError if a process dies.
    """
    if domain not in DOMAINS:
        raise ConfigError(f"domain {domain!r} unknown", hint=f"one of {', '.join(DOMAINS)}")
    provenance: dict[str, Any] = {"name": "towns", "seed": seed, "towns": towns}
    if domain != DOMAINS[0]:
        provenance["domain"] = domain
    if path.exists():
        if (path / MANIFEST).is_file() and (found := ScenarioStore(path)).generator == provenance:
            return found
        raise ConfigError(
            f"{str(path)!r} holds something else", hint="name a new folder with --out"
        )
    specs = town_specs(towns, seed, domain)
    progress(0, towns, "")
    with _made_in_place(path) as (parts, store):
        outcomes = spread(partial(partial, recordings.make_town, parts), specs)
        for done, outcome in enumerate(outcomes, start=1):
            if outcome.death:
                raise DataError(f"town {outcome.task.name!r}: {outcome.death}", hint="start again")
            progress(done, towns, outcome.task.name)
        _join(parts, specs, store, provenance)
    return ScenarioStore(path)


def _join(
    parts: Path, towns: Sequence[recordings.TownSpec], path: Path, provenance: dict[str, Any]
) -> None:
    """Move the stores of single towns into one of all."""
    with StoreWriter(path, provenance) as writer:
        for town in towns:
            part = parts / town.name
            store = ScenarioStore(part)
            writer.add_map(store.map(town.name))
            rows: dict[str, list[dict[str, Any]]] = {}
            for window in recordings.usable(store):
                rows.setdefault(window.log_name, []).append(window_row(window, town.name))
            for recording, windows in sorted(rows.items()):
                writer.take_recording(store.recording_folder(recording), recording, windows)
            writer.add_report(town.name, read_report(part, town.name))
            shutil.rmtree(part)


def _sample(store: ScenarioStore) -> list[str]:
    """Tokens of some scenarios in which the ego gets on, from every town in turn."""
    by_city: dict[str, list[str]] = {city: [] for city in store.cities}
    for scene in store:
        rows = scene.iteration_rows
        steps = np.diff(scene.ego[rows[0] : rows[-1] + 1, :2], axis=0)
        if np.hypot(*steps.T).sum() >= _SPLIT_PATH:
            by_city[scene.city].append(scene.token)
    mixed = filter(None, chain.from_iterable(zip_longest(*by_city.values())))
    return sorted(islice(mixed, _SPLIT_SIZE))
