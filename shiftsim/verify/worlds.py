"""What reference files hold of a rollout: ego states, tracks and small maps in plain JSON."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import DataError
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.verify.files import Source
from shiftsim.world import state
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, Tracks, TrafficLights

# Columns of an ego state in the words of the official tables, in the order of `state.STATE_COLUMNS`
EGO_COLUMNS = (
    *("x", "y", "heading", "vx", "vy", "ax", "ay"),
    *("tire_steering_angle", "tire_steering_rate", "angular_velocity", "angular_acceleration"),
)
CENTER_COLUMNS = ("center_x", "center_y", "center_heading")
BOX_COLUMNS = ("x", "y", "heading", "vx", "vy", "length", "width")
_IS_CONNECTOR = {"lane": False, "connector": True, "roadblock": False, "roadblock_connector": True}
_SHORT = {"omega": "angular_velocity", "alpha": "angular_acceleration"}


def ego_states(columns: Mapping[str, Any]) -> FloatArray:
    """(R, 11) ego states from columns by name; what has no column is 0."""
    out = np.zeros((len(next(iter(columns.values()))), state.NUM_STATE))
    for name, values in columns.items():
        out[:, EGO_COLUMNS.index(_SHORT.get(name, name))] = values
    return out


def ego_columns(states: FloatArray) -> dict[str, FloatArray]:
    """Columns of the official tables by name, from (R, 11) ego states: rear axle and centre."""
    columns = np.concatenate([states, state.center_poses(states[:, :3])], axis=1)
    return dict(zip((*EGO_COLUMNS, *CENTER_COLUMNS), columns.T, strict=True))


def object_columns(tracks: Tracks, rows: IntArray, index: IntArray) -> dict[str, Any]:
    """Columns of `objects.parquet` but for heights: tracks at rows, both (R,)."""
    kinds = tracks.kinds[index]
    # the official table shows static objects, which have no velocity, as standing
    moves = tracks.velocities[rows, index]
    moves = np.where(kinds[:, None] > state.LAST_AGENT_KIND, np.nan_to_num(moves), moves)
    values = [tracks.poses[rows, index], moves, tracks.sizes[rows, index]]
    return {
        "iteration": rows,
        "track_token": [tracks.tokens[i] for i in index.tolist()],
        "type": [AgentKind(kind).name for kind in kinds.tolist()],
        **dict(zip(BOX_COLUMNS, np.concatenate(values, axis=1).T, strict=True)),
    }


def make_tracks(
    shape: tuple[int, int],
    where: Any,
    values: FloatArray,
    kinds: Sequence[str],
    tokens: Sequence[str],
) -> Tracks:
    """Dense tracks of a shape (rows, tracks), with names of their types and their tokens.

    `values` (..., 7) are x, y, heading, vx, vy, length, width at the rows and tracks `where` (`...`
    where they are dense); NaN where a track is absent.
    """
    dense = np.full((*shape, 7), np.nan)
    dense[where] = values
    return Tracks(
        valid=~np.isnan(dense[..., 0]),
        poses=np.ascontiguousarray(dense[..., :3]),
        velocities=np.ascontiguousarray(dense[..., 3:5]),
        sizes=np.ascontiguousarray(dense[..., 5:]),
        kinds=np.array([AgentKind[name.upper()] for name in kinds], np.int64),
        tokens=tuple(tokens),
    )


def read_map(world: Source, *fields: str) -> VectorMap:
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
            for edge in world.each("edges")
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
    lost = [flaw for flaw in road.flaws if blocks or "roadblock" not in flaw]
    if lost:
        raise DataError(f"ids that name nothing: {', '.join(lost)}")
    return road


def _areas(rings: Iterable[tuple[object, Any]]) -> list[AreaSpec]:
    return [AreaSpec(str(name), shapely.Polygon(ring)) for name, ring in rings]


def make_scenario(
    token: str, road: VectorMap, time_us: IntArray, ego: FloatArray, tracks: Tracks
) -> Scenario:
    """A scenario whose iterations are all rows, without lights, route and goal."""
    return Scenario(
        token=token,
        scenario_type="unknown",
        log_name="world",
        city=road.name,
        map=road,
        time_us=time_us,
        ego=ego,
        tracks=tracks,
        traffic_lights=TrafficLights.empty(len(time_us)),
        iteration_rows=np.arange(len(time_us)),
        row_step=1,
        route=(),
        mission_goal=None,
        mapping=(10.0, 0.0, 1.0),
    )


def read_scenario(world: Source, road: VectorMap, ego: FloatArray) -> Scenario:
    """The scenario of a world from its map and its ego states (T, 11).

    The world also holds `time_us` and `objects`, which list x, y, heading, vx, vy per frame.
    """
    time_us = np.array(world["time_us"], np.int64)
    objects = sorted(world.each("objects"), key=lambda thing: AgentKind[thing["type"].upper()])
    counts = {len(ego), *(len(thing["frames"]) for thing in objects)}
    if counts != {len(time_us)}:
        raise DataError(f"{sorted(counts)} frames for {len(time_us)} time stamps")
    values = np.full((len(time_us), len(objects), 7), np.nan)
    for column, thing in enumerate(objects):
        for row, frame in enumerate(thing["frames"]):
            if frame is not None:
                values[row, column] = [*frame, thing["length"], thing["width"]]
    kinds, tokens = ([thing[name] for thing in objects] for name in ("type", "token"))
    tracks = make_tracks(values.shape[:2], ..., values, kinds, tokens)
    return make_scenario(f"world {world.values.get('world')}", road, time_us, ego, tracks)


def recorded_log(scenario: Scenario, ego: FloatArray) -> SimulationLog:
    """A rollout of which only the ego states (K, 11) are known; the scenario has the expert's."""
    log = as_recorded(scenario)
    if len(ego) != len(log.ego):
        raise DataError(f"{len(ego)} ego states, {len(log.ego) + 1} of the expert")
    return replace(log, ego=ego)
