"""Kernels that are compiled beside a run."""

import pytest

from shiftsim import warmup
from shiftsim.arrays.kept import fingerprint
from shiftsim.files import PACKAGE
from shiftsim.sim.traffic.idm.step import advance


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Groups of shares that are compiled; no kernel is kept."""
    monkeypatch.setattr(warmup, "kernel_folders", lambda: [tmp_path])
    groups = []
    monkeypatch.setattr(warmup, "warm_up", lambda *found: groups.extend(found))
    return groups


@pytest.mark.parametrize(
    ("traffic", "shares"),
    [("nonreactive", ["contacts"]), ("reactive", ["contacts", "agents", "routes"])],
)
def test_beside_a_first_run_the_metrics_and_the_agents_are_compiled(started, traffic, shares):
    warmup.beside_run(traffic)
    assert started == [shares]
    assert set(shares) <= set(warmup.SHARES)


def test_beside_other_runs_nothing_is_compiled(started, tmp_path):
    (tmp_path / fingerprint(PACKAGE / "metrics" / "time_to_collision.py")).mkdir()
    with warmup.beside_run("reactive"):
        assert started == []


def test_the_agents_are_moved_on_the_small_scene():
    warmup.SHARES["agents"]()
    assert advance.signatures
