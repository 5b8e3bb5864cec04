"""What mkdocs does before it builds the pages.

mkdocstrings finds nothing in folders without `__init__.py`; it reads a copy that has them all.
"""

import shutil
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).parent.parent


def on_startup(**settings: Any) -> None:
    """Copy the modules to build/api, before mkdocstrings looks there."""
    target = _ROOT / "build" / "api" / "shiftsim"
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(_ROOT / "shiftsim", target, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in target.rglob("*/"):
        (folder / "__init__.py").touch()
