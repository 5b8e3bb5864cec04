"""VectorMap -> nuPlan's map.gpkg."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import count
from pathlib import Path

import numpy as np
import shapely

from shiftsim.data.nuplan.sqlite import FeatureLayer, Value, write_geopackage
from shiftsim.errors import ConversionError
from shiftsim.world.layers import Layer, Polylines
from shiftsim.world.map import NONE, VectorMap

# A map in a local frame goes to the origin of this zone: only metres matter, and they stay.
LOCAL_EPSG = 32632

# Layers with their geometry and columns; `name` is text, `name:i` an integer, `name:r` a real; `=`
# and what is written everywhere; else it is NULL.
_LAYERS = {
    "baseline_paths": "LINESTRING path_type_fid:i=0 creator_id lane_fid:i lane_connector_fid:i"
    " dubins_node_fids",
    "boundaries": "LINESTRING boundary_segment_fids= has_reflectors:i=0 boundary_type_fid:i=2"
    " creator_id",
    "carpark_areas": "POLYGON heading:r=0.0 creator_id",
    "crosswalks": "POLYGON intersection_fids= lane_fids= creator_id is_marked:i=1",
    "dubins_nodes": "POINT radius:r heading:r creator_id",
    "gen_lane_connectors_scaled_width_polygons": "POLYGON baseline_path_fid:i lane_connector_fid:i"
    " from_edge_fid:i to_edge_fid:i left_boundary_fid:i right_boundary_fid:i",
    "generic_drivable_areas": "POLYGON creator_id",
    "intersections": "POLYGON creator_id intersection_type_fid:i is_mini:i=0",
    "lane_connectors": "LINESTRING exit_lane_group_fid:i exit_lane_fid:i entry_lane_group_fid:i"
    " lane_group_connector_fid:i entry_lane_fid:i intersection_fid:i turn_type_fid:i bulb_fids="
    " traffic_light_stop_line_fids overlap:i=0 creator_id left_has_reflectors:i=0"
    " right_has_reflectors:i=0 speed_limit_mps:r",
    "lane_group_connectors": "POLYGON intersection_fid:i from_lane_group_fid:i to_lane_group_fid:i"
    " creator_id from_edge_fid:i to_edge_fid:i left_boundary_fid:i right_boundary_fid:i",
    "lane_groups_polygons": "POLYGON creator_id left_boundary_fid:i right_boundary_fid:i"
    " from_edge_fid:i to_edge_fid:i",
    "lanes_polygons": "POLYGON lane_group_fid:i lane_fid:i lane_index:i creator_id name"
    " road_type_fid:i=1 lane_type_fid:i width:i left_offset:r right_offset:r min_speed:r"
    " max_speed:r stops:i left_boundary_fid:i right_boundary_fid:i speed_limit_mps:r"
    " left_has_reflectors:i=0 right_has_reflectors:i=0 from_edge_fid:i to_edge_fid:i",
    "road_segments": "POLYGON lane_group_fids=",
    "stop_polygons": "POLYGON stop_polygon_type_fid:i lane_group_fid:i lane_fids="
    " lane_connector_fids traffic_light_fids= crosswalk_fids= precedence_area_fids creator_id",
    "traffic_lights": "POINT traffic_light_type_fid:i intersection_fid:i heading:r creator_id",
    "walkways": "POLYGON creator_id",
}
_TYPES = {"": ("TEXT", str), "i": ("INTEGER", int), "r": ("REAL", float)}


def epsg_of(road: VectorMap) -> int:
    """Code of the coordinate system that a map is exported in."""
    return road.epsg or LOCAL_EPSG


def write_nuplan_map(path: Path, road: VectorMap, version: str) -> None:
    """Write a map in nuPlan's layers as `map.gpkg`, with its ids, or a ConversionError."""
    layers = {name: _layer(name, *text.split()) for name, text in _LAYERS.items()}
    _Writer(road, layers).write()
    meta = {
        "map_version": version,
        "geographicCoordSystem": "epsg:4326",
        "projectedCoordSystem": f"epsg:{epsg_of(road)}",
    }
    write_geopackage(path, list(layers.values()), epsg=epsg_of(road), meta=meta)


def _layer(name: str, kind: str, *columns: str) -> FeatureLayer:
    layer = FeatureLayer(name, kind, {}, {})
    for text in columns:
        head, has_default, default = text.partition("=")
        column, _, letter = head.partition(":")
        layer.columns[column], number = _TYPES[letter]
        if has_default:
            layer.defaults[column] = number(default)
    return layer


class _Writer:
    """Fills the layers of one map."""

    def __init__(self, road: VectorMap, layers: Mapping[str, FeatureLayer]) -> None:
        self.road, self.layers = road, layers
        self.edges = [self._fid(name) for name in road.edges.ids]
        self.blocks = [self._fid(name) for name in road.blocks.ids]
        self.intersections = [self._fid(name) for name in road.intersections.ids]
        self.stops = [self._fid(name) for name in road.stop_polygons.ids]
        others = (road.crosswalks, road.walkways, road.car_parks, road.drivable_areas)
        used = [
            *(self.edges + self.blocks + self.intersections + self.stops),
            *(self._fid(name) for layer in others for name in layer.ids),
            *(self._fid(name) for pair in road.boundary_ids for name in pair if name),
        ]
        self.fresh = count(max(used, default=0) + 1)  # ids of what has none in our map
        self.lines: dict[int, bytes] = {}  # boundaries written

    def _fid(self, name: str) -> int:
        try:
            if str(int(name)) == name:
                return int(name)
        except ValueError:
            pass
        raise self._refusal(f"id {name!r} cannot be exported")

    def _refusal(self, what: str) -> ConversionError:
        hint = "nuPlan's format has integer ids, and lane - connector - lane, always"
        return ConversionError(f"map {self.road.name!r}: {what}", hint)

    def _add(self, layer: str, fid: int, shape: shapely.Geometry, **values: Value) -> None:
        self.layers[layer].rows.append((fid, shape, values))

    def write(self) -> None:
        road = self.road
        for edge in range(len(road.edges)):
            self._connector(edge) if road.is_connector(edge) else self._lane(edge)
        for block in range(len(road.blocks)):
            self._block(block)
        kinds: list[int] = road.intersection_kinds.tolist()
        self._add_areas("intersections", road.intersections, intersection_type_fid=kinds)
        governed: list[list[str]] = [[] for _ in road.stop_polygons.ids]
        for edge, name in enumerate(road.edges.ids):
            for stop in road.stop_lines.at(edge).tolist():
                governed[stop].append(name)
        self._add_areas(
            "stop_polygons",
            road.stop_polygons,
            stop_polygon_type_fid=road.stop_kinds.tolist(),
            lane_connector_fids=list(map(",".join, governed)),
        )
        self._add_areas("crosswalks", road.crosswalks)
        self._add_areas("walkways", road.walkways)
        self._add_areas("carpark_areas", road.car_parks)
        self._drivable()

    def _lane(self, edge: int) -> None:
        road, fid = self.road, self.edges[edge]
        for other in (*road.incoming.at(edge), *road.outgoing.at(edge)):
            if not road.is_connector(int(other)):  # nuPlan rule 427
                raise self._refusal(
                    f"lane {road.edges.ids[edge]!r} is linked to lane"
                    f" {road.edges.ids[int(other)]!r} without a connector"
                )
        self._baseline(edge, "lane_fid")
        index = int(road.lane_index[edge])
        self._add(
            "lanes_polygons",
            fid,
            road.edges.shape(edge),
            lane_group_fid=self._block_of(edge),
            lane_fid=fid,
            lane_index=None if index == NONE else index,
            lane_type_fid=int(road.is_bike[edge]),
            **self._boundaries(edge),
            speed_limit_mps=self._speed(edge),
        )

    def _connector(self, edge: int) -> None:
        road, fid = self.road, self.edges[edge]
        start, end = (
            self._single(road.edges.ids[edge], links.at(edge).tolist())
            for links in (road.incoming, road.outgoing)
        )
        baseline = self._baseline(edge, "lane_connector_fid")
        boundaries = self._boundaries(edge)
        self._add(
            "lane_connectors",
            fid,
            _line(road.baselines, edge),
            exit_lane_group_fid=None if start is None else self._block_of(start),
            exit_lane_fid=_at(self.edges, start),
            entry_lane_group_fid=None if end is None else self._block_of(end),
            lane_group_connector_fid=self._block_of(edge),
            entry_lane_fid=_at(self.edges, end),
            intersection_fid=_at(self.intersections, int(road.intersection_of[edge])),
            turn_type_fid=int(road.turn_type[edge]),
            traffic_light_stop_line_fids=self._lit_stop_lines(edge),
            speed_limit_mps=self._speed(edge),
        )
        self._add(
            "gen_lane_connectors_scaled_width_polygons",
            next(self.fresh),
            road.edges.shape(edge),
            baseline_path_fid=baseline,
            lane_connector_fid=fid,
            **boundaries,
        )

    def _single(self, name: str, links: list[int]) -> int | None:
        """The lane at one end of a connector."""
        if len(links) > 1 or any(self.road.is_connector(edge) for edge in links):
            raise self._refusal(f"connector {name!r} does not join one lane to one lane")
        return links[0] if links else None

    def _lit_stop_lines(self, edge: int) -> str:
        """Stop lines of lit connectors only; nuPlan rule 423: any text there means lights."""
        road = self.road
        if not road.has_traffic_lights[edge]:
            return ""
        listed = [self.stops[stop] for stop in road.stop_lines.at(edge).tolist()]
        return ",".join(map(str, listed or [next(self.fresh)]))

    def _speed(self, edge: int) -> float | None:
        limit = float(self.road.speed_limits[edge])
        return None if np.isnan(limit) else limit

    def _block_of(self, edge: int) -> int | None:
        return _at(self.blocks, int(self.road.block_of[edge]))

    def _baseline(self, edge: int, owner: str) -> int:
        fid = next(self.fresh)
        line = _line(self.road.baselines, edge)
        self._add("baseline_paths", fid, line, **{owner: self.edges[edge]})
        return fid

    def _boundaries(self, edge: int) -> dict[str, int | None]:
        road, (left, right) = self.road, self.road.boundary_ids[edge]
        return {
            "left_boundary_fid": self._boundary(left, road.left_boundaries, edge),
            "right_boundary_fid": self._boundary(right, road.right_boundaries, edge),
        }

    def _boundary(self, name: str, lines: Polylines, edge: int) -> int | None:
        if lines.ptr[edge + 1] - lines.ptr[edge] < 2:
            return None
        line = _line(lines, edge)
        fid = self._fid(name) if name else next(self.fresh)
        if self.lines.get(fid, line.wkb) != line.wkb:
            fid = next(self.fresh)
        if fid not in self.lines:
            self.lines[fid] = line.wkb
            self._add("boundaries", fid, line)
        return fid

    def _block(self, block: int) -> None:
        road, fid, shape = self.road, self.blocks[block], self.road.blocks.shape(block)
        if block < road.num_roadblocks:
            self._add("lane_groups_polygons", fid, shape)
            return
        ends = [links.at(block).tolist() for links in (road.block_incoming, road.block_outgoing)]
        if any(len(end) > 1 or any(b >= road.num_roadblocks for b in end) for end in ends):
            name = f"roadblock connector {road.blocks.ids[block]!r}"
            raise self._refusal(f"{name} does not join one roadblock to one roadblock")
        members = road.block_edges.at(block).tolist()
        crossings = [int(c) for c in road.intersection_of[members] if c != NONE]
        self._add(
            "lane_group_connectors",
            fid,
            shape,
            intersection_fid=_at(self.intersections, *crossings[:1]),
            from_lane_group_fid=_at(self.blocks, *ends[0]),
            to_lane_group_fid=_at(self.blocks, *ends[1]),
        )

    def _add_areas(
        self, name: str, layer: Layer, keep: Iterable[int] | None = None, **columns: Sequence[Value]
    ) -> None:
        """Add areas, with values by their position in the layer; pieces of one id are one row."""
        pieces: dict[int, list[int]] = {}
        for at in range(len(layer)) if keep is None else keep:
            pieces.setdefault(self._fid(layer.ids[at]), []).append(at)
        for fid, places in pieces.items():
            shapes = [layer.shape(at) for at in places]
            shape = shapes[0] if len(shapes) == 1 else shapely.MultiPolygon(shapes)
            self._add(name, fid, shape, **{key: v[places[0]] for key, v in columns.items()})

    def _drivable(self) -> None:
        """What is drivable besides intersections and car parks, which count as such."""
        road, layer = self.road, self.road.drivable_areas
        known = {
            (other.ids[at], other.shape(at).wkb): other
            for other in (road.intersections, road.car_parks)
            for at in range(len(other))
        }
        owners = [known.get((layer.ids[at], layer.shape(at).wkb)) for at in range(len(layer))]
        # nuPlan rule 421: road segments, intersections, generic areas and car parks, in this order
        first = next((at for at, owner in enumerate(owners) if owner is not None), len(layer))
        rest = [at for at, owner in enumerate(owners) if owner is None]
        self._add_areas("road_segments", layer, [at for at in rest if at < first])
        self._add_areas("generic_drivable_areas", layer, [at for at in rest if at > first])


def _at(fids: Sequence[int], index: int | None = NONE) -> int | None:
    """The id at an index, None for no index."""
    return None if index is None or index == NONE else fids[index]


def _line(lines: Polylines, index: int) -> shapely.LineString:
    return shapely.LineString(lines.at(index))
