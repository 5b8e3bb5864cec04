"""Generated scenarios, so that demo, tests and benchmarks need no download.

`write_demo` makes recordings in the layout of DSC3D, which then take the way of real ones;
`bench_scene` makes one scenario in a city large enough to measure speed on.
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from shiftsim.data.demo.city import bench_scene
from shiftsim.data.demo.files import write_demo
from shiftsim.data.readers.convert import ConversionReport
from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.writing import StoreWriter

__all__ = ["DEMO_SPLIT", "bench_scene", "convert_demo", "demo_store", "write_demo"]

DEMO_SPLIT = "demo-mini"
_SPLIT_SIZE = 16
_SPLIT_PATH = 40.0  # m, shortest way of the ego in a scenario of the split


def convert_demo(recordings: Path, store: Path) -> list[ConversionReport]:
    """Convert what `write_demo` wrote into a store, with the split `demo-mini`."""
    reports = [
        convert_dsc3d(site, store, site=site.name)
        for site in sorted(recordings.iterdir())
        if (site / "data_meta.json").is_file()
    ]
    StoreWriter(store, {"name": "demo"}).close()
    tokens = _sample(ScenarioStore(store))
    lines = [f'name = "{DEMO_SPLIT}"', "tokens = [", *(f'    "{token}",' for token in tokens), "]"]
    (store / "splits").mkdir(exist_ok=True)
    (store / f"splits/{DEMO_SPLIT}.toml").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return reports


def demo_store(path: Path) -> Path:
    """The store of the demo at `path`, which is returned; made anew unless it is there."""
    if (path / "store.json").is_file():
        return path
    with tempfile.TemporaryDirectory(prefix="shiftsim-demo-") as scratch:
        recordings, store = Path(scratch) / "recordings", Path(scratch) / "store"
        write_demo(recordings)
        convert_demo(recordings, store)
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(store, path)
    return path


def _sample(store: ScenarioStore) -> list[str]:
    """Tokens of some scenarios in which the ego gets on, from every town in turn."""
    by_city: dict[str, list[str]] = {city: [] for city in store.cities}
    for scene in store:
        rows = scene.iteration_rows
        way = np.diff(scene.ego[rows[0] : rows[-1] + 1, :2], axis=0)
        if np.hypot(*way.T).sum() >= _SPLIT_PATH:
            by_city[scene.city].append(scene.token)
    turns = max(map(len, by_city.values()))
    mixed = [
        tokens[turn] for turn in range(turns) for tokens in by_city.values() if turn < len(tokens)
    ]
    return sorted(mixed[:_SPLIT_SIZE])
