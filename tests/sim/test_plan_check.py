import re

import numpy as np
import pytest

from shiftsim.sim.plan_check import contiguous, find_fault, is_short
from shiftsim.world.state import NUM_STATE, Command, Trajectory

NOW, NEXT = 1_600_000_000_000_000, 1_600_000_000_100_000


def trajectory(times_us, relative=True) -> Trajectory:
    times = np.asarray(times_us, np.int64)
    return Trajectory(times, np.zeros((len(times), NUM_STATE)), relative)


@pytest.mark.parametrize(
    "plan",
    [
        trajectory([0, 100_000, 200_000]),
        trajectory([NOW - 30_000, NEXT, NEXT + 200_000], relative=False),
        trajectory([NOW, NOW + 500_000], relative=False),
        Command(-1.0, 0.2),
    ],
)
def test_plans_that_cover_the_next_step_are_accepted(plan):
    assert find_fault(plan, NOW, NEXT) is None


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (None, "returned NoneType"),
        (np.zeros((3, 3)), "returned ndarray"),
        (trajectory([0, 100_000, 100_000]), "time 2 of the plan is 100000 us"),
        (trajectory([0, 100_000]), "2 states over 0.1 s"),
        (trajectory([]), "0 states"),
        (trajectory([100_000, 200_000, 300_000]), "starts at offset 100000 us"),
        (trajectory([NOW - 900_000, NOW], relative=False), f"ends at time {NOW} us"),
        (trajectory([0, 100_000, 200_000], relative=False), "ends at time 200000 us"),
        (Trajectory(np.arange(3), np.zeros((3, 3))), r"float64 \(3, 3\)"),
        (Trajectory(np.arange(3), np.zeros((4, NUM_STATE))), r"float64 \(4, 11\)"),
        (Trajectory(np.arange(3.0), np.zeros((3, NUM_STATE))), r"float64 \(3,\)"),
        (Trajectory([0, 1, 2], np.zeros((3, NUM_STATE))), "time_us is list"),
        (Command(float("nan"), 0.0), "acceleration nan"),
        (Command("fast", 0.0), "acceleration 'fast'"),
    ],
)
def test_a_plan_that_cannot_be_executed_says_why(plan, message):
    fault = find_fault(plan, NOW, NEXT)
    assert re.search(message, fault.message)
    assert fault.hint


def test_a_value_that_is_not_finite_is_named_with_its_column_and_row():
    plan = trajectory([0, 100_000, 200_000])
    plan.states[1, 2] = np.nan
    assert "heading of state 1 is nan" in find_fault(plan, NOW, NEXT).message


def test_a_pose_that_is_not_finite_is_named_and_not_the_velocity_made_of_it():
    poses = np.zeros((10, 3))
    poses[3, 1] = np.nan
    plan = Trajectory.from_poses(0.1 * np.arange(10), poses)
    assert "y of state 3 is nan" in find_fault(plan, NOW, NEXT).message


def test_a_plan_is_short_that_ends_before_what_the_tracker_reads():
    assert is_short(trajectory([0, 500_000, 999_999]))
    assert not is_short(trajectory([0, 500_000, 1_000_000]))
    assert not is_short(Command(0.0, 0.0))


def test_kernels_get_contiguous_arrays_that_can_be_written():
    array = np.arange(12.0).reshape(3, 4)
    assert contiguous(array) is array
    fixed = array.copy()
    fixed.flags.writeable = False
    for other in (array[:, ::2], array.T, fixed):
        found = contiguous(other)
        assert found.flags.carray
        np.testing.assert_array_equal(found, other)
