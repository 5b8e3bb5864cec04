"""Calling the real command line."""

import os
import subprocess
import sys


def call(folder, *words):
    """Run `shiftsim` in a folder; its output as text."""
    environment = {k: v for k, v in os.environ.items() if k != "SHIFTSIM_DATA"}
    return subprocess.run(
        [sys.executable, "-m", "shiftsim", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        env=environment | {"COLUMNS": "200"},
        check=False,
    )
