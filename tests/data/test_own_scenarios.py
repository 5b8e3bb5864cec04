"""The worked example of docs/own_scenarios.md, as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from shiftsim.data import synthetic
from shiftsim.data.check import check_store
from shiftsim.data.deepplan_states import resample
from shiftsim.data.deepplan_windows import find_runs
from shiftsim.data.dsc3d import find_map, open_site, read_recording

PAGE = Path(__file__).resolve().parents[2] / "docs/own_scenarios.md"
HEADER = "row,track,kind,x_m,y_m,heading_rad,vx_mps,vy_mps,length_m,width_m"


def _write_inputs(folder):
    """A CSV and a map from the first site of the demo."""
    synthetic.write_demo(folder / "demo")
    site = open_site(next(path for path in sorted((folder / "demo").iterdir()) if path.is_dir()))
    (folder / "map.xodr").write_bytes(find_map(site).read_bytes())
    source = read_recording(site, site.recordings[0])
    runs = find_runs(source, 0.5)
    tracks = resample(source, runs, log_name="", city="", offset=np.zeros(2)).tracks
    row, column = np.nonzero(tracks.valid[:200])
    table = np.column_stack(
        [
            row,
            column,
            tracks.kinds[column],
            tracks.poses[row, column],
            tracks.velocities[row, column],
            tracks.sizes[row, column],
        ]
    )
    np.savetxt(folder / "tracks.csv", table, delimiter=",", header=HEADER, comments="")


def test_the_example_turns_a_csv_and_a_map_into_scores(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    assert len(code.strip().splitlines()) <= 50
    _write_inputs(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "constant-velocity" in done.stdout
    problems = [p for p in check_store(tmp_path / "my-store") if p.is_error]
    assert problems == []
