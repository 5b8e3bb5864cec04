"""Recordings driven again as episodes of the environment, and what that earns and costs."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from shiftsim.env.episode import REWARDS, Episode
from shiftsim.env.terms import Terms, compute_reward_terms, make_state
from shiftsim.sim.log import Setting, SimulationLog
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command

REPLAY = Setting(controller="log-playback")
FACTORS = ("lane", "speed", "on_route", "comfort", "ttc")


@dataclass
class Account:
    """Where the hundred points of an episode go."""

    earned: float = 0.0
    left: float = 100.0  # the way that was not driven
    cost: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("off_road", "collision", *FACTORS), 0.0)
    )
    off_road: list[int] = field(default_factory=list)  # iterations
    collisions: list[int] = field(default_factory=list)
    last: Terms | None = None

    def add(self, row: int, terms: Terms) -> None:
        """Book one step, as the reward `regular` counts it."""
        points = 100.0 * terms.progress
        self.left, self.last = 100.0 * (1.0 - terms.completion), terms
        if terms.off_road:
            self.off_road.append(row)
        if terms.collision:
            self.collisions.append(row)
        if terms.infraction:
            self.cost[terms.infraction] += points
            return
        for name in FACTORS:
            factor = getattr(terms, name)
            self.cost[name] += points * (1.0 - factor)
            points *= factor
        self.earned += points


def replay(scenario: Scenario) -> Iterator[Episode]:
    """The recording as an episode, step by step."""
    episode = Episode(scenario, REPLAY, np.zeros(2, np.float32))
    while not episode.is_over:
        episode.advance(Command(0.0, 0.0))
        yield episode


def totals(scenario: Scenario) -> tuple[dict[str, float], Account]:
    """What the recording earns by reward, and where the rest goes."""
    total, account = dict.fromkeys(REWARDS, 0.0), Account()
    for episode in replay(scenario):
        for name, reward in REWARDS.items():
            total[name] += reward(episode)
        account.add(episode.iteration, episode.terms)
    return total, account


def expert_account(log: SimulationLog, road: VectorMap) -> tuple[SimulationLog, Account]:
    """What the expert of a rollout would earn, and the rollout as the expert drives it."""
    driven: Any = replace(log, ego=np.ascontiguousarray(log.expert_ego[: len(log.ego)]))
    state, account = make_state(driven, road), Account()
    for row in range(1, len(driven.ego)):
        account.add(row, compute_reward_terms(state, driven, row))
    return driven, account
