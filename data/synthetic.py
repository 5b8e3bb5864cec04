"""Generated scenarios, so that demo, tests and benchmarks need no download.

`write_demo` makes recordings in the layout of DSC3D, which then take the way of real ones;
`bench_scene` makes one scenario in a city large enough to measure speed on.
"""

import shutil
import tempfile
from pathlib import Path

from shiftsim.data.deepplan import ConversionReport, convert_dsc3d
from shiftsim.data.demo_files import write_sites
from shiftsim.data.synthetic_city import bench_scene

__all__ = ["bench_scene", "convert_demo", "demo_store", "write_demo"]


def write_demo(folder: Path) -> None:
    """Write the recordings of the demo, one DSC3D folder per site, always the same bytes.

    Args:
        folder: Where the folders `junction` and `street` go; made if needed.
    """
    write_sites(folder)


def convert_demo(recordings: Path, store: Path) -> list[ConversionReport]:
    """Convert what `write_demo` wrote into a store, one report per site."""
    return [
        convert_dsc3d(site, store, site=site.name)
        for site in sorted(recordings.iterdir())
        if (site / "data_meta.json").is_file()
    ]


def demo_store(path: Path) -> Path:
    """The store of the demo; made anew unless it is there.

    Args:
        path: Folder of the store.

    Returns:
        The same path.
    """
    if (path / "store.json").is_file():
        return path
    with tempfile.TemporaryDirectory(prefix="shiftsim-demo-") as scratch:
        recordings, store = Path(scratch) / "recordings", Path(scratch) / "store"
        write_demo(recordings)
        convert_demo(recordings, store)
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(store, path)
    return path
