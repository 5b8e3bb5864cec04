"""Whether a planner obeys the contract, and what to mend where it does not.

The planner is driven along the recorded ego states of one scenario: once, then again after a reset,
then as a second copy. What the simulator would reject is an error; what it would accept but is most
likely a mistake is a warning.
"""

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.geometry.frames import wrap_angle
from shiftsim.sim.plan_check import find_fault
from shiftsim.sim.planner import History, Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Tracks, Trajectory

CALLS = 20
HISTORY = 22  # samples, as in a simulation
NEAR = 2.0  # m, and
FAR = 20.0  # m between the ego and the start of a plan: a warning, an error
TURNED = 1.0  # rad between the ego's heading and that of the plan's start: a warning
SLOW = 0.1  # s per plan: slower than real time

Plans: TypeAlias = list[Trajectory | Command]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing to know about a planner.

    Attributes:
        severity: `error`, `warning` or `note`.
        check: Name of the rule.
        message: What is the case, with the offending value.
        hint: What to do about it; empty for a note.
    """

    severity: str
    check: str
    message: str
    hint: str = ""


def check_planner(planner: Any, scenario: Scenario) -> list[Finding]:
    """Try a planner on one scenario.

    Args:
        planner: A planner, or a class or function without arguments that makes one.
        scenario: Any scenario with at least three iterations.

    Returns:
        What was found, errors first; the run time is always among it.
    """
    findings: list[Finding] = []
    is_made = isinstance(planner, type) or not hasattr(planner, "plan")
    subject = _make(planner, findings) if is_made else planner
    if subject is None or not _has_methods(subject, findings):
        return findings
    copy = _second(planner if is_made else None, subject, findings)
    seconds: list[float] = []
    first = _drive(subject, scenario, findings, seconds)
    if first is None:
        return sorted(findings, key=_rank)
    _check_plans(first, scenario, findings)
    _check_repeats(subject, copy, first, scenario, findings)
    typical = float(np.median(seconds[1:] or seconds))
    findings.append(
        Finding(
            "warning", "run time", f"a plan takes {typical * 1e3:.0f} ms", "real time is 100 ms"
        )
        if typical > SLOW
        else Finding("note", "run time", f"a plan takes {typical * 1e3:.3g} ms (median)")
    )
    return sorted(findings, key=_rank)


def _rank(finding: Finding) -> int:
    return ("error", "warning", "note").index(finding.severity)


def _make(factory: Callable[[], Any], findings: list[Finding]) -> Any:
    try:
        return factory()
    except Exception as error:  # any failure of users' code becomes a finding
        findings.append(
            Finding(
                "error",
                "constructor",
                f"making the planner failed: {_describe(error)}",
                "the constructor must work without arguments, or pass a planner instead of a class",
            )
        )
        return None


def _has_methods(planner: Any, findings: list[Finding]) -> bool:
    missing = [name for name in ("reset", "plan") if not callable(getattr(planner, name, None))]
    findings.extend(
        Finding(
            "error",
            "methods",
            f"{type(planner).__name__} has no method {name}()",
            "a planner has reset(self, scene) and plan(self, observation)",
        )
        for name in missing
    )
    return not missing


def _second(factory: Callable[[], Any] | None, planner: Any, findings: list[Finding]) -> Any:
    """A second planner of the same make: a pickled copy, else a new one, else None."""
    try:
        return pickle.loads(pickle.dumps(planner))
    except Exception as error:  # pickling runs users' code
        findings.append(
            Finding(
                "error",
                "pickles",
                f"the planner cannot be sent to a worker process: {_describe(error)}",
                "define the class at the top of a module, and open files, models and locks in "
                "reset(), not in the constructor",
            )
        )
    return None if factory is None else _make(factory, [])


def _drive(
    planner: Any, scenario: Scenario, findings: list[Finding], seconds: list[float]
) -> Plans | None:
    """Plans along the recorded ego, or None when the planner failed (then there is a finding)."""
    scene, observations = frozen_inputs(scenario)
    before = _fingerprints(scene, observations)
    step, plans = "reset()", []
    try:
        planner.reset(scene)
        for observation in observations:
            step = f"plan() at iteration {observation.iteration}"
            began = perf_counter()
            plans.append(planner.plan(observation))
            seconds.append(perf_counter() - began)
    except Exception as error:  # any failure of users' code becomes a finding
        if "read-only" in str(error):
            finding = _modified(f"{step} writes into its inputs: {_describe(error)}")
        else:
            finding = Finding(
                "error", "runs", f"{step} failed: {_describe(error)}", "mend the planner"
            )
        findings.append(finding)
        return None
    if _fingerprints(scene, observations) != before:
        findings.append(_modified("the arrays it was given are not what they were"))
    return plans


def _modified(message: str) -> Finding:
    return Finding(
        "error",
        "inputs untouched",
        message,
        "work on copies: the arrays of scene and observation belong to the simulator",
    )


def _check_plans(plans: Plans, scenario: Scenario, findings: list[Finding]) -> None:
    times = scenario.iteration_times
    seen: set[str] = set()
    for iteration, plan in enumerate(plans):
        fault = find_fault(plan, int(times[iteration]), int(times[iteration + 1]))
        if fault is not None:
            found: list[Finding] = [Finding("error", fault.check, fault.message, fault.hint)]
        elif isinstance(plan, Trajectory):
            found = _check_start(
                plan.starting_at(int(times[iteration])),
                int(times[iteration]),
                scenario.expert[iteration],
            )
        else:
            found = []
        for finding in found:
            if finding.check not in seen:  # once is enough: the others look the same
                seen.add(finding.check)
                message = f"iteration {iteration}: {finding.message}"
                findings.append(replace(finding, message=message))


def _check_start(plan: Trajectory, now_us: int, ego: FloatArray) -> list[Finding]:
    x, y = (np.interp(now_us, plan.time_us, plan.states[:, i]) for i in (0, 1))
    distance = float(np.hypot(x - ego[0], y - ego[1]))
    if distance > NEAR:
        return [
            Finding(
                "error" if distance > FAR else "warning",
                "starts at the ego",
                f"the plan is {distance:.1f} m away from the ego now",
                "poses are the rear axle in the map frame, from observation.ego.pose on; "
                "shiftsim.geometry.frames.from_frame brings ego-frame poses there",
            )
        ]
    row = int(np.searchsorted(plan.time_us, now_us, side="right")) - 1
    turn = abs(float(wrap_angle(float(plan.states[row, 2] - ego[2]))))
    if turn <= TURNED:
        return []
    return [
        Finding(
            "warning",
            "heading",
            f"the plan's heading differs from the ego's by {turn:.2f} rad now",
            "headings are radians in the map frame, counter-clockwise from +x",
        )
    ]


def _check_repeats(
    planner: Any, copy: Any, first: Plans, scenario: Scenario, findings: list[Finding]
) -> None:
    other = None if copy is None else _drive(copy, scenario, findings, [])
    if other is not None and (where := _first_difference(first, other)) is not None:
        findings.append(
            Finding(
                "error",
                "deterministic",
                f"two planners of the same make differ at iteration {where}",
                "seed random numbers in reset(), from scene.token for example",
            )
        )
        return
    again = _drive(planner, scenario, findings, [])
    if again is not None and (where := _first_difference(first, again)) is not None:
        findings.append(
            Finding(
                "error",
                "survives reset",
                f"after a reset the planner differs at iteration {where}",
                "clear all state of the scenario before in reset()",
            )
        )


def _first_difference(a: Plans, b: Plans) -> int | None:
    return next((i for i in range(len(a)) if _content(a[i]) != _content(b[i])), None)


def _content(plan: object) -> object:
    if not isinstance(plan, Trajectory):
        return plan if isinstance(plan, Command) else type(plan).__name__
    return (
        np.asarray(plan.time_us).tolist(),
        np.asarray(plan.states).tobytes(),
        plan.relative,
    )


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def frozen_inputs(scenario: Scenario) -> tuple[SceneInfo, list[Observation]]:
    """What a planner sees along the recorded ego at up to `CALLS` iterations, read-only."""
    scene = SceneInfo(
        map=scenario.map,
        route=scenario.route,
        goal=None if scenario.mission_goal is None else _frozen(scenario.mission_goal),
        dt=float(np.diff(scenario.iteration_times).mean() * 1e-6),
        token=scenario.token,
        expert=scenario,
    )
    count = min(CALLS, scenario.num_iterations - 1)
    return scene, [_observation(scenario, iteration) for iteration in range(count)]


def _observation(scenario: Scenario, iteration: int) -> Observation:
    row = int(scenario.iteration_rows[iteration])
    past = np.arange(row - (HISTORY - 1) * scenario.row_step, row + 1, scenario.row_step)
    rows = past[past >= 0]
    tracks = scenario.tracks.rows(rows)
    seen = Tracks(
        _frozen(tracks.valid),
        _frozen(tracks.poses),
        _frozen(tracks.velocities),
        _frozen(tracks.sizes),
        _frozen(tracks.kinds),
        tracks.tokens,
    )
    lights = scenario.traffic_lights.rows(slice(row, row + 1))
    lights = replace(lights, status=_frozen(lights.status))
    history = History(_frozen(scenario.time_us[rows]), _frozen(scenario.ego[rows]), seen)
    return Observation(iteration, int(scenario.time_us[row]), history, lights)


def _frozen(array: Any) -> Any:
    out = array.copy()
    out.flags.writeable = False
    return out


def _fingerprints(scene: SceneInfo, observations: list[Observation]) -> list[bytes]:
    """The bytes of all arrays that a planner might have written into."""
    arrays: list[Any] = [scene.goal, scene.expert.ego, scene.expert.tracks.poses]
    for observation in observations:
        tracks = observation.history.tracks
        arrays += [observation.history.time_us, observation.history.ego, observation.lights.status]
        arrays += [tracks.valid, tracks.poses, tracks.velocities, tracks.sizes]
    return [b"" if array is None else array.tobytes() for array in arrays]
