"""The four sibling folders are sub-packages of shiftsim, and nothing else."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
FOLDERS = ("planners", "metrics", "data", "benchmarks")


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_is_the_sub_package_of_its_name(folder):
    module = importlib.import_module(f"shiftsim.{folder}")
    assert Path(module.__file__).resolve() == REPOSITORY / folder / "__init__.py"
    link = REPOSITORY / "shiftsim" / folder
    assert link.is_symlink()
    assert str(link.readlink()) == f"../{folder}"


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_refuses_to_be_imported_at_the_top_level(folder):
    done = subprocess.run(
        [sys.executable, "-c", f"import {folder}"], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert f"import it as shiftsim.{folder}" in done.stderr


def test_tests_are_no_packages():
    assert list((REPOSITORY / "tests").glob("**/__init__.py")) == []


def test_the_golden_files_stay_small():
    size = sum(path.stat().st_size for path in (REPOSITORY / "tests/golden").rglob("*"))
    assert size < 10e6


def test_the_held_torch_fits_the_allowed_range():
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert "torch>=2.6,<2.14" in extras["learned"]
    assert "torch==2.13.0" in (REPOSITORY / "constraints.txt").read_text().split()


def test_importing_shiftsim_brings_nothing_heavy():
    code = "import sys, shiftsim; print([m for m in ('numpy', 'numba') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_can_be_imported():
    import shiftsim

    assert len(shiftsim.__all__) <= 20
    for name in shiftsim.__all__:
        assert getattr(shiftsim, name) is not None
