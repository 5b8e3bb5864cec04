"""Features of PLUTO, reference lines and the route they follow, where a loop stores them."""

from typing import Any

import numpy as np

from shiftsim.planners.learned.map_features import CROSSWALK, RoadFeatures
from shiftsim.planners.learned.pluto.inputs import Inputs
from shiftsim.planners.learned.pluto.planner import Pluto, Sight
from shiftsim.sim.planner import Observation
from shiftsim.verify.nets.common import FEATURE, Loop

LINE = 1e-9  # m, rad: reference lines are made by the same operations
LAYERS = ("LANE", "LANE_CONNECTOR", "CROSSWALK")


def compare_features(
    loop: Loop, at: str, planner: Pluto, inputs: Inputs, seen: Observation
) -> None:
    """Compare everything stored for one iteration that is made before the network.

    Args:
        loop: The loop.
        at: Prefix of the iteration's arrays, without a slash.
        planner: The planner after this step.
        inputs: What its network read.
        seen: What it saw.
    """
    file = loop.file
    if f"{at}/agent_tokens" not in file.arrays:
        return
    sight, route, road = planner.sight, planner.route, loop.scenario.map
    assert sight is not None
    assert route is not None
    tracks = seen.history.tracks
    tokens = ["ego", *(tracks.tokens[track] for track in sight.agents.tracks)]
    loop.compare("pluto agents", at, tokens, file[f"{at}/agent_tokens"].tolist())
    ids = [*road.edges.ids, *road.crosswalks.ids]
    near = sight.road
    names = [ids[row] for row in near.objects]
    loop.compare("pluto map ids", at, names, file[f"{at}/map_ids"].tolist())
    layers = [LAYERS[kind] for kind in near.kind]
    loop.compare("pluto map layers", at, layers, file[f"{at}/map_layers"].tolist())
    blocks = [road.blocks.ids[block] for block in route.blocks]
    loop.compare("pluto route", at, blocks, file[f"{at}/corrected_route_ids"].tolist())
    _compare_lines(loop, at, sight)
    ours = {
        **_agents(inputs),
        **_map(loop, near),
        **_lines(inputs),
        "current_state": inputs.current_state,
        "origin": seen.history.ego[-1, :2],
        "angle": seen.history.ego[-1, 2],
    }
    for name, value in ours.items():
        given = file[f"{at}/feature/{name}"]
        if name.startswith("agent.") and name not in ("agent.category", "agent.target"):
            value, given = _where_valid(file, at, inputs, name, value, given)
        loop.compare("pluto features", f"{at} {name}", value, given, FEATURE)
    _compare_static(loop, at, inputs)


def _agents(inputs: Inputs) -> dict[str, Any]:
    return {
        "agent.valid_mask": inputs.valid,
        "agent.position": inputs.position,
        "agent.heading": inputs.heading,
        "agent.velocity": inputs.velocity,
        "agent.shape": inputs.shape,
        "agent.category": inputs.category,
        "agent.target": np.zeros((len(inputs.category), 0, 3)),
    }


def _where_valid(
    file: Any, at: str, inputs: Inputs, name: str, ours: Any, theirs: Any
) -> tuple[Any, Any]:
    """Entries of samples that exist; the others hold the origin of the map, moved."""
    mask = file[f"{at}/feature/agent.valid_mask"]
    if name == "agent.valid_mask" or ours.shape != theirs.shape or mask.shape != inputs.valid.shape:
        return ours, theirs
    return ours[mask], theirs[mask]


def _map(loop: Loop, near: RoadFeatures) -> dict[str, Any]:
    road = loop.scenario.map
    blocks = [
        0 if kind == CROSSWALK else int(road.blocks.ids[road.block_of[row]])
        for row, kind in zip(near.objects.tolist(), near.kind.tolist(), strict=True)
    ]
    return {
        "map.point_position": near.points,
        "map.point_vector": near.vectors,
        "map.point_orientation": near.orientations,
        "map.point_side": np.tile(np.arange(3), (len(near.kind), 1)),
        "map.polygon_center": near.centers,
        "map.polygon_position": near.points[:, 0, 0],
        "map.polygon_orientation": near.orientations[:, 0, 0],
        "map.polygon_type": near.kind,
        "map.polygon_on_route": near.on_route,
        "map.polygon_tl_status": near.light,
        "map.polygon_has_speed_limit": near.has_limit,
        "map.polygon_speed_limit": near.limit,
        "map.polygon_road_block_id": np.array(blocks, np.int64),
        "map.valid_mask": near.valid,
    }


def _lines(inputs: Inputs) -> dict[str, Any]:
    return {
        "reference_line.position": inputs.line_points,
        "reference_line.vector": inputs.line_vectors,
        "reference_line.orientation": inputs.line_orientations,
        "reference_line.valid_mask": inputs.line_valid,
        "reference_line.future_projection": np.zeros((len(inputs.line_valid), 8, 2)),
    }


def _compare_lines(loop: Loop, at: str, sight: Sight) -> None:
    prefix = f"{at}/reference_line_"
    stored = sorted(
        (name for name in loop.file.arrays if name.startswith(prefix)),
        key=lambda name: int(name.removeprefix(prefix)),
    )
    loop.compare("pluto reference lines", at, len(sight.lines), len(stored))
    for line, name in zip(sight.lines, stored, strict=False):
        loop.compare("pluto reference lines", name, line, loop.file[name], LINE)


def _compare_static(loop: Loop, at: str, inputs: Inputs) -> None:
    """Compare the static objects; nuPlan walks through a set, so their order means nothing."""
    prefix = f"{at}/feature/static_objects."
    names = ("position", "heading", "shape", "category", "valid_mask")
    given = [np.asarray(loop.file[prefix + name], np.float64) for name in names]
    ours = [
        inputs.object_pose[:, :2],
        inputs.object_pose[:, 2],
        inputs.object_shape,
        inputs.object_category,
        inputs.object_valid,
    ]
    count = len(inputs.object_valid)
    loop.compare("pluto static objects", at, count, len(given[0]))
    if any(len(array) != count for array in given):
        loop.compare("pluto static objects", at, [count] * 5, [len(array) for array in given])
        return
    order, their_order = _by_place(inputs.object_pose[:, :2]), _by_place(given[0])
    for name, mine, theirs in zip(names, ours, given, strict=True):
        where = f"{at} static_objects.{name}"
        loop.compare("pluto features", where, mine[order], theirs[their_order], FEATURE)


def _by_place(positions: Any) -> Any:
    """Order by place, to the centimetre."""
    rounded = np.rint(np.asarray(positions, np.float64) * 100.0)
    return np.lexsort((rounded[:, 1], rounded[:, 0]))
