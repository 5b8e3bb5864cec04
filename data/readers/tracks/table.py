"""Tracks from CSV or Parquet: one row per object and time, in SI units afterwards."""

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
from shiftsim.data.readers.files import SourceFile
from shiftsim.data.readers.motion import unit_vectors
from shiftsim.data.readers.tracks.columns import Columns, recognise
from shiftsim.errors import ConfigError, ConversionError
from shiftsim.kernels import FloatArray, IntArray

_DELIMITERS = ",;\t|"
_BLOCK_BYTES = 1 << 22  # that are parsed at once
_FIELDS = {"x": "position", "y": "position", "heading": "heading"}  # that nothing replaces


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
    file = _TableFile(path, dict(overrides or {}))
    columns, table = file.columns_of, file.table
    time_us, rate = file.times(hz)
    track_ids, track = index_ids(file.ids())
    category, categories = file.categories(track_ids, track)
    order = order_of_rows(track, time_us)
    if order is not None:
        time_us, track, category = time_us[order], track[order], category[order]

    def stacked(*roles: str) -> FloatArray | None:
        """(A, number of roles) their values, or nothing where one is missing."""
        if not all(role in columns.found for role in roles):
            return None
        out = np.empty((len(table), len(roles)))
        for place, role in enumerate(roles):
            values = file.values(role)
            out[:, place] = values if order is None else values[order]
        return out

    xy, heading = stacked("x", "y"), stacked("heading")
    headings = None if heading is None else heading[:, 0]
    size, velocity = stacked("length", "width"), stacked("vx", "vy")
    speed = stacked("speed") if velocity is None else None
    assert xy is not None  # `recognise` has found them
    xy += columns.shift
    if speed is not None and headings is not None:
        velocity = speed * unit_vectors(headings)
    if columns.reference in ("front", "rear"):
        if headings is None or size is None:
            raise ConfigError(
                f"reference = {columns.reference!r} needs heading and length of the objects",
                "name these columns",
            )
        back = -0.5 if columns.reference == "front" else 0.5
        xy += back * size[:, :1] * unit_vectors(headings)
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
        headings,
        velocity,
        size,
    )


class _TableFile(SourceFile):
    """The columns of a file that are needed."""

    remedy = "repair the file, or name other columns with --columns"

    def __init__(self, path: Path, overrides: dict[str, Any]) -> None:
        super().__init__(path)
        if not path.is_file():
            what = "is no file" if path.exists() else "does not exist"
            raise ConversionError(f"{path} {what}", "give a CSV or Parquet file")
        is_csv = path.suffix.lower() not in (".parquet", ".pq")
        self.csv = self._csv_options() if is_csv else None
        self.kinds: dict[int, str] | None = None  # by id, from levelXdata's files
        names = self._names()
        if path.stem.endswith("_tracks"):  # levelXdata: kinds and rate are in files beside it
            self._read_beside(overrides, names)
        self.columns_of = recognise(names, overrides, str(path))
        self.table = self._read()
        if not len(self.table):
            raise ConversionError(f"{path} has no rows", "export the tracks again")

    def _csv_options(self) -> tuple[dict[str, Any], str]:
        """Options of the parser, and the decimal point, from the first two lines."""
        try:
            with pa.input_stream(str(self.path), compression="detect") as stream:
                lines = stream.read(1 << 16).decode("utf-8-sig").splitlines()[:2]
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            what = f"not readable as CSV ({error})"
            raise self.fault(what, "give CSV in UTF-8, or Parquet (.parquet)") from error
        if not lines:
            raise ConversionError(f"{self.path} is empty", "export the tracks again")
        delimiter = max(_DELIMITERS, key=lines[0].count)
        point = "," if delimiter != "," and "," in lines[-1] and "." not in lines[-1] else "."
        read = pc.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
        return {"read_options": read, "parse_options": pc.ParseOptions(delimiter=delimiter)}, point

    def _names(self) -> list[str]:
        try:
            if self.csv is None:
                return list(pq.read_schema(self.path).names)
            with pc.open_csv(self.path, **self.csv[0]) as stream:
                return list(stream.schema.names)
        except (OSError, pa.ArrowException) as error:
            raise self.fault(f"not readable ({error})") from error

    def _read(self) -> pa.Table:
        found, names = self.columns_of.found, self.columns_of.names
        try:
            if self.csv is None:
                return pq.read_table(self.path, columns=names, use_threads=False)
            options, point = self.csv
            types = {
                column.name: pa.float64()
                for role, column in found.items()
                if role not in ("id", "kind", "time")
            }
            types[found["kind"].name] = pa.dictionary(pa.int32(), pa.string())
            convert = pc.ConvertOptions(
                include_columns=names,
                column_types={name: kind for name, kind in types.items() if name},
                decimal_point=point,
            )
            try:  # block by block takes half the memory; types are those of the first block
                with pc.open_csv(self.path, convert_options=convert, **options) as stream:
                    return stream.read_all()
            except pa.ArrowInvalid:
                return pc.read_csv(self.path, convert_options=convert, **options)
        except (OSError, pa.ArrowException, ValueError) as error:
            raise self.fault(f"not readable ({error})") from error

    def _read_beside(self, overrides: dict[str, Any], names: list[str]) -> None:
        """Rate and kinds from levelXdata's files; what the user gives goes first."""
        stem = self.path.stem.removesuffix("tracks")
        rates, kinds = (
            self.path.with_name(f"{stem}{part}Meta.csv") for part in ("recording", "tracks")
        )
        file = rates
        try:
            if rates.is_file() and "hz" not in overrides:
                overrides["hz"] = float(pc.read_csv(rates).to_pydict()["frameRate"][0])
            file = kinds
            has_kinds = {"class", "kind"} & {name.lower() for name in names}
            if kinds.is_file() and not has_kinds:
                found = pc.read_csv(kinds).to_pydict()
                ids = found["trackId" if "trackId" in found else "id"]
                self.kinds = dict(zip(ids, map(str, found["class"]), strict=True))
                overrides["columns"] = {"kind": "=meta"} | overrides.get("columns", {})
        except (OSError, pa.ArrowException, KeyError, ValueError, IndexError, TypeError) as error:
            raise ConversionError(f"{file}: not readable ({error!r})", self.remedy) from error

    def values(self, role: str) -> FloatArray:
        """A column in SI units; NaN only where kinds or positions can make up for it."""
        column = self.columns_of.found[role]
        if not column.name:
            try:
                return np.full(len(self.table), float(column.constant) * column.factor(role))
            except ValueError:
                what = f"column {role!r} is {column.constant!r} for all rows"
                raise ConfigError(what, f"{role} = '=NUMBER'") from None
        try:
            values = _floats(self.table[column.name])
        except (pa.ArrowException, ValueError) as error:
            kind = self.table[column.name].type
            raise self.fault(f"column {column.name!r} is {kind}, need numbers") from error
        needed = role in _FIELDS
        bad = np.flatnonzero(~np.isfinite(values) if needed else np.isinf(values))
        if len(bad):
            raise self.fault(
                f"column {column.name!r} holds {len(bad)} values that are"
                f" {'empty or ' * needed}not finite, the first in data row {bad[0] + 1}",
                f"leave these {'rows out of the file' if needed else 'values empty'}",
            )
        values *= column.factor(role)
        if needed:
            self.require(_FIELDS[role], values, f"column {column.name!r}")
        return np.pi / 2 - values if column.unit == "compass" else values

    def times(self, hz: float | None) -> tuple[IntArray, float | None]:
        """(A,) time stamps [us], and the frames per second, where they are given in frames."""
        found, rate = self.columns_of.found, hz or self.columns_of.hz
        is_frame = "frame" in found and (rate is not None or "time" not in found)
        role = "frame" if is_frame else "time"
        column = found[role]
        if is_frame and not rate:
            raise self.fault(
                f"time is given in frames ({column.name!r}) only",
                "say how many there are per second: --hz 25",
            )
        if is_frame and not 0.0 < float(rate or 0.0) < np.inf:
            raise ConfigError(f"hz is {rate!r}", "--hz 25")
        if not column.name:
            raise ConfigError(f"{role} is the same for all rows", f"name a column: {role} = 'NAME'")
        values = self.table[column.name]
        try:
            if pa.types.is_timestamp(values.type) or pa.types.is_duration(values.type):
                column = replace(column, unit=values.type.unit)
                values = values.cast(pa.int64())
            stamps = _floats(values)
        except (pa.ArrowException, ValueError) as error:
            what = f"column {column.name!r} is {values.type}, need times"
            hint = "give seconds, or dates and times such as 2024-05-01T13:02:03.040"
            raise self.fault(what, hint) from error
        stamps *= 1e6 if is_frame else column.factor(role)
        stamps /= rate if is_frame and rate else 1.0
        bad = np.flatnonzero(~(np.abs(stamps) < 2.0**55))
        if len(bad):
            raise self.fault(
                f"column {column.name!r} holds {len(bad)} values that are no times, the first"
                f" in data row {bad[0] + 1}",
                "check its unit: [units] time = 's', 'ms', 'us' or 'ns'; leave empty rows out",
            )
        return np.rint(stamps).astype(np.int64), rate if is_frame else None

    def ids(self) -> pa.ChunkedArray:
        """Integers or texts."""
        name = self.columns_of.found["id"].name
        column = self.table[name]
        if empty := int(column.is_null(nan_is_null=True).to_numpy().sum()):
            raise self.fault(f"column {name!r} is empty in {empty} rows", "give objects ids")
        if pa.types.is_floating(column.type):
            values = column.to_numpy()
            if (values == np.rint(values)).all():
                return pa.chunked_array([values.astype(np.int64)])
        return column if pa.types.is_integer(column.type) else column.cast(pa.string())

    def categories(
        self, track_ids: NDArray[Any], track: IntArray
    ) -> tuple[IntArray, tuple[str, ...]]:
        """(A,) codes, and the names that they mean: known categories where the user maps them."""
        column = self.columns_of.found["kind"]
        if self.kinds is not None and column.constant == "meta":
            names, codes = [self.kinds.get(one, "") for one in track_ids.tolist()], track
        elif not column.name:
            names, codes = [column.constant], np.zeros(len(track), np.int64)
        else:
            values = self.table[column.name]
            if not pa.types.is_dictionary(values.type):
                values = values.cast(pa.string()).dictionary_encode()
            found, codes = dictionary_codes(values)
            names = [*map(str, found.to_pylist()), ""]
        plain = [normalise_category(name) for name in names]
        known = [self.columns_of.kinds.get(name, name) for name in plain]
        distinct, place = np.unique(known, return_inverse=True)
        return place[codes], tuple(distinct.tolist())


def _floats(column: pa.ChunkedArray) -> FloatArray:
    """(A,) numbers that may be written; NaN where there is none."""
    values: FloatArray = column.cast(pa.float64(), safe=False).to_numpy()  # ns have 64 bits
    return values if values.flags.writeable else values.copy()
