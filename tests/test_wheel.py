"""What is installed from a wheel: all that is needed, weights included, and not much more."""

import subprocess
import sys
import zipfile

import pytest
from places import REPOSITORY

MOST = 3.0e6  # bytes, without weights
MOST_OF_WEIGHTS = 9.0e6  # bytes: a network of CaRL in single precision


def tracked():
    """The files that a checkout has."""
    command = ["git", "-C", str(REPOSITORY), "ls-files", "--cached", "--others", "-z"]
    done = subprocess.run(
        [*command, "--exclude-standard"], capture_output=True, text=True, check=True
    )
    return [name for name in done.stdout.split("\0") if name and (REPOSITORY / name).exists()]


@pytest.mark.thorough
@pytest.mark.slow
def test_a_wheel_holds_the_package_with_its_data_and_weights_and_is_small(tmp_path):
    pytest.importorskip("setuptools")
    copy = tmp_path / "copy"
    for name in tracked():
        source, target = REPOSITORY / name, copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            target.symlink_to(source.readlink())
        else:
            target.write_bytes(source.read_bytes())
    weights = copy / "planners/learned/carl/shiftsim.safetensors"
    if not weights.exists():
        weights.write_bytes(b"weights")
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(tmp_path), "."], cwd=copy, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        sizes = {info.filename: info.compress_size for info in archive.infolist()}
    shipped = "shiftsim/planners/learned/carl/shiftsim.safetensors"
    for name in (shipped, "shiftsim/py.typed", "shiftsim/benchmarks/published.toml"):
        assert name in sizes
    modules = {name for name in sizes if name.endswith(".py")}
    sources = {path.relative_to(copy) for path in (copy / "shiftsim").rglob("*.py")}
    assert {str(name) for name in sources} <= modules
    assert not [name for name in sizes if "/tests/" in name or "/speed/" in name]
    assert sizes.pop(shipped) < MOST_OF_WEIGHTS
    assert sum(sizes.values()) < MOST
