"""VectorMap: the semantic map as flat arrays.

Lanes and lane connectors are one list of *edges* (all lanes first, then all connectors, each in the
order of the source tables), so that one integer names a piece of road everywhere. The same holds
for roadblocks and roadblock connectors (*blocks*). Ids are strings at the boundary only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.errors import MapError, one_of
from shiftsim.world.layers import (
    Layer,
    Lists,
    Polylines,
    make_layer,
    make_lists,
    make_polylines,
    project_on_line,
)

NONE = -1  # "no such object" in index arrays
LAYERS = (
    "edges",
    "blocks",
    "intersections",
    "stop_polygons",
    "crosswalks",
    "walkways",
    "car_parks",
    "drivable_areas",
)


@dataclass(frozen=True)
class EdgeSpec:
    """One lane or lane connector, as a reader hands it to `build_map`.

    Attributes:
        id: Object id.
        is_connector: Whether it is a lane connector.
        polygon: Its area.
        baseline: (K, 2) centre line in the direction of travel [m].
        block_id: Id of its roadblock, or roadblock connector.
        incoming: Ids of the edges that lead into it, in the order of the source.
        outgoing: Ids of the edges it leads to, in the order of the source.
        left: (K, 2) left boundary [m]; None where unknown.
        right: (K, 2) right boundary [m].
        left_id: Id of the left boundary.
        right_id: Id of the right boundary.
        speed_limit: [m/s]; None where the map has none.
        lane_index: Position in the roadblock, 0 leftmost; None for a connector.
        left_lane: Id of the neighbour lane on the left.
        right_lane: Id of the neighbour lane on the right.
        has_traffic_lights: Whether lights govern the connector.
        stop_lines: Ids of the stop polygons that belong to those lights.
        intersection_id: Intersection a connector lies in.
        turn_type: 0 straight, 1 left, 2 right, 3 u-turn, 4 unknown.
        is_bike: Whether it is a bicycle lane.
    """

    id: str
    is_connector: bool
    polygon: shapely.Polygon
    baseline: FloatArray
    block_id: str
    incoming: Sequence[str] = ()
    outgoing: Sequence[str] = ()
    left: FloatArray | None = None
    right: FloatArray | None = None
    left_id: str = ""
    right_id: str = ""
    speed_limit: float | None = None
    lane_index: int | None = None
    left_lane: str | None = None
    right_lane: str | None = None
    has_traffic_lights: bool = False
    stop_lines: Sequence[str] = ()
    intersection_id: str | None = None
    turn_type: int = 4
    is_bike: bool = False


@dataclass(frozen=True)
class BlockSpec:
    """One roadblock or roadblock connector, as a reader hands it to `build_map`.

    Attributes:
        id: Object id.
        is_connector: Whether it is a roadblock connector.
        polygon: Its area.
        incoming: Ids of the blocks that lead into it.
        outgoing: Ids of the blocks it leads to.
        intersection_id: Intersection a connector lies in.
    """

    id: str
    is_connector: bool
    polygon: shapely.Polygon
    incoming: Sequence[str] = ()
    outgoing: Sequence[str] = ()
    intersection_id: str | None = None


@dataclass(frozen=True)
class AreaSpec:
    """One polygon of a layer without topology.

    Attributes:
        id: Object id.
        polygon: Its area.
        kind: Type number of a stop polygon or an intersection, 0 elsewhere.
    """

    id: str
    polygon: shapely.Polygon
    kind: int = 0


@dataclass(frozen=True)
class VectorMap:
    """A semantic map. E edges, B blocks.

    Attributes:
        name: Map (city) name.
        epsg: Code of the metric coordinate system; 0 for a local frame.
        edges: Lanes, then lane connectors: ids and polygons.
        num_lanes: How many of the edges are lanes.
        baselines: E centre lines in the direction of travel.
        left_boundaries: E lines; empty where unknown.
        right_boundaries: E lines; empty where unknown.
        boundary_ids: E pairs of boundary ids, left and right.
        speed_limits: (E,) [m/s], NaN where the map has none.
        lane_index: (E,) position in the roadblock, 0 leftmost, NONE for connectors.
        left_lane: (E,) neighbour lane on the left, or NONE.
        right_lane: (E,) neighbour lane on the right, or NONE.
        incoming: Edges that lead into an edge.
        outgoing: Edges an edge leads to.
        block_of: (E,) block of an edge, NONE where the source names an unknown one.
        has_traffic_lights: (E,) whether lights govern the edge.
        stop_lines: Stop polygons of an edge.
        intersection_of: (E,) intersection of a connector, or NONE.
        turn_type: (E,) 0 straight, 1 left, 2 right, 3 u-turn, 4 unknown.
        is_bike: (E,) whether the edge is a bicycle lane.
        blocks: Roadblocks, then roadblock connectors: ids and polygons.
        num_roadblocks: How many of the blocks are roadblocks.
        block_edges: Edges of a block, in the order of the edges.
        block_incoming: Blocks that lead into a block.
        block_outgoing: Blocks a block leads to.
        intersections: Layer.
        intersection_kinds: Type number of each intersection.
        stop_polygons: Layer.
        stop_kinds: Type number of each stop polygon.
        crosswalks: Layer.
        walkways: Layer.
        car_parks: Layer.
        drivable_areas: Layer: road segments, intersections, generic drivable areas, car parks.
        flaws: Count by kind of what the source got wrong and nuPlan tolerates.
    """

    name: str
    epsg: int
    edges: Layer
    num_lanes: int
    baselines: Polylines
    left_boundaries: Polylines
    right_boundaries: Polylines
    boundary_ids: tuple[tuple[str, str], ...]
    speed_limits: FloatArray
    lane_index: IntArray
    left_lane: IntArray
    right_lane: IntArray
    incoming: Lists
    outgoing: Lists
    block_of: IntArray
    has_traffic_lights: BoolArray
    stop_lines: Lists
    intersection_of: IntArray
    turn_type: IntArray
    is_bike: BoolArray
    blocks: Layer
    num_roadblocks: int
    block_edges: Lists
    block_incoming: Lists
    block_outgoing: Lists
    intersections: Layer
    intersection_kinds: IntArray
    stop_polygons: Layer
    stop_kinds: IntArray
    crosswalks: Layer
    walkways: Layer
    car_parks: Layer
    drivable_areas: Layer
    flaws: dict[str, int] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def edge(self, edge_id: str) -> int:
        """Index of a lane or lane connector.

        Raises:
            MapError: There is none of that id.
        """
        try:
            return self.edges.index[edge_id]
        except KeyError:
            raise MapError(f"map {self.name!r} has no lane or connector {edge_id!r}") from None

    def is_connector(self, edge: int) -> bool:
        """Whether an edge is a lane connector."""
        return edge >= self.num_lanes

    def lanes_at(self, x: float, y: float) -> list[int]:
        """Lanes that hold a point in their interior."""
        return [e for e in self.edges.containing(x, y).tolist() if e < self.num_lanes]

    def connectors_at(self, x: float, y: float) -> list[int]:
        """Lane connectors that hold a point in their interior."""
        return [e for e in self.edges.containing(x, y).tolist() if e >= self.num_lanes]

    def nearest(self, x: float, y: float, layer: str = "edges") -> int:
        """Index of the object of a layer that is nearest to a point, the first one on ties.

        Args:
            x: Point [m].
            y: Point [m].
            layer: One of `LAYERS`.

        Raises:
            ConfigError: There is no such layer.
            MapError: The layer is empty.
        """
        return self._layer(layer).nearest(x, y)[0]

    def within(self, area: shapely.Polygon | Sequence[float], layer: str = "edges") -> IntArray:
        """Indices, ascending, of the objects of a layer that share a point with an area.

        Args:
            area: A polygon, or bounds min x, min y, max x, max y [m]; touching counts.
            layer: One of `LAYERS`.

        Raises:
            ConfigError: There is no such layer.
        """
        return self._layer(layer).meeting(area)

    def _layer(self, name: str) -> Layer:
        found: Layer = getattr(self, one_of("map layer", name, LAYERS))
        return found

    def progress_on(self, edge: int, x: float, y: float) -> float:
        """Arc length of the projection of a point on the baseline of an edge [m]."""
        return float(project_on_line(self.baselines, edge, x, y))


def build_map(
    name: str,
    *,
    edges: Sequence[EdgeSpec],
    blocks: Sequence[BlockSpec],
    epsg: int = 0,
    intersections: Sequence[AreaSpec] = (),
    stop_polygons: Sequence[AreaSpec] = (),
    crosswalks: Sequence[AreaSpec] = (),
    walkways: Sequence[AreaSpec] = (),
    car_parks: Sequence[AreaSpec] = (),
    drivable_areas: Sequence[AreaSpec] = (),
) -> VectorMap:
    """A map from its parts. References to unknown ids are left out and counted in `flaws`.

    Args:
        name: Map (city) name.
        edges: Lanes and lane connectors; the order within each kind is kept.
        blocks: Roadblocks and roadblock connectors; the order within each kind is kept.
        epsg: Code of the metric coordinate system; 0 for a local frame.
        intersections: Areas, `kind` = intersection type.
        stop_polygons: Areas, `kind` = stop polygon type.
        crosswalks: Areas.
        walkways: Areas.
        car_parks: Areas.
        drivable_areas: All polygons whose union is drivable.

    Raises:
        MapError: An id occurs twice, or a baseline has fewer than two vertices.
    """
    ordered = sorted(edges, key=lambda spec: spec.is_connector)
    ordered_blocks = sorted(blocks, key=lambda spec: spec.is_connector)
    edge_index = _index_ids([spec.id for spec in ordered], name, "lane or connector")
    block_index = _index_ids([spec.id for spec in ordered_blocks], name, "roadblock")
    stop_index = {spec.id: i for i, spec in enumerate(stop_polygons)}
    intersection_index = {spec.id: i for i, spec in enumerate(intersections)}
    flaws: dict[str, int] = {}

    def look_up(index: dict[str, int], ids: Sequence[str | None], flaw: str) -> list[int]:
        known = [index[i] for i in ids if i is not None and i in index]
        missing = sum(i is not None and i not in index for i in ids)
        if missing:
            flaws[flaw] = flaws.get(flaw, 0) + missing
        return known

    def single(index: dict[str, int], wanted: str | None, flaw: str) -> int:
        return (look_up(index, [wanted], flaw) or [NONE])[0]

    for spec in ordered:
        if len(spec.baseline) < 2:
            raise MapError(f"map {name!r}: baseline of {spec.id!r} has fewer than two vertices")
    block_of = np.array(
        [single(block_index, s.block_id, "edge names an unknown roadblock") for s in ordered],
        np.int64,
    )
    members: list[list[int]] = [[] for _ in ordered_blocks]
    for edge, block in enumerate(block_of.tolist()):
        if block != NONE:
            members[block].append(edge)
    nothing = np.zeros((0, 2))
    return VectorMap(
        name=name,
        epsg=epsg,
        edges=make_layer([s.id for s in ordered], [s.polygon for s in ordered]),
        num_lanes=sum(not s.is_connector for s in ordered),
        baselines=make_polylines([s.baseline for s in ordered]),
        left_boundaries=make_polylines([nothing if s.left is None else s.left for s in ordered]),
        right_boundaries=make_polylines([nothing if s.right is None else s.right for s in ordered]),
        boundary_ids=tuple((s.left_id, s.right_id) for s in ordered),
        speed_limits=np.array(
            [np.nan if s.speed_limit is None else s.speed_limit for s in ordered], np.float64
        ),
        lane_index=np.array(
            [NONE if s.lane_index is None else s.lane_index for s in ordered], np.int64
        ),
        left_lane=np.array(
            [single(edge_index, s.left_lane, "edge names an unknown edge") for s in ordered],
            np.int64,
        ),
        right_lane=np.array(
            [single(edge_index, s.right_lane, "edge names an unknown edge") for s in ordered],
            np.int64,
        ),
        incoming=make_lists(
            look_up(edge_index, s.incoming, "edge names an unknown edge") for s in ordered
        ),
        outgoing=make_lists(
            look_up(edge_index, s.outgoing, "edge names an unknown edge") for s in ordered
        ),
        block_of=block_of,
        has_traffic_lights=np.array([s.has_traffic_lights for s in ordered], np.bool_),
        stop_lines=make_lists(
            look_up(stop_index, s.stop_lines, "edge names an unknown stop line") for s in ordered
        ),
        intersection_of=np.array(
            [
                single(intersection_index, s.intersection_id, "edge names an unknown intersection")
                for s in ordered
            ],
            np.int64,
        ),
        turn_type=np.array([s.turn_type for s in ordered], np.int64),
        is_bike=np.array([s.is_bike for s in ordered], np.bool_),
        blocks=make_layer([s.id for s in ordered_blocks], [s.polygon for s in ordered_blocks]),
        num_roadblocks=sum(not s.is_connector for s in ordered_blocks),
        block_edges=make_lists(members),
        block_incoming=make_lists(
            look_up(block_index, s.incoming, "roadblock names an unknown one")
            for s in ordered_blocks
        ),
        block_outgoing=make_lists(
            look_up(block_index, s.outgoing, "roadblock names an unknown one")
            for s in ordered_blocks
        ),
        intersections=_area_layer(intersections),
        intersection_kinds=np.array([s.kind for s in intersections], np.int64),
        stop_polygons=_area_layer(stop_polygons),
        stop_kinds=np.array([s.kind for s in stop_polygons], np.int64),
        crosswalks=_area_layer(crosswalks),
        walkways=_area_layer(walkways),
        car_parks=_area_layer(car_parks),
        drivable_areas=_area_layer(drivable_areas),
        flaws=flaws,
    )


def _area_layer(specs: Sequence[AreaSpec]) -> Layer:
    return make_layer([s.id for s in specs], [s.polygon for s in specs])


def _index_ids(ids: Sequence[str], map_name: str, what: str) -> dict[str, int]:
    index = {name: i for i, name in enumerate(ids)}
    if len(index) != len(ids):
        twice = next(i for i in ids if ids.count(i) > 1)
        raise MapError(f"map {map_name!r}: two {what}s have the id {twice!r}")
    return index
