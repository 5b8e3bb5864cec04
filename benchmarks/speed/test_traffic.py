"""One step of the reactive traffic among 100 agents in a city of 5200 lanes."""

import numpy as np

from shiftsim.data.synthetic_city import bench_scene
from shiftsim.traffic.idm import IdmTraffic

TARGET = 400e-6  # s, median of a step
AGENTS = 100
_WARM_STEPS = 5


def test_reactive_step(measure):
    scenario = bench_scene(AGENTS, 0)
    tracks = scenario.tracks.rows(scenario.iteration_rows)
    traffic = IdmTraffic()
    iterations = iter(())

    def restart():
        traffic.start(scenario, tracks, 0)
        for iteration in range(_WARM_STEPS):
            traffic.step(iteration, scenario.expert[iteration], tracks, iteration + 1)
        return iter(range(_WARM_STEPS, _WARM_STEPS + 30))

    def step():
        nonlocal iterations
        iteration = next(iterations, None)
        if iteration is None:
            iterations = restart()
            iteration = next(iterations)
        traffic.step(iteration, scenario.expert[iteration], tracks, iteration + 1)

    measure(step, calls=1, target=TARGET)

    assert np.isfinite(tracks.poses[0]).any()
