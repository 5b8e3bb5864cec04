"""interPlan against the outputs of its own classes, and proof that a changed value is noticed."""

import json
import shutil

import places
import pytest

from shiftsim.verify import verify

GOLDEN = places.GOLDEN / "scenario_edits"

pytestmark = pytest.mark.golden


@pytest.fixture(scope="module")
def equal(nuplan_reference):
    return verify(GOLDEN, scenes=nuplan_reference)


def test_codes_builds_traffic_and_closed_loops_are_equal(equal):
    assert equal.mismatches == []
    assert equal.not_covered == {}
    assert equal.quantities["build cases lanes"].cases == 12
    assert equal.quantities["traffic objects"].cases >= 30
    assert equal.quantities["metrics cases score"].cases == 3


FALSIFIED = {
    "tokens": lambda d: d["lane_change_score"][8].update(score=0.6),
    "build": lambda d: d["cases"][0]["objects0"][1].update(
        x=d["cases"][0]["objects0"][1]["x"] + 1e-5
    ),
    "traffic": lambda d: d["cases"][0]["rows"][2]["objects"][0].__setitem__(1, "BICYCLE"),
    "metrics": lambda d: d["cases"][0]["statistics"]["lane_changes_to_goal"].update(
        did_ego_got_to_goal_lane=0.0
    ),
}


@pytest.mark.parametrize("name", FALSIFIED)
def test_a_falsified_value_is_found(name, tmp_path, nuplan_reference):
    folder = tmp_path / "scenario_edits"
    folder.mkdir()
    for path in GOLDEN.glob("*.json"):
        content = json.loads(path.read_text())
        if path.stem == name:
            FALSIFIED[name](content)
        if path.stem in ("traffic", "metrics"):  # the other cases are compared above
            content["cases"] = content["cases"][: int(path.stem == name)]
        (folder / path.name).write_text(json.dumps(content))
    report = verify(folder, kind="scenario_edits", scenes=nuplan_reference)
    assert len(report.mismatches) == 1
    assert report.mismatches[0].startswith(name)


def test_a_file_of_no_known_kind_is_named(tmp_path, nuplan_reference):
    folder = tmp_path / "scenario_edits"
    shutil.copytree(GOLDEN, folder)
    for name in ("build", "traffic", "metrics"):
        (folder / f"{name}.json").write_text('{"note": "", "cases": []}')
    (folder / "more.json").write_text("{}")
    report = verify(folder, scenes=nuplan_reference)
    assert report.not_covered == {"file more.json": 1}


def test_all_cases_of_the_reference_are_equal(shared):
    report = verify(shared / "reference" / "scenario_edits")
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.num_cases > 3700
