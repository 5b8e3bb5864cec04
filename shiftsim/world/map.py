"""VectorMap: the semantic map as flat arrays.

Lanes and lane connectors are one list of *edges* (all lanes first, then all connectors, each in the
order of the source tables), so that one integer names a piece of road everywhere. The same holds
for roadblocks and roadblock connectors (*blocks*). Ids are strings at the boundary only.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache

import numpy as np
import shapely

from shiftsim.errors import MapError, one_of
from shiftsim.kernels import BoolArray, FloatArray, IntArray, readonly
from shiftsim.world import layers

NONE = -1  # "no such object" in index arrays
LAYERS = (
    *("edges", "blocks", "intersections", "stop_polygons"),
    *("crosswalks", "walkways", "car_parks", "drivable_areas"),
)


@dataclass(frozen=True, eq=False)
class VectorMap:
    """A semantic map. E edges, B blocks; objects are numbered, and `Layer.index` has their ids.

    docs/vector_map.md shows what its arrays are good for. Maps are told apart by identity.

    Example:
        ```python
        road = shiftsim.open_store("demo")["01f13e"].map
        for edge in road.block_edges.at(0):  # the lanes of the first roadblock
            print(road.baselines.at(edge)[:, :2], road.speed_limits[edge], road.outgoing.at(edge))
        ```
    """

    name: str  # map (city) name
    epsg: int  # code of the metric coordinate system; 0 for a local frame
    edges: layers.Layer  # lanes, then lane connectors: ids and polygons
    num_lanes: int  # how many of the edges are lanes
    baselines: layers.Polylines  # E centre lines in the direction of travel
    left_boundaries: layers.Polylines  # E lines; empty where unknown
    right_boundaries: layers.Polylines  # E lines; empty where unknown
    boundary_ids: tuple[tuple[str, str], ...]  # E pairs of boundary ids, left and right
    speed_limits: FloatArray  # (E,) [m/s], NaN where the map has none
    lane_index: IntArray  # (E,) position in the roadblock, 0 leftmost, NONE for connectors
    left_lane: IntArray  # (E,) neighbour lane on the left, or NONE
    right_lane: IntArray  # (E,) neighbour lane on the right, or NONE
    incoming: layers.Lists  # edges that lead into an edge
    outgoing: layers.Lists  # edges an edge leads to
    block_of: IntArray  # (E,) block of an edge, NONE where the source names an unknown one
    has_traffic_lights: BoolArray  # (E,) whether lights govern the edge
    stop_lines: layers.Lists  # stop polygons of an edge
    intersection_of: IntArray  # (E,) intersection of a connector, or NONE
    turn_type: IntArray  # (E,) 0 straight, 1 left, 2 right, 3 u-turn, 4 unknown
    is_bike: BoolArray  # (E,) whether the edge is a bicycle lane
    blocks: layers.Layer  # roadblocks, then roadblock connectors: ids and polygons
    num_roadblocks: int  # how many of the blocks are roadblocks
    block_edges: layers.Lists  # edges of a block, in the order of the edges
    block_incoming: layers.Lists  # blocks that lead into a block
    block_outgoing: layers.Lists  # blocks a block leads to
    intersections: layers.Layer  # ids and polygons
    intersection_kinds: IntArray  # type number of each intersection
    stop_polygons: layers.Layer  # ids and polygons
    stop_kinds: IntArray  # type number of each stop polygon
    crosswalks: layers.Layer  # ids and polygons
    walkways: layers.Layer  # ids and polygons
    car_parks: layers.Layer  # ids and polygons
    drivable_areas: layers.Layer  # road segments, intersections, generic drivable areas, car parks
    # count by kind of what the source got wrong and nuPlan tolerates
    flaws: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, item.name, readonly(value))

    def __repr__(self) -> str:
        connectors = len(self.edges) - self.num_lanes
        return (
            f"<VectorMap {self.name}: {self.num_lanes} lanes, {connectors} connectors, "
            f"{len(self.crosswalks)} crosswalks>"
        )

    def edge(self, edge_id: str) -> int:
        """Index of a lane or lane connector; a MapError where there is none of that id."""
        try:
            return self.edges.index[edge_id]
        except KeyError:
            raise MapError(f"map {self.name!r} has no lane or connector {edge_id!r}") from None

    def is_connector(self, edge: int) -> bool:
        """Whether an edge is a lane connector."""
        return edge >= self.num_lanes

    def lanes_of(self, blocks: Iterable[int]) -> list[int]:
        """Lanes and connectors of blocks, in their order; blocks that are NONE are passed over."""
        return [e for block in blocks if block != NONE for e in self.block_edges.at(block).tolist()]

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

    def _layer(self, name: str) -> layers.Layer:
        return getattr(self, one_of("map layer", name, LAYERS))

    def progress_on(self, edge: int, x: float, y: float) -> float:
        """Arc length of the projection of a point on the baseline of an edge [m]."""
        return float(layers.project_on_line(self.baselines, edge, x, y))


# makes a function of arrays that depend on the map only: they are built once per map, and kept for
# the latest few, as a run rarely visits more maps at a time
PerMap = lru_cache(maxsize=4)
