import pytest
from stores import write_toy_store

import shiftsim


@pytest.fixture(scope="session")
def toy(tmp_path_factory):
    """A store with four short scenarios on a straight road."""
    return write_toy_store(tmp_path_factory.mktemp("stores") / "toy")


@pytest.fixture(scope="session")
def clean_run(toy, tmp_path_factory):
    """Two planners, clean and with noise of two seeds, in this process."""
    return shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        seeds=[0, 1],
        store=str(toy),
        workers=1,
        out=str(tmp_path_factory.mktemp("runs") / "clean"),
    )
