from importlib.util import find_spec

import pytest

HAS_ALL = find_spec("torch") and find_spec("gymnasium")
collect_ignore_glob = [] if HAS_ALL else ["test_*.py"]


SMALL = {
    **{"rounds": 2, "states": 40, "samples": 384, "tau": 0.3},
    **{"tests": 2, "workers": 1, "seed": 5},
}


@pytest.fixture
def small(toy, tmp_path):
    """Makes the settings of a training that takes seconds."""
    from shiftsim.train.folder import Settings

    def make(name="out", **changes):
        return Settings(store=str(toy), out=tmp_path / name, **(SMALL | changes))

    return make


@pytest.fixture(scope="session")
def trained(toy, tmp_path_factory):
    """Such a training, done, and what it said."""
    from shiftsim.train.folder import Settings
    from shiftsim.train.recipe import Training

    settings = Settings(store=str(toy), out=tmp_path_factory.mktemp("trained") / "out", **SMALL)
    lines = []
    Training(settings, lines.append).run()
    return settings, lines
