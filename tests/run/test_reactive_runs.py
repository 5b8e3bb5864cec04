"""Reactive traffic through a whole run."""

import pytest

import shiftsim


@pytest.mark.parametrize("traffic", ["reactive", "reactive-fixed"])
def test_workers_do_not_change_reactive_results(traffic, toy, tmp_path):
    runs = [
        shiftsim.run(
            ["constant-velocity"],
            traffic=traffic,
            store=str(toy),
            workers=workers,
            out=str(tmp_path / str(workers)),
        )
        for workers in (1, 2)
    ]

    names = ("metrics.parquet", "scores.parquet")
    first, second = ([(run.path / name).read_bytes() for name in names] for run in runs)
    assert first == second
    assert f"traffic {traffic} ·" in runs[0].table()
