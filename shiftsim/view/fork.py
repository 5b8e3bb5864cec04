"""The fork of a rollout: the last moment at which its collision could be avoided, and what follows.

Until that moment the ego does what the rollout did; from there every planner drives on, and a
driver who brakes on the path of the rollout, in the same traffic and with the same noise. As in
`shiftsim edits check --avoidable`, a collision can be avoided where braking or PDM-Closed does.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from shiftsim.edits.sampling import HARDEST
from shiftsim.errors import ConfigError
from shiftsim.kernels import FloatArray
from shiftsim.metrics.result import Collision
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.registry import load_planner
from shiftsim.report.words import COLLISIONS
from shiftsim.runs.avoidable import REACTION_US, Braking, at_fault
from shiftsim.sim.log import Setting, SimulationLog
from shiftsim.sim.loop import Rollout
from shiftsim.sim.noise import NoiseModel
from shiftsim.sim.planner import Planner
from shiftsim.view.scene import Branch, Fork, ShownRollout
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command

BRAKING, PDM = "braking", "pdm-closed"
_BACK, _STRIDE = 50, 5  # iterations that are looked back, and between two looks
_REACTION = REACTION_US // 100_000  # iterations
_AFTER = 20  # iterations that are driven beyond the collision


def find_fork(scenario: Scenario, item: ShownRollout, manifest: Mapping[str, Any]) -> Fork | None:
    """The fork of a rollout, by planners of its run; None where it hits nothing at fault."""
    made_with = manifest["determining"]
    if made_with["controller"] != "lqr":
        what = f"a fork repeats commands, and controller {made_with['controller']!r} has none"
        raise ConfigError(what, hint="run with --controller lqr")
    first = next((row for row in item.metrics if row["metric"] == COLLISIONS), None)
    if first is None or first["first_violation_iteration"] is None:
        return None
    log, hit_at = item.log, first["first_violation_iteration"]
    braking = partial(Braking, scenario, HARDEST, driven=(log.time_us, log.ego))
    planners: dict[str, Callable[[], Planner]] = {BRAKING: braking}
    for name, made in made_with["planners"].items():
        planners[name] = partial(load_planner, made["planner"], made["arguments"])
    planners.setdefault(PDM, PdmClosed)
    noise = NoiseModel("custom", function=lambda *_: log.noise, name="as driven")
    setting = Setting(noise, item.seed, made_with["traffic"])

    def branch(name: str, start: int) -> Branch:
        rollout = Rollout(scenario, planners[name](), setting)
        rollout.resume(log.snapshot(start, setting))
        return Branch(name, *_drive(rollout, log, hit_at + _AFTER))

    def can_avoid(start: int) -> bool:
        return any(branch(name, start).hit is None for name in (BRAKING, PDM))

    least = max(hit_at - _BACK, 0)
    for start in range(hit_at - 1, least - 1, -_STRIDE):
        if can_avoid(start):
            later = range(min(start + _STRIDE, hit_at) - 1, start, -1)
            start = next(filter(can_avoid, later), start)
            return Fork(start, tuple(branch(name, start) for name in planners))
    return Fork(least, ())


def _drive(rollout: Rollout, log: SimulationLog, stop: int) -> tuple[FloatArray, Collision | None]:
    """What is driven from where a log was on, to the first collision at fault, and that."""
    planner, start = rollout.planner, rollout.iteration
    assert planner is not None
    stop = min(stop, rollout.num_samples - 1)
    # commands are repeated for as long as it takes to react
    acts = start + (_REACTION if isinstance(planner, Braking) else 0)
    while rollout.iteration < stop and not rollout.done:
        plan = planner.plan(rollout.observe())
        if rollout.iteration < min(acts, len(log.commands) - 1):
            plan = Command(*log.commands[rollout.iteration].tolist())
        rollout.advance(plan)
    driven = rollout.log()
    found = at_fault(driven, rollout.iteration + 1)
    hit = next((one for one in found if one.iteration > start), None)
    end = hit.iteration if hit else rollout.iteration
    return driven.ego[start : end + 1, :3], hit
