"""What an edit adds to reading a scenario: pytest benchmarks/speed/test_edits.py.

Beside `test_read` of the same scenario: at most 1 ms more, 10 ms with density, a new route or a
code of interPlan.
"""

import json
import tarfile
from pathlib import Path

import pytest

from shiftsim.data.nuplan.scenarios import read_scenario
from shiftsim.runs.edits.interplan.build import apply_code
from shiftsim.runs.scenarios import open_named_store
from shiftsim.verify.scenario_edits import WINDOW
from shiftsim.verify.scenes import Scenes
from shiftsim.world.edits.apply import apply_edit
from shiftsim.world.edits.spec import make_edit
from shiftsim.world.scenario import Scenario

GOLDEN = Path(__file__).resolve().parents[2] / "tests" / "golden"
TOKEN = "03b23cc64ccf44cb"
EDITS = {
    "spawn": {"spawn": {"at": {"ahead_m": 45.0, "left_m": -5.0}, "behavior": "stopped"}},
    "walk": {"walk": {"from": {"ahead_m": 40, "left_m": -5}, "to": {"ahead_m": 40, "left_m": 5}}},
    "block": {"block_lane": {"at": {"ahead_m": 60}, "length_m": 12, "taper_m": 4}},
    "density": {"remove": {}, "density": {"level": "high"}},
    "reroute": {"reroute": {"command": "right"}},
}


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return open_named_store("demo").read(TOKEN)


def test_read(benchmark):
    store = open_named_store("demo")
    assert benchmark(store.read, TOKEN).token == TOKEN


@pytest.mark.parametrize("name", EDITS)
def test_edit(benchmark, scenario, name):
    edit = make_edit({"name": name, **EDITS[name]}, "benchmark")
    assert benchmark(apply_edit, scenario, edit).script.name == name


def test_code_of_interplan(benchmark, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    with tarfile.open(GOLDEN / "nuplan.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    case = json.loads((GOLDEN / "scenario_edits" / "build.json").read_text())["cases"][0]
    scenes = Scenes(folder / "nuplan")
    entry = scenes.entries[case["scene"]]
    road = scenes.maps[entry["map"]]
    scene = read_scenario(scenes.folder / entry["db"], entry["token"], road, WINDOW)
    edit = make_edit({"name": "dh", "code": "dh", "details": case["details"]}, "benchmark")
    assert benchmark(apply_code, scene, edit).script.profile == "interplan"
