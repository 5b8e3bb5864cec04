"""The closed loop: simulate one scenario with one planner.

Order of one step: the planner sees iteration i; sample i is stored before anything moves; then the
ego moves to i + 1, and the traffic, which still sees the ego of i. The planner is asked T - 1
times; its last answer is never executed, and the state at T - 1 is neither reached nor stored.
"""

import warnings
from collections import deque
from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np

from shiftsim.errors import ConfigError, DataError, InvalidTrajectoryError, PlannerError
from shiftsim.kernels import FloatArray
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.sim.dynamics.perfect import KEPT_US, follow_perfectly, sample_poses
from shiftsim.sim.log import DEFAULT, Setting, SimulationLog, Snapshot
from shiftsim.sim.noise import sample_noise
from shiftsim.sim.plan_check import contiguous, find_fault, find_warning
from shiftsim.sim.planner import (
    BatchPlanner,
    Observation,
    ObservationBuilder,
    Planner,
    rollout_rows,
    scene_info,
)
from shiftsim.sim.traffic import BatchTraffic, Move, make_traffic
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, Command, Trajectory, center_poses

if TYPE_CHECKING:
    from shiftsim.sim.sensing import Sensing

T = TypeVar("T")
P = ParamSpec("P")
Plan: TypeAlias = Trajectory | Command | None
MIN_ITERATIONS = 3


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
        self.warning = ""  # why the first plan is most likely not what was meant
        # nuPlan rule 12: the last answer of the planner is never executed
        self.num_samples = scenario.num_iterations - 1
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
            from shiftsim.sim.traffic.mixed import Scripted  # few scenarios need it

            self._traffic = Scripted(self._traffic)
        self._traffic.start(scenario, self._tracks, start)
        self._is_batch = isinstance(self._traffic, BatchTraffic)  # asked once: it takes long
        self._drift, seed, token = setting.drift, setting.seed, scenario.token
        self._sensing: Sensing | None = None
        self._waiting = deque[Trajectory | Command]()  # plans under way, the next one first
        if late := self._drift.latency:
            from shiftsim.sim.sensing import first_plans  # few runs need it

            self._waiting = first_plans(late, self._ego[: start + 1], self._clock[start])
        arrays = self._time_us, self._ego, self._tracks, self._lights
        self._observations = ObservationBuilder(*arrays)
        self._noise = sample_noise(
            self._drift.noise, seed=seed, token=token, num_steps=self.num_samples
        )
        self._commands = np.full((self.num_samples, 2), np.nan)
        self._plans = np.full((self.num_samples, len(KEPT_US), 3), np.nan)
        self._seconds = np.zeros(self.num_samples)
        self._degraded = np.zeros(self.num_samples, np.bool_)
        if planner is not None:
            self.drive_by(planner)

    @property
    def done(self) -> bool:
        """Whether every sample is there."""
        return self.iteration == self.num_samples

    def observe(self) -> Observation:
        """What the planner sees now."""
        row = self._start + self.iteration
        if self._sensing is not None:
            self._sensing.see(row)
        return self._observations.at(self.iteration, row)

    def advance(self, plan: Plan, seconds: float = 0.0) -> None:
        """Store this sample, and move the ego and the traffic to the next one.

        The plan took `seconds`; it is None only under log playback without a planner.
        """
        if self._follow(plan, seconds):
            row = self._start + self.iteration
            self._traffic.step(self.iteration, self._ego[row].copy(), self._tracks, row + 1)
        self._go_on()

    def _follow(self, plan: Any, seconds: float) -> bool:
        """Store this sample and move the ego; whether the traffic is to move, too."""
        iteration, controller = self.iteration, self.setting.controller
        row = self._start + iteration
        now_us, next_us = self._clock[row : row + 2]
        state, after = self._ego[row], self._ego[row + 1]
        self._seconds[iteration] = seconds
        if self.planner is not None:
            self._note_fallback()
            plan = executable(plan, now_us, next_us, f"iteration {iteration}: ")
            if self._sensing is not None:
                plan = self._sensing.to_truth(plan, row)
            if isinstance(plan, Trajectory):
                poses = self._plans[iteration]
                sample_poses(plan.time_us, plan.states, now_us, KEPT_US, poses)
                if iteration == 0 and controller == "lqr":
                    self.warning = find_warning(plan, poses[0], state)
        if iteration + 1 == self.num_samples:
            return False
        if plan is not None and self._waiting:
            from shiftsim.sim.sensing import exchange

            plan = exchange(self._waiting, plan, next_us)
        # nuPlan rule 13: the ego moves first, and the traffic sees where it was before
        if plan is None or controller == "log-playback":
            after[:] = self.scenario.ego[self.scenario.iteration_rows[iteration + 1]]
        elif controller == "lqr":
            command, noise = self._commands[iteration], self._noise[iteration]
            follow(plan, (now_us, next_us), (state, after), command, noise)
        elif isinstance(plan, Command):
            raise ConfigError(
                "perfect tracking needs a planner that returns a trajectory, not a command",
                hint="use the controller 'lqr', which sends commands to the motion model",
            )
        else:
            follow_perfectly(plan, next_us, after)
        return True

    def _go_on(self) -> None:
        """Go to the next sample, which may be the last one."""
        self.iteration += 1
        script = self.scenario.script
        if self.done or script is None or script.termination is None:
            return
        row = self._start + self.iteration
        x, y, _ = center_poses(self._ego[row : row + 1, :3])[0].tolist()
        if script.termination.is_reached(self.scenario.map, x, y):
            # nuPlan rule 719: interPlan asks the planner once more where the goal is reached
            self.num_samples = self.iteration + 1

    def _note_fallback(self) -> None:
        """Note whether the plan is a fallback by the planner's own account."""
        if reason := getattr(self.planner, "degraded", ""):
            if self.setting.strict:
                raise PlannerError(
                    f"the planner fell back at iteration {self.iteration}: {reason}",
                    hint="without --strict it continues, and the step is counted as degraded",
                )
            self._degraded[self.iteration] = True

    def snapshot(self, action: Any = None) -> Snapshot:
        """What a rollout can go on from as this one would; `action` is kept with it.

        Raises:
            DataError: The rollout has ended.
        """
        if self.done:
            raise DataError(f"the rollout of {self.scenario.token!r} has ended")
        names: Any = {}
        for name in ("noise", "perception", "localization", "traffic"):
            if not isinstance(given := getattr(self.setting, name), str):
                names[name] = type(given).__name__ if name == "traffic" else given.name
        # views: nobody writes to the rows that lie behind
        past, ego = slice(self.iteration), self._ego[self._start :][: self.iteration + 1]
        parts = ego, self._commands[past], self._seconds[past], self._degraded[past]
        token, setting = self.scenario.token, replace(self.setting, **names)
        return Snapshot(token, setting, *parts, tuple(self._waiting), action, self.scenario)

    def resume(self, snapshot: Snapshot) -> None:
        """Come to where another rollout was that has been where this one is, or is fresh.

        The planner is not asked before, so it remembers nothing, and its plans are not there.

        Raises:
            DataError: The snapshot is of another scenario or latency, or the scenario has ended
                before.
        """
        if snapshot.token != self.scenario.token or snapshot.iteration >= self.num_samples:
            raise DataError(f"{snapshot!r} is none of scenario {self.scenario.token!r}")
        if len(snapshot.plans) != len(self._waiting):
            raise DataError(f"{snapshot!r} has {len(snapshot.plans)} plans under way")
        self._waiting = deque(snapshot.plans)
        past = slice(snapshot.iteration)
        self._ego[self._start : self._start + snapshot.iteration + 1] = snapshot.ego
        self._commands[past], self._seconds[past] = snapshot.commands, snapshot.planning_seconds
        self._degraded[past] = snapshot.degraded
        begin, end = self._start + self.iteration, self._start + snapshot.iteration
        if step_many := getattr(self._traffic, "step_many", None):
            step_many(self.iteration, self._ego[begin:end], self._tracks, begin + 1)
        for row in range(begin, end):
            if step_many is None:
                self._traffic.step(self.iteration, self._ego[row], self._tracks, row + 1)
            self._go_on()

    def fork(self) -> "Rollout":
        """Another rollout that has come as far, without a planner; it observes the truth."""
        other, scenario = copy(self), self.scenario
        for name in ("_ego", "_tracks", "_commands", "_plans", "_seconds", "_degraded"):
            setattr(other, name, getattr(self, name).copy())
        arrays = other._time_us, other._ego, other._tracks, other._lights
        other._observations, other.planner = ObservationBuilder(*arrays), None
        other._sensing, other._waiting = None, self._waiting.copy()
        shared = {id(one): one for one in (scenario, scenario.map)}
        other._traffic = deepcopy(self._traffic, shared)
        return other

    def drive_by(self, planner: Planner) -> None:
        """Have a planner drive from here on."""
        self.planner, believed = planner, None
        if self._drift.senses:
            from shiftsim.sim.sensing import Sensing  # few runs need it

            key, truth = (self.setting.seed, self.scenario.token), (self._ego, self._tracks)
            self._sensing = sensing = Sensing(self._drift, *key, truth)
            sensing.see(self._start)
            believed, seen = sensing.ego[self._start, :3], (sensing.ego, sensing.tracks)
            self._observations = ObservationBuilder(self._time_us, *seen, self._lights)
        planner.reset(scene_info(self.scenario, self.setting.seed, planner, believed))

    def log(self) -> SimulationLog:
        """The finished rollout."""
        samples = slice(self._start, self._start + self.num_samples)
        return SimulationLog(
            token=self.scenario.token,
            time_us=self._time_us[samples],
            ego=self._ego[samples],
            tracks=self._tracks.rows(samples),
            traffic_lights=self._lights.rows(samples),
            expert_time_us=self.scenario.iteration_times,
            expert_ego=self.scenario.expert,
            route=self.scenario.route,
            commands=self._commands[: self.num_samples],
            noise=self._noise[: self.num_samples],
            plans=self._plans[: self.num_samples],
            planning_seconds=self._seconds[: self.num_samples],
            degraded=self._degraded[: self.num_samples],
            seen=self._sensing.seen(samples) if self._sensing else None,
        )


def executable(plan: Any, now_us: int, next_us: int, where: str = "") -> Trajectory | Command:
    """A planner's answer in log time, as kernels take it.

    Raises:
        InvalidTrajectoryError: It cannot be executed from one time stamp to the next [us].
    """
    fault = find_fault(plan, now_us, next_us)
    if fault is not None:
        raise InvalidTrajectoryError(f"{where}{fault.message}", fault.hint)
    if isinstance(plan, Command):
        return plan
    times = plan.time_us + now_us if plan.relative else contiguous(plan.time_us)
    return Trajectory(times, contiguous(plan.states))


def follow(
    plan: Trajectory | Command,
    step: tuple[int, int],  # time stamps of both states [us]
    states: tuple[FloatArray, FloatArray],  # (11,) of the vehicle, and the next one, to be written
    command: FloatArray,  # (2,) receives the command, to which the noise (2,) is added
    noise: FloatArray,
) -> None:
    """Move a vehicle by an executable plan: tracker and kinematic bicycle, or that alone."""
    (now_us, next_us), (state, after), (accel, rate) = step, states, noise.tolist()
    if isinstance(plan, Command):
        command[:] = plan.acceleration, plan.steering_rate
        command_and_step(now_us, next_us, state, command, accel, rate, after)
        return
    plan_us, poses = plan.time_us, plan.states
    status = track_and_step(now_us, next_us, state, plan_us, poses, accel, rate, after, command)
    raise_for_status(status, now_us, plan_us)


def simulate(
    scenario: Scenario, planner: Planner | None, setting: Setting = DEFAULT, **changes: Any
) -> SimulationLog:
    """Drive one scenario in closed loop; arguments and errors are those of `shiftsim.simulate`."""
    rollout = Rollout(scenario, planner, setting, **changes)
    log = drive(rollout)
    if rollout.warning:
        warnings.warn(f"{type(planner).__name__}: {rollout.warning}", stacklevel=2)
    return log


def plans_on_recording(
    scenario: Scenario, planner: Planner, every: int, *, seed: int = 0
) -> list[Trajectory]:
    """The plans of every n-th iteration, in log time, where all drive as they were recorded.

    Raises:
        PlannerError: The planner failed, or returns commands.
    """
    rollout, plans = Rollout(scenario, planner, seed=seed, controller="log-playback"), []
    while not rollout.done:
        observation = rollout.observe()
        plan = planner.plan(observation)
        rollout.advance(plan)
        if observation.iteration % every == 0:
            if not isinstance(plan, Trajectory):
                raise PlannerError(
                    "open loop compares trajectories, and the planner returns commands",
                    hint="return a shiftsim.Trajectory",
                )
            plans.append(plan.starting_at(observation.time_us))
    return plans


def drive(rollout: Rollout) -> SimulationLog:
    """Drive a fresh rollout to its end; errors are those of `simulate`."""
    planner = rollout.planner
    while not rollout.done:
        plan, seconds = None, 0.0
        if planner is not None:
            observation = rollout.observe()
            began = perf_counter()
            plan = planner.plan(observation)
            seconds = perf_counter() - began
        rollout.advance(plan, seconds)
    return rollout.log()


def simulate_together(
    rollouts: Sequence[Rollout], steps: int | None = None
) -> list[SimulationLog | Exception]:
    """Drive several scenarios in lock step, so that their planners share one forward pass.

    Each goes to its end, or as many steps as are given. Planners that are forks of one
    `BatchPlanner` are asked together, and so is traffic that is forks of one `BatchTraffic`; others
    one by one.

    Returns:
        Per rollout its log, or the error that ended it; the others go on.
    """
    ended: dict[int, SimulationLog | Exception] = {}
    while len(ended) < len(rollouts) and steps != 0:
        steps = None if steps is None else steps - 1
        active = [i for i in range(len(rollouts)) if i not in ended]
        plans, seconds = _plans([rollouts[i] for i in active])
        moves: dict[int, Move] = {}
        for index, plan, share in zip(active, plans, seconds, strict=True):
            rollout = rollouts[index]
            moved = plan if isinstance(plan, Exception) else _attempt(rollout._follow, plan, share)
            if isinstance(moved, Exception):
                ended[index] = moved
            elif moved:
                at, row = rollout.iteration, rollout._start + rollout.iteration
                moves[index] = Move(at, rollout._ego[row].copy(), rollout._tracks, row + 1)
        batch = [i for i in moves if rollouts[i]._is_batch]
        if batch:
            models = [cast(BatchTraffic, rollouts[i]._traffic) for i in batch]
            models[0].step_batch(models, [moves.pop(i) for i in batch])
        for index, move in moves.items():
            error = _attempt(rollouts[index]._traffic.step, *move)
            if error is not None:
                ended[index] = error
        for index in (i for i in active if i not in ended):
            rollouts[index]._go_on()
            if rollouts[index].done:
                ended[index] = rollouts[index].log()
    return [ended.get(i) or rollout.log() for i, rollout in enumerate(rollouts)]


def _plans(rollouts: Sequence[Rollout]) -> tuple[list[Plan | Exception], list[float]]:
    """The next plan of each, or the error in its place, and how long each took [s]."""
    planners = [rollout.planner for rollout in rollouts]
    seen = [rollout.observe() for rollout in rollouts]
    began = perf_counter()
    if isinstance(planners[0], BatchPlanner):
        plans = planners[0].plan_batch(cast(list[BatchPlanner], planners), seen)
        return [*plans], [(perf_counter() - began) / len(plans)] * len(plans)
    out, seconds = list[Plan | Exception](), list[float]()
    for planner, observation in zip(planners, seen, strict=True):
        began = perf_counter()
        out.append(_attempt(planner.plan, observation) if planner is not None else None)
        seconds.append(perf_counter() - began)
    return out, seconds


def _attempt(work: Callable[P, T], *args: P.args, **keywords: P.kwargs) -> T | Exception:
    """What it returns, or the error: one scenario fails, its neighbours in the batch do not."""
    try:
        return work(*args, **keywords)
    except Exception as error:
        return error
