"""Reactive traffic through a whole run."""

import pytest

import shiftsim
from shiftsim.runs.derive import rescore


@pytest.mark.thorough
def test_workers_do_not_change_reactive_results(toy, tmp_path):
    runs = [
        shiftsim.run(
            ["constant-velocity"],
            traffic="reactive",
            store=str(toy),
            workers=workers,
            out=str(tmp_path / str(workers)),
        )
        for workers in (1, 2)
    ]

    names = ("metrics.parquet", "scores.parquet")
    first, second = ([(run.path / name).read_bytes() for name in names] for run in runs)
    assert first == second
    assert "traffic reactive ·" in runs[0].table()


def test_stored_reactive_traffic_is_scored_again_as_it_drove(toy, tmp_path):
    first, direct = (
        shiftsim.run(
            ["constant-velocity"],
            traffic="reactive",
            thresholds=thresholds,
            store=str(toy),
            workers=1,
            out=str(tmp_path / thresholds),
        )
        for thresholds in ("nuplan", "deepplan")
    )

    again = rescore(first, thresholds="deepplan", out=str(tmp_path / "again"), workers=1)

    for name in ("metrics.parquet", "scores.parquet"):
        assert (again.path / name).read_bytes() == (direct.path / name).read_bytes()
