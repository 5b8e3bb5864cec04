from importlib.util import find_spec

import pytest

HAS_ALL = find_spec("torch") and find_spec("gymnasium")
collect_ignore_glob = [] if HAS_ALL else ["test_*.py"]


@pytest.fixture
def small(toy, tmp_path):
    """Makes the settings of a training that takes seconds."""
    from shiftsim.train.settings import Settings

    def make(name="out", **changes):
        settings = {
            **{"store": str(toy), "rounds": 2, "states": 40, "samples": 512, "tau": 0.3},
            **{"tests": 2, "workers": 1, "seed": 5},
        }
        return Settings(out=tmp_path / name, **(settings | changes))

    return make
