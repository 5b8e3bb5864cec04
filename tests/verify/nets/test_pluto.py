"""PLUTO's reference folder: all of it agrees, and any changed value is seen."""

import json

import numpy as np
import places
import pytest

from shiftsim.verify.files import Scenes
from shiftsim.verify.nets.common import verify_nets, verify_part
from shiftsim.verify.report import Report

pytest.importorskip("torch")
pytestmark = [pytest.mark.learned, pytest.mark.golden, pytest.mark.slow]

GOLDEN = places.GOLDEN / "nets" / "pluto"
LOOP, BRAKES = "closed_loop_s02_curve_objects_drive.npz", "closed_loop_s03_queue_start_drive.npz"
FORWARD, BRAKE = "forward_b1_sparse.npz", "emergency_brake.npz"
# what the network does not read, and what decides nothing in the unit cases of the brake
UNREAD = {"in/agent.target", "in/origin", "in/angle", "in/current_state"}
FREE = {"fault_time", "candidate"}


def names_of(file, *, details=True):
    """Names of the arrays that hold something."""
    with np.load(GOLDEN / file) as archive:
        return sorted(
            name for name in archive.files if archive[name].size and (details or name[:2] != "it")
        )


@pytest.fixture(scope="module")
def scenes(nuplan_reference):
    return Scenes(nuplan_reference)


def report_of(folder, scenes):
    report = Report()
    verify_part("pluto", folder, report, scenes)
    return report


def spoiled(value, index=-1):
    """The array with one value changed."""
    out = value.astype(object) if value.dtype.kind in "US" else value.copy()
    flat = out.reshape(-1)
    kind = value.dtype.kind
    if kind in "US":
        flat[index] = f"{flat[index]}9"
    elif kind == "b":
        flat[index] = not flat[index]
    elif kind == "f" and not np.isfinite(flat[index]):
        flat[index] = 1.0
    else:
        flat[index] += 1 if kind in "iu" else 0.05
    return out.astype(str) if kind in "US" else out


def folder_with(tmp_path, file, **arrays):
    with np.load(GOLDEN / file) as archive:
        kept = {key: archive[key] for key in archive.files}
    np.savez(tmp_path / file, **{**kept, **arrays})
    return tmp_path


def with_change(tmp_path, file, name, index=-1):
    with np.load(GOLDEN / file) as archive:
        return folder_with(tmp_path, file, **{name: spoiled(archive[name], index)})


def test_everything_agrees_and_nothing_is_left_out(nuplan_reference):
    report = Report()
    verify_nets(GOLDEN, report, scenes=nuplan_reference)
    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.num_cases > 1500


@pytest.mark.thorough
@pytest.mark.parametrize("name", [n for n in names_of(LOOP) if not n.startswith("it01")])
def test_a_changed_value_of_a_closed_loop_is_seen(tmp_path, scenes, name):
    padded = name.endswith(("reference_line.position", "agent.position"))  # their last row is
    report = report_of(with_change(tmp_path, LOOP, name, 0 if padded else -1), scenes)
    assert report.mismatches or report.not_covered


@pytest.mark.thorough
@pytest.mark.parametrize("name", names_of(BRAKES, details=False))
def test_a_changed_value_of_a_braking_loop_is_seen(tmp_path, scenes, name):
    report = report_of(with_change(tmp_path, BRAKES, name), scenes)
    assert report.mismatches or report.not_covered


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(set(names_of(FORWARD)) - UNREAD))
def test_a_changed_value_of_a_forward_pass_is_seen(tmp_path, scenes, name):
    assert report_of(with_change(tmp_path, FORWARD, name), scenes).mismatches


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(set(names_of(BRAKE)) - FREE))
def test_a_changed_value_of_the_brake_is_seen(tmp_path, scenes, name):
    index = 0 if name in ("ego", "states") else -1  # the first case brakes
    assert report_of(with_change(tmp_path, BRAKE, name, index), scenes).mismatches


def test_unknown_arrays_and_files_count_as_not_covered(tmp_path, scenes):
    folder_with(tmp_path, FORWARD, more=np.zeros(1))
    (tmp_path / "more.npz").write_bytes(b"")
    assert len(report_of(tmp_path, scenes).not_covered) == 2


@pytest.mark.parametrize(
    ("file", "name"), [(FORWARD, "out/prediction"), (LOOP, "it00/post/cand"), (LOOP, "meta/error")]
)
def test_a_missing_array_is_a_mismatch(tmp_path, scenes, file, name):
    with np.load(GOLDEN / file) as archive:
        np.savez(tmp_path / file, **{key: archive[key] for key in archive.files if key != name})
    assert report_of(tmp_path, scenes).mismatches


def test_scenes_that_are_not_at_hand_count_as_not_covered(tmp_path):
    folder_with(tmp_path, LOOP)
    report = report_of(tmp_path, Scenes(tmp_path / "nowhere"))
    assert report.mismatches == []
    assert len(report.not_covered) == 1


def test_another_choice_in_a_near_tie_is_listed(tmp_path, scenes):
    with np.load(GOLDEN / BRAKES) as archive:
        best = int(archive["out/best_index"][0])
        chosen, rule = archive["out/best_index"].copy(), archive["it00/post/rule"].copy()
        total = rule + 0.3 * archive["it00/post/lscore"]
        total[best] = -1.0
        other = int(total.argmax())
        chosen[0] = other
        rule[other] += archive["it00/post/rule"][best] - rule[other]
        rule[other] += 0.3 * (
            archive["it00/post/lscore"][best] - archive["it00/post/lscore"][other]
        )
    changes = {"out/best_index": chosen, "it00/post/rule": rule}
    report = report_of(folder_with(tmp_path, BRAKES, **changes), scenes)
    assert any("near-tie" in line for line in report.informative)
    assert not any("best proposal" in line for line in report.mismatches)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["keys"][5].update(shape=[1]),
        lambda content: content["keys"][5].update(dtype="float64"),
        lambda content: content["keys"].pop(),
        lambda content: content.update(total_elements=1),
        lambda content: content["drive_overrides"]["scale"].popitem(),
        lambda content: content["checkpoint"].update(prefix="module."),
        lambda content: content["hyper_parameters"].update(num_heads=8),
        lambda content: content["selfcheck"]["norm.bias"].reverse(),
    ],
)
def test_a_changed_manifest_is_seen(tmp_path, scenes, change):
    content = json.loads((GOLDEN / "state_dict.json").read_text())
    change(content)
    (tmp_path / "state_dict.json").write_text(json.dumps(content))
    assert report_of(tmp_path, scenes).mismatches


def test_the_full_references_agree(shared):
    report = Report()
    verify_nets(shared / "reference" / "nets" / "pluto", report)
    assert report.mismatches == []
    assert report.not_covered == {}
