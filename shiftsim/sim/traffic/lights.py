"""Which lights a scenario lists for which edges."""

import numpy as np

from shiftsim.kernels import IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LightStatus

GREEN, RED = 1, 2  # lights of an edge, added up where several are listed


def light_flags(scenario: Scenario) -> tuple[IntArray, IntArray]:
    """(L,) edges with a light, and (T, L) which lights are listed at each iteration."""
    lights, index = scenario.traffic_lights, scenario.map.edges.index
    status = lights.status[scenario.iteration_rows]
    flags = GREEN * (status == LightStatus.GREEN) + RED * (status == LightStatus.RED)
    known = [i for i, name in enumerate(lights.connector_ids) if name in index]
    named = np.array([index[lights.connector_ids[i]] for i in known], np.int64)
    edges, place = np.unique(named, return_inverse=True)
    out = np.zeros((len(edges), len(status)), np.int64)
    # nuPlan rule 429: whoever asks for green finds green, whoever asks for red finds red
    np.bitwise_or.at(out, place, flags[:, known].T)
    return edges, np.ascontiguousarray(out.T)
