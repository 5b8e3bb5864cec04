"""Random ways through a town, from the streets that lead into it."""

import numpy as np

from shiftsim.data.demo.network import Street, Town
from shiftsim.data.demo.paths import Path

_CHANGING = 70.0  # m, shortest street to change lanes on
_CHANGES = 0.3  # chance of a lane change that no turn asks for
_PARKS = 0.35  # chance that who drives through a car park stays there
_TRIES = 6


class Ways:
    """Random ways, some streets more liked than others."""

    def __init__(self, town: Town, rng: np.random.Generator) -> None:
        self.town, self.rng = town, rng
        streets = town.streets.items()
        self.entries = tuple(name for name, x in streets if x.junctions[0] and not x.junctions[1])
        likes = rng.gamma(2.0, 0.5, len(town.streets)).tolist()
        self.likes: dict[str, float] = dict(zip(town.streets, likes, strict=True))

    def path(self, entry: str, category: str) -> Path | None:
        """The path of a random way from an entry; None where none was found."""
        for _ in range(_TRIES):
            if way := self._draw(entry, category):
                return self.town.path(way)
        return None

    def _draw(self, entry: str, category: str) -> str:
        """A way as `Town.path` understands it; empty where it ends at a dead end."""
        rng, town = self.rng, self.town
        street = town.streets[entry]
        lane = int(rng.integers(1, street.lanes + 1))
        legs: list[str] = []
        leg, seen = f"{entry}{lane}", {entry}
        junction = street.junctions[0]
        while junction:
            ahead = self._ahead(junction, street, seen)
            is_long = town.network.roads[street.id].length >= _CHANGING
            if not is_long or category == "bicycle":
                ahead = {name: lanes for name, lanes in ahead.items() if lane in lanes}
            if not ahead:
                return ""
            weights = np.array([self.likes[name] for name in ahead])
            target = str(rng.choice(list(ahead), p=weights / weights.sum()))
            lanes = sorted(ahead[target], key=lambda x: (abs(x - lane), x))
            if lanes[0] != lane or (len(lanes) > 1 and is_long and rng.random() < _CHANGES):
                near = [x for x in lanes if abs(x - lane) == 1]
                if not near:
                    return ""
                lane = near[0]
                leg += f">{lane}"
            legs.append(leg)
            _, lane = town.connectors[junction, street.name, lane, target]
            street = town.streets[target]
            seen.add(target)
            is_forward = junction == street.junctions[0]
            if target in town.bays and street.junctions[1] and rng.random() < _PARKS:
                if (bay := self._bay(street, is_forward=is_forward)) is not None:
                    return "-".join([*legs, f"{target}@{bay}"])
            junction, leg = street.junctions[is_forward], target
        return "-".join([*legs, leg, *(["bicycle"] if category == "bicycle" else [])])

    def _ahead(self, junction: int, street: Street, seen: set[str]) -> dict[str, list[int]]:
        """Lanes of a street that lead through a junction, by the next street."""
        ahead: dict[str, list[int]] = {}
        for at, name, lane, target in self.town.connectors:
            if at == junction and name == street.name and target not in seen:
                ahead.setdefault(target, []).append(lane)
        return ahead

    def _bay(self, street: Street, *, is_forward: bool) -> int | None:
        """A free parking space of a car park, on the right of the way where there is one."""
        count = len(self.town.bays[street.name])
        free = [x for x in street.empty if x < count]
        right = [x for x in free if (x < count // 2) == is_forward]
        return int(self.rng.choice(right or free)) if free else None
