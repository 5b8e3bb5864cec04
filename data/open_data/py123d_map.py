"""Maps that py123d wrote: Arrow tables whose objects are packed with msgpack."""

from collections import defaultdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.lanes.map import PieceMap, build_lane_map
from shiftsim.data.lanes.pieces import LanePiece, MapSource, StopArea, clean_line
from shiftsim.data.open_data.tables import read_columns
from shiftsim.data.polygons import largest_part
from shiftsim.errors import ConversionError, MissingExtraError
from shiftsim.world.ranges import OPEN_DATA, require

TESTED = "0.7.0"  # version of py123d
HINT = f"convert the log again with py123d {TESTED}"
_LANE, _GROUP, _INTERSECTION, _CROSSWALK, _WALKWAY, _CAR_PARK, _DRIVABLE, _STOP = range(8)
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


def unpack(data: bytes, place: str) -> dict[Any, Any]:
    """What msgpack packed: plain values and arrays of float64, nothing else."""
    try:
        found = need_msgpack().unpackb(data, raw=False, strict_map_key=False, object_hook=_array)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ConversionError(f"{place}: cannot be unpacked ({error})", HINT) from error
    if not isinstance(found, dict):
        raise ConversionError(f"{place}: is {type(found).__name__}, need a map", HINT)
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
    wanted = {"object_id": pa.int64(), "map_layer": pa.int8()}
    wanted |= {"features": pa.binary(), "wkb": pa.binary()}
    table = read_columns(path, wanted, HINT)
    objects: dict[int, list[tuple[str, bytes, bytes]]] = defaultdict(list)
    for number, layer, features, wkb in zip(*(table[n].to_pylist() for n in wanted), strict=True):
        objects[layer].append((str(number), features or b"", wkb or b""))
    groups = {n: unpack(f, f"{path}: lane group {n}") for n, f, _ in objects[_GROUP]}
    inside = {n for n, group in groups.items() if group.get("intersection_id") is not None}
    lanes = {n: unpack(f, f"{path}: lane {n}") for n, f, _ in objects[_LANE]}
    areas = {layer: _areas(objects[layer], path) for layer in range(_GROUP, _STOP + 1)}
    drivable = [a for layer in (_GROUP, _INTERSECTION, _CAR_PARK, _DRIVABLE) for a in areas[layer]]
    stops = [
        StopArea(area, _stop_kind(unpack(f, f"{path}: stop zone {n}")))
        for (n, f, _), area in zip(objects[_STOP], areas[_STOP], strict=True)
    ]
    return build_lane_map(
        MapSource(
            name=name,
            pieces=[
                _piece(n, lane, inside, lit, f"{path}: lane {n}")
                for n, lane in lanes.items()
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
    name: str, lane: dict[Any, Any], inside: set[str], lit: frozenset[str], place: str
) -> LanePiece:
    limit = lane.get("speed_limit_mps")
    if limit is not None:
        require(OPEN_DATA, "speed limit", limit, place, error=ConversionError)
    return LanePiece(
        id=name,
        left=_line(lane, "left_boundary", place),
        right=_line(lane, "right_boundary", place),
        center=_line(lane, "centerline", place),
        successors=tuple(map(str, lane.get("successor_ids") or ())),
        left_neighbor=_name(lane.get("left_lane_id")),
        right_neighbor=_name(lane.get("right_lane_id")),
        is_connector=_name(lane.get("lane_group_id")) in inside,
        speed_limit=limit,
        light=name if name in lit else None,
    )


def _name(value: Any) -> str | None:
    return None if value is None else str(value)


def _stop_kind(zone: dict[Any, Any]) -> int:
    kind = zone.get("stop_zone_type")
    if not isinstance(kind, int) or not 0 <= kind < len(_STOP_KINDS):
        return _STOP_KINDS[0]
    return _STOP_KINDS[kind]


def _line(item: dict[Any, Any], key: str, place: str) -> FloatArray:
    points = item.get(key)
    if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] < 2:
        raise ConversionError(f"{place}: {key!r} is no line of points", HINT)
    line = np.ascontiguousarray(points[:, :2])
    require(OPEN_DATA, "position", line, f"{place}: {key!r} as", error=ConversionError)
    return clean_line(line)


def _areas(objects: list[tuple[str, bytes, bytes]], path: Path) -> list[shapely.Polygon]:
    """Polygons of a layer."""
    out = []
    for name, _, wkb in objects:
        try:
            shape = shapely.force_2d(shapely.from_wkb(wkb))
        except (shapely.errors.GEOSException, TypeError) as error:
            raise ConversionError(f"{path}: wkb of {name}: {error}", HINT) from error
        if shape is None or shape.geom_type != "Polygon" or shape.is_empty:
            raise ConversionError(f"{path}: wkb of {name} is no polygon", HINT)
        place = f"{path}: wkb of {name} as"
        require(OPEN_DATA, "position", shapely.get_coordinates(shape), place, error=ConversionError)
        out.append(largest_part(shape))
    return out
