"""Arrow tables whose cells hold packed objects: msgpack, polygons of WKB, lists, boxes, poses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.open_data.source import Source
from shiftsim.errors import MissingExtraError


class PackedTable(Source):
    """Columns of an Arrow file, and what is packed in their cells."""

    def __init__(
        self, path: Path, columns: Mapping[str, pa.DataType], remedy: str, prefix: str = ""
    ) -> None:
        """Reads the columns, as `Source.columns`."""
        super().__init__(path, remedy)
        self.table = self.columns(columns, prefix)

    def notes(self) -> dict[Any, Any]:
        """The `metadata` of its schema."""
        packed = (self.table.schema.metadata or {}).get(b"metadata")
        if packed is None:
            raise self.fault("the schema has no 'metadata'")
        return self.unpack(packed, "'metadata'")

    def unpack(self, data: bytes, place: str) -> dict[Any, Any]:
        """What msgpack packed: plain values and arrays of float64, nothing else."""
        unpackb = need_msgpack().unpackb
        try:
            found = unpackb(data, raw=False, strict_map_key=False, object_hook=_array)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise self.fault(f"{place}: cannot be unpacked ({error})") from error
        if not isinstance(found, dict):
            raise self.fault(f"{place}: is {type(found).__name__}, need a map")
        return found

    def line_of(self, found: Mapping[Any, Any], key: str, place: str) -> FloatArray:
        """(K, 2) the line of points that an unpacked map holds by a key [m]."""
        points = found.get(key)
        if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] < 2:
            raise self.fault(f"{place}: {key!r} is no line of points")
        return self.line(points, f"{place}: {key!r}")

    def polygon(self, wkb: bytes, place: str) -> shapely.Polygon:
        """The largest valid part of the polygon of well-known binary."""
        try:
            return self.area(shapely.from_wkb(wkb), f"wkb of {place}")
        except (shapely.errors.GEOSException, TypeError) as error:
            raise self.fault(f"wkb of {place}: {error}") from error

    def lists(self, *names: str) -> tuple[IntArray, list[pa.Array]]:
        """Lengths (R,) of lists in columns, which must agree with those of the last; the items."""
        found = {name: self.table[name].combine_chunks() for name in names}
        counts = {n: found[n].value_lengths().fill_null(0).to_numpy() for n in names}
        last = counts[names[-1]]
        for name in names:
            if (counts[name] != last).any():
                raise self.fault(f"{name!r} and {names[-1]!r} differ in length")
        return last, [column.flatten() for column in found.values()]

    def boxes(self, found: FloatArray) -> FloatArray:
        """(R, 5) x, y, heading, length, width of boxes x, y, z, quaternion, length, width."""
        parts = ("position", slice(2)), ("rotation", slice(3, 7)), ("size", slice(7, 9))
        for field, part in parts:
            self.require(field, found[:, part], "box")
        return np.column_stack([found[:, :2], yaws(found[:, 3:7]), found[:, 7:9]])


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


def vectors(column: pa.FixedSizeListArray) -> FloatArray:
    """(R, width) a column of vectors; NaN where there is none."""
    out = np.full((len(column), column.type.list_size), np.nan)
    found = column.drop_null().flatten().to_numpy(zero_copy_only=False)
    out[column.is_valid().to_numpy(zero_copy_only=False)] = found.reshape(-1, out.shape[1])
    return out


def yaws(q: FloatArray) -> FloatArray:
    """(R,) headings of quaternions (R, 4) w, x, y, z [rad]."""
    w, x, y, z = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _array(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in found:
        return found
    if found[b"dtype"] != "<f8":
        raise ValueError(f"an array of {found[b'dtype']!r}, need '<f8'")
    return np.frombuffer(found[b"data"], "<f8").reshape(found[b"shape"])
