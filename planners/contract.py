"""Whether a planner obeys the contract, and what to repair where it does not.

The planner drives a whole scenario in closed loop, as in a run. Its beginning is driven again by a
second copy and after a reset, and all of it after another scenario. What the simulator would reject
is an error; what it would accept but is most likely a mistake is a warning.
"""

import pickle
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np

from shiftsim.files import place_of
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.planners.prototype import PlannerPrototype
from shiftsim.planners.registry import load_planner, planner_factory
from shiftsim.sim.loop import Rollout
from shiftsim.sim.plan_check import FAR, SHORT, find_fault, is_short
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Trajectory

CALLS = 20  # of a scenario that is only begun
NEAR = 2.0  # m between the ego and the start of a plan: a warning; beyond FAR an error
TURNED = 1.0  # rad between the ego's heading and that of the plan's start: a warning
FULL_TURN = 2.0 * np.pi + 1e-9  # rad; a heading beyond it is most likely in degrees
SLOW = 0.1  # s per plan: slower than real time
# m/s² and rad/s: no car brakes so, or turns its wheels so
STRONGEST = {"acceleration": 30.0, "steering_rate": 10.0}
COARSE = 0.05  # m between neighbouring positions of 32 bits

HANGS = "ends"  # the rule that an interrupt during the check shows to be broken

Plans: TypeAlias = list[Trajectory | Command]

_HINTS = {  # by the name of the rule: what to do
    "constructor": "the constructor must work without arguments, or pass a planner instead of "
    "a class",
    "methods": "a planner has reset(self, scene) and plan(self, observation)",
    "pickles": "define the class at the top of a module, and open files, models and locks in "
    "reset(), not in the constructor",
    "runs": "repair the planner",
    HANGS: "look there for a loop that does not end, or waits",
    "inputs untouched": "work on copies: the arrays of scene and observation belong to the "
    "simulator",
    "starts at the ego": "poses are the rear axle in the map frame, from observation.ego.pose on; "
    "shiftsim.geometry.boxes.from_frame brings ego-frame poses there",
    "heading": "headings are radians in the map frame, counter-clockwise from +x",
    "precision": "keep positions in float64, or compute near the ego and add its position last",
    "units": "accelerations are m/s^2 and steering rates rad/s",
    "deterministic": "seed random numbers in reset(), from scene.token for example",
    "survives reset": "clear all state of the scenario before in reset()",
    "company": "keep nothing of a scenario in the class, the module, or what forks share",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing to know about a planner."""

    severity: str  # `error`, `warning` or `note`
    check: str  # name of the rule
    message: str  # what is the case, with the offending value
    hint: str = ""  # what to do about it; empty for a note


def check_planner(planner: Any, scenario: Scenario, other: Scenario | None = None) -> list[Finding]:
    """Try a planner on one scenario of at least three iterations; what was found, errors first.

    `planner` is one, its name, or a class or function without arguments that makes one. With
    `other` it must not matter whether that scenario was driven before. The run time is always among
    the findings. It is a ConfigError if there is no planner of the name.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        for found in shiftsim.check_planner(shiftsim.load_planner("idm"), scenario):
            print(found.severity, found.message)
        ```
    """
    findings: list[Finding] = []
    if isinstance(planner, str):
        planner_factory(planner)
        planner = partial(load_planner, planner)
    is_made = isinstance(planner, type) or not hasattr(planner, "plan")
    candidate = _make(planner, findings) if is_made else planner
    if candidate is None or not _has_methods(candidate, findings):
        return findings
    copy = _second(planner if is_made else None, candidate, findings)
    prototype = PlannerPrototype(lambda: candidate)
    seconds: list[float] = []
    first = _drive(candidate, scenario, findings, seconds=seconds)
    if first is not None:
        _check_repeats(candidate, copy, first, scenario, findings)
        if other is not None and not any(found.severity == "error" for found in findings):
            _check_company(prototype, first, scenario, other, findings)
        findings.append(_run_time(np.array(seconds[1:] or seconds)))
    once = dict.fromkeys(findings)  # what holds of every drive is listed once
    return sorted(once, key=lambda found: ("error", "warning", "note").index(found.severity))


def _run_time(seconds: FloatArray) -> Finding:
    typical, slow = float(np.median(seconds)), float((seconds > SLOW).mean())
    text = f"a plan takes {typical * 1e3:.3g} ms (median), {seconds.max() * 1e3:.3g} ms at most"
    if not slow:
        return Finding("note", "run time", text)
    text = f"{text}; {slow:.0%} of the plans take longer than the 100 ms of a step"
    return Finding("warning", "run time", text, "results are the same, but no car could drive so")


def _error(check: str, message: str, severity: str = "error") -> Finding:
    return Finding(severity, check, message, _HINTS[check])


def _make(factory: Callable[[], Any], findings: list[Finding]) -> Any:
    try:
        return factory()
    except (Exception, SystemExit) as error:  # any failure of users' code becomes a finding
        text = f"making the planner failed: {_describe(error)}"
        findings.append(_error("constructor", text))
        return None


def _has_methods(planner: Any, findings: list[Finding]) -> bool:
    missing = [name for name in ("reset", "plan") if not callable(getattr(planner, name, None))]
    findings.extend(
        _error("methods", f"{type(planner).__name__} has no method {name}()") for name in missing
    )
    return not missing


def _second(factory: Callable[[], Any] | None, planner: Any, findings: list[Finding]) -> Any:
    """A second planner of the same make: a pickled copy, else a new one, else None."""
    try:
        return pickle.loads(pickle.dumps(planner))
    except Exception as error:  # pickling runs users' code
        text = f"the planner cannot be sent to a worker process: {_describe(error)}"
        findings.append(_error("pickles", text))
    return None if factory is None else _make(factory, [])


def _drive(
    planner: Any,
    scenario: Scenario,
    findings: list[Finding],
    *,
    calls: int | None = None,
    seconds: list[float] | None = None,
) -> Plans | None:
    """Plans of a scenario in closed loop, or of `calls` steps; None, and a finding, if it fails."""
    plans: Plans = []
    step, seen = "reset()", set[str]()
    try:
        rollout = Rollout(scenario, planner)
        while not rollout.done and len(plans) != calls:
            observation = rollout.observe()
            step = f"plan() at iteration {observation.iteration}"
            began = perf_counter()
            plan = planner.plan(observation)
            if seconds is not None:
                seconds.append(perf_counter() - began)
            plans.append(plan)
            found = _check_plan(
                plan, observation.ego.values, scenario.iteration_times[len(plans) - 1 :]
            )
            if found is not None and found.check not in seen:  # the others look the same
                seen.add(found.check)
                where = f"iteration {observation.iteration}: {found.message}"
                findings.append(replace(found, message=where))
            if found is not None and found.severity == "error":
                return None
            with warnings.catch_warnings(action="ignore"):  # what they say is among the findings
                rollout.advance(plan)
    except KeyboardInterrupt as error:
        if not (where := place_of(error)):
            raise
        findings.append(_error(HANGS, f"{step} had not ended when you interrupted it ({where})"))
        return None
    except (Exception, SystemExit) as error:  # any failure of users' code becomes a finding
        if "read-only" in str(error) or "WRITEABLE" in str(error):
            text = f"{step} writes into its inputs: {_describe(error)}"
            findings.append(_error("inputs untouched", text))
        else:
            findings.append(_error("runs", f"{step} failed: {_describe(error)}"))
        return None
    return plans


def _check_plan(plan: object, ego: FloatArray, times: IntArray) -> Finding | None:
    """What is wrong with one plan of an ego (11,), at the first of the times [us]."""
    now_us = int(times[0])
    if (fault := find_fault(plan, now_us, int(times[1]))) is not None:
        return Finding("error", fault.check, fault.message, fault.hint)
    if isinstance(plan, Command):
        return _check_command(plan)
    if not isinstance(plan, Trajectory):
        return None
    found = _check_start(plan.starting_at(now_us), now_us, ego)
    if found is None and (turned := np.abs(plan.states[:, 2]).max()) > FULL_TURN:
        text = f"a heading of the plan is {turned:.1f} rad, more than a full turn"
        found = _error("heading", text, "warning")
    if found is None and is_short(plan):
        found = Finding("warning", "length", SHORT, "plan 1 s ahead and more")
    return found or _check_precision(plan.states[:, :2])


def _check_command(command: Command) -> Finding | None:
    for name, most in STRONGEST.items():
        if abs(value := float(getattr(command, name))) > most:
            text = f"the command has {name} {value:.3g}: no car does more than {most:g}"
            return _error("units", text, "warning")
    return None


def _check_precision(places: FloatArray) -> Finding | None:
    small = places.astype(np.float32)
    step = float(np.spacing(np.abs(small)).max())
    if step < COARSE or not np.array_equal(small, places):
        return None
    text = f"all positions of the plan are numbers of 32 bits, which are {step:g} m apart here"
    return _error("precision", text, "warning")


def _check_start(plan: Trajectory, now_us: int, ego: FloatArray) -> Finding | None:
    x, y = (np.interp(now_us, plan.time_us, plan.states[:, i]) for i in (0, 1))
    distance = float(np.hypot(x - ego[0], y - ego[1]))
    if distance > NEAR:
        text = f"the plan is {distance:.1f} m away from the ego now"
        return _error("starts at the ego", text, "error" if distance > FAR else "warning")
    row = int(np.searchsorted(plan.time_us, now_us, side="right")) - 1
    turn = abs(float(wrap_angle(float(plan.states[row, 2] - ego[2]))))
    if turn <= TURNED:
        return None
    text = f"the plan's heading differs from the ego's by {turn:.2f} rad now"
    return _error("heading", text, "warning")


def _check_repeats(
    planner: Any, copy: Any, first: Plans, scenario: Scenario, findings: list[Finding]
) -> None:
    for candidate, check, text in (
        (copy, "deterministic", "two planners of the same make differ"),
        (planner, "survives reset", "after a reset the planner differs"),
    ):
        repeated = None if candidate is None else _drive(candidate, scenario, findings, calls=CALLS)
        if repeated is not None and (where := _first_difference(first, repeated)) is not None:
            findings.append(_error(check, f"{text} at iteration {where}"))
            return


def _check_company(
    prototype: PlannerPrototype,
    first: Plans,
    scenario: Scenario,
    other: Scenario,
    findings: list[Finding],
) -> None:
    """Drive another scenario, then the same one again, as a worker would."""
    elsewhere: list[Finding] = []
    _drive(prototype.copy(), other, elsewhere)
    findings.extend(
        replace(found, message=f"scenario {other.token}, {found.message}")
        for found in elsewhere
        if found.check not in {known.check for known in findings}
    )
    failed: list[Finding] = []
    repeated = _drive(prototype.copy(), scenario, failed)
    if repeated is None:
        text = f"after scenario {other.token}, {failed[-1].message}"
        findings.append(_error("company", text))
    elif (where := _first_difference(first, repeated)) is not None:
        text = f"after scenario {other.token} the planner differs at iteration {where}"
        findings.append(_error("company", text))


def _first_difference(a: Plans, b: Plans) -> int | None:
    """The first step at which plans differ, of those that both have."""
    pairs = enumerate(zip(a, b, strict=False))
    return next((i for i, (x, y) in pairs if _content(x) != _content(y)), None)


def _content(plan: object) -> object:
    if not isinstance(plan, Trajectory):
        return plan if isinstance(plan, Command) else type(plan).__name__
    times, states = np.asarray(plan.time_us), np.asarray(plan.states)
    return times.tolist(), states.tobytes(), plan.relative


def _describe(error: BaseException) -> str:
    where = place_of(error)
    return f"{type(error).__name__}: {error}{where and f' ({where})'}"
