"""Plans and single calls against those of nuPlan's own planners."""

import json
import shutil

import numpy as np
import places
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shiftsim.verify.files import Scenes
from shiftsim.verify.nuplan.runs import verify_planners
from shiftsim.verify.pdm.cases import verify_idm_calls
from shiftsim.verify.report import Report

GOLDEN = places.GOLDEN / "planners"

pytestmark = pytest.mark.golden


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


def test_every_recorded_plan_comes_out_again(nuplan_reference, scenes):
    report = Report()
    verify_planners(nuplan_reference / "expected", report, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["idm plan x"].cases == 224
    assert report.quantities["log-future plan x"].cases == 320
    assert report.quantities["simple plan x"].cases == 256


def test_every_recorded_call_of_the_idm_planner_comes_out_again(scenes):
    report = Report()
    verify_idm_calls(GOLDEN / "idm_calls.json", report, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["IDM trajectory"].cases == 54


@pytest.fixture
def falsified(nuplan_reference, tmp_path):
    """A copy of the expected tables with one value changed."""

    def make(table, column, row, change):
        (tmp_path / "expected").mkdir(exist_ok=True)
        for name in ("trajectories", "ego", "objects"):
            source = nuplan_reference / "expected" / f"{name}.parquet"
            shutil.copyfile(source, tmp_path / "expected" / source.name)
        path = tmp_path / "expected" / f"{table}.parquet"
        content = pq.read_table(path)
        values = content[column].to_numpy().copy()
        values[row] = change(values[row])
        index = content.column_names.index(column)
        pq.write_table(content.set_column(index, column, pa.array(values)), path)
        return tmp_path / "expected"

    return make


@pytest.mark.parametrize(
    ("column", "row", "change"),
    [
        ("x", 0, lambda v: v + 1e-6),
        ("heading", 17, lambda v: v + 1e-8),
        ("vx", 5000, lambda v: v + 1e-8),
        ("tire_steering_angle", 7000, lambda v: 1e-8),
        ("time_us", 12000, lambda v: v + 1),
        ("index", 9000, lambda v: v + 1),
        ("iteration", 300, lambda v: v + 1),
        ("planner", 19000, lambda v: "simple"),
        ("challenge", 40, lambda v: "PT"),
    ],
)
def test_a_changed_plan_is_noticed(falsified, scenes, column, row, change):
    report = Report()
    verify_planners(falsified("trajectories", column, row, change), report, scenes)
    assert report.mismatches


def test_an_additional_column_is_named(falsified, nuplan_reference, scenes):
    folder = falsified("trajectories", "x", 0, lambda v: v)
    path = folder / "trajectories.parquet"
    content = pq.read_table(path)
    pq.write_table(content.append_column("z", pa.array(np.zeros(len(content)))), path)
    report = Report("PT")
    verify_planners(folder, report, scenes)
    report.mode = "NR"
    verify_planners(folder, report, scenes)
    assert list(report.not_covered) == ["trajectories: column 'z'"]


@pytest.mark.parametrize(
    "change",
    [
        lambda call: call["edges"].reverse(),
        lambda call: call.update(path_found=False),
        lambda call: call.update(target_velocity=call["target_velocity"] + 1e-8),
        lambda call: call.update(path_points=call["path_points"] + 1),
        lambda call: call.update(polyline_length=call["polyline_length"] + 1e-8),
        lambda call: call["path_end"].__setitem__(3, 0.0),
        lambda call: call["trajectory"][16].__setitem__(1, 0.0),
        lambda call: call["trajectory"].pop(),
        lambda call: call["objects"].pop(),
        lambda call: call["objects"][0].update(width=9.0),
        lambda call: call["red_connectors"].append("1"),
        lambda call: call["route"].pop(),
        lambda call: call["ego_center"].__setitem__(2, 0.0),
        lambda call: call["ego_rear_velocity"].__setitem__(0, 0.0),
        lambda call: call.update(time_us=0),
        lambda call: call.update(iteration=10_000),
        lambda call: call.pop("edges"),
    ],
)
def test_a_changed_call_is_noticed(tmp_path, scenes, change):
    calls = json.loads((GOLDEN / "idm_calls.json").read_text())[:2]
    change(calls[1])
    (tmp_path / "idm_calls.json").write_text(json.dumps(calls))
    report = Report()
    verify_idm_calls(tmp_path / "idm_calls.json", report, scenes)
    assert report.mismatches
