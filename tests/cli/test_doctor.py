"""Whether an installation computes what it should."""

import shutil

import numpy as np
import pytest

from shiftsim.cli import doctor
from shiftsim.errors import ShiftsimError
from shiftsim.verify import rollouts


@pytest.mark.slow
def test_a_wrong_number_is_found(tmp_path, monkeypatch):
    shutil.copytree(rollouts.REFERENCE, tmp_path, dirs_exist_ok=True)
    with np.load(tmp_path / "bicycle_steps.npz") as stored:
        arrays = {name: stored[name].copy() for name in stored.files}
    changed = next(name for name in arrays if arrays[name].dtype == np.float64)
    arrays[changed].reshape(-1)[3] += 1e-3
    np.savez(tmp_path / "bicycle_steps.npz", **arrays)
    monkeypatch.setattr(rollouts, "REFERENCE", tmp_path)

    found = doctor.examine()

    assert 0 < len(found["mismatches"]) < found["cases"]
    assert 1 <= found["workers"] <= found["cores"]
    text = "\n".join(doctor.diagnosis_lines(found))
    for word in ("MISMATCH", "suggested workers", "numba", "torch: "):
        assert word in text


def test_missing_references_are_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(rollouts, "REFERENCE", tmp_path)
    with pytest.raises(ShiftsimError, match="bicycle_steps"):
        doctor.examine()
