"""CaRL and the shared route correction against the official code; a changed value is noticed."""

import json
import shutil
from pathlib import Path

import numpy as np
import places
import pytest

from shiftsim.verify import verify
from shiftsim.verify.files import Scenes
from shiftsim.verify.nets.common import verify_part
from shiftsim.verify.report import Report

pytest.importorskip("torch")
pytestmark = [pytest.mark.golden, pytest.mark.learned]

GOLDEN = places.GOLDEN / "nets"
LOOP = "closed_loop_s04_left_turn.npz"
ROUTES = "route_correction_s04_left_turn.json"


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


def compared(name, content, tmp_path, scenes, part="carl"):
    """The report on one file with a new content: arrays of an npz file, or JSON."""
    folder = tmp_path / part
    folder.mkdir(exist_ok=True)
    if isinstance(content, dict) and name.endswith(".npz"):
        np.savez(folder / name, **content)
    else:
        (folder / name).write_text(json.dumps(content))
    report = Report()
    verify_part(part, folder, report, scenes)
    return report


def arrays_of(name):
    with np.load(GOLDEN / "carl" / name) as stored:
        return {key: stored[key].copy() for key in stored.files}


def differing(report):
    """Where there are mismatches: (quantity, case)."""
    return {tuple(line.split(": ")[:2]) for line in report.mismatches}


def changed(array):
    """The same array with one value that is another."""
    array = array.copy()
    if array.ndim == 0:
        return np.array("other")
    if array.dtype.kind == "U":
        return np.append(array, "other")
    array.flat[-1] += 1e-3 if array.dtype.kind == "f" else 1
    return array


def test_everything_is_equal(scenes):
    report = Report()
    verify_part("carl", GOLDEN / "carl", report, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["carl picture boundaries"].cases == 60
    assert report.quantities["carl lane_connectors"].cases == 9
    assert report.quantities["action_decode next_state"].cases == 320


def test_every_route_is_corrected_alike(scenes):
    report = Report()
    verify_part("route_correction", GOLDEN / "route_correction", report, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["corrected route footprint"].cases == 52


def test_without_the_scenes_loops_and_routes_are_not_covered(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "nets")
    for path in (tmp_path / "nets" / "carl").glob("[af]*.npz"):
        path.unlink()
    report = verify(tmp_path / "nets")
    assert report.mismatches == []
    assert f"{LOOP}: scene s04_left_turn, which is not at hand" in report.not_covered
    assert f"{ROUTES}: scene s04_left_turn, which is not at hand" in report.not_covered


@pytest.mark.thorough
def test_a_changed_output_of_a_loop_is_a_mismatch(tmp_path, scenes):
    arrays = arrays_of(LOOP)
    wanted = set()
    for iteration, name in enumerate(("measurements", "action", "alpha", "beta", "value")):
        arrays[f"out/{name}"][iteration, 0] += 1e-3
        wanted.add((f"carl {name}", f"{Path(LOOP).stem} iteration {iteration}"))
    for channel in range(9):
        arrays[f"it{channel + 7:02d}/bev_semantics"][channel, 255, 255] ^= 1
    report = compared(LOOP, arrays, tmp_path, scenes)
    assert wanted <= differing(report)
    pictures = {pair for pair in differing(report) if pair[0].startswith("carl picture")}
    assert len(pictures) == 9
    assert {where.split()[-1] for _, where in pictures} == {str(c + 7) for c in range(9)}
    arrays["out/command"][6, 0] += 1e-3  # the ego goes on by it, so that later pictures differ, too
    for command in ("command[0]", "decoded command[0]"):
        wanted.add((f"carl {command}", f"{Path(LOOP).stem} iteration 6"))
    assert wanted | pictures <= differing(compared(LOOP, arrays, tmp_path, scenes))


@pytest.mark.thorough
def test_a_changed_list_of_what_was_drawn_is_a_mismatch(tmp_path, scenes):
    arrays = arrays_of(LOOP)
    names = [name for name in arrays if name.startswith("it19/cache/")]
    for name in names:
        arrays[name] = changed(arrays[name])
    lanes = "it00/cache/lanes"
    arrays[lanes] = arrays[lanes][::-1]
    report = compared(LOOP, arrays, tmp_path, scenes)
    stem = Path(LOOP).stem
    wanted = {(f"carl {name.split('/')[-1]}", f"{stem} iteration 19") for name in names}
    assert len(wanted) == 11
    assert wanted | {("carl lanes", f"{stem} iteration 0")} == differing(report)


@pytest.mark.thorough
def test_a_changed_input_of_a_loop_is_a_mismatch(tmp_path, scenes):
    arrays = arrays_of(LOOP)
    meta = ("token", "scenario_type", "map_name", "route_roadblock_ids", "state_columns")
    for name in (*meta, "source_files", "source_crc32"):
        arrays[f"meta/{name}"] = changed(arrays[f"meta/{name}"])
    arrays["ego/initial_history"][3, 4] += 1e-3
    arrays["ego/initial_history_time_us"][3] += 1
    arrays["ego/current"][-1, 10] += 1e-3
    arrays["ego/current_time_us"][-1] += 1
    report = compared(LOOP, arrays, tmp_path, scenes)
    found = {quantity for quantity, _ in differing(report)}
    assert found >= {f"carl scene {name}" for name in (*meta, "source_files", "source_crc32")}
    assert found >= {"carl current_time_us", "carl initial_history_time_us"}
    assert found >= {"carl initial_history", "carl driven ego"}


@pytest.mark.parametrize("name", ["out/alpha", "it07/bev_semantics", "ego/current", "meta/variant"])
def test_an_array_that_is_missing_is_a_mismatch(tmp_path, scenes, name):
    arrays = arrays_of(LOOP)
    del arrays[name]
    assert compared(LOOP, arrays, tmp_path, scenes).mismatches


def test_other_weights_and_a_failure_that_was_none_are_mismatches(tmp_path, scenes):
    arrays = arrays_of(LOOP)
    arrays["meta/error"] = np.array("KeyError: 3")
    report = compared(LOOP, arrays, tmp_path, scenes)
    assert {quantity for quantity, _ in differing(report)} == {"carl failure"}
    arrays = arrays_of(LOOP)
    arrays["meta/variant"] = np.array("base")
    assert "carl action" in {q for q, _ in differing(compared(LOOP, arrays, tmp_path, scenes))}


def test_what_nothing_compares_is_named(tmp_path, scenes):
    arrays = arrays_of(LOOP)
    arrays["out/novelty"] = np.zeros(3)
    arrays["it00/cache/novelty"] = np.array(["1"])
    (tmp_path / "carl").mkdir()
    (tmp_path / "carl" / "novelty.bin").write_bytes(b"?")
    report = compared(LOOP, arrays, tmp_path, scenes)
    stem = Path(LOOP).stem
    assert set(report.not_covered) == {
        "file novelty.bin",
        f"{stem}: array 'out/novelty'",
        f"{stem}: array 'it00/cache/novelty'",
    }


@pytest.mark.thorough
def test_a_changed_decoding_is_a_mismatch(tmp_path, scenes):
    name = "action_decode.npz"
    arrays = arrays_of(name)
    arrays["in.state"][3, 7] += 1e-3
    arrays["in.action"][5, 1] += 1e-3
    arrays["out.command"][7, 0] += 1e-3
    arrays["out.next_state"][9, 10] += 1e-3
    report = compared(name, arrays, tmp_path, scenes)
    cases = {where for _, where in differing(report)}
    assert cases == {f"action_decode {row}" for row in (3, 5, 7, 9)}
    arrays = arrays_of(name)
    arrays["meta"] = np.array(str(arrays["meta"]).replace("0.1", "0.2"))
    assert differing(compared(name, arrays, tmp_path, scenes)) == {("carl meta", "action_decode")}


@pytest.mark.thorough
def test_a_changed_number_of_the_network_is_a_mismatch(tmp_path, scenes):
    name = "forward_dense.npz"
    arrays = arrays_of(name)
    outputs = [key for key in arrays if key.startswith("out.")]
    report = compared(
        name, {**arrays, **{k: changed(arrays[k]) for k in outputs}}, tmp_path, scenes
    )
    wanted = {f"carl {key.rpartition('.')[2]}" for key in outputs}
    assert {quantity for quantity, _ in differing(report)} == wanted
    assert len(wanted) == 9
    for key in ("in.bev_semantics", "in.measurements", "in.value_measurements"):
        other = arrays[key].copy()
        if other.ndim == 1:
            other[0] += 0.1
        else:
            other[0, 100, 100] ^= 255
        assert compared(name, {**arrays, key: other}, tmp_path, scenes).mismatches, key


@pytest.mark.thorough
def test_a_changed_manifest_is_a_mismatch(tmp_path, scenes):
    content = json.loads((GOLDEN / "carl" / "state_dict.json").read_text())
    entries = content["entries"]
    entries[0]["value"][0] = 0.5
    entries[2]["shape"][0] += 1
    entries[3]["dtype"] = "float64"
    entries[4]["rule"] = "c"
    entries[5]["name"] += "s"
    content["selfcheck"]["first3_raw_z"][0] += 1e-9
    content["hyper"]["image"] = [128, 128]
    content["parameters"] += 1
    content["drive_overrides"]["dist_mu.0.bias"] = "[2.5, 1]"
    report = compared("state_dict.json", content, tmp_path, scenes)
    found = differing(report)
    kinds = ("value", "shape", "dtype", "rule", "names")
    assert {q for q, _ in found} >= {f"carl state {kind}" for kind in kinds}
    assert found >= {
        (f"carl manifest {key}", "state_dict") for key in ("hyper", "parameters", "drive_overrides")
    }
    assert ("carl selfcheck first3_raw_z", "policy_head.0.weight") in found


@pytest.mark.thorough
def test_a_changed_route_is_a_mismatch(tmp_path, scenes):
    content = json.loads((GOLDEN / "route_correction" / ROUTES).read_text())
    content["map"] = "elsewhere"
    content["cases"][0]["route"] = content["cases"][0]["route"][1:]
    content["cases"][0]["rear_axle"][0] += 1e-3
    content["cases"][3]["square_1m"].pop()
    content["cases"][4]["footprint"].append("1")
    del content["cases"][5]["footprint"]
    content["cases"][6]["novelty"] = 1
    report = compared(ROUTES, content, tmp_path, scenes, "route_correction")
    found = [quantity for quantity, _ in differing(report)]
    assert {"corrected route map", "corrected route route", "corrected route rear_axle"} <= set(
        found
    )
    assert found.count("corrected route square_1m") == 2
    assert found.count("corrected route footprint") == 3
    assert list(report.not_covered) == [f"{Path(ROUTES).stem} cases: field 'novelty'"]
