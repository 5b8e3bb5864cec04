"""Tables of tracks for tests: a recording of a demo town as CSV and its map, right or spoilt."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from shiftsim.data.readers.dsc3d import find_map, open_site, read_recording
from shiftsim.data.synthetic.recordings import generate_town, write_recordings
from shiftsim.data.synthetic.store import DEMO_TOWNS


def write_demo(folder: Path, only: str = "") -> None:
    """Write the recordings of the demo, one DSC3D folder per town: all, or the one named."""
    for town in DEMO_TOWNS:
        if only in ("", town.name):
            write_recordings(folder / town.name, town, *generate_town(town))


def export_town(folder: Path, town: str):
    """Columns of a demo recording at 12.5 Hz by name, and its map; `folder` is made if needed."""
    if not (folder / town).exists():
        write_demo(folder, town)
    return table_of(open_site(folder / town))


def table_of(site):
    """Columns of the first recording of a site by name, and its map."""
    found = read_recording(site, site.recordings[0])
    track = found.track
    columns = {
        "frame": found.frame,
        "time_s": found.time,
        "track": found.track_ids[track],
        "kind": np.array(found.categories)[track],
        "x_m": found.xy[:, 0],
        "y_m": found.xy[:, 1],
        "heading_rad": found.raw_headings,
        "vx_mps": found.velocities[:, 0],
        "vy_mps": found.velocities[:, 1],
        "length_m": found.sizes[track, 0],
        "width_m": found.sizes[track, 1],
    }
    return columns, find_map(site)


def write_tracks(path: Path, columns, **changed) -> Path:
    """Write a table with some columns changed; None leaves one out."""
    kept = {n: v for n, v in {**columns, **changed}.items() if v is not None}
    pc.write_csv(pa.table(kept), path)
    return path
