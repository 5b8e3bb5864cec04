"""The smallest possible planner: keep heading and speed."""

import numpy as np

from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.sim.dynamics.lqr import TRACKED
from shiftsim.sim.execute import Course, execute
from shiftsim.sim.plan_check import GOOD
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import HEADING, NUM_STATE, VX, VY, Trajectory, X, Y

_TIMES = 100_000 * np.arange(81)  # us, 8 s


class ConstantVelocity:
    """Drives straight on at the present speed."""

    name = "constant-velocity"

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation) -> Trajectory:
        """Poses every 0.1 s along the present heading."""
        ego, states = observation.ego, np.zeros((len(_TIMES), NUM_STATE))
        x, y, heading = ego.pose.tolist()
        _go_straight(x, y, heading, ego.speed, states)
        return Trajectory(_TIMES.copy(), states, relative=True)

    def drive_on(self, course: Course) -> int:
        """Take the steps of a course; the first iteration that was not taken."""
        return int(_drive_on(course, _TIMES, np.zeros((len(_TIMES), NUM_STATE))))


@kernel
def _go_straight(x: float, y: float, heading: float, speed: float, out: FloatArray) -> None:
    """Write poses and speeds of states (H, 11) from a pose straight on."""
    cos, sin = np.cos(heading), np.sin(heading)
    for step in range(len(out)):
        distance = speed * 0.1 * step
        out[step, 0], out[step, 1], out[step, 2] = x + distance * cos, y + distance * sin, heading
        out[step, VX] = speed


@kernel
def _drive_on(course: Course, plan_us: IntArray, states: FloatArray) -> int:
    """Plan and execute until the end, or until a plan cannot be executed, at that iteration."""
    ego, time_us = course.ego, course.time_us
    for iteration in range(course.first, course.stop):
        row = course.start + iteration
        speed = np.hypot(ego[row, VX], ego[row, VY])
        _go_straight(ego[row, X], ego[row, Y], ego[row, HEADING], speed, states)
        code, status = execute(
            plan_us,
            states,
            time_us[row],
            time_us[row],
            time_us[row + 1],
            row,
            iteration,
            iteration + 1 < course.stop,
            ego,
            course.noise,
            course.commands,
            course.kept,
        )
        if code != GOOD or status != TRACKED:
            return iteration
    return course.stop
