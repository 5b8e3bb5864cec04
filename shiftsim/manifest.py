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

import shiftsim
from shiftsim.config import RunConfig
from shiftsim.results import FORMAT_VERSION

_PACKAGES = ("numpy", "numba", "scipy", "shapely", "pyarrow", "torch")
# the sources that results depend on
_SOURCES = (
    "data/recording.py",
    "data/schema.py",
    "data/remote_store.py",
    "data/review.py",
    "data/store*.py",
    "dynamics/*.py",
    "metrics/*.py",
    "planners/**/*.py",
    "traffic/*.py",
    *(
        f"{name}.py"
        for name in (
            "arrays",
            "geometry",
            "layers",
            "log",
            "map",
            "noise",
            "plan_check",
            "planner",
            "predicates",
            "scenario",
            "simulation",
            "state",
            "tasks",
        )
    ),
)


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
    root = Path(__file__).parent
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted({path for pattern in _SOURCES for path in root.glob(pattern)}):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()


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
