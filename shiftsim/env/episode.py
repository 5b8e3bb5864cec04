"""One episode: a scenario under way, its rollout, rewards, and what an observation is."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from gymnasium import Space, spaces

from shiftsim.env.terms import Terms, compute_reward_terms, make_state
from shiftsim.errors import PlannerError, ShiftsimError
from shiftsim.metrics import SHORT_NAMES, compute_metrics
from shiftsim.sim.log import Setting, Snapshot
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Trajectory

NOMINAL_ITERATIONS = 150  # of an episode of 15 s, as CaRL's rewards have them
SURVIVAL = 0.6  # share of the reward `survival` that is paid for not failing


class _Driver:
    """Stands where a planner stands: whoever acts does so through the environment."""

    name = "policy"
    scene: SceneInfo

    def reset(self, scene: SceneInfo) -> None:
        self.scene = scene

    def plan(self, observation: Observation) -> Trajectory | Command:
        raise PlannerError("a policy acts through the environment, it is not asked")


def as_command(action: np.ndarray) -> np.ndarray:
    """(2,) the last action where actions are commands, else zeros."""
    return action if action.shape == (2,) else np.zeros(2, np.float32)


class Episode:
    """What an observation or a reward is made from.

    Attributes:
        scenario: The scenario, its recorded future included.
        scene: What a planner would be told of it.
        log: The rollout; its arrays have a row per iteration, filled up to the present one.
        terms: How the last step was.
        state: What the kernels read of it.
        action: (…) the last action within its bounds, zeros at the beginning.
        error: Why there are no scores; empty otherwise.
    """

    error = ""

    def __init__(self, scenario: Scenario, setting: Setting, action: np.ndarray) -> None:
        driver = _Driver()
        self._rollout = Rollout(scenario, driver, setting)
        self.scenario, self.scene = scenario, driver.scene
        self.log = self._rollout.log()
        self.action = action
        self.state = make_state(self.log, scenario.map)
        self.terms: Terms = compute_reward_terms(self.state, self.log, 0)

    def __reduce__(self) -> Any:
        """Copies come to the same iteration: the arrays are views of one another."""
        return _resumed, (self.scenario, self._rollout.setting, self.snapshot())

    def snapshot(self) -> Snapshot:
        """What another episode of the scenario can go on from."""
        return self._rollout.snapshot(self.action)

    def resume(self, snapshot: Snapshot) -> None:
        """Come, from the start of the scenario, to where another episode was.

        Raises:
            DataError: The snapshot is of another scenario.
        """
        self._rollout.resume(snapshot)
        self.action = self.action if snapshot.action is None else snapshot.action
        for row in range(1, snapshot.iteration + 1):
            self.terms = compute_reward_terms(self.state, self.log, row)

    @property
    def iteration(self) -> int:
        """The present iteration."""
        return self._rollout.iteration

    @property
    def is_over(self) -> bool:
        """Whether the scenario is at its end: its last sample is there."""
        return self._rollout.iteration + 1 == self._rollout.num_samples

    @property
    def infraction(self) -> str:
        """`off_road`, `collision`, or empty: what the last step did wrong."""
        return self.terms.infraction

    def observe(self) -> Observation:
        """What a planner would see now."""
        return self._rollout.observe()

    def advance(self, plan: Trajectory | Command) -> None:
        """Drive one step."""
        self._rollout.advance(plan)
        self.terms = compute_reward_terms(self.state, self.log, self._rollout.iteration)

    @cached_property
    def scores(self) -> dict[str, float]:
        """The closed-loop score `cls` and the scores it is made of, at the end of the scenario.

        Empty where they cannot be computed; `error` then says why.
        """
        try:
            result = compute_metrics(self.log, self.scenario.map)
        except ShiftsimError as error:  # a task of a run would fail; training goes on
            self.error = error.message
            return {}
        found = {name: result.scores[name] for name in SHORT_NAMES if name != "score"}
        return {"cls": result.score, **{n: float(v) for n, v in found.items() if v is not None}}


def _resumed(scenario: Scenario, setting: Setting, snapshot: Snapshot) -> Episode:
    episode = Episode(scenario, setting, snapshot.action)
    episode.resume(snapshot)
    return episode


Reward = Callable[[Episode], float]


def regular(episode: Episode) -> float:
    """CaRL's simple reward: progress, less what was done wrong on the way; 100 in all."""
    t = episode.terms
    if episode.infraction:
        return 0.0
    return 100.0 * t.progress * _factor(t)


def nuplan(episode: Episode) -> float:
    """CaRL's reward with the weights of nuPlan's score."""
    t = episode.terms
    if episode.infraction:
        return 0.0
    steady = 5.0 * (t.ttc == 1.0) + 4.0 * t.speed + 2.0 * (t.comfort == 1.0)
    total = (5.0 * t.progress + steady / NOMINAL_ITERATIONS) / 16.0
    return 100.0 * t.on_route * t.lane * total


def survival(episode: Episode) -> float:
    """CaRL's reward that also pays for every step without an infraction."""
    t = episode.terms
    if episode.infraction:
        return 0.0
    paid = SURVIVAL / NOMINAL_ITERATIONS
    return 100.0 * ((1.0 - SURVIVAL) * t.progress * _factor(t) + paid)


def score(episode: Episode) -> float:
    """The closed-loop score at the end of the scenario, else 0, also where there is none."""
    return episode.scores.get("cls", 0.0) if episode.is_over else 0.0


def _factor(t: Terms) -> float:
    return t.lane * t.speed * t.on_route * t.comfort * t.ttc


REWARDS: dict[str, Reward] = {f.__name__: f for f in (regular, nuplan, survival, score)}


class Observer(Protocol):
    """Makes observations; one's own is given to the environment as an object with these three."""

    space: Space[Any]  # of what `look` returns

    def start(self, episode: Episode) -> None:
        """Prepare for a new episode, which most need not."""
        return

    def look(self, episode: Episode) -> Any:
        """The present observation, in arrays that nobody writes to later."""


class NoObservation(Observer):
    """No observation, for policies that need none."""

    space: Space[Any] = spaces.Discrete(1)

    def look(self, episode: Episode) -> int:
        """Always the same."""
        return 0
