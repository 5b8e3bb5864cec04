"""Shared fixtures, and a kernel cache that any edit of a kernel starts afresh."""

import hashlib
import os
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent


def _kernel_cache() -> Path:
    digest = hashlib.sha256()
    for folder in ("shiftsim", "planners", "metrics", "data"):
        for path in sorted((REPOSITORY / folder).glob("**/*.py")):
            if "kernel" in (text := path.read_text()):
                digest.update(f"{path.name}\n{text}".encode())
    return REPOSITORY / ".numba-cache" / digest.hexdigest()[:16]


os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernel_cache()))
