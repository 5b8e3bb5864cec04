"""Maps that py123d wrote: Arrow tables whose objects are packed with msgpack."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from shiftsim.data.lanes.map import PieceMap, build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource, StopArea
from shiftsim.data.open_data.source import Source, text_or_none
from shiftsim.errors import MissingExtraError

TESTED = "0.7.0"  # version of py123d
HINT = f"convert the log again with py123d {TESTED}"
_LANE, _GROUP, _INTERSECTION, _CROSSWALK, _WALKWAY, _CAR_PARK, _DRIVABLE, _STOP = range(8)
_LAYERS = {
    _LANE: "lane",
    _GROUP: "lane group",
    _INTERSECTION: "intersection",
    _CROSSWALK: "crosswalk",
    _WALKWAY: "walkway",
    _CAR_PARK: "car park",
    _DRIVABLE: "drivable area",
    _STOP: "stop zone",
}
_WITH_FEATURES = (_LANE, _GROUP, _STOP)
_COLUMNS = {
    "object_id": pa.int64(),
    "map_layer": pa.int8(),
    "features": pa.binary(),
    "wkb": pa.binary(),
}
_BIKE_LANE = 3
_STOP_KINDS = (5, 2, 1, 4, 0, 3)  # nuPlan's type of a stop polygon, by py123d's


def need_msgpack() -> Any:
    """The module msgpack.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import msgpack
    except ImportError as error:
        raise MissingExtraError(
            "logs of py123d need msgpack", "pip install 'shiftsim[py123d]'"
        ) from error
    return msgpack


def unpack(source: Source, data: bytes, place: str) -> dict[Any, Any]:
    """What msgpack packed: plain values and arrays of float64, nothing else."""
    try:
        found = need_msgpack().unpackb(data, raw=False, strict_map_key=False, object_hook=_array)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise source.fault(f"{place}: cannot be unpacked ({error})") from error
    if not isinstance(found, dict):
        raise source.fault(f"{place}: is {type(found).__name__}, need a map")
    return found


def _array(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in found:
        return found
    if found[b"dtype"] != "<f8":
        raise ValueError(f"an array of {found[b'dtype']!r}, need '<f8'")
    return np.frombuffer(found[b"data"], "<f8").reshape(found[b"shape"])


@lru_cache(maxsize=1)  # logs of one city follow each other
def read_map(path: Path, name: str, lit: frozenset[str]) -> PieceMap:
    """A map; `lit` are the lanes that have a light.

    Raises:
        DataError: The file is missing or broken, or has no lane.
    """
    source = Source(path, HINT)
    table = source.columns(_COLUMNS)
    found: dict[int, dict[str, dict[Any, Any]]] = {layer: {} for layer in _LAYERS}
    areas: dict[int, list[shapely.Polygon]] = {layer: [] for layer in _LAYERS}
    stops: list[StopArea] = []
    for number, layer, features, wkb in zip(*(table[n].to_pylist() for n in _COLUMNS), strict=True):
        place = f"{_LAYERS.get(layer)} {number}"
        if layer in _WITH_FEATURES:
            found[layer][str(number)] = unpack(source, features or b"", place)
        if layer in _LAYERS and layer != _LANE:
            areas[layer].append(_area(source, wkb, place))
        if layer == _STOP:
            kind = _stop_kind(found[layer][str(number)].get("stop_zone_type"))
            stops.append(StopArea(areas[layer][-1], kind))
    inside = {n for n, group in found[_GROUP].items() if group.get("intersection_id") is not None}
    drivable = [a for layer in (_GROUP, _INTERSECTION, _CAR_PARK, _DRIVABLE) for a in areas[layer]]
    return build_lane_map(
        MapSource(
            name=name,
            pieces=[
                _piece(source, number, lane, inside, lit)
                for number, lane in found[_LANE].items()
                if lane.get("lane_type") != _BIKE_LANE
            ],
            drivable_areas=drivable if areas[_DRIVABLE] else (),  # Waymo has none
            stop_areas=stops,
            crosswalks=areas[_CROSSWALK],
            walkways=areas[_WALKWAY],
            car_parks=areas[_CAR_PARK],
        )
    )


def _piece(
    source: Source, name: str, lane: dict[Any, Any], inside: set[str], lit: frozenset[str]
) -> LanePiece:
    place = f"lane {name}"
    limit = lane.get("speed_limit_mps")
    lines = {}
    for key in ("left_boundary", "right_boundary", "centerline"):
        points = lane.get(key)
        if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] < 2:
            raise source.fault(f"{place}: {key!r} is no line of points")
        lines[key] = source.line(points, f"{place}: {key!r}")
    return LanePiece(
        id=name,
        left=lines["left_boundary"],
        right=lines["right_boundary"],
        center=lines["centerline"],
        successors=tuple(map(str, lane.get("successor_ids") or ())),
        left_neighbor=text_or_none(lane.get("left_lane_id")),
        right_neighbor=text_or_none(lane.get("right_lane_id")),
        is_connector=text_or_none(lane.get("lane_group_id")) in inside,
        speed_limit=None if limit is None else source.number(limit, "speed limit", place),
        light=name if name in lit else None,
    )


def _stop_kind(code: Any) -> int:
    return _STOP_KINDS[code if isinstance(code, int) and 0 <= code < len(_STOP_KINDS) else 0]


def _area(source: Source, wkb: bytes, place: str) -> shapely.Polygon:
    try:
        return source.area(shapely.from_wkb(wkb), f"wkb of {place}")
    except (shapely.errors.GEOSException, TypeError) as error:
        raise source.fault(f"wkb of {place}: {error}") from error
