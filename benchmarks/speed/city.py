"""A generated city, large enough to measure speed on, and one scenario in it.

Streets form a grid: two lanes per direction, a junction at every crossing with straight, left and
right connectors. Coordinates are UTM-like.
"""

from collections import defaultdict
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import shapely

from shiftsim.data.readers.samples import ROW_S, ego_states
from shiftsim.kernels import FloatArray
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, LightStatus, Tracks, TrafficLights

_NODES = 26  # junctions along each axis: 2600 roadblocks of two lanes
_SPACING, _HALF = 72.0, 15.0  # m between junctions, m from a junction's middle to its streets
_WIDTH = 3.5  # m
_ORIGIN = np.array([331_000.0, 4_690_000.0])  # m
_STEP = 0.5  # m between baseline vertices
_LIMIT = 13.9  # m/s
_HEADINGS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # east, north, west, south
_SPAN = (3.0, 15.0, 8.0)  # s of history, scenario and future
_RADIUS = 50.0  # m around the ego in which agents start
_LIGHTS_RADIUS = 150.0  # m around the ego in which lights are listed
_LIGHTS_SECONDS = 10.0  # s for which lights stay as they are
_FEW, _MANY = 11, 75  # points of a connector's border
_ROUTE = ("right", "straight", "left", "right", "straight")
_TURNS = {"right": -1, "straight": 0, "left": 1}
_LANES_OF = {"straight": (0, 1), "left": (0,), "right": (1,)}  # lanes that turn, left first

# middle of all lanes that turn, to the right of a street, and half their width, in lanes
_BLOCK_TURNS = {"straight": (1.0, 1.0), "left": (0.5, 0.5), "right": (1.5, 0.5)}


@dataclass(frozen=True)
class _Shape:
    """A baseline and its borders, relative to the middle of a junction. K points."""

    line: FloatArray
    left: FloatArray
    right: FloatArray

    def area(self, middle: FloatArray) -> shapely.Polygon:
        """The area between the borders."""
        return shapely.Polygon(np.concatenate([self.left, self.right[::-1]]) + middle)


Place = tuple[tuple[int, int], int]  # the node that a street leaves, and its direction


@dataclass(frozen=True)
class _Street:
    """One direction of one street: node it leaves, direction, ids of its lanes, roadblock."""

    node: tuple[int, int]
    direction: int
    lanes: tuple[str, str]
    block: str

    @property
    def end(self) -> tuple[int, int]:
        """The node it leads to."""
        dx, dy = _HEADINGS[self.direction].tolist()
        return self.node[0] + dx, self.node[1] + dy

    def after(self, turn: str) -> Place:
        """The street behind a turn at its end."""
        return self.end, (self.direction + _TURNS[turn]) % 4


@dataclass
class _City:
    """Streets, the turns from one to another, and the baseline of every lane and connector."""

    streets: dict[Place, _Street]
    turns: list[tuple[_Street, str]]
    lines: dict[str, FloatArray] = field(default_factory=dict)


def bench_scene(num_agents: int, seed: int, *, lights: bool = False) -> Scenario:
    """A 15 s scenario in a city of 5200 lanes, with 3 s of history and 8 s of future.

    Vehicles, pedestrians, bicycles and objects start within 50 m of the ego, as the seed wants; the
    city and the ego are always the same. With `lights` they hang at every junction, those the ego
    drives up to are red, and connectors have the many vertices (150) of a real map's.
    """
    city = _city()
    road = _map(city, lights)
    path, route = _ego_path(city)
    rows = round(sum(_SPAN) / ROW_S) + 1
    ego = _drive(path, rows)
    start = round(_SPAN[0] / ROW_S)
    iterations = np.arange(start, start + round(_SPAN[1] / ROW_S) + 1, 2)
    rng = np.random.Generator(np.random.Philox(seed))
    return Scenario(
        token=f"bench{num_agents:04d}{seed:04d}",
        scenario_type="bench",
        log_name="bench-city",
        city=road.name,
        map=road,
        time_us=1_700_000_000_000_000 + np.arange(rows) * 50_000,
        ego=ego,
        tracks=_agents(num_agents, rng, ego, start, list(city.lines.values())),
        traffic_lights=(
            _lights(city, ego[start, :2], rows) if lights else TrafficLights.empty(rows)
        ),
        iteration_rows=iterations,
        row_step=2,
        route=route,
        mission_goal=ego[-1, :3].copy(),
        mapping=(_SPAN[1], 0.0, 0.5),
    )


def _city() -> _City:
    streets: dict[Place, _Street] = {}
    for x, y in product(range(_NODES), repeat=2):
        for direction, (dx, dy) in enumerate(_HEADINGS.tolist()):
            if 0 <= x + dx < _NODES and 0 <= y + dy < _NODES:
                number = len(streets)
                lanes = (str(100_000 + 2 * number), str(100_001 + 2 * number))
                streets[(x, y), direction] = _Street((x, y), direction, lanes, str(10_000 + number))
    turns = [(s, turn) for s in streets.values() for turn in _TURNS if s.after(turn) in streets]
    return _City(streets, turns)


def _lights(city: _City, here: FloatArray, rows: int) -> TrafficLights:
    """Lights of the junctions around a point: red along one axis and green along the other."""
    names, axes = [], []
    for number, (street, turn) in enumerate(city.turns):
        if np.hypot(*(_middle(street.end) - here)) < _LIGHTS_RADIUS:
            names += [_connector(number, index) for index in _LANES_OF[turn]]
            axes += [street.direction % 2] * len(_LANES_OF[turn])
    phase = (np.arange(rows) * ROW_S // _LIGHTS_SECONDS).astype(np.int64)
    is_red = np.array(axes) == phase[:, None] % 2
    status = np.where(is_red, LightStatus.RED, LightStatus.GREEN).astype(np.int8)
    return TrafficLights(tuple(names), status)


def _map(city: _City, lights: bool) -> VectorMap:
    """The map; fills the baselines of the city."""
    border = _MANY if lights else _FEW
    into: dict[str, list[str]] = defaultdict(list)  # connectors by the lane or block they lead to
    out_of: dict[str, list[str]] = defaultdict(list)
    edges: list[EdgeSpec] = []
    blocks: list[BlockSpec] = []
    for street in city.streets.values():
        for index, lane in enumerate(street.lanes):
            city.lines[lane] = _lane_shape(street.direction, index).line + _middle(street.node)
    for number, (street, turn) in enumerate(city.turns):
        target, middle = city.streets[street.after(turn)], _middle(street.end)
        block, junction = str(20_000 + number), _junction(street.end)
        for index in _LANES_OF[turn]:
            name = _connector(number, index)
            source, goal = street.lanes[index], target.lanes[index]
            shape = _turn_shape(street.direction, turn, index, border)
            city.lines[name] = shape.line + middle
            into[goal].append(name)
            out_of[source].append(name)
            edges.append(
                _edge(
                    name,
                    block,
                    shape,
                    middle,
                    is_connector=True,
                    has_traffic_lights=lights,
                    baseline=city.lines[name],
                    incoming=[source],
                    outgoing=[goal],
                    intersection_id=junction,
                    turn_type={"straight": 0, "left": 1, "right": 2}[turn],
                )
            )
        area = _turn_shape(street.direction, turn, None).area(middle)
        blocks.append(BlockSpec(block, True, area, [street.block], [target.block], junction))
        into[target.block].append(block)
        out_of[street.block].append(block)
    for street in city.streets.values():
        name, middle = street.block, _middle(street.node)
        left, right = street.lanes
        edges += [
            _edge(
                lane,
                name,
                _lane_shape(street.direction, index),
                middle,
                is_connector=False,
                baseline=city.lines[lane],
                incoming=into[lane],
                outgoing=out_of[lane],
                lane_index=index,
                left_lane=left if index else None,
                right_lane=None if index else right,
            )
            for index, lane in enumerate(street.lanes)
        ]
        area = _lane_shape(street.direction, None).area(middle)
        blocks.append(BlockSpec(name, False, area, into[name], out_of[name]))
    junctions, crosswalks = [], []
    for node in product(range(_NODES), repeat=2):
        (left, low), (right, high) = _middle(node) - _HALF, _middle(node) + _HALF
        junctions.append(AreaSpec(_junction(node), shapely.box(left, low, right, high)))
        box = shapely.box(left, low, left + 3.0, high)
        crosswalks.append(AreaSpec(f"c{_junction(node)}", box))
    areas = [AreaSpec(f"d{b.id}", b.polygon) for b in blocks if not b.is_connector]
    return build_map(
        "bench-city",
        edges=edges,
        blocks=blocks,
        epsg=32_619,
        intersections=junctions,
        crosswalks=crosswalks,
        drivable_areas=[*areas, *(AreaSpec(f"d{j.id}", j.polygon) for j in junctions)],
    )


def _edge(name: str, block: str, shape: _Shape, middle: FloatArray, **rest: Any) -> EdgeSpec:
    return EdgeSpec(
        id=name,
        polygon=shape.area(middle),
        block_id=block,
        left=shape.left + middle,
        right=shape.right + middle,
        speed_limit=_LIMIT,
        **rest,
    )


def _junction(node: tuple[int, ...]) -> str:
    return str(1_000 + node[0] * _NODES + node[1])


def _connector(turn: int, index: int) -> str:
    return f"{200_000 + 2 * turn + index}"


def _middle(node: tuple[int, ...]) -> FloatArray:
    return _ORIGIN + _SPACING * np.array(node, np.float64)


def _to_right(direction: int) -> FloatArray:
    along = _HEADINGS[direction]
    return np.array([along[1], -along[0]], np.float64)


@cache
def _lane_shape(direction: int, index: int | None) -> _Shape:
    """A lane of a street that leaves a junction; without an index, the whole roadblock."""
    along, right = _HEADINGS[direction].astype(np.float64), _to_right(direction)
    at = np.linspace(_HALF, _SPACING - _HALF, round((_SPACING - 2 * _HALF) / _STEP) + 1)
    ends = at[[0, -1], None] * along
    inner, outer = (0.0, 2 * _WIDTH) if index is None else (index * _WIDTH, (index + 1) * _WIDTH)
    line = at[:, None] * along + 0.5 * (inner + outer) * right
    return _Shape(line, ends + inner * right, ends + outer * right)


@cache
def _turn_shape(direction: int, turn: str, index: int | None, border: int = _FEW) -> _Shape:
    """A connector from a street of some direction; without an index, the whole roadblock.

    A quadratic Bezier curve through a junction, `offset` to the right of both streets. Each of its
    borders has `border` points.
    """
    center, share = _BLOCK_TURNS[turn] if index is None else (index + 0.5, 0.5)
    offset, half = center * _WIDTH, share * _WIDTH
    target = (direction + _TURNS[turn]) % 4
    u, v = _HEADINGS[direction].astype(np.float64), _HEADINGS[target].astype(np.float64)
    a = -_HALF * u + offset * _to_right(direction)
    b = _HALF * v + offset * _to_right(target)
    corner = 0.5 * (a + b) if turn == "straight" else a + u * ((b - a) @ u)

    def curve(points: int) -> tuple[FloatArray, FloatArray]:
        t = np.linspace(0.0, 1.0, points)[:, None]
        tangent = 2 * (1 - t) * (corner - a) + 2 * t * (b - corner)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        line = (1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b
        return line, np.column_stack([-tangent[:, 1], tangent[:, 0]])

    line, normal = curve(border)
    return _Shape(curve(41)[0], line + half * normal, line - half * normal)


def _ego_path(city: _City) -> tuple[FloatArray, tuple[str, ...]]:
    """Centre line of the ego's way from the middle of the city, and its route."""
    street = city.streets[(_NODES // 2, _NODES // 2), 0]
    parts, route = [city.lines[street.lanes[1]]], [street.block]
    for turn in _ROUTE:
        index = _LANES_OF[turn][-1]
        following = city.streets[street.after(turn)]
        shape = _turn_shape(street.direction, turn, index)
        parts += [shape.line + _middle(street.end), city.lines[following.lanes[index]]]
        route += [str(20_000 + city.turns.index((street, turn))), following.block]
        street = following
    return np.concatenate(parts), tuple(route)


def _drive(path: FloatArray, rows: int) -> FloatArray:
    """(rows, 11) ego states along a path, slower where it bends."""
    arc = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    at = np.arange(0.0, arc[-1], 0.25)
    dense = np.column_stack([np.interp(at, arc, path[:, k]) for k in (0, 1)])
    weights = np.hanning(41)
    weights /= weights.sum()
    ends = np.concatenate([np.repeat(dense[:1], 20, 0), dense, np.repeat(dense[-1:], 20, 0)])
    local = ends - dense[0]
    smooth = dense[0] + np.column_stack([np.convolve(x, weights, "valid") for x in local.T])
    step = np.gradient(smooth, 0.25, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    bend = np.abs(np.gradient(heading, 0.25))
    speed = np.minimum(9.0, np.sqrt(1.8 / np.maximum(bend, 1e-3)))
    for order, towards in ((range(len(speed) - 2, -1, -1), 1), (range(1, len(speed)), -1)):
        for index in order:
            speed[index] = min(speed[index], np.sqrt(speed[index + towards] ** 2 + 2 * 1.0 * 0.25))
    time = np.r_[0.0, np.cumsum(0.5 / (speed[1:] + speed[:-1]))]
    clock = np.arange(rows) * ROW_S
    s = np.interp(clock, time, at)
    poses = np.column_stack([np.interp(s, at, column) for column in (*smooth.T, heading)])
    along = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    velocity = np.interp(s, at, speed)[:, None] * along
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return ego_states(poses, velocity)


class _Sort(NamedTuple):
    """Agents of one kind."""

    size: tuple[float, float]  # m
    share: float  # of all agents
    top: float = 0.0  # m/s
    aside: float = 3.2  # m to the right of the middle of a lane


_SORTS = {
    AgentKind.VEHICLE: _Sort((4.6, 1.9), 0.5, 9.0, 0.0),
    AgentKind.PEDESTRIAN: _Sort((0.7, 0.7), 0.25, 1.5),
    AgentKind.BICYCLE: _Sort((1.8, 0.6), 0.15, 5.0, 1.3),
    AgentKind.TRAFFIC_CONE: _Sort((0.4, 0.4), 0.06),
    AgentKind.BARRIER: _Sort((2.0, 0.5), 0.04),
}


def _agents(
    count: int, rng: np.random.Generator, ego: FloatArray, start: int, lines: list[FloatArray]
) -> Tracks:
    """Agents that start near the ego and keep clear of its recorded way."""
    here = ego[start, :2]
    reach = _RADIUS + _SPACING
    near = [line for line in lines if np.abs(line[len(line) // 2] - here).max() < reach]
    shares = [sort.share for sort in _SORTS.values()]
    kinds = rng.choice(np.array([*map(int, _SORTS)]), count, p=shares).astype(np.int64)
    rows = len(ego)
    poses = np.zeros((rows, count, 3))
    velocities = np.full((rows, count, 2), np.nan)
    placed: list[FloatArray] = []
    for index, kind in enumerate(kinds.tolist()):
        pose, speed = _place(kind, rng, ego, start, near, placed)
        placed.append(pose[:2])
        along = np.array([np.cos(pose[2]), np.sin(pose[2])]) * speed
        time = (np.arange(rows) - start)[:, None] * ROW_S
        poses[:, index, :2] = pose[:2] + time * along
        poses[:, index, 2] = pose[2]
        if kind <= AgentKind.BICYCLE:
            velocities[:, index] = along
    sizes = np.array([_SORTS[AgentKind(kind)].size for kind in kinds.tolist()]).reshape(-1, 2)
    return Tracks(
        np.ones((rows, count), np.bool_),
        poses,
        velocities,
        np.broadcast_to(sizes, (rows, count, 2)).copy(),
        kinds,
        tuple(f"agent{index:04d}" for index in range(count)),
    )


def _place(
    kind: int,
    rng: np.random.Generator,
    ego: FloatArray,
    start: int,
    near: list[FloatArray],
    placed: list[FloatArray],
) -> tuple[FloatArray, float]:
    """A pose at the start and a speed, such that nobody is hit; less choosy after many tries."""
    time = (np.arange(len(ego)) - start) * ROW_S
    taken = np.array(placed).reshape(-1, 2)
    sort = _SORTS[AgentKind(kind)]
    for attempt in range(2000):
        line = near[rng.integers(len(near))]
        at = int(rng.integers(len(line) - 1))
        step = line[at + 1] - line[at]
        heading = float(np.arctan2(step[1], step[0]))
        normal = np.array([np.sin(heading), -np.cos(heading)])
        xy = line[at] + sort.aside * normal + rng.uniform(-0.3, 0.3, 2)
        speed = float(sort.top * rng.random()) if rng.random() < 0.6 else 0.0
        room = max(6.0 * 0.97**attempt, 1.0) if kind == AgentKind.VEHICLE else 1.0
        path = xy + (time * speed)[:, None] * np.array([np.cos(heading), np.sin(heading)])
        clear = np.hypot(*(path - ego[:, :2]).T).min() > (6.5 if kind == 0 else 4.0)
        free = len(taken) == 0 or np.hypot(*(taken - xy).T).min() > room
        if np.hypot(*(xy - ego[start, :2])) < _RADIUS and clear and free:
            break
    return np.array([xy[0], xy[1], heading]), speed
