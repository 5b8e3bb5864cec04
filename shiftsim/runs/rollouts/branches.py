"""Branches of rollouts: K plans driven from one snapshot, and what each of them is worth.

A branch follows its plan, or follows it for a while and leaves the rest to a planner. Its parts are
those of NAVSIM's EPDMS over all that it has driven, among what the others really did there.

Array axes: N snapshots, K plans of each, H poses of a plan, T = steps + 1 states.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, DataError, ShiftsimError
from shiftsim.geometry.boxes import boxes_to_corners, from_frame
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics import navsim
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.pdm.scorer import TTC_STEPS
from shiftsim.planners.proposals import contacts
from shiftsim.planners.registry import load_planner
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import (
    MIN_POSES,
    NOT_COVERED,
    NUPLAN,
    TOO_SHORT,
    TRACKED,
    aim,
    command,
    fit_profiles,
    num_resampled,
    raise_for_status,
)
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.log import Setting, Snapshot
from shiftsim.sim.loop import Rollout, simulate_together
from shiftsim.sim.planner import BatchPlanner, Planner
from shiftsim.sim.traffic import traffic_name
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, Command, Tracks, Trajectory

_PAST = 15  # states before the present that comfort looks back on
_TTC = TTC_STEPS[-1]  # steps that the time to collision looks ahead
PARTS = (
    *navsim.VERSIONS["v2"].multipliers,
    "time_to_collision_within_bound",
    "lane_keeping",
    "history_comfort",
    "progress_m",
)
FIRST = {  # those that are violated at a step, and what NAVSIM's scores call it
    "no_at_fault_collisions": "collision_index",
    "drivable_area_compliance": "off_road_index",
    "driving_direction_compliance": "wrong_way_index",
    "traffic_light_compliance": "red_light_index",
    "time_to_collision_within_bound": "ttc_index",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Branches:
    """What was driven, and how. `lead` is (K,) for one snapshot, and (N, K) for a list of them.

    A branch that failed has NaN for states and parts.

    Attributes:
        states: (*lead, T, 11) ego states, the present one first.
        parts: (*lead,) each, by name, as of `navsim.Scores` in version v2; `progress_m` is along
            the centerline [m].
        first: (*lead,) step of the first violation of a part, inf without one; comfort, whose
            filters look at the whole, and `lane_keeping` have none.
        errors: (*lead,) why a branch failed, else empty.
    """

    states: FloatArray
    parts: dict[str, FloatArray]
    first: dict[str, FloatArray]
    errors: np.ndarray

    def __repr__(self) -> str:
        return f"<Branches: {self.errors.shape}, {self.states.shape[-2] - 1} steps each>"


def branch(
    snapshot: Snapshot | Sequence[Snapshot],
    plans: FloatArray,
    steps: int = 80,
    *,
    spacing: float = 0.1,
    follow: int | None = None,
    planner: str | Planner = "",
    store: Any = None,
    setting: Setting | None = None,
) -> Branches:
    """Drive several plans from one state each, and rate what comes of them.

    Args:
        snapshot: Where they begin, or N of them.
        plans: (K, H, 3), or (N, K, H, 3): rear axle x [m], y [m], heading [rad] in the frame of the
            ego, at `spacing`, twice that, … from now.
        steps: How many steps of 0.1 s are driven.
        spacing: Time between two poses [s].
        follow: Steps after which the planner goes on; all if None.
        planner: By name, or one that is copied for every branch. It is first asked there.
        store: Where the scenarios are, of snapshots from other processes.
        setting: In place of the snapshot's, which names models of one's own only.

    Raises:
        ConfigError: Plans do not fit or are too short, or the controller is not `lqr`.
        DataError: The scenario is not there, or ends before.

    Example:
        ```python
        import numpy as np
        from shiftsim.sim.loop import Rollout

        scenario = shiftsim.open_store("demo")["01f13e"]
        rollout = Rollout(scenario, shiftsim.load_planner("idm"))
        ahead = 0.6 * np.arange(1, 41)  # m, at 6 m/s
        plans = np.stack([np.stack([ahead, by * ahead, 0.0 * ahead], -1) for by in (0.0, 0.1)])
        found = shiftsim.branch(rollout.snapshot(), plans, steps=40)
        print(found.parts["progress_m"], found.first["drivable_area_compliance"])
        ```
    """
    plans = np.asarray(plans, np.float64)
    rest = (steps, spacing, follow, planner)
    if isinstance(snapshot, Snapshot):
        return _branch(_start(snapshot, store, setting), snapshot, plans, *rest)
    if len(plans) != len(snapshot) or not len(plans):
        raise ConfigError(f"{len(snapshot)} snapshots, and plans for {len(plans)} of them")
    pairs = zip(snapshot, plans, strict=True)
    found = [_branch(_start(one, store, setting), one, own, *rest) for one, own in pairs]
    return Branches(
        states=np.stack([one.states for one in found]),
        parts={name: np.stack([one.parts[name] for one in found]) for name in PARTS},
        first={name: np.stack([one.first[name] for one in found]) for name in FIRST},
        errors=np.stack([one.errors for one in found]),
    )


def _start(snapshot: Snapshot, store: Any, setting: Setting | None) -> Rollout:
    """The rollout that has come to a snapshot, without a planner."""
    if snapshot.scenario is None and store is None:
        raise DataError(
            f"{snapshot!r} is from another process, without its scenario",
            hint="give the store that has it: store=shiftsim.open_store(NAME)",
        )
    setting = setting or snapshot.setting
    if setting.controller != "lqr":
        raise ConfigError(f"branches need the controller 'lqr', not {setting.controller}")
    scenario = snapshot.scenario or store.read(snapshot.token)
    rollout = Rollout(scenario, ConstantVelocity(), setting).fork()
    rollout.resume(snapshot)
    return rollout


def _branch(
    rollout: Rollout,
    snapshot: Snapshot,
    plans: FloatArray,
    steps: int,
    spacing: float,
    follow: int | None,
    planner: str | Planner,
) -> Branches:
    """All branches of one snapshot, to which a rollout has come; arguments as of `branch`."""
    follow = steps if follow is None or not planner else min(follow, steps)
    log, now, ego = rollout.log(), snapshot.iteration, snapshot.ego[-1]
    left = rollout.num_samples - 1 - now
    if not 1 <= steps <= left or not follow:
        raise DataError(f"{steps} steps, {follow} by plan: {snapshot!r} has {left} left")
    if plans.ndim != 3 or plans.shape[2] != 3 or not plans.size or not np.isfinite(plans).all():
        raise ConfigError(f"plans must be finite and (K, H, 3), not {plans.shape}")
    if round(10 * spacing * plans.shape[1]) < follow:
        raise ConfigError(
            f"plans of {spacing * plans.shape[1]:g} s are too short for {follow} steps",
            hint="drive fewer steps, or let a planner go on: follow=…, planner=…",
        )
    plan_us = log.time_us[now] + np.rint(1e6 * spacing * np.arange(plans.shape[1] + 1))
    times = log.time_us[now : now + follow + 1], plan_us.astype(np.int64)
    states = np.zeros((len(plans), plans.shape[1] + 1, NUM_STATE))
    states[:, 0, :3], states[:, 1:, :3] = ego[:3], from_frame(plans, ego[:3])
    commands = np.empty((len(plans), follow, 2))
    driven = np.empty((len(plans), follow + 1, NUM_STATE))
    driven[:, 0] = ego
    if late := min(len(snapshot.plans), follow):  # what all do before their plans arrive
        before = rollout.fork()
        for _ in range(late):
            before.advance(Command(0.0, 0.0))  # is not followed any more
        driven[:, : late + 1] = before.log().ego[now : now + late + 1]
        commands[:, :late] = before.log().commands[now : now + late]
    noise = log.noise[now : now + follow]
    status = follow_plans(*times, states, late, noise, driven, commands)
    raise_for_status(int(status), int(times[0][0]), times[1])
    # whether the others do the same whatever the ego does
    named, script = rollout.setting.traffic, rollout.scenario.script
    is_replayed = isinstance(named, str) and traffic_name(named) == "nonreactive"
    is_replayed = is_replayed and not (script is not None and script.has_pedestrians)
    forks, errors = list[Rollout](), np.full(len(plans), "", object)
    if is_replayed and follow == steps:
        return _rated(rollout, driven, forks, errors, is_replayed)
    for number, (one, sent) in enumerate(zip(driven, commands, strict=True)):
        forks.append(rollout.fork())
        under_way = (*snapshot.plans[follow:], *[Trajectory(times[1], states[number])] * late)
        more = replace(
            snapshot,
            ego=np.concatenate([snapshot.ego, one[1:]]),
            commands=np.concatenate([snapshot.commands, sent]),
            planning_seconds=np.zeros(now + follow),
            degraded=np.zeros(now + follow, np.bool_),
            plans=under_way,
        )
        try:
            forks[-1].resume(more)  # the others see what it drove
        except ShiftsimError as error:
            errors[number] = error.message
    if follow < steps:
        _drive_on(forks, errors, planner, steps - follow)
    out = np.full((len(plans), steps + 1, NUM_STATE), np.nan)
    for number, fork in enumerate(forks):
        reached = fork.log().ego[now : now + steps + 1]
        out[number, : len(reached)] = reached
        if len(reached) <= steps and not errors[number]:
            errors[number] = "the scenario has ended"
    return _rated(rollout, out, forks, errors, is_replayed)


def _drive_on(forks: list[Rollout], errors: np.ndarray, planner: str | Planner, steps: int) -> None:
    """Let planners drive the branches that are under way; those of one network together."""
    one: Any = load_planner(planner) if isinstance(planner, str) else planner
    active = np.flatnonzero(errors == "").tolist()
    for number in active:
        forks[number].drive_by(one.fork() if isinstance(one, BatchPlanner) else deepcopy(one))
    ended = simulate_together([forks[number] for number in active], steps)
    for number, result in zip(active, ended, strict=True):
        if isinstance(result, Exception):
            errors[number] = str(result)


def _rated(
    rollout: Rollout,
    driven: FloatArray,
    worlds: list[Rollout],
    errors: np.ndarray,
    is_replayed: bool,
) -> Branches:
    """Parts of all branches, in one world each, or in the recorded one."""
    now, count, scenario = rollout.iteration, driven.shape[1], rollout.scenario
    observation = rollout.observe()
    planner = PdmClosed(map_radius=navsim.RADIUS, lateral_offsets=())
    ground, _ = navsim.look_around(scenario, observation, planner)
    ego, lights = observation.history.ego, scenario.iteration_rows[now : now + count]
    # beyond what was driven only a recording is known
    known = slice(now, now + count + (_TTC if is_replayed else 0))
    ignored = np.zeros(len(scenario.tracks.tokens), np.bool_)
    around = [_around(one.log().tracks.rows(known), ignored) for one in (rollout, *worlds)]
    values = {name: np.full(len(driven), np.nan) for name in (*PARTS, *FIRST.values())}
    good = np.flatnonzero(errors == "")
    if len(good):
        past = np.ascontiguousarray(ego[-1 - _PAST : -1])
        own = tuple(around[1 + number] for number in good if worlds)
        lit = navsim.seen_by_v2(around[0], scenario, lights, 1, ego[-1])
        found = navsim.evaluate(driven[good], ground, lit, "v2", past, own)
        for name, column in values.items():
            column[good] = found[name]
    driven[errors != ""] = np.nan
    parts = {name: values[name] for name in PARTS}
    first = {name: values[index] for name, index in FIRST.items()}
    return Branches(states=driven, parts=parts, first=first, errors=errors)


def _around(tracks: Tracks, ignored: BoolArray) -> navsim.Surroundings:
    """The others at times 0.1 s apart, without lights; some (N,) are ignored."""
    boxes = boxes_to_corners(tracks.poses, tracks.sizes)
    centers = np.where(tracks.valid[..., None], tracks.poses[..., :2], np.inf)
    is_agent = tracks.kinds <= LAST_AGENT_KIND
    speeds = np.where(is_agent, np.nan_to_num(np.hypot(*tracks.velocities.T).T), 0.0)
    radii = 0.5 * np.nan_to_num(np.hypot(*tracks.sizes.T).T).max(axis=0, initial=0.0)
    others = contacts.Obstacles(boxes, centers, centers, speeds, radii, is_agent, ignored)
    way = np.nan_to_num(np.hypot(*np.diff(tracks.poses[..., :2], axis=0).T).T)
    reaches = (_TTC + 1) * way.max(axis=0, initial=0.0)
    return navsim.Surroundings(others, np.arange(len(boxes)), reaches, [], np.zeros((0, 0), bool))


@kernel
def follow_plans(
    time_us: IntArray,  # (S + 1,) time stamps, from now on [us]
    plan_us: IntArray,  # (H,) those of the poses of plans [us]
    plans: FloatArray,  # (K, H, 11) states of plans; only the poses are read
    first: int,  # the step at which they are there; states before are given
    noise: FloatArray,  # (S, 2) of the commands
    states: FloatArray,  # (K, S + 1, 11) receives those after that step
    commands: FloatArray,  # (K, S, 2) receives the commands before noise
) -> int:
    """What `track_and_step` does step by step, for plans that are not made anew; its status."""
    if num_resampled(plan_us, NUPLAN.step_us) < MIN_POSES:
        return TOO_SHORT
    target, ahead = np.empty(plans.shape[2]), np.empty(NUPLAN.horizon)
    for row in range(len(plans)):
        profiles = fit_profiles(plan_us, plans[row], NUPLAN)
        for step in range(first, len(noise)):
            now, state, sent = time_us[step], states[row, step], commands[row, step]
            if not interpolate(plan_us, plans[row], now, target):
                return NOT_COVERED
            goal = aim(now, state, target, plan_us[0], profiles, NUPLAN, ahead)
            sent[0], sent[1] = command(state, goal, NUPLAN)
            added, after = noise[step], states[row, step + 1]
            command_and_step(now, time_us[step + 1], state, sent, added[0], added[1], after)
    return TRACKED
