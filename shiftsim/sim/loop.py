"""The closed loop: simulate one scenario with one planner.

Order of one step: the planner sees iteration i; sample i is stored before anything moves; then the
ego moves to i + 1, and the traffic, which still sees the ego of i. The planner is asked T - 1
times; its last answer is never executed, and the state at T - 1 is neither reached nor stored.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np

from shiftsim.errors import ConfigError, DataError, InvalidTrajectoryError, PlannerError, one_of
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import TRACKED, raise_for_status
from shiftsim.sim.dynamics.perfect import KEPT_US, follow_perfectly, sample_poses
from shiftsim.sim.execute import Course, execute
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.noise import NoiseModel, sample_noise
from shiftsim.sim.plan_check import (
    GOOD,
    Fault,
    doubt_of,
    find_fault,
    find_form_fault,
    plain,
)
from shiftsim.sim.planner import (
    BatchPlanner,
    Observation,
    ObservationBuilder,
    Planner,
    rollout_rows,
    scene_info,
)
from shiftsim.sim.traffic import BatchTraffic, LogReplay, Move, Traffic, make_traffic
from shiftsim.sim.traffic.scripted import Scripted
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, Command, Trajectory, center_poses

T = TypeVar("T")
MIN_ITERATIONS = 3
CONTROLLERS = ("lqr", "perfect", "log-playback")


@dataclass(frozen=True, slots=True)
class Setting:
    """How a scenario is driven, whichever scenario and planner it is."""

    # actuation noise, by name or model; added to the command before the motion model
    noise: str | NoiseModel = "none"
    seed: int = 0  # seed of the noise, and of planners that sample
    traffic: str | Traffic = "nonreactive"  # `nonreactive`, `reactive`, or a traffic model
    # `lqr` (tracker and kinematic bicycle), `perfect` (the ego is where the plan says) or `log-
    # playback` (the ego is where the recording was; plans are ignored)
    controller: str = "lqr"
    strict: bool = False  # fail where the planner falls back instead of counting the step

    def __post_init__(self) -> None:
        one_of("controller", self.controller, CONTROLLERS)


DEFAULT = Setting()


class Rollout:
    """One scenario on its way through the closed loop.

    `simulate` and `simulate_together` drive it: see what the planner sees, advance by its answer,
    until it is done.
    """

    def __init__(
        self,
        scenario: Scenario,
        planner: Planner | None,
        setting: Setting = DEFAULT,
        **changes: Any,
    ) -> None:
        """Prepare a scenario and its planner; the arguments and errors are those of `simulate`."""
        self.setting = setting = replace(setting, **changes)
        if planner is None and setting.controller != "log-playback":
            raise ConfigError(
                f"controller {setting.controller!r} needs a planner",
                hint="only log-playback needs none",
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
        self.doubt = ""  # why the first plan is most likely not what was meant
        # nuPlan rule 12: the last answer of the planner is never executed
        self.num_samples = scenario.num_iterations - 1
        self._times = scenario.iteration_times
        rows, start = rollout_rows(scenario)
        self._start = start
        # rows: the past samples, then the iterations; the ego is filled up to the present, the
        # tracks from the log until the traffic rewrites them
        self._time_us = scenario.time_us[rows]
        self._clock: list[int] = self._time_us.tolist()
        self._ego = np.full((len(rows), NUM_STATE), np.nan)
        self._ego[: start + 1] = scenario.ego[rows[: start + 1]]
        self._tracks = scenario.tracks.rows(rows)
        self._lights = scenario.traffic_lights.rows(rows)
        traffic = setting.traffic
        self._traffic = make_traffic(traffic) if isinstance(traffic, str) else traffic
        if scenario.script is not None and scenario.script.has_pedestrians:
            self._traffic = Scripted(self._traffic)
        self._traffic.start(scenario, self._tracks, start)
        self._sight = ObservationBuilder(self._time_us, self._ego, self._tracks, self._lights)
        self._is_tracked = planner is not None and setting.controller == "lqr"
        noise = sample_noise(
            setting.noise, seed=setting.seed, token=scenario.token, num_steps=self.num_samples
        )
        self._noise = plain(noise)
        self._commands = np.full((self.num_samples, 2), np.nan)
        self._plans = np.full((self.num_samples, len(KEPT_US), 3), np.nan)
        self._seconds = np.zeros(self.num_samples)
        self._degraded = np.zeros(self.num_samples, np.bool_)
        if planner is not None:
            planner.reset(scene_info(scenario, setting.seed, planner))

    @property
    def done(self) -> bool:
        """Whether every sample is there."""
        return self.iteration == self.num_samples

    def observe(self) -> Observation:
        """What the planner sees now."""
        return self._sight.at(self.iteration, self._start + self.iteration)

    def advance(self, plan: Trajectory | Command | None, seconds: float = 0.0) -> None:
        """Store this sample, and move the ego and the traffic to the next one.

        The plan took `seconds`; it is None only under log playback without a planner.
        """
        move = self._follow(plan, seconds)
        if move is not None:
            self._traffic.step(*move)
        self._go_on()

    def drive_on(self) -> None:
        """Let the planner take steps at once, as far as it goes, if it can and nothing else acts.

        Each counts with the mean of their times.
        """
        offers = "drive_on" in vars(type(self.planner))  # a class that inherits may plan otherwise
        replays = type(self._traffic) is LogReplay and self.scenario.script is None
        if not (offers and replays and self._is_tracked):
            return
        first, stop = self.iteration, self.num_samples
        arrays = self._ego, self._noise, self._commands, self._plans
        began = perf_counter()
        driven = cast(Any, self.planner).drive_on(
            Course(self._time_us, self._start, first, stop, *arrays)
        )
        self._seconds[first:driven] = (perf_counter() - began) / max(driven - first, 1)
        self.iteration = driven

    def _follow(self, plan: Trajectory | Command | None, seconds: float) -> Move | None:
        """Store this sample and move the ego; what the traffic is to do, None after the last."""
        iteration, row = self.iteration, self._start + self.iteration
        self._seconds[iteration] = seconds
        moves = iteration + 1 < self.num_samples
        if self.planner is not None:
            self._note_fallback()
        # nuPlan rule 13: the ego moves first, and the traffic sees where it was before
        if self._is_tracked and isinstance(plan, Trajectory):
            self._track(plan, moves)
        else:
            if self.planner is not None:
                plan = self._checked(plan)
            if moves:
                self._move_ego(plan)
        return Move(iteration, self._ego[row], self._tracks, row + 1) if moves else None

    def _go_on(self) -> None:
        """Go to the next sample, which may be the last one."""
        self.iteration += 1
        if not self.done and self._is_finished(self._start + self.iteration):
            # nuPlan rule 719: interPlan asks the planner once more where the goal is reached
            self.num_samples = self.iteration + 1

    def _is_finished(self, row: int) -> bool:
        """Whether the ego is where an edit ends the rollout."""
        finish = self.scenario.script.finish if self.scenario.script is not None else None
        if finish is None:
            return False
        x, y, _ = center_poses(self._ego[row : row + 1, :3])[0].tolist()
        return finish.is_reached(self.scenario.map, x, y)

    def _move_ego(self, plan: Trajectory | Command | None) -> None:
        """Write the next state of the ego, and note the command."""
        iteration, row = self.iteration, self._start + self.iteration
        now_us, next_us = self._clock[row], self._clock[row + 1]
        state, after = self._ego[row], self._ego[row + 1]
        noise, command = self._noise[iteration], self._commands[iteration]
        controller = self.setting.controller
        if controller == "log-playback":
            after[:] = self.scenario.ego[self.scenario.iteration_rows[iteration + 1]]
        elif isinstance(plan, Command):
            if controller == "perfect":
                raise ConfigError(
                    "perfect tracking needs a planner that returns a trajectory, not a command",
                    hint="use the controller 'lqr', which sends commands to the motion model",
                )
            command[:] = plan.acceleration, plan.steering_rate
            command_and_step(now_us, next_us, state, command, noise[0], noise[1], after)
        elif isinstance(plan, Trajectory):
            follow_perfectly(plan, next_us, after)

    def _note_fallback(self) -> None:
        """Note whether the plan is a fallback by the planner's own account."""
        iteration = self.iteration
        if reason := getattr(self.planner, "degraded", ""):
            if self.setting.strict:
                raise PlannerError(
                    f"the planner fell back at iteration {iteration}: {reason}",
                    hint="without --strict it continues, and the step is counted as degraded",
                )
            self._degraded[iteration] = True

    def _track(self, plan: Trajectory, moves: bool) -> None:
        """Check a plan, note its poses, and let the tracker follow it."""
        iteration, row = self.iteration, self._start + self.iteration
        now_us, next_us = self._clock[row], self._clock[row + 1]
        self._refuse(find_form_fault(plan))
        times, states = plain(plan.time_us), plain(plan.states)
        code, status = execute(
            times,
            states,
            now_us if plan.relative else 0,
            now_us,
            next_us,
            row,
            iteration,
            moves,
            self._ego,
            self._noise,
            self._commands,
            self._plans,
        )
        if code != GOOD:
            self._refuse(find_fault(plan, now_us, next_us))
        if status != TRACKED:
            raise_for_status(status, now_us, plan.starting_at(now_us).time_us)
        if iteration == 0:
            self.doubt = doubt_of(plan, self._plans[0, 0], self._ego[row])

    def _refuse(self, fault: Fault | None) -> None:
        if fault is not None:
            where = f"iteration {self.iteration}"
            raise InvalidTrajectoryError(f"{where}: {fault.message}", fault.hint)

    def _checked(self, plan: Any) -> Trajectory | Command:
        """The plan in log time; its poses are noted."""
        iteration, row = self.iteration, self._start + self.iteration
        now_us, next_us = self._clock[row], self._clock[row + 1]
        self._refuse(find_fault(plan, now_us, next_us))
        if isinstance(plan, Trajectory):
            time_us = plan.time_us + now_us if plan.relative else plain(plan.time_us)
            plan = Trajectory(time_us, plain(plan.states))
            sample_poses(plan.time_us, plan.states, now_us, KEPT_US, self._plans[iteration])
        return plan

    def log(self) -> SimulationLog:
        """The finished rollout."""
        samples = slice(self._start, self._start + self.num_samples)
        return SimulationLog(
            token=self.scenario.token,
            time_us=self._time_us[samples],
            ego=self._ego[samples],
            tracks=self._tracks.rows(samples),
            traffic_lights=self._lights.rows(samples),
            expert_time_us=self._times,
            expert_ego=self.scenario.expert,
            route=self.scenario.route,
            commands=self._commands[: self.num_samples],
            noise=self._noise[: self.num_samples],
            plans=self._plans[: self.num_samples],
            planning_seconds=self._seconds[: self.num_samples],
            degraded=self._degraded[: self.num_samples],
        )


def simulate(
    scenario: Scenario, planner: Planner | None, setting: Setting = DEFAULT, **changes: Any
) -> SimulationLog:
    """Drive one scenario in closed loop.

    Args:
        scenario: The scenario.
        planner: The planner; None only with `log-playback`, which needs none.
        setting: How it is driven.
        changes: Fields of `Setting` that differ from it: `noise`, `seed`, `traffic`, `controller`,
            `strict`.

    Returns:
        The rollout, K = T - 1 samples.

    Raises:
        ConfigError: A setting is unknown.
        DataError: The scenario has fewer than three iterations.
        PlannerError: The planner returned something that cannot be executed.
    """
    rollout = Rollout(scenario, planner, setting, **changes)
    log = drive(rollout)
    if rollout.doubt:
        warnings.warn(f"{type(planner).__name__}: {rollout.doubt}", stacklevel=2)
    return log


def drive(rollout: Rollout) -> SimulationLog:
    """Drive a fresh rollout to its end; errors are those of `simulate`."""
    planner = rollout.planner
    rollout.drive_on()
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

    The rollouts are fresh. Planners that are forks of one `BatchPlanner` are asked together, and so
    is traffic that is forks of one `BatchTraffic`; others one by one.

    Returns:
        Per rollout its log, or the error that ended it; the others go on.
    """
    ended: dict[int, SimulationLog | Exception] = {}
    while len(ended) < len(rollouts):
        active = [i for i in range(len(rollouts)) if i not in ended]
        plans, seconds = _plans([rollouts[i] for i in active])
        moves: dict[int, Move] = {}
        for index, plan, share in zip(active, plans, seconds, strict=True):
            move = _attempt(partial(_follow, rollouts[index], plan, share))
            if isinstance(move, Exception):
                ended[index] = move
            elif move is not None:
                moves[index] = move
        batch = [i for i in moves if isinstance(rollouts[i]._traffic, BatchTraffic)]
        if batch:
            models = [cast(BatchTraffic, rollouts[i]._traffic) for i in batch]
            models[0].step_batch(models, [moves.pop(i) for i in batch])
        for index, move in moves.items():
            error = _attempt(partial(rollouts[index]._traffic.step, *move))
            if error is not None:
                ended[index] = error
        for index in (i for i in active if i not in ended):
            rollouts[index]._go_on()
            if rollouts[index].done:
                ended[index] = rollouts[index].log()
    return [ended[i] for i in range(len(rollouts))]


Plan: TypeAlias = Trajectory | Command | None


def _plans(rollouts: Sequence[Rollout]) -> tuple[list[Plan | Exception], list[float]]:
    """The next plan of each, or the error in its place, and how long each took [s]."""
    planners = [cast(BatchPlanner, rollout.planner) for rollout in rollouts]
    seen = [rollout.observe() for rollout in rollouts]
    began = perf_counter()
    if isinstance(planners[0], BatchPlanner):
        plans = planners[0].plan_batch(planners, seen)
        return [*plans], [(perf_counter() - began) / len(plans)] * len(plans)
    out, seconds = list[Plan | Exception](), list[float]()
    for planner, observation in zip(planners, seen, strict=True):
        began = perf_counter()
        out.append(_attempt(partial(planner.plan, observation)) if planner is not None else None)
        seconds.append(perf_counter() - began)
    return out, seconds


def _follow(rollout: Rollout, plan: Plan | Exception, seconds: float) -> Move | None:
    if isinstance(plan, Exception):
        raise plan
    return rollout._follow(plan, seconds)


def _attempt(work: Callable[[], T]) -> T | Exception:
    """What it returns, or the error: one scenario fails, its neighbours in the batch do not."""
    try:
        return work()
    except Exception as error:
        return error
