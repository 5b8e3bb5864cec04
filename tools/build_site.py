"""Build the pages of docs/ as a site, strictly: python tools/build_site.py [FOLDER].

mkdocstrings finds nothing in folders without `__init__.py`; it reads a copy that has them all.
FOLDER lies inside the repository, since Zensical writes nowhere else.
"""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def copy_modules(target: Path, tree: Path = ROOT) -> None:
    """Copy the package of a source tree to `target`, with an `__init__.py` in every folder."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(tree / "shiftsim", target, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in target.rglob("*/"):
        (folder / "__init__.py").touch()


def build(folder: str) -> int:
    """Write the site to `folder`, relative to the repository; exit code, 1 after a warning."""
    copy_modules(ROOT / "build" / "api" / "shiftsim")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    title = f"shiftsim {project['version']}"
    names = {"SHIFTSIM_SITE": folder, "SHIFTSIM_TITLE": title, "NO_COLOR": "1"}
    command = [sys.executable, "-m", "zensical", "build", "--clean", "--strict", "-f", "mkdocs.yml"]
    return subprocess.run(command, cwd=ROOT, env=os.environ | names, check=False).returncode


if __name__ == "__main__":
    sys.exit(build(*sys.argv[1:] or ["build/docs"]))
