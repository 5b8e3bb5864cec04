"""Random traffic lights of a junction."""

import numpy as np

from shiftsim.data.demo.lights import Lights
from shiftsim.data.demo.network import Street, Town
from shiftsim.data.towns.streets import AT_JUNCTION


def random_lights(town: Town, junction: int, rng: np.random.Generator) -> Lights:
    """Lights of a junction, at which streets that face each other are green together."""
    roads: dict[str, set[int]] = {}
    for (at, street, _, _), (number, _) in town.connectors.items():
        if at == junction:
            roads.setdefault(street, set()).add(number)
    phases = _phases({name: _inward(town.streets[name], junction) for name in roads})
    crossings = {
        town.streets[name].crossing_name(number): place
        for place, phase in enumerate(phases)
        for name in phase
        for number, ends in enumerate(town.streets[name].crossings)
        if ends in AT_JUNCTION and junction == town.streets[name].junctions[0]
    }
    green = tuple(round(float(rng.uniform(7.0, 13.0)), 1) for _ in phases)
    begun = round(float(rng.uniform(0.0, 30.0)), 1)
    numbers = tuple(frozenset(x for name in phase for x in roads[name]) for phase in phases)
    fastest = max(town.streets[name].limit for name in roads)
    yellow = float(np.clip(0.1 * fastest - 2.0, 3.0, 5.0))  # as in German towns
    return Lights(numbers, green, begun, crossings, yellow)


def _phases(headings: dict[str, float]) -> list[list[str]]:
    """Streets by the headings in which they enter a junction [rad], those that face in pairs."""
    left, phases = list(headings), []
    while left:
        first = left.pop(0)
        phase = [first]
        turn = [abs(np.cos(headings[x] - headings[first]) + 1.0) for x in left]
        if turn and min(turn) < 0.2:
            phase.append(left.pop(int(np.argmin(turn))))
        phases.append(phase)
    return phases


def _inward(street: Street, junction: int) -> float:
    """Heading of a street where it enters a junction [rad]."""
    if street.junctions[0] == junction:
        return street.start[2] + float(np.pi)
    road = street.road()
    return float(road.at(np.array([road.length]))[0, 2])
