"""The fork of a rollout: the last moment at which its collision could be avoided, and what follows.

Until that moment the ego does what the rollout did; from there every planner drives on, and a
driver who brakes on the path of the rollout, in the same traffic and with the same noise. As in
`shiftsim edits check --avoidable`, a collision can be avoided where braking or PDM-Closed does.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from shiftsim.edits.sampling import HARDEST
from shiftsim.errors import ConfigError
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.registry import load_planner
from shiftsim.report.words import COLLISIONS
from shiftsim.runs.avoidable import REACTION_US, Braking, at_fault
from shiftsim.sim.log import SimulationLog
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
    planners = {
        name: partial(load_planner, made["planner"], made["arguments"])
        for name, made in made_with["planners"].items()
    }
    iteration = first["first_violation_iteration"]
    return _Search(scenario, item.log, item.seed, made_with["traffic"], iteration).fork(planners)


@dataclass(frozen=True)
class _Search:
    """A rollout that collides at fault, and what could be driven in its place."""

    scenario: Scenario
    log: SimulationLog  # the rollout
    seed: int
    traffic: str
    iteration: int  # at which it collides

    def fork(self, planners: Mapping[str, Callable[[], Planner]]) -> Fork:
        """The last moment within five seconds at which the collision is avoided, and branches."""
        makers = {BRAKING: self._braking, **planners}
        makers.setdefault(PDM, PdmClosed)

        def branch(name: str, start: int) -> Branch:
            return self._branch(name, start, makers[name]())

        def can_avoid(start: int) -> bool:
            return any(branch(name, start).hit is None for name in (BRAKING, PDM))

        least = max(self.iteration - _BACK, 0)
        for start in range(self.iteration - 1, least - 1, -_STRIDE):
            if can_avoid(start):
                later = range(min(start + _STRIDE, self.iteration) - 1, start, -1)
                start = next(filter(can_avoid, later), start)
                return Fork(start, tuple(branch(name, start) for name in makers))
        return Fork(least, ())

    def _braking(self) -> Planner:
        return Braking(self.scenario, HARDEST, driven=(self.log.time_us, self.log.ego))

    def _branch(self, name: str, start: int, planner: Planner) -> Branch:
        """What a planner drives from an iteration on, to the first collision at fault."""
        noise = NoiseModel("custom", function=lambda *_: self.log.noise, name="as driven")
        rollout = Rollout(self.scenario, planner, noise=noise, seed=self.seed, traffic=self.traffic)
        rollout.resume(self.log.snapshot(start, rollout.setting))
        stop = min(self.iteration + _AFTER, rollout.num_samples - 1)
        # commands are repeated for as long as it takes to react
        acts = start + (_REACTION if isinstance(planner, Braking) else 0)
        while rollout.iteration < stop and not rollout.done:
            plan = planner.plan(rollout.observe())
            if rollout.iteration < min(acts, len(self.log.commands) - 1):
                plan = Command(*self.log.commands[rollout.iteration].tolist())
            rollout.advance(plan)
        log = rollout.log()
        hits = at_fault(log, rollout.iteration + 1)
        hit = next((one for one in hits if one.iteration > start), None)
        end = hit.iteration if hit else rollout.iteration
        return Branch(name, log.ego[start : end + 1, :3], hit)
