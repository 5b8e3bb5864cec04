"""A map from its parts, as readers and generators hand them over."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.layers import Layer, Lists, make_layer, make_lists, make_polylines
from shiftsim.world.map import LAYERS, NONE, VectorMap


@dataclass(frozen=True)
class EdgeSpec:
    """One lane or lane connector, as a reader hands it to `build_map`."""

    id: str  # object id
    is_connector: bool  # whether it is a lane connector
    polygon: shapely.Polygon  # its area
    baseline: FloatArray  # (K, 2) centre line in the direction of travel [m]
    block_id: str  # id of its roadblock, or roadblock connector
    incoming: Sequence[str] = ()  # ids of the edges that lead into it, in the order of the source
    outgoing: Sequence[str] = ()  # ids of the edges it leads to, in the order of the source
    left: FloatArray | None = None  # (K, 2) left boundary [m]; None where unknown
    right: FloatArray | None = None  # (K, 2) right boundary [m]
    left_id: str = ""  # id of the left boundary
    right_id: str = ""  # id of the right boundary
    speed_limit: float | None = None  # [m/s]; None where the map has none
    lane_index: int | None = None  # position in the roadblock, 0 leftmost; None for a connector
    left_lane: str | None = None  # id of the neighbour lane on the left
    right_lane: str | None = None  # id of the neighbour lane on the right
    has_traffic_lights: bool = False  # whether lights govern the connector
    stop_lines: Sequence[str] = ()  # ids of the stop polygons that belong to those lights
    intersection_id: str | None = None  # intersection a connector lies in
    turn_type: int = 4  # 0 straight, 1 left, 2 right, 3 u-turn, 4 unknown
    is_bike: bool = False  # whether it is a bicycle lane


@dataclass(frozen=True)
class BlockSpec:
    """One roadblock or roadblock connector, as a reader hands it to `build_map`."""

    id: str  # object id
    is_connector: bool  # whether it is a roadblock connector
    polygon: shapely.Polygon  # its area
    incoming: Sequence[str] = ()  # ids of the blocks that lead into it
    outgoing: Sequence[str] = ()  # ids of the blocks it leads to
    intersection_id: str | None = None  # intersection a connector lies in


@dataclass(frozen=True)
class AreaSpec:
    """One polygon of a layer without topology."""

    id: str  # object id
    polygon: shapely.Polygon  # its area
    kind: int = 0  # type number of a stop polygon or an intersection, 0 elsewhere


def build_map(
    name: str,
    *,
    edges: Sequence[EdgeSpec],  # lanes and connectors; the order within each kind is kept
    blocks: Sequence[BlockSpec],  # roadblocks and their connectors, likewise
    epsg: int = 0,  # code of the metric coordinate system; 0 for a local frame
    **areas: Sequence[AreaSpec],  # by name of another layer of the map
) -> VectorMap:
    """A map from its parts. References to unknown ids are left out and counted in `flaws`.

    The `kind` of `intersections` and `stop_polygons` is their type, `drivable_areas` are polygons
    whose union is drivable. It is a MapError if an id occurs twice, or a baseline is too short.
    """
    edges = sorted(edges, key=lambda spec: spec.is_connector)
    blocks = sorted(blocks, key=lambda spec: spec.is_connector)
    edge_index = _index_ids([spec.id for spec in edges], name, "lane or connector")
    block_index = _index_ids([spec.id for spec in blocks], name, "roadblock")
    others = {layer: areas.pop(layer, ()) for layer in LAYERS[2:]}
    if areas:
        raise TypeError(f"map {name!r}: there is no layer {next(iter(areas))!r}")
    stop_index = {spec.id: i for i, spec in enumerate(others["stop_polygons"])}
    intersection_index = {spec.id: i for i, spec in enumerate(others["intersections"])}
    flaws: dict[str, int] = {}

    def known(index: dict[str, int], ids: Sequence[str | None], flaw: str) -> list[int]:
        missing = sum(i is not None and i not in index for i in ids)
        if missing:
            flaws[flaw] = flaws.get(flaw, 0) + missing
        return [index[i] for i in ids if i is not None and i in index]

    def lists(specs: Sequence[Any], attribute: str, index: dict[str, int], flaw: str) -> Lists:
        return make_lists(known(index, getattr(spec, attribute), flaw) for spec in specs)

    def to_one(index: dict[str, int], attribute: str, what: str) -> IntArray:
        flaw = f"edge names an unknown {what}"
        found = [known(index, [getattr(s, attribute)], flaw) for s in edges]
        return np.array([(one or [NONE])[0] for one in found], np.int64)

    for spec in edges:
        if len(spec.baseline) < 2:
            raise MapError(f"map {name!r}: baseline of {spec.id!r} has fewer than two vertices")
    block_of = to_one(block_index, "block_id", "roadblock")
    nothing = np.zeros((0, 2))
    members: list[list[int]] = [[] for _ in blocks]
    for edge, block in enumerate(block_of.tolist()):
        if block != NONE:
            members[block].append(edge)
    limits = [np.nan if s.speed_limit is None else s.speed_limit for s in edges]
    positions = [NONE if s.lane_index is None else s.lane_index for s in edges]
    return VectorMap(
        name=name,
        epsg=epsg,
        edges=_layer(edges),
        num_lanes=sum(not s.is_connector for s in edges),
        baselines=make_polylines([s.baseline for s in edges]),
        left_boundaries=make_polylines([nothing if s.left is None else s.left for s in edges]),
        right_boundaries=make_polylines([nothing if s.right is None else s.right for s in edges]),
        boundary_ids=tuple((s.left_id, s.right_id) for s in edges),
        speed_limits=np.array(limits, np.float64),
        lane_index=np.array(positions, np.int64),
        left_lane=to_one(edge_index, "left_lane", "edge"),
        right_lane=to_one(edge_index, "right_lane", "edge"),
        incoming=lists(edges, "incoming", edge_index, "edge names an unknown edge"),
        outgoing=lists(edges, "outgoing", edge_index, "edge names an unknown edge"),
        block_of=block_of,
        has_traffic_lights=np.array([s.has_traffic_lights for s in edges], np.bool_),
        stop_lines=lists(edges, "stop_lines", stop_index, "edge names an unknown stop line"),
        intersection_of=to_one(intersection_index, "intersection_id", "intersection"),
        turn_type=np.array([s.turn_type for s in edges], np.int64),
        is_bike=np.array([s.is_bike for s in edges], np.bool_),
        blocks=_layer(blocks),
        num_roadblocks=sum(not s.is_connector for s in blocks),
        block_edges=make_lists(members),
        block_incoming=lists(blocks, "incoming", block_index, "roadblock names an unknown one"),
        block_outgoing=lists(blocks, "outgoing", block_index, "roadblock names an unknown one"),
        intersection_kinds=np.array([s.kind for s in others["intersections"]], np.int64),
        stop_kinds=np.array([s.kind for s in others["stop_polygons"]], np.int64),
        flaws=flaws,
        **{layer: _layer(specs) for layer, specs in others.items()},
    )


def _layer(specs: Sequence[EdgeSpec] | Sequence[BlockSpec] | Sequence[AreaSpec]) -> Layer:
    return make_layer([s.id for s in specs], [s.polygon for s in specs])


def _index_ids(ids: Sequence[str], map_name: str, what: str) -> dict[str, int]:
    index = {name: i for i, name in enumerate(ids)}
    if len(index) != len(ids):
        twice = next(i for i in ids if ids.count(i) > 1)
        raise MapError(f"map {map_name!r}: two {what}s have the id {twice!r}")
    return index
