"""Traffic lights of generated junctions, in a fixed cycle."""

from dataclasses import dataclass

import numpy as np

from shiftsim.data.synthetic.streets import AT_JUNCTION
from shiftsim.data.synthetic.town import Street, Town
from shiftsim.world.state import LightStatus

_CLEARING = 2.0  # s


@dataclass(frozen=True)
class Lights:
    """The lights of one junction: streets take turns."""

    # connecting roads that are green together, phase after phase
    phases: tuple[frozenset[int], ...]
    green: tuple[float, ...]  # how long each phase is green [s]
    begun: float  # how long the cycle has been going on at time 0 [s]
    crossings: dict[str, int]  # phase of the vehicles that a crosswalk stops, by its name
    yellow: float = 3.0  # how long a phase is yellow [s]

    def status(self, phase: int, time: float) -> LightStatus:
        """What a phase shows at a time [s]."""
        wait = self.wait(phase, time)
        if wait > 0.0:
            return LightStatus.RED
        return LightStatus.GREEN if -wait < self.green[phase] else LightStatus.YELLOW

    def wait(self, phase: int, time: float) -> float:
        """Time until a phase becomes green; 0 and less, how long it has been, or yellow [s]."""
        spans = [green + self.yellow + _CLEARING for green in self.green]
        since = (self.begun + time - sum(spans[:phase])) % sum(spans)
        return -since if since < self.green[phase] + self.yellow else sum(spans) - since

    def closed(self, time: float) -> set[int]:
        """Connecting roads that nobody may enter at a time [s]."""
        return {
            number
            for phase, numbers in enumerate(self.phases)
            if self.status(phase, time) != LightStatus.GREEN
            for number in numbers
        }

    def waits(self, time: float) -> dict[str, float]:
        """How long the vehicles before each crosswalk will see red [s]."""
        return {name: self.wait(phase, time) for name, phase in self.crossings.items()}


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
