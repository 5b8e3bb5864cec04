"""Traffic that goes straight on, and several models in one rollout, each for tracks of its own."""

from collections.abc import Callable, Collection
from typing import Protocol

import numpy as np

from shiftsim.errors import ConfigError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, Tracks

Rule = Collection[int] | Callable[[Tracks], BoolArray]


class ConstantVelocity:
    """Everyone goes on as before: straight ahead, with the velocity of the first sighting.

    Vehicles, pedestrians and bicycles keep their velocity and heading, and nobody leaves.
    A track that the recording brings in later begins as recorded. Static objects are replayed.
    """

    def __init__(self) -> None:
        self._moving: BoolArray | None = None
        self._spans = np.zeros(0)

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Note who moves: the tracks `own` (all by default), static objects apart."""
        self._moving = tracks.kinds <= LAST_AGENT_KIND
        if own is not None:
            self._moving = self._moving & np.isin(np.arange(tracks.num_tracks), own)
        self._spans = np.diff(scenario.iteration_times) * 1e-6

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move everyone who was there a step ago."""
        if self._moving is None:
            raise ConfigError("traffic was stepped before it was started", hint="call start first")
        who = np.flatnonzero(self._moving & tracks.valid[row - 1])
        velocities = tracks.velocities[row - 1, who]
        tracks.valid[row, who] = True
        tracks.poses[row, who] = tracks.poses[row - 1, who]
        tracks.poses[row, who, :2] += self._spans[iteration] * np.nan_to_num(velocities)
        tracks.velocities[row, who] = velocities
        tracks.sizes[row, who] = tracks.sizes[row - 1, who]


class AgentPolicy(Protocol):
    """A traffic model that can share a rollout: `start` is also told which tracks are its own.

    It writes the rows of its own tracks, all of them in one call, and reads those of the others:
    their row of iteration i + 1 holds the recording, or what policies before it have written.
    """

    def start(self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray) -> None:
        """As `Traffic.start`; `own`: (A,) indices of the tracks this policy moves."""

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """As `Traffic.step`."""


class Mixed:
    """Traffic in which every track follows one of several policies, or the recording.

    Each policy comes with the tracks it moves: a set of `AgentKind`, or a function that takes the
    tracks and returns a mask (N,). A track belongs to the first policy that claims it, and to the
    recording if none does. Policies move in the order given, so that a later one sees where the
    earlier ones have gone.
    """

    def __init__(self, *policies: tuple[Rule, AgentPolicy]) -> None:
        self._policies = policies

    def start(self, scenario: Scenario, tracks: Tracks, row: int) -> None:
        """Share the tracks out."""
        free = np.ones(tracks.num_tracks, np.bool_)
        for rule, policy in self._policies:
            claimed = rule(tracks) if callable(rule) else np.isin(tracks.kinds, list(rule))
            if np.shape(claimed) != free.shape:
                raise ConfigError(
                    f"the rule for {type(policy).__name__} returned an array of shape "
                    f"{np.shape(claimed)}",
                    hint=f"return a mask of shape {free.shape}, one entry per track",
                )
            own = free & np.asarray(claimed, np.bool_)
            free &= ~own
            policy.start(scenario, tracks, row, np.flatnonzero(own))

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Let every policy move its own."""
        for _, policy in self._policies:
            policy.step(iteration, ego, tracks, row)
