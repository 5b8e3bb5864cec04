"""nuPlan's open-loop scores: how far the plans of a recorded drive are from what was driven.

Nothing moves by the planner: once a second it is asked at the recorded state, and its plan is
compared with the recording of the next 8 s, box centre with box centre. No map is read.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shiftsim.errors import DataError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.result import MetricPart, MetricRow
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

EVERY = 10  # iterations between plans that are compared
HORIZONS = (3, 5, 8)  # s, one comparison each second
MISSED = (6.0, 8.0, 16.0)  # m, by horizon: a plan that is once farther away has missed
MAX_MISS_RATE = 0.3
MISS = "planner_miss_rate_within_bound"
# by metric: names of its statistics, unit, bound, weight; the miss rate multiplies
METRICS = {
    "planner_expert_average_l2_error_within_bound": ("ADE", "meter", 8.0, 1.0),
    "planner_expert_final_l2_error_within_bound": ("FDE", "meter", 8.0, 1.0),
    "planner_expert_final_heading_error_within_bound": ("FHE", "radian", 0.8, 2.0),
    "planner_expert_average_heading_error_within_bound": ("AHE", "radian", 0.8, 2.0),
}
TOTAL, COUNT = "open_loop_score", "open_loop_plans"
NAMES = (TOTAL, *METRICS, MISS, COUNT)


class Poses(NamedTuple):
    """Poses over time: a plan, or the recording."""

    time_us: IntArray  # (N,) strictly increasing, except that the recording may repeat one [us]
    poses: FloatArray  # (N, 3) rear axle in the map frame [m, m, rad]

    def centers(self, time_us: IntArray) -> FloatArray:
        """(M, 3) poses of the centre at times (M,) within these [us]."""
        first = int(self.time_us[0])
        columns = (*self.poses[:, :2].T, np.unwrap(self.poses[:, 2]))
        known = self.time_us - first
        return center_poses(
            np.stack([np.interp(time_us - first, known, values) for values in columns], axis=1)
        )


@dataclass(frozen=True, slots=True)
class OpenLoopResult:
    """What nuPlan says about the plans of one scenario. F frames, a second apart."""

    score: float  # in [0, 1]
    parts: tuple[MetricPart, ...]  # the five metrics
    errors: dict[str, FloatArray]  # ADE, FDE [m], AHE, FHE [rad], each (3, F) by horizon
    farthest: FloatArray  # (3, F) largest distance within each horizon [m]


def recording(scenario: Scenario) -> Poses:
    """What the plans of a scenario are compared with: its tenth iterations, and 8 s behind."""
    rows, second = scenario.iteration_rows, scenario.row_step * EVERY
    last = int(rows[:-1][::EVERY][-1])
    ahead = last + second * np.arange(1, HORIZONS[-1] + 1)
    # nuPlan rule 732: iterations and what follows the last plan may have a sample in common
    rows = np.concatenate([rows[::EVERY], ahead[ahead < len(scenario.time_us)]])
    return Poses(scenario.time_us[rows], scenario.ego[rows, :3])


def metric_rows(plans: Sequence[Poses], scenario: Scenario) -> list[MetricRow]:
    """Rows of the plans of a scenario whose 8 s were recorded; the last one counts them.

    nuPlan scores all plans or none: where the count is below its bound, the score is not nuPlan's.
    It is a DataError if a plan, or the recording behind the first of them, is too short.
    """
    expert = recording(scenario)
    count = max(1, min(len(plans), len(expert.time_us) - HORIZONS[-1]))
    result = open_loop(plans[:count], expert, scenario.token)
    total = MetricRow(TOTAL, result.score, result.score, "ratio", None, None)
    frames = MetricRow(COUNT, None, count, "count", len(plans), None)
    return [total, *(part.row for part in result.parts), frames]


def open_loop(plans: Sequence[Poses], expert: Poses, token: str = "") -> OpenLoopResult:
    """Compare plans, made a second apart, with the recording.

    `plans` are those of every tenth iteration but the last, which no planner is asked at, and
    `expert` recorded poses, as by `recording`. It is a DataError, with the scenario's `token`, if a
    plan or the recording behind it is too short.
    """
    distances, turns = np.empty((2, HORIZONS[-1], len(plans)))
    for frame, plan in enumerate(plans):
        planned, driven = _compared(plan, expert, frame, token)
        distances[:, frame] = np.hypot(*(planned - driven)[:, :2].T)
        turn = planned[:, 2] - driven[:, 2]
        turns[:, frame] = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
    errors = {
        "ADE": np.stack([distances[:horizon].mean(axis=0) for horizon in HORIZONS]),
        "FDE": np.stack([distances[horizon - 1] for horizon in HORIZONS]),
        "AHE": np.stack([turns[:horizon].mean(axis=0) for horizon in HORIZONS]),
        "FHE": np.stack([turns[horizon - 1] for horizon in HORIZONS]),
    }
    farthest = np.stack([distances[:horizon].max(axis=0) for horizon in HORIZONS])
    missed = (farthest > np.array(MISSED)[:, None]).mean(axis=1)
    parts = [_error_part(metric, errors[name[0]]) for metric, name in METRICS.items()]
    weights = [weight for *_, weight in METRICS.values()]
    score = np.average([part.row.score for part in parts], weights=weights)
    miss = _miss_part(missed)
    assert miss.row.score is not None
    return OpenLoopResult(float(score) * miss.row.score, (*parts, miss), errors, farthest)


def _compared(plan: Poses, expert: Poses, frame: int, token: str) -> tuple[FloatArray, FloatArray]:
    """Centres (8, 3) of a plan and of the recording, 1 to 8 s after a frame."""
    end = plan.time_us[-1]
    times = expert.time_us[frame : frame + HORIZONS[-1] + 1]
    where = f"scenario {token!r}: open loop, iteration {frame * EVERY}"
    reached = int(np.count_nonzero(times <= end))
    if reached <= HORIZONS[-1]:  # nuPlan rule 730: then the end of the plan is the last place
        times = np.append(times[:reached], end)
    if len(times) <= HORIZONS[-1]:
        seconds = (end - plan.time_us[0]) / 1e6
        what = f"{where}: the plan covers {seconds:.3g} s"
        raise DataError(what, "open loop compares plans of 8 s")
    if times[-1] > expert.time_us[-1]:
        missing = (times[-1] - expert.time_us[-1]) / 1e6
        what = f"{where}: the recording ends {missing:.3g} s before the plan"
        raise DataError(what, "shorten the scenario: 8 s of the recording must lie behind it")
    return plan.centers(times[1:]), expert.centers(times[1:])


def _error_part(metric: str, errors: FloatArray) -> MetricPart:
    """Score of errors (3, F) by horizon and frame."""
    name, unit, bound, _ = METRICS[metric]
    mean = float(errors.mean())  # nuPlan rule 731
    by_horizon = zip(HORIZONS, errors.mean(axis=1).tolist(), strict=True)
    return MetricPart.of(
        MetricRow(metric, max(0.0, 1.0 - mean / bound), mean, unit, bound, None),
        *((f"planner_expert_{name}_horizon_{h}", unit, "MEAN", value) for h, value in by_horizon),
        (metric, "boolean", "BOOLEAN", mean <= bound),
        (f"avg_planner_expert_{name}_over_all_horizons", unit, "MEAN", mean),
    )


def _miss_part(rates: FloatArray) -> MetricPart:
    worst = float(rates.max())
    score = float(worst <= MAX_MISS_RATE)
    by_horizon = zip(HORIZONS, rates.tolist(), strict=True)
    return MetricPart.of(
        MetricRow(MISS, score, worst, "ratio", MAX_MISS_RATE, None),
        *((f"planner_miss_rate_horizon_{h}", "ratio", "RATIO", rate) for h, rate in by_horizon),
        (MISS, "boolean", "BOOLEAN", score),
    )
