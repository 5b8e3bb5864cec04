"""The closed loop: simulate one scenario with one planner.

Order of one step (nuplan-simulation.md §2): the planner sees iteration i; sample i is stored before
anything moves; then the ego moves to i + 1, and the traffic, which still sees the ego of i. The
planner is asked T - 1 times; its last answer is never executed, and the state at T - 1 is neither
reached nor stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import cast

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import ConfigError, DataError, PlannerError
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.sim.dynamics.perfect import follow_perfectly, sample_poses
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.noise import NoiseModel, sample_noise
from shiftsim.sim.observation import HISTORY_SAMPLES, past_rows, scene_info
from shiftsim.sim.plan_check import validate_plan
from shiftsim.sim.planner import BatchPlanner, History, Observation, Planner
from shiftsim.sim.traffic import Traffic, make_traffic
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    NUM_STATE,
    Command,
    Tracks,
    TrafficLights,
    Trajectory,
)

PLAN_SAMPLES = 11  # first second of a plan, every 0.1 s
MIN_ITERATIONS = 3
CONTROLLERS = ("lqr", "perfect", "log-playback")


@dataclass(frozen=True, slots=True)
class _Buffer:
    """Rows of a rollout: the past samples, then the iterations. B rows.

    Attributes:
        start: Row of iteration 0.
        time_us: (B,) time stamps [us].
        ego: (B, 11) ego states, filled up to the present.
        tracks: Tracks, filled from the log; traffic models rewrite them.
        lights: Lights.
    """

    start: int
    time_us: IntArray
    ego: FloatArray
    tracks: Tracks
    lights: TrafficLights

    def observation(self, iteration: int) -> Observation:
        row = self.start + iteration
        span = slice(max(0, row + 1 - HISTORY_SAMPLES), row + 1)
        history = History(self.time_us[span], self.ego[span], self.tracks.rows(span))
        lights = self.lights.rows(slice(row, row + 1))
        return Observation(iteration, int(self.time_us[row]), history, lights)


class Rollout:
    """One scenario on its way through the closed loop.

    `simulate` and `simulate_together` drive it: see what the planner sees, advance by its answer,
    until it is done.
    """

    def __init__(
        self,
        scenario: Scenario,
        planner: Planner | None,
        *,
        noise: str | NoiseModel = "none",
        seed: int = 0,
        traffic: str | Traffic = "nonreactive",
        controller: str = "lqr",
        strict: bool = False,
    ) -> None:
        """Prepare a scenario and its planner; the arguments and errors are those of `simulate`."""
        if controller not in CONTROLLERS or (planner is None and controller != "log-playback"):
            raise ConfigError(
                f"controller {controller!r} with planner {planner!r} is not possible",
                hint=f"controllers: {', '.join(CONTROLLERS)}; only log-playback needs no planner",
            )
        if scenario.num_iterations < MIN_ITERATIONS:
            raise DataError(
                f"scenario {scenario.token!r} (log {scenario.log_name!r}) has "
                f"{scenario.num_iterations} iterations; at least {MIN_ITERATIONS} are needed",
                hint="convert it with a longer duration, or leave it out",
            )
        self.scenario = scenario
        self.planner = planner
        self.iteration = 0
        self.num_samples = scenario.num_iterations - 1
        self._controller = controller
        self._strict = strict
        self._traffic = make_traffic(traffic) if isinstance(traffic, str) else traffic
        self._noise = sample_noise(
            noise, seed=seed, token=scenario.token, num_steps=self.num_samples
        )
        self._times = scenario.iteration_times
        self._buffer = _make_buffer(scenario)
        self._traffic.start(scenario, self._buffer.tracks, self._buffer.start)
        self._commands = np.full((self.num_samples, 2), np.nan)
        self._plans = np.full((self.num_samples, PLAN_SAMPLES, 3), np.nan)
        self._seconds = np.zeros(self.num_samples)
        self._degraded = np.zeros(self.num_samples, np.bool_)
        if planner is not None:
            planner.reset(scene_info(scenario, seed))

    @property
    def done(self) -> bool:
        """Whether every sample is there."""
        return self.iteration == self.num_samples

    def observe(self) -> Observation:
        """What the planner sees now."""
        return self._buffer.observation(self.iteration)

    def advance(self, plan: Trajectory | Command | None, seconds: float = 0.0) -> None:
        """Store this sample, and move the ego and the traffic to the next one.

        Args:
            plan: The planner's answer; None only under log playback without a planner.
            seconds: How long it took [s].
        """
        iteration, buffer = self.iteration, self._buffer
        row = buffer.start + iteration
        self._seconds[iteration] = seconds
        if plan is not None:
            plan = self._checked(plan)
        if iteration + 1 < self.num_samples:
            if self._controller == "log-playback":
                rows = self.scenario.iteration_rows
                buffer.ego[row + 1] = self.scenario.ego[rows[iteration + 1]]
            else:
                noise, command = self._noise[iteration], self._commands[iteration]
                _advance(self._controller, buffer, row, plan, noise, command)
            self._traffic.step(iteration, buffer.ego[row], buffer.tracks, row + 1)
        self.iteration += 1

    def _checked(self, plan: Trajectory | Command) -> Trajectory | Command:
        """The plan in log time; its first second and whether it is a makeshift are noted."""
        now_us = int(self._buffer.time_us[self._buffer.start + self.iteration])
        next_us = int(self._times[self.iteration + 1])
        if reason := getattr(self.planner, "degraded", ""):
            if self._strict:
                raise PlannerError(
                    f"the planner fell back at iteration {self.iteration}: {reason}",
                    hint="without --strict it continues, and the step is counted as degraded",
                )
            self._degraded[self.iteration] = True
        if not isinstance(plan, Trajectory):
            validate_plan(plan, now_us, next_us)
            return plan
        plan = plan.starting_at(now_us)
        validate_plan(plan, now_us, next_us)
        sample_poses(plan.time_us, plan.states, now_us, self._plans[self.iteration])
        return plan

    def log(self) -> SimulationLog:
        """The finished rollout."""
        buffer = self._buffer
        samples = slice(buffer.start, buffer.start + self.num_samples)
        return SimulationLog(
            token=self.scenario.token,
            time_us=buffer.time_us[samples],
            ego=buffer.ego[samples],
            tracks=buffer.tracks.rows(samples),
            traffic_lights=buffer.lights.rows(samples),
            expert_time_us=self._times,
            expert_ego=self.scenario.expert,
            route=self.scenario.route,
            commands=self._commands,
            noise=self._noise,
            plans=self._plans,
            planning_seconds=self._seconds,
            degraded=self._degraded,
        )


def simulate(
    scenario: Scenario,
    planner: Planner | None,
    *,
    noise: str | NoiseModel = "none",
    seed: int = 0,
    traffic: str | Traffic = "nonreactive",
    controller: str = "lqr",
    strict: bool = False,
) -> SimulationLog:
    """Drive one scenario in closed loop.

    Args:
        scenario: The scenario.
        planner: The planner; None only with `log-playback`, which needs none.
        noise: Actuation noise, by name or model; added to the command before the motion model.
        seed: Seed of the noise, and of planners that sample.
        traffic: `nonreactive`, `reactive`, or a traffic model.
        controller: `lqr` (tracker and kinematic bicycle), `perfect` (the ego is where the plan
            says) or `log-playback` (the ego is where the recording was; plans are ignored).
        strict: Fail where the planner falls back to a makeshift instead of counting the step.

    Returns:
        The rollout, K = T - 1 samples.

    Raises:
        ConfigError: An argument is unknown.
        DataError: The scenario has fewer than three iterations.
        PlannerError: The planner returned something that cannot be executed.
    """
    rollout = Rollout(
        scenario,
        planner,
        noise=noise,
        seed=seed,
        traffic=traffic,
        controller=controller,
        strict=strict,
    )
    while not rollout.done:
        plan, seconds = None, 0.0
        if planner is not None:
            observation = rollout.observe()
            began = perf_counter()
            plan = planner.plan(observation)
            seconds = perf_counter() - began
        rollout.advance(plan, seconds)
    return rollout.log()


def simulate_together(rollouts: Sequence[Rollout]) -> list[SimulationLog | Exception]:
    """Drive several scenarios in lock step, so that their planners share one forward pass.

    Args:
        rollouts: Fresh rollouts, each with a planner of its own; the planners are forks of one
            `BatchPlanner`.

    Returns:
        Per rollout its log, or the error that ended it; the others go on.
    """
    ended: dict[int, SimulationLog | Exception] = {}
    while len(ended) < len(rollouts):
        active = [i for i in range(len(rollouts)) if i not in ended]
        planners = [cast(BatchPlanner, rollouts[i].planner) for i in active]
        observations = [rollouts[i].observe() for i in active]
        began = perf_counter()
        plans = planners[0].plan_batch(planners, observations)
        share = (perf_counter() - began) / len(active)
        for index, plan in zip(active, plans, strict=True):
            outcome = _advanced(rollouts[index], plan, share)
            if outcome is not None:
                ended[index] = outcome
    return [ended[i] for i in range(len(rollouts))]


def _advanced(
    rollout: Rollout, plan: Trajectory | Command | Exception, seconds: float
) -> SimulationLog | Exception | None:
    """How a rollout ended with this step; None while it goes on."""
    if isinstance(plan, Exception):
        return plan
    try:
        rollout.advance(plan, seconds)
    except Exception as error:  # one scenario fails, its neighbours in the batch do not
        return error
    return rollout.log() if rollout.done else None


def _advance(
    controller: str,
    buffer: _Buffer,
    row: int,
    plan: Trajectory | Command | None,
    noise: FloatArray,
    command: FloatArray,
) -> None:
    """Move the ego from `row` to the next one, and note the command in `command`."""
    now_us, next_us = buffer.time_us[row], buffer.time_us[row + 1]
    state, after = buffer.ego[row], buffer.ego[row + 1]
    if isinstance(plan, Command):
        if controller == "perfect":
            raise ConfigError(
                "perfect tracking needs a planner that returns a trajectory, not a command",
                hint="use the controller 'lqr', which sends commands to the motion model",
            )
        command[:] = plan.acceleration, plan.steering_rate
        command_and_step(now_us, next_us, state, command, noise[0], noise[1], after)
    elif isinstance(plan, Trajectory) and controller == "perfect":
        follow_perfectly(plan, int(next_us), after)
    elif isinstance(plan, Trajectory):
        status = track_and_step(
            now_us, next_us, state, plan.time_us, plan.states, noise[0], noise[1], after, command
        )
        raise_for_status(status, int(now_us), plan.time_us)


def _make_buffer(scenario: Scenario) -> _Buffer:
    """Rows from up to 2.2 s before iteration 0 to the last iteration, filled from the log.

    nuPlan asks for 22 past samples and drops the oldest when the present one arrives; samples that
    the log does not have are missing silently (nuplan-simulation.md §1, §2).
    """
    rows = np.concatenate([past_rows(scenario, 0)[:-1], scenario.iteration_rows])
    start = len(rows) - scenario.num_iterations
    ego = np.full((len(rows), NUM_STATE), np.nan)
    ego[: start + 1] = scenario.ego[rows[: start + 1]]
    return _Buffer(
        start,
        scenario.time_us[rows],
        ego,
        scenario.tracks.rows(rows),
        scenario.traffic_lights.rows(rows),
    )
