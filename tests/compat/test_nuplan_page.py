"""The code blocks of docs/nuplan_planners.md, as they stand there."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
from commands import call

PAGE = Path(__file__).resolve().parents[2] / "docs/nuplan_planners.md"


def test_the_examples_run(toy, tmp_path):
    text = PAGE.read_text()
    planner, script = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    (commands,) = re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)
    shutil.copytree(toy, tmp_path / "my-store")
    (tmp_path / "my_planner.py").write_text(planner)
    for line in commands.strip().splitlines():
        program, *words = line.split()
        assert program == "shiftsim"
        done = call(tmp_path, *words)
        assert done.returncode == 0, done.stdout + done.stderr
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "cruise" in done.stdout
    one, other = (
        pq.read_table(tmp_path / name / "scores.parquet").column("cls").to_pylist()
        for name in ("my-run", "same-run")
    )
    assert len(one) == 4
    assert one == other
