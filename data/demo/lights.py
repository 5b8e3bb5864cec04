"""Traffic lights of generated junctions, in a fixed cycle."""

from dataclasses import dataclass

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
