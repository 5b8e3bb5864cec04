"""Whether an installation computes what it should."""

import shutil

import numpy as np
import pytest

from shiftsim import doctor


@pytest.mark.slow
def test_a_wrong_number_is_found(tmp_path, monkeypatch):
    folder = tmp_path / "dynamics"
    shutil.copytree(doctor.REFERENCE / "dynamics", folder)
    with np.load(folder / "bicycle_steps.npz") as stored:
        arrays = {name: stored[name].copy() for name in stored.files}
    changed = next(name for name in arrays if arrays[name].dtype == np.float64)
    arrays[changed].reshape(-1)[3] += 1e-3
    np.savez(folder / "bicycle_steps.npz", **arrays)
    monkeypatch.setattr(doctor, "REFERENCE", tmp_path)

    found = doctor.examine()

    assert not found.is_well
    assert any("MISMATCH" in line for line in found.lines())


def test_nothing_to_compare_with_is_not_well(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "REFERENCE", tmp_path)
    assert not doctor.examine().is_well


def test_cores_memory_and_torch_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "REFERENCE", tmp_path)
    found = doctor.examine()
    assert 1 <= found.workers <= found.cores
    text = "\n".join(found.lines())
    assert "suggested workers" in text
    assert "numba" in text
    assert "torch: " in text
