"""Writing a GeoPackage with plain SQLite: the same content gives the same bytes.

What the tables and the geometry blob must hold is in nuplan-formats.md §3.
"""

import os
import sqlite3
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyproj
import shapely

from shiftsim.data.nuplan.geopackage import to_metres

Value: TypeAlias = int | float | str | bytes | None

_APPLICATION_ID, _VERSION = 0x47504B47, 10200  # "GPKG", version 1.2
_WGS84 = 4326
_LAST_CHANGE = "2020-01-01T00:00:00.000Z"  # fixed, so that exports can be compared
_LITTLE_ENDIAN_WITH_ENVELOPE = 0x03


@dataclass
class FeatureLayer:
    """One layer to be written.

    Attributes:
        name: Table name.
        geometry: `POLYGON`, `LINESTRING` or `POINT`.
        columns: SQL type by column name, besides `fid` and `geom`.
        rows: fid, geometry in metres and values by column; missing ones are NULL.
    """

    name: str
    geometry: str
    columns: Mapping[str, str]
    rows: list[tuple[int, shapely.Geometry, Mapping[str, Value]]] = field(default_factory=list)


def write_database(
    path: Path,
    tables: Mapping[str, str],
    rows: Mapping[str, Sequence[Sequence[Value]]],
    after: Sequence[str] = (),
) -> None:
    """Write an SQLite file in one step.

    Args:
        path: The file; it is replaced.
        tables: Column definitions by table name.
        rows: Whole rows by table name.
        after: Statements that end it, such as indexes.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".tmp")
    partial.unlink(missing_ok=True)
    connection = sqlite3.connect(partial, isolation_level=None)
    try:
        connection.execute("PRAGMA journal_mode = OFF")
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("BEGIN")
        for name, columns in tables.items():
            connection.execute(f'CREATE TABLE "{name}" ({columns})')
            if rows.get(name):
                marks = ", ".join("?" * len(rows[name][0]))
                connection.executemany(f'INSERT INTO "{name}" VALUES ({marks})', rows[name])
        for statement in after:
            connection.execute(statement)
        connection.execute("COMMIT")
    finally:
        connection.close()
    os.replace(partial, path)


def write_geopackage(
    path: Path, layers: Sequence[FeatureLayer], *, epsg: int, meta: Mapping[str, str]
) -> None:
    """Write layers in longitude and latitude.

    Args:
        path: The file; it is replaced.
        layers: The layers, geometries in metres.
        epsg: Code of the metric system of the geometries.
        meta: Content of the table `meta`.
    """
    tables = dict(_SYSTEM_TABLES)
    wgs84 = pyproj.CRS(_WGS84).to_wkt("WKT1_GDAL")
    rows: dict[str, list[Sequence[Value]]] = {
        "gpkg_spatial_ref_sys": [
            ("Undefined cartesian SRS", -1, "NONE", -1, "undefined", None),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
            ("WGS 84 geodetic", _WGS84, "EPSG", _WGS84, wgs84, None),
        ],
        "gpkg_contents": [],
        "gpkg_geometry_columns": [],
    }
    for layer in layers:
        shapes, kind = _projected(layer, epsg)
        bounds = shapely.total_bounds(shapes).tolist() if len(shapes) else [None] * 4
        contents = (layer.name, "features", layer.name, "", _LAST_CHANGE, *bounds, _WGS84)
        rows["gpkg_contents"].append(contents)
        rows["gpkg_geometry_columns"].append((layer.name, "geom", kind, _WGS84, 0, 0))
        columns = "".join(f', "{name}" {sql}' for name, sql in layer.columns.items())
        tables[layer.name] = f'{_FID}, "geom" {kind}{columns}'
        blobs = _blobs(shapes)
        rows[layer.name] = [
            (fid, blob, *(values.get(name) for name in layer.columns))
            for (fid, _, values), blob in zip(layer.rows, blobs, strict=True)
        ]
    no_bounds = (None,) * 5
    rows["gpkg_contents"].append(("meta", "attributes", "meta", "", _LAST_CHANGE, *no_bounds))
    tables["meta"] = f'{_FID}, "key" TEXT, "value" TEXT'
    rows["meta"] = [(i, *item) for i, item in enumerate(meta.items(), 1)]
    header = (f"PRAGMA application_id = {_APPLICATION_ID}", f"PRAGMA user_version = {_VERSION}")
    write_database(path, tables, rows, header)


def _projected(layer: FeatureLayer, epsg: int) -> tuple[np.ndarray, str]:
    """Geometries in longitude and latitude; all of them multiple when one is."""
    shapes = np.empty(len(layer.rows), object)
    shapes[:] = [shape for _, shape, _ in layer.rows]
    kind = layer.geometry
    if any(shape.geom_type.startswith("Multi") for shape in shapes):
        kind = f"MULTI{kind}"
        shapes[:] = [shapely.multipolygons(shapely.get_parts(shape)) for shape in shapes]
    xy = shapely.get_coordinates(shapes)
    lon, lat = to_metres(epsg).transform(xy[:, 0], xy[:, 1], direction="INVERSE")
    return shapely.set_coordinates(shapes, np.column_stack([lon, lat])), kind


def _blobs(shapes: np.ndarray) -> list[bytes]:
    bodies = shapely.to_wkb(shapes, byte_order=1)
    return [
        b"GP"
        + struct.pack(
            "<BBi4d", 0, _LITTLE_ENDIAN_WITH_ENVELOPE, _WGS84, low_x, high_x, low_y, high_y
        )
        + body
        for (low_x, low_y, high_x, high_y), body in zip(
            shapely.bounds(shapes).tolist(), bodies, strict=True
        )
    ]


_FID = '"fid" INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL'
_SYSTEM_TABLES = {
    "gpkg_spatial_ref_sys": "srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY NOT NULL, "
    "organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, "
    "definition TEXT NOT NULL, description TEXT",
    "gpkg_contents": "table_name TEXT PRIMARY KEY NOT NULL, data_type TEXT NOT NULL, "
    "identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL, "
    "min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER",
    "gpkg_geometry_columns": "table_name TEXT NOT NULL, column_name TEXT NOT NULL, "
    "geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, "
    "m TINYINT NOT NULL, CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name)",
}
