"""The round trip that several modules of tests look at; nobody writes into it."""

import pytest
from nuplan_trips import FROM_START, SCENES, round_trip


@pytest.fixture(scope="session")
def trip(nuplan_reference, tmp_path_factory):
    return round_trip(nuplan_reference, tmp_path_factory.mktemp("trip"), FROM_START, SCENES)
