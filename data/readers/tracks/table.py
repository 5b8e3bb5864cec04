"""Tracks from CSV or Parquet: one row per object and time, in SI units afterwards."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shiftsim.data.readers.build import dictionary_codes, index_ids, order_of_rows
from shiftsim.data.readers.codes import normalise_category
from shiftsim.data.readers.motion import unit_vectors
from shiftsim.data.readers.tracks.columns import Columns, recognise
from shiftsim.errors import ConfigError, ConversionError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.ranges import OPEN_DATA, require

_REPAIR = "repair the file, or name other columns with --columns"
_DELIMITERS = ",;\t|"
_BLOCK_BYTES = 1 << 22  # that are parsed at once
_FIELDS = {"x": "position", "y": "position", "heading": "heading"}  # what nothing can make up for


@dataclass(frozen=True)
class TrackTable:
    """Rows of a file, sorted by object and time. A rows."""

    name: str  # name of the recording
    columns: Columns  # where they come from
    hz: float | None  # frames per second, where time was given in frames
    time_us: IntArray  # (A,) [us]
    track: IntArray  # (A,) index into `track_ids`
    track_ids: NDArray[Any]  # (N,) integers or texts, ascending
    category: IntArray  # (A,) index into `categories`
    categories: tuple[str, ...]  # normalised names
    xy: FloatArray  # (A, 2) [m]
    headings: FloatArray | None  # (A,) [rad]
    velocities: FloatArray | None  # (A, 2) [m/s]
    sizes: FloatArray | None  # (A, 2) length, width [m]


def read_tracks(
    path: Path, *, overrides: Mapping[str, Any] | None = None, hz: float | None = None
) -> TrackTable:
    """The rows of a CSV or Parquet file.

    Args:
        path: The file; `*Meta.csv` files of levelXdata beside it are read too.
        overrides: Names, units and kinds that the user gives (`columns.recognise`).
        hz: Frames per second, for time given in frames.

    Raises:
        ConversionError: The file cannot be read, a column is missing or holds something else.
        ConfigError: An override does not fit the file.
    """
    if not path.is_file():
        what = "is no file" if path.exists() else "does not exist"
        raise ConversionError(f"{path} {what}", "give a CSV or Parquet file")
    is_csv = path.suffix.lower() not in (".parquet", ".pq")
    options = _csv_options(path) if is_csv else None
    names = _names(path, options)
    overrides, meta = dict(overrides or {}), None
    stem = path.stem.removesuffix("_tracks")
    if stem != path.stem:  # levelXdata: kinds and rate are in files beside the tracks
        overrides, meta = _beside(path.with_name(f"{stem}_"), overrides, names)
    columns = recognise(names, overrides, str(path))
    table = _read(path, columns, options)
    if not len(table):
        raise ConversionError(f"{path} has no rows", "export the tracks again")
    time_us, rate = _times(table, columns, hz, path)
    track_ids, track = index_ids(_ids(table, columns.found["id"].name, path))
    category, categories = _categories(table, columns, track_ids, track, meta)
    order = order_of_rows(track, time_us)
    if order is not None:
        time_us, track, category = time_us[order], track[order], category[order]

    def stacked(*roles: str) -> FloatArray | None:
        """(A, number of roles) their values, or nothing where one is missing."""
        if not all(role in columns.found for role in roles):
            return None
        out = np.empty((len(track), len(roles)))
        for place, role in enumerate(roles):
            values = _numbers(table, role, columns, path)
            out[:, place] = values if order is None else values[order]
        return out

    xy = stacked("x", "y")
    heading = stacked("heading")
    heading = None if heading is None else heading[:, 0]
    size, velocity = stacked("length", "width"), stacked("vx", "vy")
    speed = stacked("speed") if velocity is None else None
    assert xy is not None  # `recognise` has found them
    xy += columns.shift
    if speed is not None and heading is not None:
        velocity = speed * unit_vectors(heading)
    if columns.reference in ("front", "rear"):
        if heading is None or size is None:
            raise ConfigError(
                f"reference = {columns.reference!r} needs heading and length of the objects",
                "name these columns",
            )
        back = -0.5 if columns.reference == "front" else 0.5
        xy += back * size[:, :1] * unit_vectors(heading)
    return TrackTable(
        path.name.partition(".")[0],
        columns,
        rate,
        time_us,
        track,
        track_ids,
        category,
        categories,
        xy,
        heading,
        velocity,
        size,
    )


def _csv_options(path: Path) -> tuple[pc.ReadOptions, pc.ParseOptions, str]:
    """How a CSV file is written: its delimiter and its decimal point, from the first two lines."""
    try:
        with pa.input_stream(str(path), compression="detect") as stream:
            start = stream.read(1 << 16)
        lines = start.decode("utf-8-sig").splitlines()[:2]
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        what = f"{path}: not readable as CSV ({error})"
        raise ConversionError(what, "give CSV in UTF-8, or Parquet (.parquet)") from error
    if not lines:
        raise ConversionError(f"{path} is empty", "export the tracks again")
    delimiter = max(_DELIMITERS, key=lines[0].count)
    point = "," if delimiter != "," and "," in lines[-1] and "." not in lines[-1] else "."
    read = pc.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
    return read, pc.ParseOptions(delimiter=delimiter), point


def _names(path: Path, options: Any) -> list[str]:
    try:
        if options is None:
            return list(pq.read_schema(path).names)
        with pc.open_csv(path, read_options=options[0], parse_options=options[1]) as stream:
            return list(stream.schema.names)
    except (OSError, pa.ArrowException) as error:
        raise ConversionError(f"{path}: not readable ({error})", _REPAIR) from error


def _read(path: Path, columns: Columns, options: Any) -> pa.Table:
    """The columns that are needed."""
    texts = {columns.found[role].name for role in ("kind",) if role in columns.found}
    try:
        if options is None:
            return pq.read_table(path, columns=columns.names, use_threads=False)
        read, parse, point = options
        floats = [
            column.name
            for role, column in columns.found.items()
            if role not in ("id", "kind", "time") and column.name
        ]
        convert = pc.ConvertOptions(
            include_columns=columns.names,
            column_types={
                **{name: pa.float64() for name in floats},
                **{name: pa.dictionary(pa.int32(), pa.string()) for name in texts if name},
            },
            decimal_point=point,
        )
        how = {"read_options": read, "parse_options": parse, "convert_options": convert}
        try:  # block by block takes half the memory; types are those of the first block
            with pc.open_csv(path, **how) as stream:
                return stream.read_all()
        except pa.ArrowInvalid:
            return pc.read_csv(path, **how)
    except (OSError, pa.ArrowException, ValueError) as error:
        raise ConversionError(f"{path}: not readable ({error})", _REPAIR) from error


def _numbers(table: pa.Table, role: str, columns: Columns, path: Path) -> FloatArray:
    """One of our columns in SI units; NaN only where kinds or positions can make up for it."""
    column = columns.found[role]
    if not column.name:
        try:
            return np.full(len(table), float(column.constant) * column.factor(role))
        except ValueError:
            what = f"column {role!r} is {column.constant!r} for all rows"
            raise ConfigError(what, f"{role} = '=NUMBER'") from None
    try:
        values = _floats(table[column.name])
    except (pa.ArrowException, ValueError) as error:
        what = f"{path}: column {column.name!r} is {table[column.name].type}, need numbers"
        raise ConversionError(what, _REPAIR) from error
    needed = role in ("x", "y", "heading")
    bad = np.flatnonzero(~np.isfinite(values) if needed else np.isinf(values))
    if len(bad):
        raise ConversionError(
            f"{path}: column {column.name!r} holds {len(bad)} values that are"
            f" {'empty or ' * needed}not finite, the first in data row {bad[0] + 1}",
            f"leave these {'rows out of the file' if needed else 'values empty'}",
        )
    values *= column.factor(role)
    if role in _FIELDS:
        where = f"{path}: column {column.name!r} as"
        require(OPEN_DATA, _FIELDS[role], values, where, error=ConversionError)
    return np.pi / 2 - values if column.unit == "compass" else values


def _floats(column: pa.ChunkedArray) -> FloatArray:
    """(A,) numbers that may be written; NaN where there is none."""
    values: FloatArray = column.cast(pa.float64(), safe=False).to_numpy()  # ns have 64 bits
    return values if values.flags.writeable else values.copy()


def _times(
    table: pa.Table, columns: Columns, hz: float | None, path: Path
) -> tuple[IntArray, float | None]:
    """(A,) time stamps [us], and the frames per second, where they are given in frames."""
    rate = hz or columns.hz
    role = "frame" if "frame" in columns.found and (rate or "time" not in columns.found) else "time"
    column = columns.found[role]
    if role == "frame" and not rate:
        raise ConversionError(
            f"{path}: time is given in frames ({column.name!r}) only",
            "say how many there are per second: --hz 25",
        )
    if role == "frame" and not 0.0 < float(rate or 0.0) < np.inf:
        raise ConfigError(f"hz is {rate!r}", "--hz 25")
    values = table[column.name] if column.name else None
    if values is None:
        raise ConfigError(f"{role} is the same for all rows", f"name a column: {role} = 'NAME'")
    try:
        if pa.types.is_timestamp(values.type) or pa.types.is_duration(values.type):
            column = replace(column, unit=values.type.unit)
            values = values.cast(pa.int64())
        stamps = _floats(values)
    except (pa.ArrowException, ValueError) as error:
        what = f"{path}: column {column.name!r} is {values.type}, need times"
        hint = "give seconds, or dates and times such as 2024-05-01T13:02:03.040"
        raise ConversionError(what, hint) from error
    stamps *= 1e6 if role == "frame" else column.factor(role)
    stamps /= rate if role == "frame" and rate else 1.0
    bad = np.flatnonzero(~(np.abs(stamps) < 2.0**55))
    if len(bad):
        raise ConversionError(
            f"{path}: column {column.name!r} holds {len(bad)} values that are no times, the first"
            f" in data row {bad[0] + 1}",
            "check its unit: [units] time = 's', 'ms', 'us' or 'ns'; leave empty rows out",
        )
    return np.rint(stamps, out=stamps).astype(np.int64), rate if role == "frame" else None


def _ids(table: pa.Table, name: str, path: Path) -> pa.ChunkedArray:
    """Integers or texts."""
    column = table[name]
    if empty := int(column.is_null(nan_is_null=True).to_numpy().sum()):
        raise ConversionError(
            f"{path}: column {name!r} is empty in {empty} rows", "give objects ids"
        )
    if pa.types.is_floating(column.type):
        values = column.to_numpy()
        if (values == np.rint(values)).all():
            return pa.chunked_array([values.astype(np.int64)])
    return column if pa.types.is_integer(column.type) else column.cast(pa.string())


def _categories(
    table: pa.Table,
    columns: Columns,
    track_ids: NDArray[Any],
    track: IntArray,
    meta: Mapping[int, str] | None,
) -> tuple[IntArray, tuple[str, ...]]:
    """(A,) codes, and the names that they mean, of known categories where the user has mapped."""
    column = columns.found["kind"]
    if meta is not None and column.constant == "meta":
        names, codes = [meta.get(one, "") for one in track_ids.tolist()], track
    elif not column.name:
        names, codes = [column.constant], np.zeros(len(table), np.int64)
    else:
        values = table[column.name]
        if not pa.types.is_dictionary(values.type):
            values = values.cast(pa.string()).dictionary_encode()
        found, codes = dictionary_codes(values)
        names = [*map(str, found.to_pylist()), ""]
    plain = [normalise_category(name) for name in names]
    plain = [columns.kinds.get(name, name) for name in plain]
    distinct = sorted(set(plain))
    place = np.array([distinct.index(name) for name in plain])
    return place[codes], tuple(distinct)


def _beside(
    prefix: Path, overrides: dict[str, Any], names: list[str]
) -> tuple[dict[str, Any], dict[int, str] | None]:
    """Rate and kinds from levelXdata's files beside the tracks; what the user gives goes first."""
    meta, file = None, prefix
    rates, kinds = (prefix.with_name(f"{prefix.name}{n}Meta.csv") for n in ("recording", "tracks"))
    try:
        if os.path.isfile(file := rates) and "hz" not in overrides:
            found = pc.read_csv(rates).to_pydict()
            overrides["hz"] = float(found["frameRate"][0])
        if os.path.isfile(file := kinds) and not {"class", "kind"} & {
            name.lower() for name in names
        }:
            found = pc.read_csv(kinds).to_pydict()
            number = "trackId" if "trackId" in found else "id"
            meta = dict(zip(found[number], map(str, found["class"]), strict=True))
            overrides["columns"] = {"kind": "=meta"} | overrides.get("columns", {})
    except (OSError, pa.ArrowException, KeyError, ValueError, IndexError, TypeError) as error:
        raise ConversionError(f"{file}: not readable ({error!r})", _REPAIR) from error
    return overrides, meta
