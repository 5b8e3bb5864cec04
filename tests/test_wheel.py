"""What is installed from a wheel: all that is needed, weights included, and not much more."""

import ctypes
import json
import os
import resource
import subprocess
import sys
import zipfile

import pytest
from places import REPOSITORY

from shiftsim.data.synthetic.store import demo_store
from shiftsim.planners.table import SHIPPED_NOTE

MOST = 3.0e6  # bytes, without weights
TRAINED = ("carl", "plantf", "pluto")
SHIPPED = [f"shiftsim/planners/learned/{name}/shiftsim.safetensors" for name in TRAINED]
HEADLINE = "shiftsim run --planner carl --noise ou-high"
MOST_SECONDS = 180.0  # from the command to its table
MOST_OF_WEIGHTS = 21.0e6  # bytes: a network of CaRL in single precision, others in half of it


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
    for name in (
        *SHIPPED,
        "shiftsim/py.typed",
        "shiftsim/benchmarks/published.toml",
        "shiftsim/report/cite.bib",
    ):
        assert name in sizes
    modules = {name for name in sizes if name.endswith(".py")}
    copy = wheel.parent / "copy"
    sources = {path.relative_to(copy) for path in (copy / "shiftsim").rglob("*.py")}
    assert {str(name) for name in sources} <= modules
    assert not [name for name in sizes if "/tests/" in name or "/speed/" in name]
    assert sum(map(sizes.pop, SHIPPED)) < MOST_OF_WEIGHTS
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
    assert "16 of 16 scenarios found" in done.stderr + done.stdout
    assert SHIPPED_NOTE in done.stdout
    assert "ou-high" in done.stdout
    # busy processors, of which it uses two
    assert after.ru_utime - before.ru_utime < 2.0 * MOST_SECONDS
    assert HEADLINE in (REPOSITORY / "README.md").read_text()


COUNTED = """
import json, sys
from contextlib import redirect_stdout, suppress
from numba.core import event
from shiftsim.cli import main

compiled = []

class Watch(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event):
        pass

event.register("numba:compile", Watch())
with redirect_stdout(sys.stderr):
    try:
        main(sys.argv[1:])
    except SystemExit as left:
        compiled += [f"left with {left.code}"] if left.code else []
print(json.dumps(compiled))
"""


def obey_permissions():
    """Nor may root write then what nobody may."""
    if os.geteuid() == 0:
        drop, override = 24, 1
        assert ctypes.CDLL(None, use_errno=True).prctl(drop, override, 0, 0, 0) == 0


class Image:
    """A wheel in a folder, and users of it."""

    def __init__(self, wheel, folder):
        self.folder, self.package = folder, folder / "installed"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(self.package)
        self.store = demo_store(folder / "demo")

    def compiled(self, user, *words):
        """What a command compiles."""
        home = self.folder / user
        home.mkdir(exist_ok=True)
        places = {"PATH": os.defpath, "PYTHONPATH": str(self.package), "HOME": str(home)}
        done = subprocess.run(
            [sys.executable, "-c", COUNTED, *words], capture_output=True, text=True, cwd=home,
            env=places, preexec_fn=obey_permissions,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    def run(self, user, planner, traffic="nonreactive"):
        """What a run compiles."""
        words = ["--store", str(self.store), "--limit", "2", "--workers", "1", "--quiet"]
        out = self.folder / user / f"{planner}-{traffic}"
        words += ["--traffic", traffic, "--out", str(out)]
        return self.compiled(user, "run", "--planner", planner, *words)

    def seal(self):
        """As a layer of an image: nobody may write, and times are others."""
        for path in [*self.package.rglob("*"), self.package]:
            os.utime(path, (1_000_000_000, 1_000_000_000))
            path.chmod(0o555 if path.is_dir() else 0o444)


@pytest.fixture
def image(wheel, tmp_path):
    image = Image(wheel, tmp_path)
    yield image
    for path in [image.package, *image.package.rglob("*")]:
        path.chmod(0o755)


@pytest.mark.thorough
@pytest.mark.slow
def test_kernels_of_an_image_serve_users_who_cannot_write_there(image):
    built = image.run("builder", "constant-velocity")
    assert "_driven_route" in built
    image.seal()
    # the machine code is copied for the user; what the image lacks is compiled once and added
    assert image.run("user", "constant-velocity") == []
    assert "advance" in image.run("user", "constant-velocity", "reactive")
    assert [*(image.folder / "user" / ".cache" / "shiftsim" / "kernels").rglob("*.nbc")]
    assert image.run("user", "constant-velocity", "reactive") == []


@pytest.mark.long
def test_after_doctor_compile_no_run_compiles(image):
    assert not [word for word in image.compiled("builder", "doctor", "--compile") if "left" in word]
    image.seal()
    for planner, traffic in (
        ("constant-velocity", "nonreactive"), ("pdm-closed", "reactive"), ("idm", "nonreactive"),
        ("simple", "constant-velocity"), ("log-future", "reactive"),
    ):  # fmt: skip
        assert image.run("user", planner, traffic) == [], (planner, traffic)
