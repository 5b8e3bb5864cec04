"""What is installed from a wheel: all that is needed, weights included, and not much more."""

import os
import resource
import subprocess
import sys
import zipfile

import pytest
from places import REPOSITORY

from shiftsim.planners.table import SHIPPED_NOTE

MOST = 3.0e6  # bytes, without weights
SHIPPED = "shiftsim/planners/learned/carl/shiftsim.safetensors"
HEADLINE = "shiftsim run --planner carl --noise ou-high"
MOST_SECONDS = 180.0  # from the command to its table
MOST_OF_WEIGHTS = 9.0e6  # bytes: a network of CaRL in single precision


def tracked():
    """The files that a checkout has."""
    command = ["git", "-C", str(REPOSITORY), "ls-files", "--cached", "--others", "-z"]
    done = subprocess.run(
        [*command, "--exclude-standard"], capture_output=True, text=True, check=True
    )
    return [name for name in done.stdout.split("\0") if name and (REPOSITORY / name).exists()]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of what a checkout has."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "copy"
    for name in tracked():
        source, target = REPOSITORY / name, copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            target.symlink_to(source.readlink())
        else:
            target.write_bytes(source.read_bytes())
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(folder), "."], cwd=copy, check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.thorough
@pytest.mark.slow
def test_a_wheel_holds_the_package_with_its_data_and_weights_and_is_small(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sizes = {info.filename: info.compress_size for info in archive.infolist()}
    for name in (SHIPPED, "shiftsim/py.typed", "shiftsim/benchmarks/published.toml"):
        assert name in sizes
    modules = {name for name in sizes if name.endswith(".py")}
    copy = wheel.parent / "copy"
    sources = {path.relative_to(copy) for path in (copy / "shiftsim").rglob("*.py")}
    assert {str(name) for name in sources} <= modules
    assert not [name for name in sizes if "/tests/" in name or "/speed/" in name]
    assert sizes.pop(SHIPPED) < MOST_OF_WEIGHTS
    assert sum(sizes.values()) < MOST


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.learned
def test_the_headline_command_scores_in_an_empty_folder_and_says_whose_weights(wheel, tmp_path):
    """Cold: it makes the scenarios and compiles all kernels, within the time a person waits."""
    pytest.importorskip("torch")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    empty = tmp_path / "empty"
    empty.mkdir()
    words = [*HEADLINE.split()[1:], "--workers", "2"]
    environment = {
        "PATH": os.defpath,
        "PYTHONPATH": str(tmp_path / "installed"),
        "HOME": str(empty),
    }
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "shiftsim", *words],
        capture_output=True, text=True, cwd=empty, env=environment,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    assert "81 of 81 scenarios found" in done.stderr + done.stdout
    assert SHIPPED_NOTE in done.stdout
    assert "ou-high" in done.stdout
    # busy processors, of which it uses two
    assert after.ru_utime - before.ru_utime < 2.0 * MOST_SECONDS
    assert HEADLINE in (REPOSITORY / "README.md").read_text()
