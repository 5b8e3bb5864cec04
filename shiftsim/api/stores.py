"""Stores from Python: what `convert`, `demo`, `filter`, `check` and `stats` do on the command line.

The methods of a store that need more than its files are attached here.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shiftsim.data import open_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, one_of
from shiftsim.files import DEFAULT_STORE, store_path

if TYPE_CHECKING:
    from shiftsim.data.nuplan.convert import ConversionReport as NuplanReport
    from shiftsim.data.readers.convert import ConversionReport
    from shiftsim.data.readers.reader import Reader
    from shiftsim.data.store.check import CheckReport
    from shiftsim.data.store.statistics import StoreStats
    from shiftsim.runs.filter import FilterResults

OnProgress = Callable[..., None]  # done, total and the name of the last one


def convert_nuplan(
    logs: str | Path, maps: str | Path, store: str | Path, **filters: Any
) -> "NuplanReport":
    """Convert scenarios of nuPlan logs and maps into a store, or add them to one.

    Args:
        logs: Folder of .db logs, or one log.
        maps: Folder of the maps.
        store: Name or folder of the store.
        filters: `tokens`, `types`, `filter_file` (nuPlan's YAML), `mapping` (duration [s], offset
            [s], ratio); and `progress`, called with logs done, logs in all and a name.

    Returns:
        What was converted, and what failed and why.

    Raises:
        DataError: There are no logs or no maps, or the store cannot be written.
        ConfigError: The filter asks for something that is not supported.

    Example:
        ```python
        report = shiftsim.convert_nuplan("nuplan/logs", "nuplan/maps", "logs")
        ```
    """
    from shiftsim.data.nuplan.convert import convert_nuplan

    return convert_nuplan(Path(logs), Path(maps), store_path(store), **filters)


def convert_dsc3d(
    source: str | Path,
    store: str | Path,
    *,
    site: str | None = None,
    map_path: str | Path | None = None,
    workers: int = 0,
    on_progress: OnProgress = lambda *_: None,
    **thresholds: Any,
) -> "ConversionReport":
    """Convert recordings in the layout of DSC3D into a store.

    Args:
        source: Folder with data_meta.json, annotations and map.
        store: Name or folder of the store.
        site: Name of the site; that of the folder by default.
        map_path: OpenDRIVE file, if it is elsewhere.
        workers: Processes; as many as the machine suggests where 0.
        on_progress: Called with recordings done, recordings in all and a name.
        thresholds: Fields of `ConversionConfig`, such as `window_s`, `overlap_s`, `country`.

    Returns:
        What became of each recording; a broken one is skipped and named.

    Raises:
        ConfigError: A threshold is unknown or out of range.
        ConversionError: None of the recordings can be converted.

    Example:
        ```python
        report = shiftsim.convert_dsc3d("dsc3d/sindelfingen", "site", workers=1)
        ```
    """
    from shiftsim.data.readers.dsc3d import Dsc3dReader
    from shiftsim.data.readers.windows import make_config

    place = None if map_path is None else Path(map_path)
    reader = Dsc3dReader(Path(source), site=site, map_path=place, config=make_config(thresholds))
    return convert_reader(reader, store, workers, on_progress)


def convert_tracks(
    tables: str | Path | Sequence[str | Path],
    map_path: str | Path,
    store: str | Path,
    *,
    egos: Sequence[str] | None = None,
    city: str | None = None,
    hz: float | None = None,
    columns: dict[str, Any] | None = None,
    replace: bool = False,
    **thresholds: Any,
) -> "ConversionReport":
    """Convert tracks of any source: tables with a row per object and time, and their map.

    Args:
        tables: CSV or Parquet; several are joined.
        map_path: OpenDRIVE file.
        store: Name or folder of the store.
        egos: Ids of the objects that become the ego; all vehicles by default.
        city: Name of the map; that of the file by default.
        hz: Frames per second, where time is given in frames.
        columns: Names, units and kinds of columns, as in the TOML file of `--columns`.
        replace: Replace the recording that other tables of that name became.
        thresholds: Fields of `ConversionConfig`, such as `window_s`.

    Raises:
        ConfigError: A column or a threshold is wrong.
        ConversionError: The tracks cannot be right, or give no scenario.

    Example:
        ```python
        report = shiftsim.convert_tracks("tracks.csv", "map.xodr", "own")
        ```
    """
    from shiftsim.data.readers.scenarios import EGO_CATEGORIES
    from shiftsim.data.readers.tracks.reader import TracksReader, convert_tracks
    from shiftsim.data.readers.windows import make_config

    paths = [Path(path) for path in ([tables] if isinstance(tables, str | Path) else tables)]
    config = make_config({"ego_categories": EGO_CATEGORIES, **thresholds})
    reader = TracksReader(
        paths, Path(map_path), city=city, overrides=columns or {}, hz=hz, config=config
    )
    return convert_tracks(reader, store_path(store), egos=egos, replace=replace)


def convert_dataset(
    kind: str,
    folder: str | Path,
    store: str | Path,
    *,
    egos: str = "recorded",
    at: str | Path | None = None,
    workers: int = 0,
    on_progress: OnProgress = lambda *_: None,
) -> "ConversionReport":
    """Convert scenes of an open data set: `av2`, `py123d` or `commonroad`.

    Args:
        kind: Which of them.
        folder: Folder of the data set.
        store: Name or folder of the store.
        egos: `recorded`, the recording car, or `vehicles`, each vehicle that drives; of CommonRoad
            always the latter.
        at: Of py123d: a CSV file with columns `log_name` and `time_us`; only the scenarios that
            begin there are made.
        workers: Processes; as many as the machine suggests where 0.
        on_progress: Called with scenes done, scenes in all and a name.

    Raises:
        ConfigError: The data set, or what becomes the ego, is unknown.
        ConversionError: None of the scenes can be converted.

    Example:
        ```python
        report = shiftsim.convert_dataset("commonroad", "commonroad", "scenes", workers=1)
        ```
    """
    from shiftsim.data.readers.av2 import Av2Reader
    from shiftsim.data.readers.commonroad import CommonRoadReader
    from shiftsim.data.readers.py123d import Py123dReader, read_starts

    if at is not None and kind != "py123d":
        raise ConfigError(f"at is for py123d, not {kind}", hint="leave it out")
    vehicles = one_of("egos", egos, ("recorded", "vehicles")) == "vehicles"
    starts = None if at is None else read_starts(Path(at))
    readers: dict[str, Any] = {
        "av2": partial(Av2Reader, vehicles=vehicles),
        "py123d": partial(Py123dReader, vehicles=vehicles, starts=starts),
        "commonroad": CommonRoadReader,
    }
    reader = readers[one_of("data set", kind, readers)](Path(folder))
    return convert_reader(reader, store, workers, on_progress)


def convert_reader(
    reader: "Reader", store: str | Path, workers: int = 0, on_progress: OnProgress = lambda *_: None
) -> "ConversionReport":
    """Convert what a reader gives, over processes, into a store by name or folder.

    Raises:
        ConversionError: None of the recordings can be converted.
    """
    from shiftsim.data.readers.convert import convert
    from shiftsim.runs.workers import map_unordered

    executor = partial(map_unordered, workers=workers)
    return convert(reader, store_path(store), progress=on_progress, executor=executor)


def demo_store(store: str | Path = DEFAULT_STORE) -> ScenarioStore:
    """The store of the demo; generated where it is not there yet.

    Example:
        ```python
        store = shiftsim.demo_store()
        ```
    """
    from shiftsim.data.synthetic.store import demo_store

    return open_store(demo_store(store_path(store)))


def make_towns(
    store: str | Path,
    towns: int,
    *,
    seed: int = 0,
    domain: str = "all",
    workers: int = 0,
    on_progress: OnProgress = lambda *_: None,
) -> ScenarioStore:
    """A store of random towns to train in; the same bytes for the same number and seed.

    Args:
        store: Name or folder of the store.
        towns: How many.
        seed: Of everything that is random.
        domain: `home` for towns without roundabouts and shared spaces, `foreign` for these alone
            with twice as many pedestrians and cyclists, `all` for every kind.
        workers: Processes; as many as the machine suggests where 0.
        on_progress: Called with towns done, towns in all and a name.

    Raises:
        ConfigError: The folder holds something else.

    Example:
        ```python
        store = shiftsim.make_towns("towns", 1, seed=1)
        ```
    """
    from shiftsim.data.synthetic.store import write_towns
    from shiftsim.runs.workers import map_unordered

    spread = partial(map_unordered, workers=workers, alone=1)
    folder = store_path(store)
    return write_towns(
        folder, towns=towns, seed=seed, domain=domain, spread=spread, progress=on_progress
    )


def _filter(
    self: ScenarioStore,
    *,
    workers: int = 0,
    on_progress: OnProgress = lambda *_: None,
    **limits: Any,
) -> "FilterResults":
    """Drive every scenario as recorded; those that cannot be driven so are left out of runs.

    `workers` processes share them, as many as the machine suggests where 0; `on_progress` is called
    with scenarios done and scenarios in all; `limits` are fields of `FilterConfig`: `thresholds`,
    `min_path_m`, `min_progress_share`.
    """
    from shiftsim.runs.filter import FilterConfig, filter_store

    config = FilterConfig(**limits)
    return filter_store(self.path, config, workers=workers, on_progress=on_progress)


def _check(self: ScenarioStore) -> "CheckReport":
    """Files, units, motion, maps and routes: every problem, and what each recording holds."""
    from shiftsim.data.store.check import survey_store

    return survey_store(self.path)


def _stats(self: ScenarioStore, tokens: Sequence[str] | None = None) -> "StoreStats":
    """Agents, speeds, lengths and interactions of some scenarios, or of all."""
    from shiftsim.data.store.statistics import store_stats

    return store_stats(self, tokens)


def _export_nuplan(self: ScenarioStore, out: str | Path, **options: Any) -> Any:
    """Write scenarios as nuPlan logs and maps; options are `tokens` and `progress`."""
    from shiftsim.data.nuplan.export import export_nuplan

    return export_nuplan(self, Path(out), **options)


for _method in (_filter, _check, _stats, _export_nuplan):
    setattr(ScenarioStore, _method.__name__[1:], _method)
