"""Whether what a planner returned can be executed from one iteration to the next."""

from typing import Any, NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.state import NUM_STATE, STATE_COLUMNS, Command, Trajectory

MIN_SPAN_US = 200_000  # us, three poses at 0.1 s: the tracker cannot be built with fewer
LOOK_AHEAD_US = 1_000_000  # us, what the tracker reads of a plan
MAX_SPAN_US = 3_600_000_000  # us; the tracker samples all of a plan
FAR = 20.0  # m between the ego and the start of a plan: nobody means that
LARGEST = 1e9  # m, rad, m/s, … of either sign; more is a mistake, and squares of it overflow
SHORT = (
    "plans reach less than 1 s ahead: the tracker looks 1 s ahead, and takes the end for the rest"
)

GOOD, _NOT_INCREASING, _TOO_LARGE, _STARTS_LATE, _ENDS_EARLY, _TOO_SHORT, _TOO_LONG = range(7)


class Fault(NamedTuple):
    """What is wrong with a plan."""

    # name of the rule: `type`, `shapes`, `times`, `finite`, `length`, `covers the next step` or
    # `three poses`
    check: str
    message: str  # what is wrong, with the offending value
    hint: str  # what to do about it


def find_fault(plan: Any, now_us: int, next_us: int) -> Fault | None:
    """Why a plan cannot be executed from one iteration to the next [us]; None where it can."""
    if isinstance(plan, Command):
        return _find_command_fault(plan)
    if not isinstance(plan, Trajectory):
        return Fault(
            "type",
            f"plan() returned {type(plan).__name__}, not a Trajectory or a Command",
            "return shiftsim.Trajectory.from_poses(times, poses) or a shiftsim.Command",
        )
    times, states = plan.time_us, plan.states
    fits = (
        isinstance(times, np.ndarray)
        and isinstance(states, np.ndarray)
        and times.ndim == 1
        and times.dtype == np.int64
        and states.dtype == np.float64
        and states.shape == (len(times), NUM_STATE)
    )
    if not fits:
        return Fault(
            "shapes",
            f"time_us is {_describe(times)} and states is {_describe(states)}; "
            f"need int64 (H,) and float64 (H, {NUM_STATE})",
            "Trajectory.from_poses builds both from times (H,) [s] and poses (H, 3)",
        )
    if plan.relative:
        now_us, next_us = 0, next_us - now_us
    code = check_values(contiguous(times), contiguous(states), now_us, next_us)
    return None if code == GOOD else _explain(code, plan, now_us, next_us)


def is_short(plan: object) -> bool:
    """Whether a plan that can be executed ends before what the tracker reads does."""
    return isinstance(plan, Trajectory) and bool(plan.time_us[-1] - plan.time_us[0] < LOOK_AHEAD_US)


def find_warning(plan: Trajectory, start: FloatArray, ego: FloatArray) -> str:
    """Why a plan that can be executed is most likely not what was meant; empty where it may be.

    `start` is where it is now, and `ego` where the ego is: x [m], y [m] and more.
    """
    away = float(np.hypot(start[0] - ego[0], start[1] - ego[1]))
    if away > FAR:
        return f"the first plan begins {away:.0f} m away from the ego: poses are in the map frame"
    return SHORT if is_short(plan) else ""


def _find_command_fault(command: Command) -> Fault | None:
    for name in ("acceleration", "steering_rate"):
        value = getattr(command, name)
        try:
            good = abs(float(value)) <= LARGEST
        except (TypeError, ValueError, OverflowError):
            good = False
        if not good:
            return Fault(
                "finite",
                f"the command has {name} {value!r}, not a finite number up to {LARGEST:g}",
                "return floats in m/s^2 and rad/s",
            )
    return None


def contiguous(array: Any) -> Any:
    """The array, or a contiguous writable copy: kernels are compiled for that kind alone."""
    return array if array.flags.carray else array.copy()


def _describe(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return type(value).__name__


@kernel
def check_values(time_us: IntArray, states: FloatArray, now_us: int, next_us: int) -> int:
    """GOOD, or what is wrong with a plan."""
    for row in range(1, len(time_us)):
        if time_us[row] <= time_us[row - 1]:
            return _NOT_INCREASING
    num_good = 0
    for value in states.flat:
        num_good += 1 if abs(value) <= LARGEST else 0  # NaN is not
    if num_good < states.size:
        return _TOO_LARGE
    if len(time_us) < 2 or float(time_us[-1]) - float(time_us[0]) < MIN_SPAN_US:
        return _TOO_SHORT
    if float(time_us[-1]) - float(time_us[0]) > MAX_SPAN_US:  # a difference of integers wraps
        return _TOO_LONG
    if time_us[0] > now_us:
        return _STARTS_LATE
    if time_us[-1] < next_us:
        return _ENDS_EARLY
    return GOOD


def _explain(code: int, plan: Trajectory, now_us: int, next_us: int) -> Fault:
    times = plan.time_us
    if code == _NOT_INCREASING:
        row = int(np.argmax(times[1:] <= times[:-1])) + 1
        return Fault(
            "times",
            f"time {row} of the plan is {times[row]} us, not after time {row - 1} "
            f"({times[row - 1]} us)",
            "times must increase strictly",
        )
    if code == _TOO_LARGE:
        # poses first: from_poses makes velocities of them
        column, row = np.argwhere(~(np.abs(plan.states.T) <= LARGEST))[0]
        return Fault(
            "finite",
            f"{STATE_COLUMNS[column]} of state {row} is {plan.states[row, column]}",
            f"every value of every state must be a finite number up to {LARGEST:g}",
        )
    if code == _TOO_LONG:
        return Fault(
            "length",
            f"time {len(times) - 1} of the plan is {times[-1]} us, more than an hour after time 0 "
            f"({times[0]} us)",
            "times of from_poses are seconds, time_us are microseconds",
        )
    if code == _TOO_SHORT:
        span = (times[-1] - times[0]) * 1e-6 if len(times) else 0.0
        return Fault(
            "three poses",
            f"the plan has {len(times)} states over {span:g} s; "
            "the tracker needs three poses 0.1 s apart",
            "plan at least 0.2 s ahead, better 1 s and more: the tracker looks 1 s ahead",
        )
    kind = "offset" if plan.relative else "time"
    hint = (
        "times of from_poses are seconds from now, the first one 0"
        if plan.relative
        else "time_us are log time stamps from now on (observation.time_us; for a nuPlan planner "
        "the time_point of the last ego state), unless a Trajectory has relative=True"
    )
    if code == _STARTS_LATE:
        what = f"the plan starts at {kind} {times[0]} us, after the present ({now_us} us)"
    else:
        what = f"the plan ends at {kind} {times[-1]} us, before the next step ({next_us} us)"
    return Fault("covers the next step", what, hint)
