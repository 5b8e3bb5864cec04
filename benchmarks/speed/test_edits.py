"""What an edit adds to reading a scenario: pytest benchmarks/speed/test_edits.py -s.

At most 1 ms more than reading it, 10 ms with density, a new route or a code of interPlan. Processor
time, reading and editing in turn.
"""

import json
import tarfile
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from parity_cases import Scenes

from shiftsim.data import open_store
from shiftsim.edits.apply import apply_edit
from shiftsim.edits.spec import make_edit
from shiftsim.metrics.interplan import driven_lanes

GOLDEN = Path(__file__).resolve().parents[2] / "tests" / "golden"
TOKEN = "01f13ee575198fdf"
WINDOW = (20.0, 0.0, 0.5)  # s, s, share of the rows: of the cases of interPlan
EDITS = {
    "spawn": {"spawn": {"at": {"ahead_m": 45.0, "left_m": -5.0}, "behavior": "stopped"}},
    "walk": {"walk": {"from": {"ahead_m": 40, "left_m": -5}, "to": {"ahead_m": 40, "left_m": 5}}},
    "block": {"block_lane": {"at": {"ahead_m": 60}, "length_m": 12, "taper_m": 4}},
    "density": {"remove": {}, "density": {"level": "high"}},
    "reroute": {"reroute": {"command": "right"}},
}


FEW, MANY = 1e-3, 10e-3  # s, that may be added
MUCH = ("density", "reroute")


@pytest.fixture(scope="module")
def codes(tmp_path_factory):
    """Scenes of nuPlan's format with the codes of interPlan that are kept for tests."""
    folder = tmp_path_factory.mktemp("reference")
    with tarfile.open(GOLDEN / "nuplan.tar.xz") as archive:
        archive.extractall(folder)
    scenes = Scenes(folder / "nuplan", mapping=WINDOW)
    cases = json.loads((GOLDEN / "scenario_edits" / "build.json").read_text())["cases"]
    found = {}
    for case in (case for case in cases if "error" not in case):
        table = {"name": case["code"], "code": case["code"], "details": case.get("details") or {}}
        edit = make_edit(table, "benchmark")
        found[f"{case['scene']} {case['code']}"] = scenes[case["scene"]], edit
    return found


def added(read, edit, rounds):
    """Processor time of reading and of editing [s], medians of so many rounds in turn."""
    times = []
    for _ in range(rounds + 1):
        marks = [process_time()]
        for call in (read, edit):
            call()
            marks.append(process_time())
        times.append(np.diff(marks))
    return np.median(times[1:], axis=0).tolist()


@pytest.mark.parametrize("name", EDITS)
def test_edit(size, note, name):
    store = open_store("demo")
    scenario = store.read(TOKEN)
    edit = make_edit({"name": name, **EDITS[name]}, "benchmark")
    reading, more = added(
        lambda: store.read(TOKEN), lambda: apply_edit(scenario, edit), size(30, 2)
    )
    note(added=more)
    print(f"\nedit {name}: +{more * 1e3:.2f} ms, {1 + more / reading:.2f} times reading", end="")
    assert more <= (MANY if name in MUCH else FEW) or size(0, 1)


def test_codes_of_interplan(size, note, codes):
    store = open_store("demo")
    worst = 0.0
    for name, (scene, edit) in codes.items():
        _, more = added(
            lambda: store.read(TOKEN),
            lambda s=scene, e=edit: apply_edit(s, e, driven_lanes),
            size(10, 1),
        )
        print(f"\n{name}: +{more * 1e3:.2f} ms", end="")
        worst = max(worst, more)
    note(worst=worst)
    assert worst <= MANY or size(0, 1)
