"""Dynamics against stored outputs of nuPlan's own code, and falsified ones that must be seen."""

from pathlib import Path

import numpy as np
import places
import pytest

from shiftsim.verify.dynamics import verify_dynamics
from shiftsim.verify.report import Report

FOLDER = places.GOLDEN / "dynamics"
FILES = sorted(path.stem for path in FOLDER.glob("*.npz"))
LABELS = {"case", "kind", "shape"}
UNREAD = LABELS | {"odeint", "rk45", "sig_in_vx"}
# Inputs of which only some columns or rows are read; their first value is.
PARTLY_READ = {
    *("in_state", "ego_state", "knot_state", "ref_pose", "rear_state"),
    *("sig_in_time_us", "knot_time_us", "lead"),
}
FIRST_READ = {"lead": 1}  # a lead's position is not read below the minimum gap, its speed is


def arrays_of(stem: str) -> dict[str, np.ndarray]:
    with np.load(FOLDER / f"{stem}.npz") as archive:
        return {name: archive[name] for name in archive.files}


ARRAYS = [(stem, name) for stem in FILES for name in arrays_of(stem)]


def verified(folder: Path) -> Report:
    report = Report()
    verify_dynamics(folder, report)
    return report


def changed(array: np.ndarray, index: int, amount: float) -> np.ndarray:
    out = array.copy()
    flat = out.reshape(-1)
    if out.dtype.kind == "b":
        flat[index] = not flat[index]
    elif out.dtype.kind == "U":
        flat[index] = "?"
    else:
        flat[index] += 1 if out.dtype.kind == "i" else amount
    return out


def falsify(folder: Path, stem: str, name: str, index: int) -> None:
    arrays = arrays_of(stem)
    amount = 1e-2 if name in PARTLY_READ else 1e-5  # inputs act on outputs attenuated
    np.savez(folder / f"{stem}.npz", **{**arrays, name: changed(arrays[name], index, amount)})


@pytest.mark.golden
def test_bundled_references_agree_and_are_covered_completely():
    report = verified(FOLDER)

    assert report.mismatches == []
    assert report.not_covered == {}
    assert report.exit_code(require_all=True) == 0


@pytest.mark.golden
@pytest.mark.slow
def test_all_references_agree_and_are_covered_completely(shared):
    report = verified(shared / "reference" / "dynamics")

    assert report.mismatches == []
    assert report.not_covered == {}


@pytest.mark.golden
@pytest.mark.parametrize(("stem", "name"), [a for a in ARRAYS if a[1] not in UNREAD])
def test_a_falsified_first_value_is_seen(tmp_path, stem, name):
    falsify(tmp_path, stem, name, FIRST_READ.get(name, 0))

    assert verified(tmp_path).exit_code() == 1


@pytest.mark.golden
@pytest.mark.parametrize(("stem", "name"), [a for a in ARRAYS if a[1] not in UNREAD | PARTLY_READ])
def test_a_falsified_last_value_is_seen(tmp_path, stem, name):
    falsify(tmp_path, stem, name, -1)

    assert verified(tmp_path).exit_code() == 1


@pytest.mark.golden
@pytest.mark.parametrize(("stem", "name"), [a for a in ARRAYS if a[1] in UNREAD])
def test_an_array_that_is_not_compared_is_named(tmp_path, stem, name):
    falsify(tmp_path, stem, name, 0)

    report = verified(tmp_path)

    assert report.exit_code(require_all=True) == 0
    assert any(line.startswith(stem) and name in line for line in report.informative)


@pytest.mark.golden
@pytest.mark.parametrize(("stem", "name"), [a for a in ARRAYS if a[1] not in UNREAD])
def test_a_missing_array_is_a_mismatch(tmp_path, stem, name):
    arrays = arrays_of(stem)
    del arrays[name]
    np.savez(tmp_path / f"{stem}.npz", **arrays)

    assert verified(tmp_path).exit_code() == 1


@pytest.mark.parametrize("stem", FILES)
def test_an_unknown_array_is_not_covered(tmp_path, stem):
    arrays = arrays_of(stem)
    np.savez(tmp_path / f"{stem}.npz", **arrays, surprise=arrays["case"])

    assert list(verified(tmp_path).not_covered) == [f"{stem}: array 'surprise'"]


@pytest.mark.parametrize("stem", FILES)
def test_an_array_with_a_surplus_row_is_a_mismatch(tmp_path, stem):
    arrays = arrays_of(stem)
    longer = max(
        (name for name in arrays if not name.endswith(("_columns", "_order"))),
        key=lambda name: arrays[name].ndim,
    )
    arrays[longer] = np.concatenate([arrays[longer], arrays[longer][-1:]])
    np.savez(tmp_path / f"{stem}.npz", **arrays)

    assert verified(tmp_path).exit_code() == 1


def test_unknown_files_are_not_covered(tmp_path):
    (tmp_path / "surprise.npz").write_bytes(b"")

    assert verified(tmp_path).not_covered == {"file surprise.npz": 1}


def test_a_truncated_file_is_a_mismatch(tmp_path):
    whole = (FOLDER / "idm_steps.npz").read_bytes()
    (tmp_path / "idm_steps.npz").write_bytes(whole[: len(whole) // 2])

    assert verified(tmp_path).exit_code() == 1


BROKEN = {  # file, array: what is written into it, what the mismatch says
    ("closed_loop", "mode"): ("other", "neither 'full' nor 'window'"),
    ("closed_loop", "ref_time_us"): (0, "increasing integer time stamps"),
    ("trajectory_interpolation", "knot_time_us"): (0, "increasing integer time stamps"),
    ("lqr_commands", "traj_ptr"): (1, "which are not those of"),
}


@pytest.mark.parametrize(("stem", "name"), BROKEN)
def test_what_is_broken_in_an_input_is_named(tmp_path, stem, name):
    value, message = BROKEN[stem, name]
    arrays = arrays_of(stem)
    arrays[name][:] = value
    np.savez(tmp_path / f"{stem}.npz", **arrays)

    assert message in " ".join(verified(tmp_path).mismatches)
