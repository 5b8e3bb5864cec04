"""Everyone goes on as before: straight ahead, with the velocity of the first sighting."""

import numpy as np

from shiftsim.errors import ConfigError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LAST_AGENT_KIND, Tracks


class ConstantVelocity:
    """Vehicles, pedestrians and bicycles keep their velocity and heading, and nobody leaves.

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
