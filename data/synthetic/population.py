"""Random traffic in random towns: who drives and walks where, when and how.

Whoever would run into somebody is left out, and the others drive again without them.
"""

from dataclasses import replace

import numpy as np
import shapely

from shiftsim.data.synthetic.agents import SIZES, Driver, Path, Pedestrian, arc_at, shifted
from shiftsim.data.synthetic.roads import STEP
from shiftsim.data.synthetic.routes import RandomRoutes
from shiftsim.data.synthetic.town import Town
from shiftsim.data.synthetic.traffic import Box, Traffic
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import FloatArray

_HALTS = {"bus": 0.4, "bicycle": 0.2}  # chance to stop for a while
_HALTS_ELSE, _SLOW = 0.08, 0.07  # chance of all others, and of those who dawdle
_NEVER = (0.0, 0.0)  # a halt that is none
_WALK_UP = 14.0  # m, of pedestrians to the place where they cross
_MERGING = 14.0  # m, on which who was parked joins the lane
_ROUNDS = 12  # how often somebody is left out
_MARGIN = 0.1  # m, added to length and width, so that nobody brushes anybody
_EVERY = 3  # frames
_PARKED = -1  # number of what nobody drives
_ON_FOOT = 1.0  # m, who is shorter walks


def random_traffic(
    town: Town, rng: np.random.Generator, duration: float, *, crowd: float = 1.0
) -> Traffic:
    """Traffic that was recorded for a time [s], without anybody touching anybody.

    `crowd` times as many people walk, or cycle for each that drives.
    """
    routes = RandomRoutes(town, rng, crowd)
    drivers = [*_present(routes, rng), *_arriving(routes, rng, duration)]
    pedestrians = _pedestrians(town, rng, duration, crowd)
    for _ in range(_ROUNDS):
        fresh = [replace(driver, admitted=set(), waiting=set()) for driver in drivers]
        traffic = Traffic(town, fresh, [replace(pedestrian) for pedestrian in pedestrians])
        left_out = touching(traffic.record(duration), town.parked(), drivers)
        if not left_out:
            break
        pedestrians = [
            x for number, x in enumerate(pedestrians, len(drivers)) if number not in left_out
        ]
        drivers = [x for number, x in enumerate(drivers) if number not in left_out]
    return traffic


def _driver(
    path: Path, category: str, rng: np.random.Generator, s: float = 0.0, start: float = 0.0
) -> Driver:
    """A driver at rest with a random temper, at an arc length [m], who appears at a time [s]."""
    eager = float(np.clip(rng.normal(0.95, 0.1), 0.65, 1.06))
    if category in ("truck", "bus"):
        eager = float(rng.uniform(0.7, 0.92))
    elif rng.random() < _SLOW:
        eager = float(rng.uniform(0.35, 0.65))
    driver = Driver(category, path, s, 0.0, round(eager, 3), start)
    if rng.random() < 0.16:
        depth, period = float(rng.uniform(0.15, 0.65)), float(rng.uniform(6, 15))
        driver.wave = round(depth, 2), round(period, 1)
    if rng.random() < _HALTS.get(category, _HALTS_ELSE) and not path.is_parking:
        driver.halt = _halt(path, driver, rng)
    return driver


def _halt(path: Path, driver: Driver, rng: np.random.Generator) -> tuple[float, float]:
    """A place to stop for a while, away from junctions and crossings."""
    spans = [(z.stop - 8.0, z.exit + driver.length + 4.0) for z in path.zones]
    spans += [(first - 4.0, last + driver.length + 3.0) for _, first, last in path.crossings]
    for _ in range(8):
        at = float(rng.uniform(driver.s + 25.0, max(path.length - 10.0, driver.s + 26.0)))
        if at < path.length - 8.0 and all(not low < at < high for low, high in spans):
            return round(at, 1), round(float(rng.uniform(2.0, 9.0)), 1)
    return _NEVER


def _present(routes: RandomRoutes, rng: np.random.Generator) -> list[Driver]:
    """Those who are there at time 0: queues before junctions, parked ones, and others anywhere."""
    placed: list[Driver] = []
    for entry in routes.entries:
        if rng.random() < (0.85 if _is_red(routes.town, entry) else 0.12):
            placed += _queue(routes, entry, rng, placed)
    for entry in routes.entries:
        placed += _moving_off(routes, entry, rng)
    wanted = int(rng.integers(3, 16))
    for _ in range(4 * wanted):
        if len(placed) >= wanted:
            break
        category = routes.category()
        path = routes.path(str(rng.choice(routes.entries)), category)
        if path is None or path.length < 40.0:
            continue
        driver = _driver(path, category, rng)
        driver.move_to(float(rng.uniform(8.0, path.length - 15.0)))
        if path.is_parking and driver.s > path.length - 40.0:
            continue
        speed = float(path.speed[int(driver.s / STEP)]) * driver.eager
        driver.v = 0.0 if rng.random() < 0.12 else speed * float(rng.uniform(0.7, 1.0))
        if driver.halt[0] < driver.front + 20.0:
            driver.halt = _NEVER
        if _may_begin(driver) and _fits(driver, placed) and driver.has_room(placed):
            placed.append(driver)
    return placed


def _queue(
    routes: RandomRoutes, entry: str, rng: np.random.Generator, placed: list[Driver]
) -> list[Driver]:
    """Vehicles that stand before the junction at the end of a street."""
    out: list[Driver] = []
    stop = None
    for _ in range(int(rng.integers(1, 6))):
        category = routes.category()
        path = routes.path(entry, category)
        if path is None or not path.zones:
            continue
        driver = _driver(path, category, rng)
        driver.halt = _NEVER
        stop = path.zones[0].stop - 0.9 if stop is None else stop
        driver.move_to(stop - 0.5 * driver.length)
        if driver.s < 10.0:
            break
        if any(stop > z.stop for z in path.zones) or not _fits(driver, [*placed, *out], 1.2):
            continue
        out.append(driver)
        stop = driver.rear - float(rng.uniform(1.8, 4.0))
    return out


def _is_red(town: Town, entry: str) -> bool:
    """Whether a street has a light that is red at time 0."""
    numbers = {road.id for turn, road in town.connectors.items() if turn.street == entry}
    return any(x.wait(phase, 0.0) > 0.0 for n, (x, phase) in town.lit().items() if n in numbers)


def _moving_off(routes: RandomRoutes, entry: str, rng: np.random.Generator) -> list[Driver]:
    """Vehicles that stand in a parking space along a street until they move off."""
    bays = routes.town.bays.get(entry)
    if bays is None:
        return []
    out = []
    inward = [x for x in routes.town.streets[entry].empty if len(bays) // 2 <= x < len(bays)]
    for space in rng.permutation(inward)[: int(rng.integers(0, 4))].tolist():
        path = routes.path(entry, "car")
        if path is None or not path.zones:
            continue
        s = arc_at(path.points, bays[space, :2])
        x, y, heading = path.at(s)
        aside = (bays[space, 1] - y) * np.cos(heading) - (bays[space, 0] - x) * np.sin(heading)
        if aside > -1.5 or s < 15.0 or path.zones[0].stop < s + 30.0:
            continue
        category = str(rng.choice(("car", "van"), p=(0.85, 0.15)))
        driver = _driver(_merging(path, s, float(aside)), category, rng, s)
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


def _may_begin(driver: Driver) -> bool:
    """Whether a driver can still stop before every zone and crossing that is not behind."""
    need = driver.v**2 / 2.4 + 4.0
    spans = [(z.stop, z.exit) for z in driver.path.zones]
    spans += [(first - 1.5, last) for _, first, last in driver.path.crossings]
    return all(driver.rear > end + 1.0 or driver.front + need < begin for begin, end in spans)


def _fits(driver: Driver, placed: list[Driver], gap: float = 6.0) -> bool:
    """Whether a driver stands a gap away from all others, more at speed [m]."""
    for other in placed:
        apart = float(np.hypot(*np.subtract(driver.pose, other.pose)[:2]))
        apart -= 0.5 * (driver.length + other.length)
        one, two = driver.offset(*other.pose[:2]), other.offset(*driver.pose[:2])
        aside = min(abs(one[1]), abs(two[1]))
        needed = gap + 1.2 * max(driver.v, other.v)
        if apart < min(needed, 40.0) and (aside < 2.3 or (apart < 0.5 and aside < 2.6)):
            return False
    return True


def _arriving(routes: RandomRoutes, rng: np.random.Generator, duration: float) -> list[Driver]:
    """Those who come into town later."""
    out = []
    level = float(rng.choice((0.4, 0.8, 1.3)))
    for entry in routes.entries:
        street = routes.town.streets[entry]
        mean = 11.0 / (level * routes.likes[entry] * street.lanes**0.7 + 0.15)  # s
        time = float(rng.exponential(mean))
        while time < duration - 4.0:
            category = routes.category()
            path = routes.path(entry, category)
            if path is not None:
                driver = _driver(path, category, rng, start=round(time, 2))
                driver.move_to(0.5 * driver.length + 3.0)
                speed = float(path.speed[int(driver.s / STEP)]) * driver.eager
                driver.v = speed * float(rng.uniform(0.85, 1.0))
                out.append(driver)
            time += 1.0 + float(rng.exponential(mean))
    return sorted(out, key=lambda driver: driver.start)


def _pedestrians(
    town: Town, rng: np.random.Generator, duration: float, crowd: float
) -> list[Pedestrian]:
    """Pedestrians over crossings and along the streets."""
    out = []
    level = crowd * float(rng.choice((0.5, 1.0, 1.5)))
    for walk in town.walks:
        last = walk.kerb - 4.0 if walk.crossing else 0.7 * walk.length
        if last < 3.0:
            continue
        for _ in range(int(rng.poisson(level if walk.crossing else 0.5 * level))):
            start = float(rng.uniform(0.0, duration - 8.0)) if rng.random() < 0.7 else 0.0
            s = float(rng.uniform(max(2.0, last - _WALK_UP), last))
            out.append(Pedestrian(walk, start=round(start, 2), s=round(s, 2)))
    return sorted(out, key=lambda pedestrian: pedestrian.start)


def touching(boxes: list[Box], parked: FloatArray, drivers: list[Driver]) -> set[int]:
    """Numbers of agents to leave out, so that nobody touches anybody, nor cars `parked` (n, 3).

    Agents are numbered from 0 on, drivers first, in the order of their tracks.
    """
    rows = np.array([(x[0], x[1] - 1, *x[3:6], *SIZES[x[2]][:2]) for x in boxes]).reshape(-1, 7)
    out: set[int] = set()
    car = SIZES["car"][:2]
    still = np.array([(0, _PARKED, *pose, *car) for pose in parked.tolist()]).reshape(-1, 7)
    for frame in range(0, round(rows[:, 0].max(initial=-1.0)) + 1, _EVERY):
        low, high = np.searchsorted(rows[:, 0], (frame, frame + 1))
        now = np.concatenate([rows[low:high], still])
        for i, j in _pairs(now, high - low):
            one, two = (int(now[k, 1]) for k in (i, j))
            if not out & {one, two}:
                out.add(_blamed(one, two, drivers))
    return out


def _pairs(now: FloatArray, moving: int) -> list[tuple[int, int]]:
    """Pairs of rows i < j that touch, of which the first is one of those that may move."""
    sizes = now[:, 5:7] + np.where(now[:, 1:2] == _PARKED, 0.0, _MARGIN)
    shapes = shapely.polygons(boxes_to_corners(now[:, 2:5], sizes))
    i, j = shapely.STRtree(shapes).query(shapes[:moving], predicate="intersects")
    counts = (j > i) & ((now[i, 5] >= _ON_FOOT) | (now[j, 5] >= _ON_FOOT))
    return sorted(zip(i[counts].tolist(), j[counts].tolist(), strict=True))


def _blamed(one: int, two: int, drivers: list[Driver]) -> int:
    """Which of two to leave out: a pedestrian, else the much longer vehicle, else the later one."""
    low, high = sorted((one, two))
    if low == _PARKED or high >= len(drivers):
        return high
    longer = drivers[low].length - drivers[high].length
    return low if longer > 2.0 else high
