"""Walkers that an edit adds, beside any traffic: they wait for the ego, cross once, and stand."""

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.sim.traffic import Traffic
from shiftsim.world.scenario import Scenario
from shiftsim.world.script import Walker
from shiftsim.world.state import Tracks, center_poses


class Scripted:
    """Traffic of any model, and the walkers of an edited scenario."""

    def __init__(self, traffic: Traffic) -> None:
        self._traffic = traffic
        self._walkers: tuple[Walker, ...] = ()
        self._begun: list[float] = []
        self._seconds = np.zeros(0)

    def start(self, scenario: Scenario, tracks: Tracks, row: int) -> None:
        """Prepare traffic and walkers."""
        self._walkers = scenario.script.walkers if scenario.script else ()
        self._begun = [np.inf] * len(self._walkers)
        times = scenario.iteration_times
        self._seconds = (times - times[0]) * 1e-6
        self._traffic.start(scenario, tracks, row)

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move the walkers, which the other traffic then sees, and that traffic."""
        now, after = self._seconds[iteration], self._seconds[iteration + 1]
        x, y, _ = center_poses(ego[None, :3])[0]
        for number, walker in enumerate(self._walkers):
            near = np.hypot(walker.start[0] - x, walker.start[1] - y) <= walker.ego_within
            if near and self._begun[number] == np.inf:
                self._begun[number] = now
        self._place(after, tracks, row)
        self._traffic.step(iteration, ego, tracks, row)
        self._place(after, tracks, row)  # a model may have moved all pedestrians

    def _place(self, seconds: float, tracks: Tracks, row: int) -> None:
        for walker, begun in zip(self._walkers, self._begun, strict=True):
            track = walker.track
            if begun == np.inf and not walker.visible:
                continue
            step = walker.end - walker.start[:2]
            length = float(np.hypot(*step))
            gone = 0.0 if begun == np.inf else min((seconds - begun) * walker.speed, length)
            walks = 0.0 < gone < length
            tracks.valid[row, track] = True
            tracks.poses[row, track] = walker.start
            tracks.poses[row, track, :2] += gone / length * step
            tracks.velocities[row, track] = walker.speed * step / length if walks else 0.0
            tracks.sizes[row, track] = walker.size
