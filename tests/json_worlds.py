"""Small worlds in plain JSON: a map, an ego and its expert, and objects, frame by frame."""

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
import shapely

from shiftsim.errors import DataError
from shiftsim.kernels import FloatArray
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.rollouts import ego_states, recorded_log
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario, scenario_of_rows
from shiftsim.world.state import AgentKind, tracks_of_boxes

World: TypeAlias = Mapping[str, Any]  # fields by name
_IS_CONNECTOR = {"lane": False, "connector": True, "roadblock": False, "roadblock_connector": True}


def kind_of(thing: World) -> AgentKind:
    """Type of an object that is listed."""
    return AgentKind[thing["type"].upper()]


def read_map(world: World, *fields: str) -> VectorMap:
    """The map of a world; `DataError` if an id names nothing.

    The world holds `edges` and `intersections`, perhaps `roadblocks` and `drivable_area`, perhaps
    `stop_lines`; its edges also hold the `fields`, named as in `EdgeSpec`.
    """
    blocks, stops = (world[n] if n in world else {} for n in ("roadblocks", "stop_lines"))
    road = build_map(
        "world",
        edges=[
            EdgeSpec(
                is_connector=_IS_CONNECTOR[edge["kind"]],
                polygon=shapely.Polygon(edge["polygon"]),
                baseline=np.array(edge["baseline"], np.float64),
                block_id=edge["roadblock"] if blocks else "",
                **{name: edge[name] for name in ("id", "outgoing", "speed_limit", *fields)},
            )
            for edge in world["edges"]
        ],
        blocks=[
            BlockSpec(name, _IS_CONNECTOR[block["kind"]], shapely.Polygon(block["polygon"]))
            for name, block in blocks.items()
        ],
        intersections=_areas(enumerate(world["intersections"])),
        drivable_areas=_areas(enumerate(world["drivable_area"])) if blocks else (),
        stop_polygons=_areas(stops.items()),
    )
    # an edge of a map without blocks is in none
    if lost := [flaw for flaw in road.flaws if blocks or "roadblock" not in flaw]:
        raise DataError(f"ids that name nothing: {', '.join(lost)}")
    return road


def _areas(rings: Iterable[tuple[object, Any]]) -> list[AreaSpec]:
    return [AreaSpec(str(name), shapely.Polygon(ring)) for name, ring in rings]


def read_scenario(world: World, road: VectorMap, ego: FloatArray) -> Scenario:
    """The scenario of a world from its map and its ego states (T, 11).

    The world also holds `time_us` and `objects`, which list x, y, heading, vx, vy per frame.
    """
    time_us = np.array(world["time_us"], np.int64)
    objects = sorted(world["objects"], key=kind_of)
    counts = {len(ego), *(len(thing["frames"]) for thing in objects)}
    if counts != {len(time_us)}:
        raise DataError(f"{sorted(counts)} frames for {len(time_us)} time stamps")
    values = np.full((len(time_us), len(objects), 7), np.nan)
    for column, thing in enumerate(objects):
        for row, frame in enumerate(thing["frames"]):
            if frame is not None:
                values[row, column] = [*frame, thing["length"], thing["width"]]
    kinds, tokens = [kind_of(thing) for thing in objects], [thing["token"] for thing in objects]
    tracks = tracks_of_boxes(values, kinds, tokens)
    return scenario_of_rows(f"world {world.get('world')}", road, time_us, ego, tracks)


def read_world(world: World) -> tuple[SimulationLog, VectorMap]:
    """Rollout and map of a world that holds an `ego` and its `expert`."""
    road = read_map(world["map"], "incoming")
    ego, expert = (
        ego_states(dict(zip(world["state_columns"], np.transpose(world[name]), strict=True)))
        for name in ("ego", "expert")
    )
    return recorded_log(read_scenario(world, road, expert), ego), road
