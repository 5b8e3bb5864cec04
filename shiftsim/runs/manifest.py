"""The manifest of a run: how its results were made, and whether a folder holds the same run."""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, TypeAlias

from shiftsim._version import __version__
from shiftsim.errors import ConfigError, DataError, plural
from shiftsim.files import PACKAGE
from shiftsim.runs.config import RunConfig
from shiftsim.runs.journal import has_entries
from shiftsim.runs.results import FORMAT_VERSION, JOURNAL, read_manifest

_PACKAGES = ("numpy", "numba", "scipy", "shapely", "pyarrow", "torch")
# what computes a result, and everything that may be named by a setting
_SOURCES = (
    "kernels.py",
    "data/store/*.py",
    *(
        f"{name}/**/*.py"
        for name in "compat edits geometry metrics planners runs sim world".split()
    ),
)

State: TypeAlias = Literal["new", "unfinished", "failed", "complete"]
_NAMES = {"tokens": "scenarios", "review": "reviews"}  # in messages
_OF_TASK, _OF_ROLLOUT = 17e3, 68e3  # bytes on disk when a run ends; in reactive traffic more


def make_manifest(
    folder: Path,
    config: RunConfig,
    fingerprint: Any,
    *,
    split: str,
    store: str,
    argv: Sequence[str],
) -> dict[str, Any]:
    """What a run folder says of how it was made; state and counts come later."""
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
        "determining": fingerprint,
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
    for path in sorted(path for pattern in _SOURCES for path in PACKAGE.glob(pattern)):
        name = path.relative_to(PACKAGE).as_posix()
        digest.update(f"{name}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of Python, shiftsim and the packages that results could depend on."""
    out = {"shiftsim": __version__, "python": sys.version.split()[0]}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            out[name] = metadata.version(name)
    return out


def _git_state() -> str:
    """Commit of the checkout that shiftsim runs from, empty when it is none."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def state_of(folder: Path) -> State:
    """How far the run in a folder is; `failed` has ended with failed tasks, `new` loses nothing."""
    if not folder.exists():
        return "new"
    has_results = has_entries(folder / JOURNAL)
    if folder.is_dir() and not has_results:
        # a process that was killed before it had begun leaves hidden files and an empty journal
        names = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
        if names <= {JOURNAL}:
            return "new"
    manifest = read_manifest(folder)
    if manifest["state"] == "running" and not has_results:
        return "new"
    if manifest["state"] != "finished" or has_results:
        return "unfinished"
    counts = manifest["counts"]
    return "complete" if counts["ok"] == counts["expected"] else "failed"


def check_target(folder: Path, fingerprint: dict[str, Any], *, shard: str = "") -> State:
    """How far the run in a folder is; a ConfigError where that is another one or something else."""
    try:
        state = state_of(folder)
    except (DataError, KeyError) as error:
        what = f"{str(folder)!r} exists and is not a run folder"
        raise ConfigError(what, hint="choose another --out") from error
    if state == "new":
        return state
    differs = difference(read_manifest(folder), fingerprint, shard)
    if differs:
        what = f"{str(folder)!r} holds another run: {differs}"
        raise ConfigError(what, hint="choose another --out, or remove that folder")
    return state


def check_space(folder: Path, num_tasks: int, *, with_rollouts: bool) -> None:
    """Refuse a run whose disk cannot hold it; its folder need not exist yet."""
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    needed = num_tasks * (_OF_TASK + _OF_ROLLOUT * with_rollouts)
    if needed > (free := shutil.disk_usage(place).free):
        what = f"{plural(num_tasks, 'task')}: about {needed / 1e6:,.1f} MB, but {str(place)!r} has"
        hint = "choose another --out" + ", or --save-rollouts failed" * with_rollouts
        raise DataError(f"{what} {free / 1e6:,.1f} MB free", hint)


def difference(manifest: dict[str, Any], fingerprint: dict[str, Any], shard: str = "") -> str:
    """The settings that differ from those of a manifest, in words; empty when none does."""
    before = {**manifest.get("determining", {}), "shard": manifest.get("shard", "")}
    after = {**fingerprint, "shard": shard}
    words = {name: _NAMES.get(name, name) for name in _differing(before, after)}
    planners = [one.get("planners", {}) for one in (before, after)]
    for name in _differing(*planners) if {*planners[0]} == {*planners[1]} else ():
        parts = _differing(*(one[name] for one in planners))
        words["planners"] += f" ({name}: {', '.join(parts)})"
    return f"{', '.join(words.values())} differ" if words else ""


def _differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """The keys under which two tables hold different values."""
    return [key for key in sorted({*one, *other}) if one.get(key) != other.get(key)]


def check_resumable(folder: Path, fingerprint: dict[str, Any], *, shard: str = "") -> None:
    """Refuse to begin anew where an unfinished run with other settings seems to be meant."""
    prefix = folder.name.rpartition("_")[0]
    for other in sorted(folder.parent.glob(f"{prefix}_*")) if prefix else ():
        try:
            manifest = read_manifest(other)
            if state_of(other) != "unfinished" or manifest.get("shard", "") != shard:
                continue
        except (DataError, KeyError):
            continue
        differs = difference(manifest, fingerprint, shard)
        what = f"no unfinished run with these settings; {str(other)!r} is another one: {differs}"
        raise ConfigError(what, hint="give its settings, or leave out --resume to begin anew")
