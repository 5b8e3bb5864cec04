"""Fixtures and hypothesis profiles shared by all tests."""

import os
import signal
import tarfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from stores import write_toy_store

import shiftsim

REPOSITORY = Path(__file__).resolve().parent.parent
GOLDEN = REPOSITORY / "tests" / "golden"


settings.register_profile("fast", max_examples=25, deadline=None, derandomize=True)
settings.register_profile("thorough", max_examples=500, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fast"))


def pytest_configure(config: pytest.Config) -> None:
    """Workers would compile the same kernels side by side."""
    # interrupts are heard, also where the tests run in the background of a shell
    signal.signal(signal.SIGINT, signal.default_int_handler)
    is_worker = hasattr(config, "workerinput")
    if not is_worker and getattr(config.option, "numprocesses", None):
        from kernels import compile_all

        compile_all()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of the full reference folders, which most clones lack, are a target of their own."""
    for item in items:
        if "shared" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.thorough)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20260101)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with all reference outputs and maps; absent from most clones."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "reference").is_dir():
        pytest.skip("needs the full reference folder beside the repository")
    return folder


@pytest.fixture(scope="session")
def nuplan_reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The nuplan reference folder: logs, maps and outputs of the official stack."""
    folder = tmp_path_factory.mktemp("reference")
    with tarfile.open(GOLDEN / "nuplan.tar.xz") as archive:
        archive.extractall(folder)
    return folder / "nuplan"


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with four short scenarios on a straight road."""
    return write_toy_store(tmp_path_factory.mktemp("stores") / "toy")


@pytest.fixture(scope="session")
def clean_run(toy: Path, tmp_path_factory: pytest.TempPathFactory) -> "shiftsim.Run":
    """Two planners, clean and with noise of two seeds, in this process."""
    return shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        seeds=[0, 1],
        store=str(toy),
        workers=1,
        out=str(tmp_path_factory.mktemp("runs") / "clean"),
    )
