"""SQLite files, and the layers of a GeoPackage (.gpkg), which is one, without GDAL.

Those from somewhere else are read only, and nothing in them is executed. Only ordinary tables are
read. A view or a virtual table under an expected name is refused, so that no SQL of the file runs;
triggers never fire, since nothing is written.

Geometries of a GeoPackage are a short header followed by WKB. nuPlan's layers are in longitude and
latitude and are projected to the metric system that the table `meta` names. Those written here are
in that system itself (nuPlan rule 430), which nuPlan's code and this one then leave as it is. The
same content is written with the same bytes.
"""

import re
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

import numpy as np
import pyproj
import shapely

from shiftsim.errors import DataError
from shiftsim.files import atomic_write
from shiftsim.world.ranges import MAP_EXTENT, NUPLAN_MAP, require

Value: TypeAlias = int | float | str | bytes | None

_REPAIR = "the file is damaged or of another format; get it again from its source"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
REPAIR = "the map is damaged or not a nuPlan map; get it again from its source"
_ENVELOPE_BYTES = (0, 32, 48, 48, 64)
_WGS84 = 4326
_APPLICATION_ID, _VERSION = 0x47504B47, 10200  # "GPKG", version 1.2
_LAST_CHANGE = "2020-01-01T00:00:00.000Z"  # fixed, so that exports can be compared
_LITTLE_ENDIAN_WITH_ENVELOPE = 0x03
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


class Database:
    """An open file. Made by `open_database`."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._columns: dict[str, list[str]] = {}
        listed = self.query("SELECT name, type, sql FROM sqlite_master", "its schema")
        for name, kind, sql in listed:
            plain = kind == "table" and not str(sql or "").upper().startswith("CREATE VIRTUAL")
            if plain and isinstance(name, str) and _NAME.match(name):
                info = self.query(f'PRAGMA table_xinfo("{name}")', f"table {name!r}")
                self._columns[name] = [row[1] for row in info]

    def query(
        self, sql: str, what: str, parameters: Sequence[object] = ()
    ) -> list[tuple[Any, ...]]:
        """All rows of a query, with names of ours or checked by `require`; or a DataError."""
        try:
            return self._connection.execute(sql, tuple(parameters)).fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise DataError(f"{self.path}: cannot read {what}: {error}", hint=_REPAIR) from error

    def require(self, table: str, columns: Sequence[str]) -> None:
        """A DataError unless an ordinary table with these columns exists."""
        if table not in self._columns:
            raise DataError(f"{self.path}: table {table!r} is missing", hint=_REPAIR)
        missing = [name for name in columns if name not in self._columns[table]]
        if missing:
            raise DataError(f"{self.path}: table {table!r} has no column {missing[0]!r}", _REPAIR)

    def columns(
        self, table: str, required: Sequence[str], optional: Sequence[str] = ()
    ) -> dict[str, list[object]]:
        """Whole columns of a table in the order of its rows; None where an optional one is missing.

        Raises DataError: the table or a required column is missing, or the file cannot be read.
        """
        self.require(table, required)
        present = [*required, *(name for name in optional if name in self._columns[table])]
        names = ", ".join(f'"{name}"' for name in present)
        rows = self.query(f'SELECT {names} FROM "{table}" ORDER BY rowid', f"table {table!r}")
        out = {name: [row[i] for row in rows] for i, name in enumerate(present)}
        out.update({name: [None] * len(rows) for name in optional if name not in out})
        return out


@contextmanager
def open_database(path: Path) -> Iterator[Database]:
    """Open an SQLite file for reading, or a DataError; nothing in it is trusted."""
    if not path.is_file():
        raise DataError(f"{path}: no such file", hint="check the path")
    # Without a journal beside it, nobody can be writing: no locks, also on read-only media.
    busy = any(path.with_name(path.name + end).exists() for end in ("-wal", "-journal"))
    uri = f"file:{quote(str(path.resolve()))}?mode=ro" + ("" if busy else "&immutable=1")
    try:
        connection = sqlite3.connect(uri, uri=True)
    except sqlite3.Error as error:
        raise DataError(f"{path}: cannot open the file: {error}", hint=_REPAIR) from error
    try:
        for setting in ("trusted_schema = OFF", "query_only = ON", "cell_size_check = ON"):
            connection.execute(f"PRAGMA {setting}")
        yield Database(path, connection)
    finally:
        connection.close()


def write_database(
    path: Path,
    tables: Mapping[str, str],
    rows: Mapping[str, Sequence[Sequence[Value]]],
    after: Sequence[str] = (),
) -> None:
    """Write an SQLite file in one step: column definitions and rows by table, then statements."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.unlink(missing_ok=True)  # a process that was killed may have left a part
        with closing(sqlite3.connect(partial, isolation_level=None)) as connection:
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
        codes = [default if v is None else int(_id(v, self.name, column)) for v in values]
        require(NUPLAN_MAP, column, np.array(codes, np.float64), f"layer {self.name!r}: column")
        return codes


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
            what = f"projectedCoordSystem is {system!r}, not 'epsg:<code>'"
            raise DataError(f"{self.path}: table 'meta': {what}", REPAIR)
        return int(code)

    def table(self, name: str, columns: str = "", extra: str = "") -> LayerTable:
        """A layer with the columns named, separated by blanks; those in `extra` may be missing.

        Raises DataError: the layer or a column is missing, or a geometry is broken.
        """
        raw = self.database.columns(name, ["fid", "geom", *columns.split()], extra.split())
        where = f"{self.path}: layer {name!r}"
        blobs = [self._wkb(b, name, f) for f, b in zip(raw["fid"], raw["geom"], strict=True)]
        systems, bodies = {system for system, _ in blobs}, [body for _, body in blobs]
        if len(systems) > 1:
            raise DataError(f"{where} has several coordinate systems: {sorted(systems)}", REPAIR)
        try:
            shapes = shapely.force_2d(shapely.from_wkb(np.array(bodies, object)))
            x, y = shapely.get_coordinates(shapes).T
            if systems == {_WGS84}:
                x, y = self._project.transform(x, y)
        except (shapely.errors.GEOSException, pyproj.exceptions.ProjError) as error:
            raise DataError(f"{where}: broken geometry: {error}", REPAIR) from error
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise DataError(f"{where}: a coordinate is not finite in epsg:{self.epsg}", REPAIR)
        if len(x):
            require(MAP_EXTENT, "extent", max(np.ptp(x), np.ptp(y)), f"{where}: its")
        projected = shapely.set_coordinates(shapes, np.column_stack([x, y]))
        ids = [_id(v, name, "fid") for v in raw["fid"]]
        return LayerTable(name, ids, list(projected), raw)

    def _wkb(self, blob: object, layer: str, fid: object) -> tuple[int, bytes]:
        """The coordinate system of a geometry, and its WKB."""
        where = f"{self.path}: layer {layer!r}: geometry of fid {fid!r}"
        if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
            raise DataError(f"{where} is not a GeoPackage geometry", hint=REPAIR)
        envelope = (blob[3] >> 1) & 7
        if envelope >= len(_ENVELOPE_BYTES) or blob[3] & 0x30:
            raise DataError(f"{where} is empty or of an unknown kind", hint=REPAIR)
        (system,) = struct.unpack("<i" if blob[3] & 1 else ">i", blob[4:8])
        if system not in (_WGS84, self.epsg):
            known = f"neither {_WGS84} nor {self.epsg}"
            raise DataError(f"{where} has the coordinate system {system}, {known}", REPAIR)
        return system, blob[8 + _ENVELOPE_BYTES[envelope] :]


@lru_cache(maxsize=8)
def to_metres(epsg: int) -> pyproj.Transformer:
    """From longitude and latitude to the metric system of a code."""
    try:
        return pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    except pyproj.exceptions.CRSError as error:
        raise DataError(f"epsg:{epsg} is not a coordinate system: {error}", hint=REPAIR) from error


def _id(value: object, layer: str, column: str) -> str:
    # nuPlan rule 425: columns of references are numbers as a whole
    try:
        number = float(value)  # type: ignore[arg-type]  # anything SQLite can hold
        if number == int(number):
            return str(int(value)) if not isinstance(value, float) else str(int(number))  # type: ignore[call-overload]
    except (TypeError, ValueError, OverflowError):
        pass
    raise DataError(f"layer {layer!r}: column {column!r} holds {value!r}, not an integer", REPAIR)


@dataclass
class FeatureLayer:
    """One layer to be written."""

    name: str  # table name
    geometry: str  # `POLYGON`, `LINESTRING` or `POINT`
    columns: dict[str, str]  # SQL type by column name, besides `fid` and `geom`
    defaults: dict[str, Value]  # values by column where a row has none; else NULL
    # fid, geometry in metres and values by column
    rows: list[tuple[int, shapely.Geometry, Mapping[str, Value]]] = field(default_factory=list)


def write_geopackage(
    path: Path, layers: Sequence[FeatureLayer], *, epsg: int, meta: Mapping[str, str]
) -> None:
    """Write layers as they are; `epsg` is the metric system of their geometries."""
    tables = dict(_SYSTEM_TABLES)
    systems = {code: pyproj.CRS(code) for code in (_WGS84, epsg)}
    rows: dict[str, list[Sequence[Value]]] = {
        "gpkg_spatial_ref_sys": [
            ("Undefined cartesian SRS", -1, "NONE", -1, "undefined", None),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
            *(
                (system.name, code, "EPSG", code, system.to_wkt("WKT1_GDAL"), None)
                for code, system in systems.items()
            ),
        ],
        "gpkg_contents": [],
        "gpkg_geometry_columns": [],
    }
    for layer in layers:
        shapes, kind = _shapes_of(layer)
        bounds = shapely.total_bounds(shapes).tolist() if len(shapes) else [None] * 4
        contents = (layer.name, "features", layer.name, "", _LAST_CHANGE, *bounds, epsg)
        rows["gpkg_contents"].append(contents)
        rows["gpkg_geometry_columns"].append((layer.name, "geom", kind, epsg, 0, 0))
        columns = "".join(f', "{name}" {sql}' for name, sql in layer.columns.items())
        tables[layer.name] = f'{_FID}, "geom" {kind}{columns}'
        rows[layer.name] = [
            (fid, blob, *(values.get(name, layer.defaults.get(name)) for name in layer.columns))
            for (fid, _, values), blob in zip(layer.rows, _blobs(shapes, epsg), strict=True)
        ]
    rows["gpkg_contents"].append(("meta", "attributes", "meta", "", _LAST_CHANGE, *[None] * 5))
    tables["meta"] = f'{_FID}, "key" TEXT, "value" TEXT'
    rows["meta"] = [(i, *item) for i, item in enumerate(meta.items(), 1)]
    header = (f"PRAGMA application_id = {_APPLICATION_ID}", f"PRAGMA user_version = {_VERSION}")
    write_database(path, tables, rows, header)


def _shapes_of(layer: FeatureLayer) -> tuple[np.ndarray, str]:
    """Geometries and their kind; all of them multiple when one is."""
    shapes = np.empty(len(layer.rows), object)
    shapes[:] = [shape for _, shape, _ in layer.rows]
    kind = layer.geometry
    if any(shape.geom_type.startswith("Multi") for shape in shapes):
        kind = f"MULTI{kind}"
        shapes[:] = [shapely.multipolygons(shapely.get_parts(shape)) for shape in shapes]
    return shapes, kind


def _blobs(shapes: np.ndarray, epsg: int) -> list[bytes]:
    envelopes = shapely.bounds(shapes)[:, [0, 2, 1, 3]].tolist()  # low and high x, low and high y
    head = ("<2sBBi4d", b"GP", 0, _LITTLE_ENDIAN_WITH_ENVELOPE, epsg)
    bodies = shapely.to_wkb(shapes, byte_order=1)
    return [struct.pack(*head, *e) + body for e, body in zip(envelopes, bodies, strict=True)]
