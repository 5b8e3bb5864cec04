"""PDM-Closed against the official code, and proof that a changed value is noticed."""

import json
import shutil

import numpy as np
import places
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from shiftsim.verify import verify
from shiftsim.verify.files import Scenes
from shiftsim.verify.pdm.cases import verify_kernels, verify_routes
from shiftsim.verify.pdm.steps import verify_calls
from shiftsim.verify.report import Report

GOLDEN = places.GOLDEN / "pdm"
RUN = "s02_curve_objects"

pytestmark = pytest.mark.golden


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "pdm")
    return tmp_path / "pdm"


def check_kernels(folder, scenes):
    report = Report()
    verify_kernels(folder / "kernels", report)
    return report


def check_routes(folder, scenes):
    report = Report()
    verify_routes(folder / "routes.json", report, scenes)
    return report


def check_calls(folder, scenes):
    report = Report()
    verify_calls(folder / "loop", report, scenes)
    return report


def test_every_kernel_and_step_is_equal(scenes):
    report = check_kernels(GOLDEN, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["PDM best"].cases == 5
    assert report.quantities["tracker_sim simulated_states"].cases == 2
    assert report.quantities["lane_dijkstra path"].cases == 30


def test_every_route_is_corrected_alike(scenes):
    report = check_routes(GOLDEN, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["PDM corrected"].cases == 57


def test_every_recorded_call_is_made_alike(scenes):
    report = check_calls(GOLDEN, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["PDM best"].cases == 8


def test_the_folder_is_recognised_and_names_what_it_cannot_compare(folder):
    shutil.rmtree(folder / "kernels")
    (folder / "surprise.txt").write_text("?")
    report = verify(folder)
    assert set(report.not_covered) == {
        "loop: the logs and maps of the scenes are not at hand",
        "routes.json: the logs and maps of the scenes are not at hand",
        "file surprise.txt",
    }


def change_array(path, name):
    with np.load(path) as archive:
        arrays = {key: archive[key].copy() for key in archive.files}
    flat = arrays[name].reshape(-1)
    if arrays[name].dtype.kind == "U":
        arrays[name] = np.append(arrays[name].reshape(-1), "other")
    elif arrays[name].dtype == np.bool_:
        flat[-1] = not flat[-1]
    else:
        last = np.flatnonzero(np.isfinite(flat))[0 if name.endswith("origin") else -1]
        flat[last] += 1e-3 if flat.dtype.kind == "f" else 1
    np.savez(path, **arrays)


ARRAYS = [
    ("idm", "next_progress_velocity"),
    ("idm", "prev_progress_velocity"),
    ("tracker_sim", "velocity_profile"),
    ("tracker_sim", "curvature_profile"),
    ("tracker_sim", "simulated_states"),
    ("comfort", "is_comfortable"),
    ("comfort", "lon_jerk"),
    ("emergency_brake", "center_poses_every_2s"),
    ("path", "1_poses"),
    ("path", "2_substring_4"),
    *(
        ("step_004", name)
        for name in (
            *("map_tokens", "map_boxes", "proposal_poses", "idm", "lead", "simulated"),
            *("ego_areas", "multi", "weighted", "progress_raw", "scores", "best", "braked"),
            *("trajectory_rear", "trajectory_time_us"),
        )
    ),
    ("step_005", "collided_ids"),
    ("step_005", "collision_idx"),
    ("step_005", "ttc_idx"),
]


@pytest.mark.parametrize(("file", "name"), ARRAYS)
def test_a_changed_array_is_noticed(folder, scenes, file, name):
    for path in (folder / "kernels").iterdir():
        if path.stem != file:
            path.unlink()
    change_array(folder / "kernels" / f"{file}.npz", name)
    assert check_kernels(folder, scenes).mismatches


@pytest.mark.parametrize(
    "field",
    ["ego_state", "ego_time_us", "speed_limit_mps", "objects", "drivable", "centerline"],
)
def test_a_changed_input_of_a_step_is_noticed(folder, scenes, field):
    path = folder / "kernels" / "step_004.json"
    inputs = json.loads(path.read_text())
    if field == "objects":
        inputs[field][0]["x"] += 0.5
    elif field == "drivable":
        inputs[field] = inputs[field][1:]
    elif field == "centerline":
        inputs[field] = [[x + 0.01, y, h] for x, y, h in inputs[field]]
    elif field == "ego_state":
        inputs[field][0] += 0.01
    else:
        inputs[field] += 1
    path.write_text(json.dumps(inputs))
    assert check_kernels(folder, scenes).mismatches


def test_a_changed_search_is_noticed(folder, scenes):
    path = folder / "kernels" / "graph_search.json"
    cases = json.loads(path.read_text())
    cases[3]["path"] = [*cases[3]["path"][::-1], "99"]
    path.write_text(json.dumps(cases))
    assert check_kernels(folder, scenes).mismatches


def test_a_search_among_more_lanes_than_there_are_is_noticed(folder, scenes):
    path = folder / "kernels" / "graph_search.json"
    cases = json.loads(path.read_text())
    case = next(case for case in cases if case["kind"] == "lane_dijkstra")
    case["length"].append(1.0)
    path.write_text(json.dumps(cases))
    assert len(check_kernels(folder, scenes).mismatches) == 1


def test_an_unknown_array_and_field_are_named(folder, scenes):
    path = folder / "kernels" / "idm.npz"
    with np.load(path) as archive:
        np.savez(path, **{key: archive[key] for key in archive.files}, extra=np.zeros(1))
    cases = json.loads((folder / "routes.json").read_text())
    cases[0]["extra"] = 1
    (folder / "routes.json").write_text(json.dumps(cases[:1]))
    assert "idm: array 'extra'" in check_kernels(folder, scenes).not_covered
    assert "routes.json: field 'extra'" in check_routes(folder, scenes).not_covered


@pytest.mark.parametrize(
    "field",
    [
        *("start_block", "start_candidates", "corrected", "route_lanes", "intersecting_lanes"),
        *("heading_errors", "current_lane", "n_centerline", "centerline_first"),
        *("centerline_last", "centerline_length"),
    ],
)
def test_a_changed_route_is_noticed(folder, scenes, field):
    case = json.loads((folder / "routes.json").read_text())[0]
    value = case[field]
    if isinstance(value, str):
        case[field] = value + "0"
    elif isinstance(value, list):
        case[field] = [*value[:-1], value[-1] + ("0" if isinstance(value[-1], str) else 1e-6)]
    else:
        case[field] = value + 1
    (folder / "routes.json").write_text(json.dumps([case]))
    assert check_routes(folder, scenes).mismatches


COLUMNS = [
    *(("steps", name) for name in ("best", "braked", "best_score", "current_lane_id")),
    *(("steps", name) for name in ("speed_limit_mps", "collided_ids", "time_us")),
    *(("steps", name) for name in ("n_map_tokens", "n_drivable_tokens")),
    *(("proposals", name) for name in ("score", "no_collision", "progress", "ttc", "comfort")),
    *(("proposals", name) for name in ("progress_raw", "drivable_area", "sim_x", "sim_vx")),
    ("ego", "x"),
    ("ego", "vx"),
]


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_a_changed_column_of_a_loop_is_noticed(folder, scenes, table, column):
    path = folder / "loop" / f"{table}.parquet"
    content = pq.read_table(path)
    values = content[column].to_pylist()
    first = values[0]
    changed = {bool: lambda: not first, str: lambda: first + "7"}.get(type(first))
    values[0] = changed() if changed else first + (1 if isinstance(first, int) else 0.01)
    position = content.column_names.index(column)
    content = content.set_column(position, column, pa.array(values, content[column].type))
    pq.write_table(content, path)
    assert check_calls(folder, scenes).mismatches


@pytest.mark.parametrize(
    "name",
    [
        *("trajectory", "trajectory_origin", "trajectory_time_us", "proposals_0", "idm_0"),
        *("lead_0", "simulated_0", "ego_areas_0", "map_tokens_0", "drivable_tokens_0"),
    ],
)
def test_a_changed_array_of_a_loop_is_noticed(folder, scenes, name):
    path = folder / "loop" / f"{RUN}_R.npz"
    change_array(path, name)
    assert check_calls(folder, scenes).mismatches


@pytest.mark.parametrize(
    "field", ["scenario_route_ids", "route_ids", "route_lane_ids", "centerline"]
)
def test_a_changed_fact_of_a_loop_is_noticed(folder, scenes, field):
    path = folder / "loop" / "static.json"
    static = json.loads(path.read_text())
    static[RUN]["R"][field] = static[RUN]["R"][field][:-1]
    path.write_text(json.dumps(static))
    assert check_calls(folder, scenes).mismatches
