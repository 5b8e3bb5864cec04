"""The manifest of a run: how its results were made, and whether a folder holds the same run."""

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, TypeAlias

from shiftsim._version import __version__
from shiftsim.errors import ConfigError, DataError
from shiftsim.files import PACKAGE, sources
from shiftsim.runs.config import RunConfig
from shiftsim.runs.journal import has_entries
from shiftsim.runs.results import FORMAT_VERSION, JOURNAL, read_manifest

_PACKAGES = ("numpy", "numba", "scipy", "shapely", "pyarrow", "torch")
# what computes a result: a task, and everything that may be named by a setting
_ROOTS = ("runs/task.py", "planners/**/*.py", "sim/traffic/**/*.py")

State: TypeAlias = Literal["new", "unfinished", "failed", "complete"]
_MAX_MESSAGE = 600  # characters
_DIGEST = re.compile("[0-9a-f]{16,64}")
_NAMES = {"tokens": "scenarios", "review": "reviews"}  # in messages
_DIGESTS = ("store", "tokens", "filter", "review", "code")
# on disk when a run ends, of 15 s in non-reactive traffic with few others, so rather too little
_BYTES_PER_TASK = 15e3
_BYTES_PER_ROLLOUT = 73e3


def make_manifest(
    folder: Path,
    *,
    config: RunConfig,
    split: str,
    store: str,
    fingerprint: dict[str, Any],
    argv: Sequence[str],
) -> dict[str, Any]:
    """What a run folder says about how its results were made; state and counts come later.

    The run fingerprint, `determining` in the file, is everything that scores depend on.
    """
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


def state_of(folder: Path) -> State:
    """How far the run in a folder is.

    Returns:
        `new` when there is nothing to lose, `unfinished` when it was interrupted or killed,
        `failed` when it ended with failed or missing tasks, else `complete`.

    Raises:
        DataError: The folder holds something else.
    """
    if not folder.exists() or (folder.is_dir() and not _has_content(folder)):
        return "new"
    manifest = read_manifest(folder)
    has_results = has_entries(folder / JOURNAL)
    if manifest["state"] == "running" and not has_results:
        return "new"
    if manifest["state"] != "finished" or has_results:
        return "unfinished"
    counts = manifest["counts"]
    return "complete" if counts["ok"] == counts["expected"] else "failed"


def _has_content(folder: Path) -> bool:
    """Whether there is more than what a process leaves that was killed before it had begun.

    These are halves of files, whose names begin with a dot, and a journal without entries.
    """
    names = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    return names != {JOURNAL} or has_entries(folder / JOURNAL) if names else False


def check_target(folder: Path, fingerprint: dict[str, Any], *, shard: str = "") -> State:
    """How far the run in a folder is, to which another one is to be written: the same, or none yet.

    Raises:
        ConfigError: The folder holds something else; the message says what differs.
    """
    try:
        state = state_of(folder)
    except (DataError, KeyError) as error:
        raise ConfigError(
            f"{str(folder)!r} exists and is not a run folder", hint="choose another --out"
        ) from error
    if state == "new":
        return state
    differs = difference(read_manifest(folder), fingerprint, shard)
    if differs:
        raise ConfigError(
            f"{str(folder)!r} holds another run: {differs}"[:_MAX_MESSAGE],
            hint="choose another --out, or remove that folder",
        )
    return state


def difference(manifest: dict[str, Any], fingerprint: dict[str, Any], shard: str = "") -> str:
    """What tells a run from the one of a manifest, in words; empty when nothing does."""
    before = {**manifest.get("determining", {}), "shard": manifest.get("shard", "")}
    after = {**fingerprint, "shard": shard}
    names = [n for n in sorted({*before, *after}) if before.get(n) != after.get(n)]
    if not names:
        return ""
    first = _in_words(names[0], before.get(names[0]), after.get(names[0]))
    listed = ", ".join(_NAMES.get(name, name) for name in names)
    return f"{listed} differ{first and f' ({first})'}"


def _in_words(name: str, old: Any, new: Any) -> str:
    """How one setting differs; empty for digests, which say nothing."""
    if isinstance(old, dict) and isinstance(new, dict):
        if old.keys() == new.keys():
            inner = next(key for key in old if old[key] != new[key])
            return _in_words(f"{name} {inner}", old[inner], new[inner])
        old, new = list(old), list(new)
    if any(isinstance(value, str) and _DIGEST.fullmatch(value) for value in (old, new)):
        return "" if name in _DIGESTS else f"{name} is another"
    return f"{name}: {_value(old)}, not {_value(new)}"


def _value(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return "none" if value in (None, "", {}) else str(value)


def check_resumable(folder: Path, fingerprint: dict[str, Any], *, shard: str = "") -> None:
    """Refuse to begin anew where an unfinished run with other settings seems to be meant.

    Raises:
        ConfigError: There is one; the message says what differs.
    """
    prefix = folder.name.rpartition("_")[0]
    for other in sorted(folder.parent.glob(f"{prefix}_*")) if prefix else ():
        try:
            manifest = read_manifest(other)
            if state_of(other) != "unfinished" or manifest.get("shard", "") != shard:
                continue
        except (DataError, KeyError):
            continue
        differs = difference(manifest, fingerprint, shard)
        text = f"no unfinished run with these settings; {str(other)!r} is another one: {differs}"
        raise ConfigError(
            text[:_MAX_MESSAGE], hint="give its settings, or leave out --resume to begin anew"
        )


def check_space(folder: Path, num_tasks: int, *, with_rollouts: bool) -> None:
    """Refuse a run that cannot end in its folder, which need not exist yet.

    Raises:
        ConfigError: The disk has too little space.
    """
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    needed = num_tasks * (_BYTES_PER_TASK + _BYTES_PER_ROLLOUT * with_rollouts)
    free = shutil.disk_usage(place).free
    if needed > free:
        raise ConfigError(
            f"{num_tasks} tasks need about {needed / 1e9:.1f} GB, "
            f"{str(place)!r} has {free / 1e9:.1f} GB free",
            hint="choose another --out" + ", or --save-rollouts failed" * with_rollouts,
        )
