from importlib.util import find_spec

import pytest

collect_ignore_glob = [] if find_spec("gymnasium") else ["test_*.py"]


class Source:
    """Scenarios in memory, for environments."""

    def __init__(self, *scenarios):
        self._by_token = {scenario.token: scenario for scenario in scenarios}
        self.tokens = tuple(self._by_token)

    def read(self, token):
        return self._by_token[token]


@pytest.fixture(scope="session")
def source_of():
    return Source
