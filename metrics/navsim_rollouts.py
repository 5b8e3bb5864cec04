"""NAVSIM's scores of closed-loop rollouts, in two modes that are not NAVSIM's.

`plans`: each 0.5 s the plan made there is a proposal, driven by NAVSIM's tracker from the state of
that moment; extended comfort compares it with the plan before. `windows`: what was driven in the
next 4 s is scored as it is, with the driven past and without extended comfort. In both, the world
is what the rollout's own did next, PDM-Closed plans the reference from the driven state, and no
human filter acts. Scores are means over the frames that have 4 s (PDMS: 5 s) of rollout ahead.
"""

from collections import defaultdict
from dataclasses import replace
from itertools import product

import numpy as np

from shiftsim.errors import DataError, PlannerError
from shiftsim.geometry.boxes import to_frame
from shiftsim.kernels import FloatArray
from shiftsim.metrics import navsim
from shiftsim.metrics.result import MetricRow
from shiftsim.planners.proposals.tracker import SCORED
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.planner import rollout_rows
from shiftsim.world.scenario import Scenario

STRIDE = 5  # iterations between frames
MODES = ("plans", "windows")
TOTALS = {"v1": "PDMS", "v2": "EPDMS"}
SHORT = {  # sub-scores of v2, as tables call them
    "no_at_fault_collisions": "NC",
    "drivable_area_compliance": "DAC",
    "driving_direction_compliance": "DDC",
    "traffic_light_compliance": "TLC",
    "ego_progress": "EP",
    "time_to_collision_within_bound": "TTC",
    "lane_keeping": "LK",
    "history_comfort": "HC",
    "two_frame_extended_comfort": "EC",
}
FRAMES = "frames"  # how many were scored, of as many as there are
COLUMNS = (*TOTALS.values(), *SHORT.values(), FRAMES)
# times of the poses that a rollout keeps of a plan, and of those that are scored [s]
_KEPT_S = np.concatenate([np.arange(11) / 10.0, np.arange(2.0, 9.0)])
_PLAN_S = navsim.SPACING * np.arange(1, 9)


def metric_name(mode: str, column: str) -> str:
    """Name of a row, such as `navsim_plans_EPDMS`."""
    return f"navsim_{mode}_{column}"


def metric_rows(log: SimulationLog, scenario: Scenario) -> list[MetricRow]:
    """Means over the frames of a rollout; a mode that nothing is known of has no rows.

    Where the planner returned commands there are no plans. Frames where PDM-Closed finds no way
    along the route, or with less than 1.5 s before them, are left out.
    """
    found, driven = defaultdict[str, list[float]](list), driven_scenario(log, scenario)
    for version, total in TOTALS.items():
        before: navsim.Scores | None = None
        columns = {"score": total} | (SHORT if version == "v2" else {})
        ahead = round(10 * navsim.VERSIONS[version].seconds)
        for iteration in range(0, len(log.ego) - ahead, STRIDE):
            try:
                world = navsim.frame_world(driven, iteration, version)
            except (DataError, PlannerError):  # no past, no way
                before = None
                continue
            states = np.ascontiguousarray(log.ego[None, iteration : iteration + SCORED + 1])
            parts = navsim.evaluate(states, world.ground, world.around, version, world.past)
            scores = {"windows": navsim.total(parts, version, world.time_us, None, world.reach)}
            if (plan := plan_at(log, iteration)) is not None:
                kept = before if version == "v2" else None
                before = navsim.score(world, plan, human_filter=False, previous=kept)
                scores["plans"] = before
            for (mode, each), (name, column) in product(scores.items(), columns.items()):
                if (values := getattr(each, name)) is not None:
                    found[metric_name(mode, column)].append(float(values[0]))
    rows = [
        MetricRow(name, None, float(np.mean(found[name])), "score", None, None)
        for name in (metric_name(*pair) for pair in product(MODES, COLUMNS))
        if name in found
    ]
    frames = len(range(0, len(log.ego) - SCORED, STRIDE))
    for mode in MODES:
        if scored := found.get(metric_name(mode, TOTALS["v2"])):
            name = metric_name(mode, FRAMES)
            rows.append(MetricRow(name, None, len(scored), "count", frames, None))
    return rows


vars(metric_rows)["of_scenario"] = True  # it needs more than the map


def driven_scenario(log: SimulationLog, scenario: Scenario) -> Scenario:
    """The scenario as it would be if the rollout were its recording."""
    rows, start = rollout_rows(scenario)
    index = np.maximum(np.arange(-start, len(log.ego)), 0)
    tracks = log.tracks.rows(index)  # a copy
    tracks.valid[:start] = False
    for values in tracks.arrays[1:]:
        values[:start] = np.nan
    return replace(
        scenario,
        time_us=np.concatenate([scenario.time_us[rows[:start]], log.time_us]),
        ego=np.concatenate([scenario.ego[rows[:start]], log.ego]),
        tracks=tracks,
        traffic_lights=log.traffic_lights.rows(index),
        iteration_rows=start + np.arange(len(log.ego)),
        row_step=1,
    )


def plan_at(log: SimulationLog, iteration: int) -> FloatArray | None:
    """(1, 8, 3) the plan of an iteration as NAVSIM takes it; None where a command was returned.

    Between the poses that are kept of it, every second from 1 s on, it is interpolated.
    """
    poses = log.plans[iteration]
    known = ~np.isnan(poses[:, 0])
    if known.sum() < 2:
        return None
    in_ego = to_frame(poses[known], log.ego[iteration, :3])
    columns = (*in_ego[:, :2].T, np.unwrap(in_ego[:, 2]))
    times = _KEPT_S[known]
    return np.stack([np.interp(_PLAN_S, times, values) for values in columns], axis=1)[None]
