"""Non-reactive traffic: everyone does what the recording did (nuplan-simulation.md §9)."""

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks


class LogReplay:
    """Leaves the recorded tracks as they are."""

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Nothing to prepare: the buffer already holds the recording."""

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Nothing to do: the next row already holds the recording."""
