"""Names that earlier documentation printed work for one version more, and say where they are."""

import importlib
import subprocess
import sys

import pytest

import shiftsim

MODULES = {old: new for old, new in shiftsim._DEPRECATED.items() if ":" not in old}
PRINTED = (
    "from shiftsim.api import RunSettings",
    "from shiftsim.data.lanes.map import build_lane_map",
    "from shiftsim.data.lanes.pieces import LanePiece, MapSource",
    "from shiftsim.data.opendrive.map import build_road_map",
    "from shiftsim.data.opendrive.reading import read_opendrive",
    "from shiftsim.data.tracks.build import make_samples",
    "from shiftsim.data.tracks.scenarios import make_scenarios, write_converted",
)


@pytest.mark.parametrize(("old", "new"), MODULES.items())
def test_a_module_that_moved_is_found(old, new):
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"):
        earlier = importlib.reload(importlib.import_module(old))
    current = importlib.import_module(new)
    public = {name for name in vars(current) if not name.startswith("_")}
    assert all(vars(earlier)[name] is vars(current)[name] for name in public)


@pytest.mark.parametrize("line", PRINTED)
@pytest.mark.thorough
def test_what_was_printed_can_be_imported(line):
    words = [sys.executable, "-W", "always", "-c", line]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert f"{line.split()[1]}" in done.stderr
    assert "DeprecationWarning" in done.stderr


def test_other_names_are_unknown():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("shiftsim.simulations")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = importlib.import_module("shiftsim.api").nothing
