"""Run folders with made-up results, for tests of what is printed of them."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.metrics import SHORT_NAMES
from shiftsim.runs.results import FORMAT_VERSION, open_run
from shiftsim.runs.tables import TABLES

METRICS = [name for name in SHORT_NAMES if name != "score"]


def write_run(
    path,
    *,
    planners=("alpha",),
    noise=("none",),
    seeds=(0,),
    tokens=("t0", "t1", "t2", "t3"),
    cities=("x", "x", "y", "y"),
    logs=("l0", "l0", "l1", "l2"),
    types=None,
    durations=None,
    score=lambda planner, noise, seed, number: 0.5,
    missing=(),
    **settings,
):
    """A run whose scores `score` gives; `missing` holds (planner, noise, seed, token)."""
    kinds = types or ["unlabelled"] * len(tokens)
    rows, tasks = [], []
    for planner in planners:
        for name in noise:
            for seed in (0,) if name == "none" else seeds:
                for number, token in enumerate(tokens):
                    key = {"planner": planner, "noise": name, "seed": seed, "token": token}
                    lost = tuple(key.values()) in set(missing)
                    status = {"status": "failed" if lost else "ok", "scenario_type": kinds[number]}
                    times = {"planning_ms_mean": 2.0, "planning_ms_p95": 3.0}
                    tasks.append({**key, **status, **times})
                    if lost:
                        continue
                    value = score(planner, name, seed, number)
                    rows.append(
                        {
                            **key,
                            "scenario_type": kinds[number],
                            "city": cities[number],
                            "duration_class": (durations or ["15 s"] * len(tokens))[number],
                            "log_name": logs[number],
                            "traffic": settings.get("traffic", "nonreactive"),
                            "cls": value,
                            **dict.fromkeys(METRICS, value),
                            "degraded_steps": number,
                            "thresholds": settings.get("thresholds", "nuplan"),
                            "metric_version": "1",
                        }
                    )
    path.mkdir(parents=True)
    contents = {"scores": rows, "tasks": tasks, "metrics": []}
    for name, table in contents.items():
        pq.write_table(pa.Table.from_pylist(table, TABLES[name]), path / f"{name}.parquet")
    manifest = _manifest(planners, noise, seeds, len(tasks), len(rows), settings)
    (path / "manifest.json").write_text(json.dumps(manifest))
    return open_run(path)


def _manifest(planners, noise, seeds, expected, done, settings):
    config = {"planners": list(planners), "noise": list(noise), "seeds": list(seeds)}
    return {
        "format": FORMAT_VERSION,
        "run": "made",
        "state": "finished",
        "split": settings.get("split", "made-up"),
        "shard": settings.get("shard", ""),
        "store": "nowhere",
        "ended": "2026-01-02T03:04:05+00:00",
        "versions": {"shiftsim": "9.8.7", "numpy": "1.2", "numba": "0.3"},
        "git": "abc",
        "edits": settings.get("edits"),
        "config": {**config, "limit": settings.get("limit", 0)},
        "counts": {"expected": expected, "ok": done, "failed": expected - done, "missing": 0},
        "determining": {
            "store": "0123456789abcdef",
            "planners": {name: settings.get("fingerprint", name) for name in planners},
            "traffic": settings.get("traffic", "nonreactive"),
            "controller": settings.get("controller", "lqr"),
            "thresholds": {"name": settings.get("thresholds", "nuplan")},
            "metric_version": "1",
        },
    }


def random_scores(seed):
    """Reproducible scores that depend on planner, noise, seed and scenario."""

    def score(planner, noise, run_seed, number):
        key = [seed, *planner.encode(), *noise.encode(), run_seed, number]
        return float(np.random.default_rng(key).random())

    return score
