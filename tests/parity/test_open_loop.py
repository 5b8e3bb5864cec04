"""nuPlan's open-loop scores against the official code, from the plans it was given."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parity_cases import Cases, File, read_file

from shiftsim.errors import DataError
from shiftsim.metrics import open_loop as ours
from shiftsim.metrics.open_loop import OpenLoopResult, Poses, open_loop
from shiftsim.world.state import center_poses

pytestmark = [pytest.mark.golden, pytest.mark.reference("open_loop")]

ATOL = 1e-6
RUN = ("scene", "planner", "duration")
MOTION = "vx vy ax ay tire_steering_angle tire_steering_rate angular_velocity angular_acceleration"


class Inputs:
    """Plans and recordings that the official code was given."""

    def __init__(self, folder: Path, cases: Cases) -> None:
        self.tables = [read_table(folder, name, cases) for name in ("plans", "expert", "scenarios")]
        plans, expert, scenarios = self.tables
        for table in (plans, expert):
            columns = ("center_x", "center_y", "center_heading")
            centers = center_poses(poses(table).poses).T
            table.match("all", dict(zip(columns, centers, strict=True)), ATOL)
            table.note("no metric reads it", *MOTION.split(), "index")
        expert.note("order of the rows", "part")
        scenarios.note(
            "of the scenario", "iterations", "token", "scenario_type", "database_interval"
        )
        self.plans = plans.groups("scene", "planner", "iteration")
        self.experts = expert.groups("scene", "duration")
        rows = scenarios.groups("scene", "duration")
        self.lengths = {key: int(row["history"][0]) for key, row in rows.items()}

    def result(self, scene: str, planner: str, duration: str) -> OpenLoopResult:
        """Our scores of one run."""
        frames = range(0, self.lengths[scene, duration], ours.EVERY)
        keys = [(scene, planner, str(frame)) for frame in frames]
        plans = [poses(self.plans[key]) for key in keys if key in self.plans]
        return open_loop(plans, poses(self.experts[scene, duration]), scene)


def read_table(folder: Path, name: str, cases: Cases) -> File:
    return read_file(folder / f"openloop_{name}.parquet", cases)


def poses(rows: File) -> Poses:
    """A plan, or a recording."""
    return Poses(rows["time_us"], np.stack([rows[name] for name in ("x", "y", "heading")], axis=1))


def test_scores(folder: Path, cases: Cases) -> None:
    inputs = Inputs(folder, cases)
    scores, frames = (read_table(folder, name, cases) for name in ("scores", "frames"))
    statistics = read_table(folder, "statistics", cases)
    by_frame = frames.groups(*RUN, "horizon")
    by_metric = statistics.groups(*RUN, "metric")
    for run, row in scores.groups(*RUN).items():
        result, where = inputs.result(*run), " ".join(run)
        columns: dict[str, Any] = {p.row.metric: [p.row.score] for p in result.parts}
        row.match(where, {**columns, "score": [result.score]}, ATOL)
        for part in result.parts:
            names, units, kinds, values = (
                [getattr(statistic, field) for statistic in part.statistics]
                for field in ("name", "unit", "kind", "value")
            )
            columns = {"statistic": names, "unit": units, "type": kinds, "value": values}
            by_metric[*run, part.row.metric].match(where, columns, {"value": ATOL})
        for number, horizon in enumerate(ours.HORIZONS):
            errors = {name: values[number] for name, values in result.errors.items()}
            means = result.errors["ADE"].mean(axis=0)
            columns = {"fde": errors["FDE"], "ahe": errors["AHE"], "fhe": errors["FHE"]}
            columns |= {"max_de": result.farthest[number], "ade_mean_over_horizons": means}
            of_horizon = by_frame[*run, str(horizon)]
            of_horizon.match(where, columns, ATOL)
            numbers = np.arange(len(means))
            of_horizon.match(where, {"frame": numbers, "iteration": numbers * ours.EVERY})
    frames.note("time of the frame", "time_us")
    for table in (*inputs.tables, scores, frames, statistics):
        table.finish()


def test_what_the_official_code_refuses(folder: Path, cases: Cases) -> None:
    inputs, failures = Inputs(folder, cases), read_table(folder, "failures", cases)
    for run in failures.groups(*RUN):
        with pytest.raises(DataError, match="the recording ends"):
            inputs.result(*run)
        cases.compare("refused", " ".join(run), True, True)
    failures.note("wording", "stage", "error")
    failures.finish()


def test_bounds(folder: Path, cases: Cases) -> None:
    config = json.loads((folder / "openloop_config.json").read_text())
    settings = {**config["low_level"], **config["high_level"]}
    found = {
        entry["name"]: next(v for k, v in entry.items() if k.startswith("max_") and k != MISS_RATE)
        for entry in settings.values()
    }
    expected = {name: bound for name, (_, _, bound, _) in ours.METRICS.items()}
    cases.compare("bounds", "config", {**expected, ours.MISS: list(ours.MISSED)}, found)


MISS_RATE = "max_miss_rate_threshold"
