"""The manifest of a run: how its results were made."""

import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from shiftsim._version import __version__
from shiftsim.files import PACKAGE, sources
from shiftsim.runs.config import RunConfig
from shiftsim.runs.results import FORMAT_VERSION

_PACKAGES = ("numpy", "numba", "scipy", "shapely", "pyarrow", "torch")
# what computes a result: a task, and everything that may be named by a setting
_ROOTS = ("runs/task.py", "planners/**/*.py", "sim/traffic/**/*.py")


def make_manifest(
    folder: Path,
    *,
    config: RunConfig,
    split: str,
    store: str,
    determining: dict[str, Any],
    argv: Sequence[str],
) -> dict[str, Any]:
    """What a run folder says about how its results were made; state and counts come later."""
    return {
        "format": FORMAT_VERSION,
        "run": folder.name,
        "state": "running",
        "argv": list(argv),
        "config": replace(config, resume=False, retry_failed=False).to_dict(),
        "split": split,
        "shard": config.shard,
        "store": store,
        "counts": {},
        "determining": determining,
        "started": now(),
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


@cache
def code_digest() -> str:
    """Digest of all sources that results depend on: two versions of them are not mixed."""
    digest = hashlib.blake2b(digest_size=8)
    roots = [path for pattern in _ROOTS for path in PACKAGE.glob(pattern)]
    for name, source in sorted(sources(roots).items()):
        digest.update(f"{name}\n".encode() + source)
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of Python, shiftsim and the packages that results could depend on."""
    out = {"shiftsim": __version__, "python": sys.version.split()[0]}
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
