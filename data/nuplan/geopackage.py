"""Layers of a GeoPackage (.gpkg), without GDAL.

A GeoPackage is an SQLite file whose geometries are a short header followed by WKB. Layers are kept
in longitude and latitude and projected to the metric system that the table `meta` names
(nuplan-formats.md §3).
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyproj
import shapely

from shiftsim.data.nuplan.sqlite import Database
from shiftsim.errors import DataError

MEND = "the map is damaged or not a nuPlan map; get it again from its source"
_ENVELOPE_BYTES = (0, 32, 48, 48, 64)


@dataclass(frozen=True)
class LayerTable:
    """One layer: ids, projected geometries and the columns asked for."""

    name: str
    ids: list[str]
    shapes: list[shapely.Geometry]
    columns: dict[str, list[object]]

    def text_ids(self, column: str) -> list[str | None]:
        """A column of references as strings; None where it is empty."""
        values = self.columns[column]
        return [None if v is None or v == "" else _id(v, self.name, column) for v in values]

    def integers(self, column: str, default: int) -> list[int]:
        """A column of codes; `default` where it is empty."""
        values = self.columns[column]
        return [default if v is None else int(_id(v, self.name, column)) for v in values]


class GeoPackage:
    """Reads and projects the layers of one file."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self.path = database.path
        meta = database.columns("meta", ["key", "value"])
        system = dict(zip(meta["key"], meta["value"], strict=True)).get("projectedCoordSystem")
        self.epsg = self._epsg(system)
        self._project = to_metres(self.epsg)

    def _epsg(self, system: object) -> int:
        name, _, code = str(system).lower().partition(":")
        if name != "epsg" or not code.isdigit():
            raise DataError(
                f"{self.path}: table 'meta': projectedCoordSystem is {system!r}, not 'epsg:<code>'",
                hint=MEND,
            )
        return int(code)

    def table(
        self, name: str, columns: Sequence[str] = (), extra: Sequence[str] = ()
    ) -> LayerTable:
        """A layer with the columns named; those in `extra` may be missing.

        Raises:
            DataError: The layer or a column is missing, or a geometry is broken.
        """
        raw = self.database.columns(name, ["fid", "geom", *columns], extra)
        bodies = [self._wkb(b, name, f) for f, b in zip(raw["fid"], raw["geom"], strict=True)]
        try:
            shapes = shapely.force_2d(shapely.from_wkb(np.array(bodies, object)))
            xy = shapely.get_coordinates(shapes)
            x, y = self._project.transform(xy[:, 0], xy[:, 1])
        except (shapely.errors.GEOSException, pyproj.exceptions.ProjError) as error:
            raise DataError(
                f"{self.path}: layer {name!r}: broken geometry: {error}", hint=MEND
            ) from error
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise DataError(
                f"{self.path}: layer {name!r}: a coordinate is not finite in epsg:{self.epsg}",
                hint=MEND,
            )
        projected = shapely.set_coordinates(shapes, np.column_stack([x, y]))
        ids = [_id(v, name, "fid") for v in raw["fid"]]
        return LayerTable(name, ids, list(projected), raw)

    def _wkb(self, blob: object, layer: str, fid: object) -> bytes:
        where = f"{self.path}: layer {layer!r}: geometry of fid {fid!r}"
        if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
            raise DataError(f"{where} is not a GeoPackage geometry", hint=MEND)
        envelope = (blob[3] >> 1) & 7
        if envelope >= len(_ENVELOPE_BYTES) or blob[3] & 0x30:
            raise DataError(f"{where} is empty or of an unknown kind", hint=MEND)
        (system,) = struct.unpack("<i" if blob[3] & 1 else ">i", blob[4:8])
        if system != 4326:
            raise DataError(f"{where} has the coordinate system {system}, not 4326", hint=MEND)
        return blob[8 + _ENVELOPE_BYTES[envelope] :]


@lru_cache(maxsize=8)
def to_metres(epsg: int) -> pyproj.Transformer:
    """From longitude and latitude to the metric system of a code."""
    try:
        return pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    except pyproj.exceptions.CRSError as error:
        raise DataError(f"epsg:{epsg} is not a coordinate system: {error}", hint=MEND) from error


def _id(value: object, layer: str, column: str) -> str:
    # nuPlan: reference columns are cast to int as a whole (nuplan-formats.md §3 rule 5).
    try:
        number = float(value)  # type: ignore[arg-type]  # anything SQLite can hold
        if number == int(number):
            return str(int(value)) if not isinstance(value, float) else str(int(number))  # type: ignore[call-overload]
    except (TypeError, ValueError, OverflowError):
        pass
    raise DataError(
        f"layer {layer!r}: column {column!r} holds {value!r}, not an integer", hint=MEND
    )
