"""One step of the closed loop with a plan, behind one call: check, note, track, move."""

from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.sim.dynamics.lqr import TRACKED, track_and_step
from shiftsim.sim.dynamics.perfect import KEPT_US, sample_poses
from shiftsim.sim.plan_check import GOOD, check_values


class Course(NamedTuple):
    """The steps that a planner takes at once, and the arrays that a rollout keeps of them."""

    time_us: IntArray  # (R,) time stamps of the rows [us]
    start: int  # row of iteration 0
    first: int  # iteration to begin with
    stop: int  # one past the last iteration
    ego: FloatArray  # (R, 11) ego states, known up to the first iteration
    noise: FloatArray  # (K, 2) added to the commands
    commands: FloatArray  # (K, 2) clean commands
    kept: FloatArray  # (K, P, 3) poses of the plans


@kernel
def execute(
    plan_us: IntArray,  # (H,) time stamps of the plan, from `offset_us` on [us]
    states: FloatArray,  # (H, 11) its states
    offset_us: int,  # the moment of planning where time stamps count from it, else 0 [us]
    now_us: int,
    next_us: int,  # time stamp of the next iteration [us]
    row: int,  # of the ego
    iteration: int,  # of the samples
    moves: bool,  # whether the ego moves; the last plan is not executed
    ego: FloatArray,  # (R, 11) ego states; the next row is written
    noise: FloatArray,  # (K, 2) added to the commands
    commands: FloatArray,  # (K, 2) the clean command is written
    kept: FloatArray,  # (K, P, 3) poses of the plan are written
) -> tuple[int, int]:
    """Check a plan, keep what a rollout keeps of it, and move the ego by tracker and bicycle.

    Returns:
        GOOD, or what is wrong with the plan: then nothing is written; TRACKED, or why the ego was
        not moved.
    """
    code, _, _ = check_values(plan_us, states, now_us - offset_us, next_us - offset_us)
    if code != GOOD:
        return code, TRACKED
    time_us = np.empty(len(plan_us), np.int64)
    for sample in range(len(plan_us)):
        time_us[sample] = plan_us[sample] + offset_us
    sample_poses(time_us, states, now_us, KEPT_US, kept[iteration])
    if not moves:
        return GOOD, TRACKED
    accel, rate = noise[iteration, 0], noise[iteration, 1]
    status = track_and_step(
        now_us, next_us, ego[row], time_us, states, accel, rate, ego[row + 1], commands[iteration]
    )
    return GOOD, status
