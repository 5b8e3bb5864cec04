"""States along a trajectory at any time, and perfect tracking.

nuPlan interpolates linearly over microseconds; headings are unwrapped over the whole trajectory
first and wrapped afterwards; yaw rate, yaw acceleration and steering rate are not carried and come
out as 0; nothing is extrapolated.
"""

import numpy as np

from shiftsim.errors import InvalidTrajectoryError, PlannerError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import interpolate as between
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.state import (
    HEADING,
    STEERING,
    STEERING_RATE,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    Trajectory,
)

MAX_SPEED = 50.0  # m/s, nuPlan perfect tracking controller
# us from the moment of planning on, of the poses of a plan that a rollout keeps: every 0.1 s over
# the first second, which the tracker looks ahead, then every second to 8 s
KEPT_US = np.concatenate([np.arange(0, 1_000_001, 100_000), np.arange(2, 9) * 1_000_000])


@kernel
def unwrap_correction(before: float, after: float) -> float:
    """What to add to a heading (and all later ones) to make the step from the one before small."""
    # nuPlan rule 16: as numpy.unwrap, whose steps of exactly half a turn keep their sign
    step = after - before
    if abs(step) < np.pi:
        return 0.0
    wrapped = (step + np.pi) % (2.0 * np.pi) - np.pi
    if wrapped == -np.pi and step > 0.0:
        wrapped = np.pi
    return wrapped - step


@kernel
def segment_end(traj_time_us: IntArray, query_us: int) -> int:
    """Index of the first knot at or after the query, at least 1, at most the last knot."""
    low, high = 1, len(traj_time_us) - 1
    while low < high:
        middle = (low + high) // 2
        if traj_time_us[middle] < query_us:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def interpolate(
    traj_time_us: IntArray, traj_states: FloatArray, query_us: int, out: FloatArray
) -> bool:
    """Write the state of a trajectory at one time; steering rate, yaw rate and acceleration are 0.

    The trajectory has states (H, 11) at strictly increasing times (H,) [us]. False, and `out` (11,)
    is untouched, where it does not cover the query.
    """
    count = len(traj_time_us)
    if count < 2 or query_us < traj_time_us[0] or query_us > traj_time_us[count - 1]:
        return False
    end = segment_end(traj_time_us, query_us)
    begin = end - 1
    span = float(traj_time_us[end] - traj_time_us[begin])
    ahead = float(query_us - traj_time_us[begin])
    for column in range(STEERING + 1):
        out[column] = between(traj_states[begin, column], traj_states[end, column], span, ahead)
    turn = 0.0
    for knot in range(1, end):
        turn += unwrap_correction(traj_states[knot - 1, HEADING], traj_states[knot, HEADING])
    first = traj_states[begin, HEADING] + turn
    turn += unwrap_correction(traj_states[begin, HEADING], traj_states[end, HEADING])
    last = traj_states[end, HEADING] + turn
    out[HEADING] = wrap_angle(between(first, last, span, ahead))
    # nuPlan rule 17: yaw rate, yaw acceleration and steering rate are not carried
    out[STEERING_RATE] = 0.0
    out[YAW_RATE] = 0.0
    out[YAW_ACCEL] = 0.0
    return True


@kernel
def sample_poses(
    traj_time_us: IntArray,
    traj_states: FloatArray,
    start_us: int,
    ahead_us: IntArray,
    out: FloatArray,
) -> None:
    """Poses of a trajectory at ascending times (P,) after a start, into `out` (P, 3).

    The same numbers as `interpolate` at each time, in one sweep; NaN where it covers none.
    """
    last, end, turn, next_turn = len(traj_time_us) - 1, 0, 0.0, 0.0
    for row in range(len(out)):
        query = start_us + ahead_us[row]
        if last < 1 or query < traj_time_us[0] or query > traj_time_us[last]:
            out[row] = np.nan
            continue
        while end < 1 or traj_time_us[end] < query:
            end, turn = end + 1, next_turn
            before, after = traj_states[end - 1, HEADING], traj_states[end, HEADING]
            next_turn = turn + unwrap_correction(before, after)
        begin = end - 1
        span = float(traj_time_us[end] - traj_time_us[begin])
        ahead = float(query - traj_time_us[begin])
        for column in range(HEADING):
            first, final = traj_states[begin, column], traj_states[end, column]
            out[row, column] = between(first, final, span, ahead)
        first, final = traj_states[begin, HEADING] + turn, traj_states[end, HEADING] + next_turn
        out[row, HEADING] = wrap_angle(between(first, final, span, ahead))


def follow_perfectly(plan: Trajectory, next_us: int, out: FloatArray) -> None:
    """Put the ego where the plan, in log time, wants it at the next iteration: into `out` (11,).

    Raises:
        InvalidTrajectoryError: The plan does not cover the next iteration.
        PlannerError: The plan is there at 50 m/s or more.
    """
    if not interpolate(plan.time_us, plan.states, next_us, out):
        raise InvalidTrajectoryError(
            f"trajectory does not cover the next iteration at {next_us} us",
            "return at least two states, from the present iteration to the next one or beyond",
        )
    speed = float(np.hypot(out[VX], out[VY]))
    if speed >= MAX_SPEED:
        raise PlannerError(
            f"trajectory has speed {speed:.6g} m/s at {next_us} us; "
            f"perfect tracking needs less than {MAX_SPEED:g} m/s",
            "give velocities in m/s, in the body frame",
        )
