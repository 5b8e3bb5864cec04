"""PlanTF against the official code, and proof that a changed value of any array is noticed."""

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

GOLDEN = places.GOLDEN / "nets" / "plantf"
FORWARD, LOOP = "forward_b2_drive.npz", "closed_loop_s04_left_turn_drive.npz"
KEPT = 2  # iterations of the loop in which values are changed
PER_ITERATION = ("ego/current", "ego/current_time_us", "out/trajectory", "out/trajectory_time_us")
UNUSED = ("in/origin", "in/angle")  # by no network, and random in the synthetic inputs


def arrays_of(name: str) -> dict[str, np.ndarray]:
    with np.load(GOLDEN / name) as archive:
        return {key: archive[key] for key in archive.files}


def short_loop() -> dict[str, np.ndarray]:
    arrays = {k: v for k, v in arrays_of(LOOP).items() if not k.startswith(("it07", "it19"))}
    return {k: v[:KEPT] if k in PER_ITERATION else v for k, v in arrays.items()}


def changed(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The array with one value changed, or with one row more where it has none."""
    if array.size == 0:
        return np.ones((*array.shape[:-2], 1, array.shape[-1]), array.dtype)
    out = array.copy()
    flat = out.reshape(-1)
    at = int(rng.integers(len(flat)))
    if array.dtype.kind == "U":
        out = array.astype("<U99")
        out.reshape(-1)[at] = f"{flat[at]}0"
    elif array.dtype.kind == "b":
        flat[at] = not flat[at]
    elif array.dtype.kind == "f":
        flat[at] += 0.5
    else:
        flat[at] += 1 if flat[at] <= 0 else -1
    return out


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


def report_of(folder: Path, scenes: Scenes) -> Report:
    report = Report()
    verify_part("plantf", folder, report, scenes)
    return report


def check(arrays: dict[str, np.ndarray], name: str, folder: Path, scenes: Scenes) -> Report:
    np.savez(folder / name, **arrays)
    return report_of(folder, scenes)


def test_network_and_closed_loop_are_equal(nuplan_reference):
    report = verify(GOLDEN, scenes=nuplan_reference)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.quantities["plantf trajectory"].cases == 20
    assert report.quantities["plantf map.point_position"].cases == 3
    assert report.quantities["plantf (base) trajectory"].cases == 1
    assert report.quantities["plantf state shape"].cases == 218


def test_a_shortened_loop_is_equal(tmp_path, scenes):
    report = check(short_loop(), LOOP, tmp_path, scenes)
    assert report.mismatches == []
    assert report.not_covered == {}


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(short_loop()))
def test_a_changed_value_of_a_loop_is_noticed(tmp_path, scenes, rng, name):
    arrays = short_loop()
    for _ in range(2):
        report = check({**arrays, name: changed(arrays[name], rng)}, LOOP, tmp_path, scenes)
        assert report.mismatches or name == "meta/scene"
        assert report.exit_code(require_all=True) != 0


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(set(arrays_of(FORWARD)) - set(UNUSED)))
def test_a_changed_value_of_an_input_or_output_is_noticed(tmp_path, scenes, rng, name):
    arrays = arrays_of(FORWARD)
    for _ in range(4):
        other = changed(arrays[name], rng)
        if name == "in/current_state":
            other[0, 5] += 0.5  # the yaw rate behind it is not read
        report = check({**arrays, name: other}, FORWARD, tmp_path, scenes)
        assert report.mismatches


@pytest.mark.parametrize("file", [FORWARD, LOOP])
def test_arrays_that_nobody_knows_are_named(tmp_path, scenes, file):
    arrays = short_loop() if file == LOOP else arrays_of(file)
    report = check({**arrays, "out/news": np.zeros(1)}, file, tmp_path, scenes)
    assert report.exit_code() == 0
    assert report.exit_code(require_all=True) == 3


@pytest.mark.parametrize("file", [FORWARD, LOOP])
def test_a_missing_array_is_a_mismatch(tmp_path, scenes, file):
    arrays = short_loop() if file == LOOP else arrays_of(file)
    for name in sorted(arrays)[:: len(arrays) // 8]:
        rest = {key: value for key, value in arrays.items() if key != name}
        report = check(rest, file, tmp_path, scenes)
        assert report.mismatches or name in ("meta/db_md5", "meta/map_md5")


def test_files_that_nobody_knows_are_named(tmp_path, scenes):
    (tmp_path / "README.md").write_text("what this is")
    (tmp_path / "weights.bin").write_bytes(b"\0")
    report = report_of(tmp_path, scenes)
    assert list(report.not_covered) == ["file weights.bin"]


def test_a_scene_that_is_not_at_hand_is_not_covered(tmp_path):
    shutil.copy(GOLDEN / LOOP, tmp_path)
    report = report_of(tmp_path, Scenes(tmp_path / "absent"))
    assert report.exit_code(require_all=True) == 2
    assert list(report.not_covered) == [
        f"{LOOP}: scene s04_left_turn, which is not at hand",
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["keys"][3].update(shape=[1, 2]),
        lambda content: content["keys"][3].update(key="pos_emb.9.bias"),
        lambda content: content["keys"][3].update(kind="buffer"),
        lambda content: content["keys"].pop(),
        lambda content: content["selfcheck"]["norm.bias"].__setitem__(1, 0.5),
        lambda content: content["hyper_parameters"].update(num_heads=4),
        lambda content: content["feature_builder"].update(radius=90),
        lambda content: content["checkpoint"].update(prefix="net."),
        lambda content: content.update(total_elements=7),
        lambda content: content["drive_overrides"]["scale"].update(x=2),
    ],
)
def test_a_changed_manifest_is_noticed(tmp_path, scenes, change):
    content = json.loads((GOLDEN / "state_dict.json").read_text())
    change(content)
    (tmp_path / "state_dict.json").write_text(json.dumps(content))
    assert report_of(tmp_path, scenes).mismatches


def test_a_broken_file_is_a_mismatch(tmp_path, scenes):
    (tmp_path / FORWARD).write_bytes(b"no archive")
    assert len(report_of(tmp_path, scenes).mismatches) == 1
