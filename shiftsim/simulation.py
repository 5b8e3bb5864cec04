"""The closed loop: simulate one scenario with one planner.

Order of one step (nuplan-simulation.md §2): the planner sees iteration i; sample i is stored before
anything moves; then the ego moves to i + 1, and the traffic, which still sees the ego of i. The
planner is asked T - 1 times; its last answer is never executed, and the state at T - 1 is neither
reached nor stored.
"""

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.dynamics.bicycle import command_and_step
from shiftsim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.dynamics.perfect import follow_perfectly, sample_poses
from shiftsim.errors import ConfigError, DataError
from shiftsim.log import SimulationLog
from shiftsim.noise import NoiseModel, sample_noise
from shiftsim.plan_check import validate_plan
from shiftsim.planner import History, Observation, Planner, SceneInfo
from shiftsim.scenario import Scenario
from shiftsim.state import (
    NUM_STATE,
    PACIFICA,
    Command,
    Tracks,
    TrafficLights,
    Trajectory,
)
from shiftsim.traffic import Traffic, make_traffic

HISTORY_SAMPLES = 22  # 2.1 s and the present; nuPlan: not 2.0 s (nuplan-simulation.md §12 Q3)
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


def simulate(
    scenario: Scenario,
    planner: Planner | None,
    *,
    noise: str | NoiseModel = "none",
    seed: int = 0,
    traffic: str | Traffic = "nonreactive",
    controller: str = "lqr",
) -> SimulationLog:
    """Drive one scenario in closed loop.

    Args:
        scenario: The scenario.
        planner: The planner; None only with `log-playback`, which needs none.
        noise: Actuation noise, by name or model; added to the command before the motion model.
        seed: Seed of the noise.
        traffic: `nonreactive`, `reactive`, or a traffic model.
        controller: `lqr` (tracker and kinematic bicycle), `perfect` (the ego is where the plan
            says) or `log-playback` (the ego is where the recording was; plans are ignored).

    Returns:
        The rollout, K = T - 1 samples.

    Raises:
        ConfigError: An argument is unknown.
        DataError: The scenario has fewer than three iterations.
        PlannerError: The planner returned something that cannot be executed.
    """
    if controller not in CONTROLLERS or (planner is None and controller != "log-playback"):
        raise ConfigError(
            f"controller {controller!r} with planner {planner!r} is not possible",
            hint=f"controllers: {', '.join(CONTROLLERS)}; only log-playback needs no planner",
        )
    num_samples = scenario.num_iterations - 1
    if scenario.num_iterations < MIN_ITERATIONS:
        raise DataError(
            f"scenario {scenario.token!r} (log {scenario.log_name!r}) has "
            f"{scenario.num_iterations} iterations; at least {MIN_ITERATIONS} are needed",
            hint="convert it with a longer duration, or leave it out",
        )
    model = make_traffic(traffic) if isinstance(traffic, str) else traffic
    added = sample_noise(noise, seed=seed, token=scenario.token, num_steps=num_samples)
    buffer = _make_buffer(scenario)
    expert_time_us = scenario.iteration_times
    model.start(scenario, buffer.tracks, buffer.start)
    commands = np.full((num_samples, 2), np.nan)
    plans = np.full((num_samples, PLAN_SAMPLES, 3), np.nan)
    planning_seconds = np.zeros(num_samples)
    if planner is not None:
        planner.reset(_scene_info(scenario))
    for iteration in range(num_samples):
        plan = None
        if planner is not None:
            observation = buffer.observation(iteration)
            began = perf_counter()
            plan = planner.plan(observation)
            planning_seconds[iteration] = perf_counter() - began
            next_us = int(expert_time_us[iteration + 1])
            if isinstance(plan, Trajectory):
                plan = plan.starting_at(observation.time_us)
                validate_plan(plan, observation.time_us, next_us)
                sample_poses(plan.time_us, plan.states, observation.time_us, plans[iteration])
            else:
                validate_plan(plan, observation.time_us, next_us)
        if iteration + 1 < num_samples:
            row = buffer.start + iteration
            if controller == "log-playback":
                buffer.ego[row + 1] = scenario.ego[scenario.iteration_rows[iteration + 1]]
            else:
                _advance(controller, buffer, row, plan, added[iteration], commands[iteration])
            model.step(iteration, buffer.ego[row], buffer.tracks, row + 1)
    samples = slice(buffer.start, buffer.start + num_samples)
    return SimulationLog(
        token=scenario.token,
        time_us=buffer.time_us[samples],
        ego=buffer.ego[samples],
        tracks=buffer.tracks.rows(samples),
        traffic_lights=buffer.lights.rows(samples),
        expert_time_us=expert_time_us,
        expert_ego=scenario.expert,
        route=scenario.route,
        commands=commands,
        noise=added,
        plans=plans,
        planning_seconds=planning_seconds,
    )


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
    first = int(scenario.iteration_rows[0])
    past = np.arange(first - (HISTORY_SAMPLES - 1) * scenario.row_step, first, scenario.row_step)
    rows = np.concatenate([past[past >= 0], scenario.iteration_rows])
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


def _scene_info(scenario: Scenario) -> SceneInfo:
    return SceneInfo(
        map=scenario.map,
        route=scenario.route,
        goal=scenario.mission_goal,
        dt=float(np.diff(scenario.iteration_times).mean() * 1e-6),
        token=scenario.token,
        expert=scenario,
        vehicle=PACIFICA,
    )
