"""Random traffic in random towns: who drives and walks where, when and how.

Whoever would run into somebody is left out, and the others drive again without them.
"""

from dataclasses import replace

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.demo.agents import SIZES, Driver, Walker, has_room
from shiftsim.data.demo.network import Town
from shiftsim.data.demo.paths import STEP, Path, arc_at, shifted
from shiftsim.data.demo.traffic import Box, Traffic
from shiftsim.data.towns.layouts import Place
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.world.state import LightStatus

_KINDS = {
    "car": 0.71,
    "van": 0.09,
    "pickup": 0.06,
    "truck": 0.04,
    "bus": 0.03,
    "motorcycle": 0.03,
    "bicycle": 0.04,
}
_CHANGING = 70.0  # m, shortest street to change lanes on
_MERGING = 14.0  # m, on which who was parked joins the lane
_ROUNDS = 12  # how often somebody is left out
_MARGIN = 0.1  # m around every vehicle, within which two of them count as touching


def random_traffic(place: Place, rng: np.random.Generator, duration: float) -> Traffic:
    """Traffic that runs for a time without anybody touching anybody [s]."""
    town = place.town
    ways = _Ways(town, rng)
    drivers = _standing_and_moving(place, ways, rng)
    drivers += _arriving(ways, rng, duration)
    walkers = _walkers(town, rng, duration)
    for _ in range(_ROUNDS):
        traffic = Traffic(
            town, [_anew(x) for x in drivers], [replace(x) for x in walkers], lights=place.lights
        )
        culprits = _who_touches(traffic.record(duration), town.parked(), drivers)
        if not culprits:
            break
        walkers = [x for k, x in enumerate(walkers, len(drivers)) if k not in culprits]
        drivers = [x for k, x in enumerate(drivers) if k not in culprits]
    return traffic


def _anew(driver: Driver) -> Driver:
    """A driver who has not set off yet."""
    return replace(driver, held=set(), waiting=set())


class _Ways:
    """Random ways through a town."""

    def __init__(self, town: Town, rng: np.random.Generator) -> None:
        self.town, self.rng = town, rng
        names = [n for n, s in town.streets.items() if s.junctions[0] and not s.junctions[1]]
        self.entries = tuple(names)
        # how much each street is liked as the next one
        self.weights = dict(zip(town.streets, rng.gamma(2.0, 0.5, len(town.streets)), strict=True))

    def draw(self, entry: str, category: str) -> str:
        """A way that begins on a street, as `Town.path` understands it."""
        street = self.town.streets[entry]
        first = int(self.rng.integers(1, street.lanes + 1))
        lane, names = first, []
        current, junction, leg = entry, street.junctions[0], f"{entry}{first}"
        seen = {entry}
        while junction:
            ahead: dict[str, list[int]] = {}
            for (at, name, from_lane, target), _ in self.town.connectors.items():
                if at == junction and name == current and target not in seen:
                    ahead.setdefault(target, []).append(from_lane)
            length = self.town.network.roads[self.town.streets[current].id].length
            if length < _CHANGING or category == "bicycle":
                ahead = {name: lanes for name, lanes in ahead.items() if lane in lanes}
            if not ahead:
                return "" if not names else "-".join(names) if self._ends(names) else ""
            targets = list(ahead)
            weights = np.array([self.weights[name] for name in targets])
            target = str(self.rng.choice(targets, p=weights / weights.sum()))
            lanes = sorted(ahead[target], key=lambda x: (abs(x - lane), x))
            if lanes[0] != lane or (
                len(lanes) > 1 and length >= _CHANGING and self.rng.random() < 0.15
            ):
                near = [x for x in lanes if abs(x - lane) == 1] or lanes
                if abs(near[0] - lane) > 1:
                    return ""
                lane = near[0]
                leg += f">{lane}"
            names.append(leg)
            _, lane = self.town.connectors[junction, current, lane, target]
            street = self.town.streets[target]
            seen.add(target)
            if street.name == "lot" and self.rng.random() < 0.35:
                free = [x for x in street.empty if x < len(self.town.bays["lot"])]
                if free:
                    names.append(f"lot@{self._bay(free, street.junctions[0] == junction)}")
                    return "-".join(names)
            forward = junction == street.junctions[0]
            junction, current, leg = street.junctions[1 if forward else 0], target, target
        names.append(leg)
        return "-".join(names) + ("-bicycle" if category == "bicycle" else "")

    def _bay(self, free: list[int], is_forward: bool) -> int:
        """A free parking space; those on the right of the way are turned into."""
        half = len(self.town.bays["lot"]) // 2
        right = [x for x in free if (x < half) == is_forward] or free
        return int(self.rng.choice(right))

    def _ends(self, names: list[str]) -> bool:
        return False

    def path(self, entry: str, category: str) -> Path | None:
        """The path of a random way; None where there is none for this category."""
        for _ in range(6):
            way = self.draw(entry, category)
            if way:
                return self.town.path(way)
        return None


def _category(rng: np.random.Generator) -> str:
    return str(rng.choice(list(_KINDS), p=list(_KINDS.values())))


def _driver(path: Path, category: str, rng: np.random.Generator, **rest: float) -> Driver:
    """A driver with a random temper."""
    eager = float(np.clip(rng.normal(0.95, 0.1), 0.65, 1.06))
    if category in ("truck", "bus"):
        eager = float(rng.uniform(0.7, 0.92))
    made = Driver(category, path, eager=round(eager, 3), **rest)  # type: ignore[arg-type]
    if rng.random() < 0.16:
        made.wave = (round(float(rng.uniform(0.15, 0.65)), 2), round(float(rng.uniform(6, 15)), 1))
    if rng.random() < (0.4 if category == "bus" else 0.05) and not path.is_parking:
        made.halt = _halt(path, made, rng)
    return made


def _halt(path: Path, driver: Driver, rng: np.random.Generator) -> tuple[float, float]:
    """A place to stop for a while, away from junctions and crossings."""
    for _ in range(8):
        at = float(rng.uniform(driver.s + 25.0, max(path.length - 10.0, driver.s + 26.0)))
        spans = [(z.stop - 8.0, z.exit + driver.length + 4.0) for z in path.zones]
        spans += [(first - 4.0, last + driver.length + 3.0) for _, first, last in path.crossings]
        if at < path.length - 8.0 and all(not low < at < high for low, high in spans):
            return round(at, 1), round(float(rng.uniform(2.0, 9.0)), 1)
    return 0.0, 0.0


def _standing_and_moving(place: Place, ways: _Ways, rng: np.random.Generator) -> list[Driver]:
    """Those who are there at time 0: queues before red lights, and others anywhere."""
    placed: list[Driver] = []
    for entry in ways.entries:
        is_red = _is_red(place, entry)
        if rng.random() < (0.85 if is_red else 0.12):
            placed += _queue(ways, entry, rng, placed)
    for entry in ways.entries:
        placed += _moving_off(ways, entry, rng)
    wanted = int(rng.integers(3, 16))
    for _ in range(4 * wanted):
        if len(placed) >= wanted:
            break
        category = _category(rng)
        path = ways.path(str(rng.choice(ways.entries)), category)
        if path is None or path.length < 40.0:
            continue
        driver = _driver(path, category, rng, s=0.0, v=0.0)
        driver.move_to(float(rng.uniform(8.0, path.length - 15.0)))
        if path.is_parking and driver.s > path.length - 40.0:
            continue
        speed = float(path.speed[int(driver.s / STEP)]) * driver.eager
        driver.v = 0.0 if rng.random() < 0.12 else speed * float(rng.uniform(0.7, 1.0))
        if driver.halt[0] < driver.front + 20.0:
            driver.halt = (0.0, 0.0)
        if _may_begin(driver) and _fits(driver, placed):
            placed.append(driver)
    return placed


def _moving_off(ways: _Ways, entry: str, rng: np.random.Generator) -> list[Driver]:
    """Vehicles that stand in a parking space along a street until they move off."""
    town = ways.town
    bays, free = town.bays.get(entry), town.streets[entry].empty
    if bays is None:
        return []
    out = []
    inward = [x for x in free if len(bays) // 2 <= x < len(bays)]  # on the side that enters
    for space in rng.permutation(inward)[: int(rng.integers(0, 4))].tolist():
        path = ways.path(entry, "car")
        if path is None or not path.zones:
            continue
        s = arc_at(path.points, bays[space, :2])
        x, y, heading = path.at(s)
        aside = (bays[space, 1] - y) * np.cos(heading) - (bays[space, 0] - x) * np.sin(heading)
        if aside > -1.5 or s < 15.0 or path.zones[0].stop < s + 30.0:
            continue
        category = str(rng.choice(("car", "van"), p=(0.85, 0.15)))
        driver = _driver(_merging(path, s, float(aside)), category, rng, s=s, v=0.0)
        driver.halt = (driver.front + 1.0, round(float(rng.uniform(0.5, 20.0)), 1))
        driver.wave, driver.is_parked = (0.0, 1.0), True
        out.append(driver)
    return out


def _merging(path: Path, s: float, aside: float) -> Path:
    """A path that begins beside the road and joins the lane from an arc length on [m]."""
    arc = STEP * np.arange(len(path.points))
    share = np.clip((s + 2.5 + _MERGING - arc) / _MERGING, 0.0, 1.0)
    slow = (arc > s - 5.0) & (share > 0.1)
    speed = np.where(slow, np.minimum(path.speed, 4.5), path.speed)
    moved = shifted(path, aside * share * share * (3.0 - 2.0 * share))
    return replace(moved, speed=speed)


def _queue(ways: _Ways, entry: str, rng: np.random.Generator, placed: list[Driver]) -> list[Driver]:
    """Vehicles that stand before the junction at the end of a street."""
    out: list[Driver] = []
    stop = None
    for _ in range(int(rng.integers(1, 6))):
        category = _category(rng)
        path = ways.path(entry, category)
        if path is None or not path.zones:
            continue
        driver = _driver(path, category, rng, s=0.0, v=0.0)
        driver.halt = (0.0, 0.0)
        stop = path.zones[0].stop - 0.9 if stop is None else stop
        driver.move_to(stop - 0.5 * driver.length)
        if driver.s < 10.0:
            break
        if any(stop > z.stop for z in path.zones) or not _fits(driver, [*placed, *out], 1.2):
            continue
        out.append(driver)
        stop = driver.rear - float(rng.uniform(1.8, 4.0))
    return out


def _is_red(place: Place, entry: str) -> bool:
    """Whether a street has a light that is red at time 0."""
    street = place.town.streets[entry]
    numbers = {
        number
        for (junction, name, _, _), (number, _) in place.town.connectors.items()
        if name == entry and junction == street.junctions[0]
    }
    return any(
        numbers & phase and lights.status(k, 0.0) == LightStatus.RED
        for lights in place.lights
        for k, phase in enumerate(lights.phases)
    )


def _may_begin(driver: Driver) -> bool:
    """Whether a driver can still stop before every zone and crossing that is not behind."""
    need = driver.v**2 / 2.4 + 4.0
    spans = [(z.stop, z.exit) for z in driver.path.zones]
    spans += [(first - 1.5, last) for _, first, last in driver.path.crossings]
    return all(driver.rear > end + 1.0 or driver.front + need < begin for begin, end in spans)


def _fits(driver: Driver, placed: list[Driver], gap: float = 6.0) -> bool:
    """Whether a driver has room among others, and leaves them theirs."""
    for other in placed:
        one, two = np.array(driver.place), np.array(other.place)
        apart = float(np.hypot(*(one - two)[:2])) - 0.5 * (driver.length + other.length)
        if apart > 40.0:
            continue
        aside = min(abs(driver.aside(*other.place[:2])), abs(other.aside(*driver.place[:2])))
        needed = gap + max(1.2 * driver.v, 1.2 * other.v)
        if apart < needed and (aside < 2.3 or (apart < 0.5 and aside < 2.6)):
            return False
    return has_room(driver, placed) if gap > 2.0 else True


def _arriving(ways: _Ways, rng: np.random.Generator, duration: float) -> list[Driver]:
    """Those who come into town later."""
    out = []
    level = float(rng.choice((0.4, 0.8, 1.3)))
    for entry in ways.entries:
        street = ways.town.streets[entry]
        mean = 11.0 / (level * ways.weights[entry] * street.lanes**0.7 + 0.15)  # s
        time = float(rng.exponential(mean))
        while time < duration - 4.0:
            category = _category(rng)
            path = ways.path(entry, category)
            if path is not None:
                driver = _driver(path, category, rng, s=0.0, v=0.0, start=round(time, 2))
                driver.move_to(0.5 * driver.length + 3.0)
                speed = float(path.speed[int(driver.s / STEP)]) * driver.eager
                driver.v = speed * float(rng.uniform(0.85, 1.0))
                out.append(driver)
            time += 1.0 + float(rng.exponential(mean))
    return sorted(out, key=lambda x: x.start)


def _walkers(town: Town, rng: np.random.Generator, duration: float) -> list[Walker]:
    """Pedestrians over crossings and along the streets."""
    out = []
    level = float(rng.choice((0.15, 0.5, 1.0)))
    for walk in town.walks.values():
        crosses = bool(walk.crossing)
        if rng.random() >= level * (0.55 if crosses else 0.8):
            continue
        last = walk.kerb - 4.0 if crosses else 0.7 * walk.length
        if last < 3.0:
            continue
        start = float(rng.uniform(0.0, duration - 8.0)) if rng.random() < 0.7 else 0.0
        s = float(rng.uniform(2.0, last))
        out.append(Walker(walk, start=round(start, 2), s=round(s, 2)))
    return sorted(out, key=lambda x: x.start)


def _who_touches(boxes: list[Box], parked: FloatArray, drivers: list[Driver]) -> set[int]:
    """Numbers of agents to leave out, so that nobody touches anybody."""
    rows = np.array([(x[0], x[1], *x[3:6], *SIZES[x[2]][:2]) for x in boxes])
    out: set[int] = set()
    if not len(rows):
        return out
    still = np.column_stack(
        [
            np.full(len(parked), -1.0),
            np.full(len(parked), 1e9),
            parked,
            np.tile([4.5, 1.85], (len(parked), 1)),
        ]
    )
    for frame in range(0, int(rows[:, 0].max()) + 1, 3):
        low, high = np.searchsorted(rows[:, 0], (frame, frame + 1))
        now = np.concatenate([rows[low:high], still])
        count = high - low
        gap = np.hypot(*np.moveaxis(now[:count, None, 2:4] - now[None, :, 2:4], -1, 0))
        reach = 0.5 * np.hypot(now[:, 5], now[:, 6])
        near = gap < reach[:count, None] + reach + 2.0 * _MARGIN
        i, j = np.nonzero(near)
        keep = (j > i) & ~((now[i, 5] < 1.0) & (now[j, 5] < 1.0))  # pedestrians may brush
        i, j = i[keep], j[keep]
        if not len(i):
            continue
        sizes = now[:, 5:7] + np.where(now[:, 1:2] < 1e9, _MARGIN, 0.0)
        shapes = shapely.polygons(boxes_to_corners(now[:, 2:5], sizes))
        for k in np.flatnonzero(shapely.intersects(shapes[i], shapes[j])).tolist():
            one, two = now[i[k]], now[j[k]]
            if not out & {int(one[1]) - 1, int(two[1]) - 1}:
                out.add(_blamed(one, two, drivers))
    return out


def _blamed(one: FloatArray, two: FloatArray, drivers: list[Driver]) -> int:
    """Which of two to leave out: the pedestrian, or who changes lanes or is longer, or is later."""
    a, b = (int(x[1]) - 1 if x[1] < 1e9 else -1 for x in (one, two))
    if b < 0 or a < 0:
        return max(a, b)
    walkers = [x for x in (a, b) if x >= len(drivers)]
    if walkers:
        return walkers[0]
    longer = drivers[a].length - drivers[b].length
    return (a if longer > 0.0 else b) if abs(longer) > 2.0 else max(a, b)
