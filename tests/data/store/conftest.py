"""The town and the log that tests of stores share."""

from pathlib import Path

import pytest
from recordings import GOLDEN, LOG, TOKEN

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.map import read_map
from shiftsim.world.map import VectorMap


@pytest.fixture(scope="module")
def road() -> VectorMap:
    return read_map(GOLDEN / "maps" / "fixture-town" / "1.0.0" / "map.gpkg", "fixture-town")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "store"
    convert_nuplan(LOG, GOLDEN / "maps", path, tokens=[TOKEN], mapping=(10.0, 0.0, 0.5))
    return path
