"""Vehicles in the lanes around the ego at random distances, with speeds that let them stop.

The draws are those of interPlan (`random.Random`, in its order), so that its density codes give the
same vehicles; what it does with them is in `shiftsim.edits.interplan`.
"""

import math
import random
from contextlib import suppress
from functools import partial
from itertools import takewhile
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.edits.builder import ScenarioBuilder
from shiftsim.edits.spec import LEVELS, Density
from shiftsim.errors import ConfigError
from shiftsim.kernels import FloatArray
from shiftsim.world.events import FOLLOW
from shiftsim.world.lanes import find_start, initial_curvature, poses_at
from shiftsim.world.layers import Lists
from shiftsim.world.map import VectorMap

NEAR_EGO = 10.0  # m, a vehicle nearer to the ego in its lane becomes the ego
_DEFAULT_LIMIT = 10.0  # m/s, where the map has none
_SIZE = np.array([4.6, 1.9])  # m
_ALPHA = 0.75  # s^2/m: 3 / (2 * 2 m/s^2), a braking distance for a square of speed
_COMFORT = 1.0  # m/s^2, at which the first one of a lane could stop at its end


class Slot(NamedTuple):
    """A place for a vehicle."""

    pose: FloatArray  # (3,) x [m], y [m], heading [rad]
    speed: float  # [m/s]


def fill_lanes(builder: ScenarioBuilder, density: Density) -> None:
    """Add vehicles that drive, as far as there is space; a ConfigError if the ego is on no lane."""
    road, center = builder.scenario.map, builder.center
    start = find_start(road, center)
    if start is None:
        raise ConfigError("density: the ego is on no lane at the start")
    gap = density.gap_m or LEVELS[density.level]
    slots, speed = draw_slots(
        road, start.edge, center, gap, density.also_at, builder.draws, reach=density.reach_m
    )
    if speed is not None:
        builder.set_ego_speed(speed)
    for slot in slots:
        with suppress(ConfigError):  # no space: density is a matter of chance
            builder.add_vehicle(builder.name("vehicle"), slot.pose, _SIZE, slot.speed, FOLLOW)


def draw_slots(
    road: VectorMap,
    ego_edge: int,  # lane or connector of the ego
    center: FloatArray,  # (3,) centre of the ego
    gap: tuple[float, float],  # least and largest distance between two vehicles [m]
    also_at: tuple[tuple[float, float], ...],  # points whose roadblocks are filled, too [m]
    draws: random.Random,
    *,
    reach: float = 50.0,  # how far beyond the ego the lanes are filled [m]
) -> tuple[list[Slot], float | None]:
    """Places of vehicles in all lanes, and the ego's speed in one of them; or a ConfigError."""
    block = int(road.block_of[ego_edge])
    lanes = road.block_edges.at(block).tolist()
    for x, y in also_at:
        found = blocks_at(road, x, y)
        if not found:
            raise ConfigError(f"density: ({x:.1f}, {y:.1f}) is in no roadblock")
        lanes += road.block_edges.at(found[0]).tolist()
    has_one_exit = len(road.block_outgoing.at(block)) == 1
    out: list[Slot] = []
    ego_speed = None
    for lane in lanes:
        line = lane_line(road, extended(road, lane, center, reach))
        ego_at = float(shapely.line_locate_point(line, shapely.Point(center[0], center[1])))
        limit = float(road.speed_limits[lane])
        limit = 0.0 if math.isnan(limit) else limit
        along, speed, is_first = float(line.length), 0.0, True
        found_at, found_speeds = list[float](), list[float]()
        while along > 0.0:
            distance: float = draws.randrange(int(gap[0]), int(gap[1]))
            along -= distance
            if along < 0.0:
                continue
            if lane == ego_edge and abs(along - ego_at) < NEAR_EGO:
                distance += along - ego_at
                along = ego_at
            if not is_first:
                reaction = max(draws.gauss(0.25, 0.05), 0.1)
                speed = safe_speed(speed, distance, reaction)
            elif has_one_exit:
                speed = limit or _DEFAULT_LIMIT
            else:
                speed = math.sqrt((2 / 3) * abs(line.length - along) * _COMFORT)
            speed += draws.gauss(0, 1)
            speed = max(min(speed, limit) if limit else speed, 0)
            is_first = False
            if along - ego_at == 0:
                ego_speed = speed
            else:
                found_at.append(along)
                found_speeds.append(speed)
        points = shapely.line_interpolate_point(line, found_at)
        out += map(Slot, poses_at(line, shapely.line_locate_point(line, points)), found_speeds)
    return out, ego_speed


def safe_speed(lead: float, distance: float, reaction: float) -> float:
    """Speed [m/s] that stops behind a `lead` [m/s] that brakes, at a `distance` [m]."""
    root = math.sqrt(reaction**2 + 4 * _ALPHA * (_ALPHA * lead**2 + distance))
    return min(distance / 2, (-reaction + root) / (2 * _ALPHA))


def blocks_at(road: VectorMap, x: float, y: float) -> list[int]:
    """Roadblocks, else roadblock connectors, that hold a point."""
    found = road.blocks.containing(x, y).tolist()
    return [b for b in found if b < road.num_roadblocks] or found


def extended(road: VectorMap, lane: int, center: FloatArray, reach: float) -> list[int]:
    """A lane and those before and behind it, `reach` [m] beyond the ego, up to traffic lights."""
    along = road.progress_on(lane, center[0], center[1])

    def chain(neighbours: Lists, beyond: float) -> list[int]:
        edges = [lane]
        while beyond < reach:
            # interPlan: lights close not their own edge only, but all listed after it as well
            following = takewhile(
                lambda edge: not road.has_traffic_lights[edge], neighbours.at(edges[-1]).tolist()
            )
            curvature = partial(initial_curvature, road.baselines)
            if (chosen := min(following, key=curvature, default=None)) is None:
                break
            beyond += road.baselines.length(chosen)
            edges.append(chosen)
        return edges

    before = chain(road.incoming, along)
    return before[:0:-1] + chain(road.outgoing, road.baselines.length(lane) - along)


def lane_line(road: VectorMap, edges: list[int]) -> shapely.LineString:
    """The centre lines of edges as one line; a ConfigError where they do not meet."""
    lines = [shapely.LineString(road.baselines.at(edge)) for edge in edges]
    line = shapely.line_merge(shapely.MultiLineString(lines))
    if not isinstance(line, shapely.LineString):
        names = ", ".join(road.edges.ids[edge] for edge in edges)
        raise ConfigError(f"density: the centre lines of {names} do not meet")
    return line
