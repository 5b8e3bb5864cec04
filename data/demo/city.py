"""A generated city, large enough to measure speed on, and one scenario in it.

Streets form a grid: two lanes per direction, a junction at every crossing with straight, left and
right connectors. Coordinates are UTM-like.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.deepplan.states import ego_states
from shiftsim.data.deepplan.windows import ROW_S
from shiftsim.world.map import AreaSpec, BlockSpec, EdgeSpec, VectorMap, build_map
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, Tracks, TrafficLights

_NODES = 26  # junctions along each axis: 2600 roadblocks of two lanes
_SPACING, _HALF = 72.0, 15.0  # m between junctions, m from a junction's middle to its streets
_WIDTH = 3.5  # m
_ORIGIN = np.array([331_000.0, 4_690_000.0])  # m
_STEP = 0.5  # m between baseline vertices
_LIMIT = 13.9  # m/s
_HEADINGS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # east, north, west, south
_SPAN = (3.0, 15.0, 8.0)  # s of history, scenario and future
_RADIUS = 50.0  # m around the ego in which agents start
_ROUTE = ("right", "straight", "left", "right", "straight")
_TURNS = {"right": -1, "straight": 0, "left": 1}


@dataclass(frozen=True)
class _Shape:
    """A baseline and its borders, relative to the middle of a junction. K points."""

    line: FloatArray
    left: FloatArray
    right: FloatArray

    def area(self, middle: FloatArray) -> shapely.Polygon:
        """The area between the borders."""
        return shapely.Polygon(np.concatenate([self.left, self.right[::-1]]) + middle)


@dataclass(frozen=True)
class _Street:
    """One direction of one street: node it leaves, direction, ids of its lanes, roadblock."""

    node: tuple[int, int]
    direction: int
    lanes: tuple[str, str]
    block: str


def bench_scene(num_agents: int, seed: int) -> Scenario:
    """A 15 s scenario in a city of 5200 lanes, with 3 s of history and 8 s of future.

    Args:
        num_agents: Vehicles, pedestrians, bicycles and objects that start within 50 m of the ego.
        seed: Of the agents; the city and the ego are always the same.
    """
    streets = _streets()
    road, lines = _city(streets)
    path, route = _ego_path(streets, lines)
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
        tracks=_agents(num_agents, rng, ego, start, lines),
        traffic_lights=TrafficLights.empty(rows),
        iteration_rows=iterations,
        row_step=2,
        route=route,
        mission_goal=ego[-1, :3].copy(),
        mapping=(_SPAN[1], 0.0, 0.5),
    )


def _streets() -> dict[tuple[tuple[int, int], int], _Street]:
    """Streets by the node they leave and their direction."""
    out: dict[tuple[tuple[int, int], int], _Street] = {}
    for x in range(_NODES):
        for y in range(_NODES):
            for direction, (dx, dy) in enumerate(_HEADINGS.tolist()):
                if 0 <= x + dx < _NODES and 0 <= y + dy < _NODES:
                    number = len(out)
                    lanes = (str(100_000 + 2 * number), str(100_001 + 2 * number))
                    out[(x, y), direction] = _Street((x, y), direction, lanes, str(10_000 + number))
    return out


def _city(
    streets: dict[tuple[tuple[int, int], int], _Street],
) -> tuple[VectorMap, dict[str, FloatArray]]:
    """The map, and the baseline of every lane and connector."""
    lines: dict[str, FloatArray] = {}
    into: dict[str, list[str]] = {}
    out_of: dict[str, list[str]] = {}
    edges: list[EdgeSpec] = []
    blocks: list[BlockSpec] = []
    junctions: list[AreaSpec] = []
    for street in streets.values():
        for index, lane in enumerate(street.lanes):
            lines[lane] = _lane_shape(street.direction, index).line + _middle(street.node)
    turns = [
        (street, turn)
        for street in streets.values()
        for turn in _TURNS
        if (_end_node(street), (street.direction + _TURNS[turn]) % 4) in streets
    ]
    for number, (street, turn) in enumerate(turns):
        target = streets[_end_node(street), (street.direction + _TURNS[turn]) % 4]
        indices = {"straight": (0, 1), "left": (0,), "right": (1,)}[turn]
        names = [f"{200_000 + 2 * number + index}" for index in indices]
        block = str(20_000 + number)
        node = _end_node(street)
        junction = str(1_000 + node[0] * _NODES + node[1])
        middle = _middle(node)
        for name, index in zip(names, indices, strict=True):
            source, goal = street.lanes[index], target.lanes[index]
            shape = _turn_shape(street.direction, turn, index)
            lines[name] = shape.line + middle
            into.setdefault(goal, []).append(name)
            out_of.setdefault(source, []).append(name)
            edges.append(
                EdgeSpec(
                    id=name,
                    is_connector=True,
                    polygon=shape.area(middle),
                    baseline=lines[name],
                    block_id=block,
                    incoming=[source],
                    outgoing=[goal],
                    left=shape.left + middle,
                    right=shape.right + middle,
                    speed_limit=_LIMIT,
                    intersection_id=junction,
                    turn_type={"straight": 0, "left": 1, "right": 2}[turn],
                )
            )
        blocks.append(
            BlockSpec(
                block,
                True,
                _block_shape(street.direction, turn).area(middle),
                [street.block],
                [target.block],
                junction,
            )
        )
        into.setdefault(target.block, []).append(block)
        out_of.setdefault(street.block, []).append(block)
    for street in streets.values():
        edges += _lane_specs(street, lines, into, out_of)
        blocks.append(
            BlockSpec(
                street.block,
                False,
                _lane_shape(street.direction, None).area(_middle(street.node)),
                into.get(street.block, []),
                out_of.get(street.block, []),
            )
        )
    for x in range(_NODES):
        for y in range(_NODES):
            cx, cy = _ORIGIN + _SPACING * np.array([x, y])
            square = shapely.box(cx - _HALF, cy - _HALF, cx + _HALF, cy + _HALF)
            junctions.append(AreaSpec(str(1_000 + x * _NODES + y), square))
    areas = [AreaSpec(f"d{b.id}", b.polygon) for b in blocks if not b.is_connector]
    road = build_map(
        "bench-city",
        edges=edges,
        blocks=blocks,
        epsg=32_619,
        intersections=junctions,
        crosswalks=[AreaSpec(f"c{j.id}", _crosswalk(j.polygon)) for j in junctions],
        drivable_areas=[*areas, *(AreaSpec(f"d{j.id}", j.polygon) for j in junctions)],
    )
    return road, lines


def _lane_specs(
    street: _Street,
    lines: dict[str, FloatArray],
    into: dict[str, list[str]],
    out_of: dict[str, list[str]],
) -> list[EdgeSpec]:
    left, right = street.lanes
    middle = _middle(street.node)
    shapes = [_lane_shape(street.direction, index) for index in (0, 1)]
    return [
        EdgeSpec(
            id=lane,
            is_connector=False,
            polygon=shapes[index].area(middle),
            baseline=lines[lane],
            block_id=street.block,
            incoming=into.get(lane, []),
            outgoing=out_of.get(lane, []),
            left=shapes[index].left + middle,
            right=shapes[index].right + middle,
            speed_limit=_LIMIT,
            lane_index=index,
            left_lane=left if index else None,
            right_lane=None if index else right,
        )
        for index, lane in enumerate(street.lanes)
    ]


def _end_node(street: _Street) -> tuple[int, int]:
    dx, dy = _HEADINGS[street.direction].tolist()
    return street.node[0] + dx, street.node[1] + dy


def _middle(node: tuple[int, int]) -> FloatArray:
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
def _turn_shape(direction: int, turn: str, index: int) -> _Shape:
    """A connector through a junction from a street of some direction."""
    return _between(direction, turn, (index + 0.5) * _WIDTH, 0.5 * _WIDTH)


@cache
def _block_shape(direction: int, turn: str) -> _Shape:
    """All connectors of one turn from a street of some direction."""
    center, half = {"straight": (1.0, 1.0), "left": (0.5, 0.5), "right": (1.5, 0.5)}[turn]
    return _between(direction, turn, center * _WIDTH, half * _WIDTH)


def _between(direction: int, turn: str, offset: float, half: float) -> _Shape:
    """A quadratic Bezier curve through a junction, `offset` to the right of both streets."""
    target = (direction + _TURNS[turn]) % 4
    u, v = _HEADINGS[direction].astype(np.float64), _HEADINGS[target].astype(np.float64)
    a = -_HALF * u + offset * _to_right(direction)
    b = _HALF * v + offset * _to_right(target)
    corner = 0.5 * (a + b) if turn == "straight" else a + u * ((b - a) @ u)
    t = np.linspace(0.0, 1.0, 41)[:, None]
    line = (1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b
    tangent = 2 * (1 - t) * (corner - a) + 2 * t * (b - corner)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    every = slice(None, None, 4)
    return _Shape(line, (line + half * normal)[every], (line - half * normal)[every])


def _crosswalk(junction: shapely.Polygon) -> shapely.Polygon:
    x, y, _, high = junction.bounds
    return shapely.box(x, y, x + 3.0, high)


def _ego_path(
    streets: dict[tuple[tuple[int, int], int], _Street], lines: dict[str, FloatArray]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Centre line of the ego's way from the middle of the city, and its route."""
    street = streets[(_NODES // 2, _NODES // 2), 0]
    parts, route = [lines[street.lanes[1]]], [street.block]
    for turn in _ROUTE:
        index = 0 if turn == "left" else 1
        direction = (street.direction + _TURNS[turn]) % 4
        following = streets[_end_node(street), direction]
        shape = _turn_shape(street.direction, turn, index)
        parts += [shape.line + _middle(_end_node(street)), lines[following.lanes[index]]]
        route += [_block_between(streets, street, following), following.block]
        street = following
    return np.concatenate(parts), tuple(route)


def _block_between(
    streets: dict[tuple[tuple[int, int], int], _Street], source: _Street, goal: _Street
) -> str:
    number = 0
    for street in streets.values():
        for turn in _TURNS:
            end = _end_node(street), (street.direction + _TURNS[turn]) % 4
            if end not in streets:
                continue
            if street is source and streets[end] is goal:
                return str(20_000 + number)
            number += 1
    raise AssertionError("streets that do not meet")


def _drive(path: FloatArray, rows: int) -> FloatArray:
    """(rows, 11) ego states along a path, slower where it bends."""
    arc = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    at = np.arange(0.0, arc[-1], 0.25)
    dense = np.column_stack([np.interp(at, arc, path[:, k]) for k in (0, 1)])
    weights = np.hanning(41)
    weights /= weights.sum()
    ends = np.concatenate([np.repeat(dense[:1], 20, 0), dense, np.repeat(dense[-1:], 20, 0)])
    local = ends - dense[0]
    smooth = dense[0] + np.column_stack(
        [np.convolve(local[:, k], weights, "valid") for k in (0, 1)]
    )
    step = np.gradient(smooth, 0.25, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    bend = np.abs(np.gradient(heading, 0.25))
    speed = np.minimum(9.0, np.sqrt(1.8 / np.maximum(bend, 1e-3)))
    for order in (range(len(speed) - 2, -1, -1), range(1, len(speed))):
        towards = 1 if order.step == -1 else -1
        for index in order:
            speed[index] = min(speed[index], np.sqrt(speed[index + towards] ** 2 + 2 * 1.0 * 0.25))
    time = np.r_[0.0, np.cumsum(0.5 / (speed[1:] + speed[:-1]))]
    clock = np.arange(rows) * ROW_S
    s = np.interp(clock, time, at)
    poses = np.column_stack([np.interp(s, at, column) for column in (*smooth.T, heading)])
    velocity = np.interp(s, at, speed)[:, None] * np.column_stack(
        [np.cos(poses[:, 2]), np.sin(poses[:, 2])]
    )
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return ego_states(poses, velocity)


_SIZES = {
    AgentKind.VEHICLE: (4.6, 1.9),
    AgentKind.PEDESTRIAN: (0.7, 0.7),
    AgentKind.BICYCLE: (1.8, 0.6),
    AgentKind.TRAFFIC_CONE: (0.4, 0.4),
    AgentKind.BARRIER: (2.0, 0.5),
}


def _agents(
    count: int,
    rng: np.random.Generator,
    ego: FloatArray,
    start: int,
    lines: dict[str, FloatArray],
) -> Tracks:
    """Agents that start near the ego and keep clear of its recorded way."""
    here = ego[start, :2]
    near = [
        line
        for line in lines.values()
        if np.abs(line[len(line) // 2] - here).max() < _RADIUS + _SPACING
    ]
    kinds = rng.choice(
        np.array([int(kind) for kind in _SIZES]), count, p=[0.5, 0.25, 0.15, 0.06, 0.04]
    ).astype(np.int64)
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
    sizes = np.array([_SIZES[AgentKind(kind)] for kind in kinds.tolist()]).reshape(-1, 2)
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
    aside = {AgentKind.VEHICLE: 0.0, AgentKind.BICYCLE: 1.3}.get(AgentKind(kind), 3.2)
    top = {AgentKind.VEHICLE: 9.0, AgentKind.PEDESTRIAN: 1.5, AgentKind.BICYCLE: 5.0}.get(
        AgentKind(kind), 0.0
    )
    for attempt in range(2000):
        line = near[rng.integers(len(near))]
        at = int(rng.integers(len(line) - 1))
        step = line[at + 1] - line[at]
        heading = float(np.arctan2(step[1], step[0]))
        normal = np.array([np.sin(heading), -np.cos(heading)])
        xy = line[at] + aside * normal + rng.uniform(-0.3, 0.3, 2)
        speed = float(top * rng.random()) if rng.random() < 0.6 else 0.0
        room = max(6.0 * 0.97**attempt, 1.0) if kind == AgentKind.VEHICLE else 1.0
        path = xy + (time * speed)[:, None] * np.array([np.cos(heading), np.sin(heading)])
        clear = np.hypot(*(path - ego[:, :2]).T).min() > (6.5 if kind == 0 else 4.0)
        free = len(taken) == 0 or np.hypot(*(taken - xy).T).min() > room
        if np.hypot(*(xy - ego[start, :2])) < _RADIUS and clear and free:
            break
    return np.array([xy[0], xy[1], heading]), speed
