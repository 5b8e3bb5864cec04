"""The manifest of a run: how its results were made."""

import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import shiftsim
from shiftsim.config import RunConfig
from shiftsim.results import FORMAT_VERSION

_PACKAGES = ("numpy", "numba", "scipy", "shapely", "pyarrow", "torch")


def make_manifest(
    folder: Path,
    *,
    config: RunConfig,
    split: str,
    store: Path,
    determining: dict[str, Any],
    counts: dict[str, int],
    argv: Sequence[str],
) -> dict[str, Any]:
    """What a run folder says about how its results were made."""
    return {
        "format": FORMAT_VERSION,
        "run": folder.name,
        "state": "finished",
        "argv": list(argv),
        "config": config.to_dict(),
        "split": split,
        "store": str(store),
        "counts": counts,
        "determining": determining,
        "ended": now(),
        "versions": versions(),
        "machine": {
            "system": platform.platform(),
            "processor": platform.machine(),
            "cores": os.cpu_count(),
        },
        "git": _git_state(),
    }


def now() -> str:
    """The time, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Versions of Python, shiftsim and the packages that results could depend on."""
    out = {"shiftsim": shiftsim.__version__, "python": sys.version.split()[0]}
    for name in _PACKAGES:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return out


def _git_state() -> str:
    """Commit of the checkout that shiftsim runs from, empty when it is none."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()
