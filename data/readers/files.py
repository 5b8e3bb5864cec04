"""A file of an open data set: what is read of it is checked, and faults name it and a remedy.

Every reader says what it needs: of columns the Arrow type (`items`: lists without nulls), of JSON
and msgpack the form (`SourceFile.expect`). What passes is used without further checks but those of
ranges.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import shapely

from shiftsim.data.maps.segments import clean_line
from shiftsim.data.polygons import largest_part
from shiftsim.data.readers.reader import Reader
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.errors import ConversionError, DataError, readable
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.ranges import OPEN_DATA, require

_MAX_BYTES = 2_000_000_000
_MAX_ROWS = 8_000_000
_RECORDED = ConversionConfig(min_peak_speed=0.0, max_overlap=1e6)  # also a car that stands
# what JSON and msgpack call a type of Python, and the types of values that will do
_KINDS: dict[type, tuple[str, tuple[type, ...]]] = {
    bool: ("true or false", (bool,)),
    int: ("an integer", (int,)),
    float: ("a number", (int, float)),
    str: ("a text", (str,)),
    list: ("a list", (list,)),
    dict: ("a map", (dict,)),
    np.ndarray: ("an array", (np.ndarray,)),
}


class SourceFile:
    """A file, and what to do where it is not as expected."""

    # hint of all faults that have none of their own
    remedy = "get the file again from its source, or leave the scene out"
    casts = False  # whether columns may have another type that can be cast to the one wanted

    def __init__(self, path: Path) -> None:
        self.path = path

    def fault(self, what: object, remedy: str = "") -> ConversionError:
        """The error that says what is wrong."""
        return ConversionError(f"{self.path}: {what}", remedy or self.remedy)

    def require_that(self, is_good: object, what: str, remedy: str = "") -> None:
        """Raise an error that says what is wrong, unless all is good."""
        if not is_good:
            raise self.fault(what, remedy)

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Add the path of the file to errors raised inside."""
        try:
            yield
        except DataError as error:
            if str(self.path) in error.message:
                raise
            raise type(error)(f"{self.path}: {error.message}", error.hint) from error

    def content(self, max_bytes: int = _MAX_BYTES) -> bytes:
        """All bytes of it."""
        self.require_size(max_bytes)
        try:
            return self.path.read_bytes()
        except OSError as error:
            raise self.fault(f"cannot be read ({error})") from error

    def require_size(self, max_bytes: int = _MAX_BYTES) -> None:
        """The file is there, and not too large."""
        try:
            size = self.path.stat().st_size
        except FileNotFoundError as error:
            what = f"{self.path} is missing"
            raise ConversionError(what, "copy all files of the scene") from error
        except OSError as error:
            raise self.fault(f"cannot be read ({error})") from error
        if size > max_bytes:
            raise self.fault(f"more than {max_bytes} bytes", "split the recording")

    def number(self, value: Any, field: str, place: str) -> float:
        """A number, or a text that is one, in the range of its field."""
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            raise self.fault(f"{place} is {value!r}, need a number") from None
        self.require(field, number, place)
        return number

    def require(self, field: str, values: Any, place: str) -> None:
        """Numbers are in the range of their field."""
        require(OPEN_DATA, field, values, f"{self.path}: {place} as", error=ConversionError)

    def line(self, points: Any, place: str, least: int = 2) -> FloatArray:
        """(K, 2) a line of points (K', 2 or 3), or maps of x and y, without repeated ones [m]."""
        if isinstance(points, list):
            points = [(p["x"], p["y"]) if isinstance(p, dict) else p for p in points]
        try:
            line = np.array(points, np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise self.fault(f"{place} is no line of points ({error})") from error
        line = line if line.size else np.empty((0, 2))
        if line.ndim != 2 or line.shape[1] < 2:
            raise self.fault(f"{place} is no line of points (shape {line.shape})")
        self.require("position", line[:, :2], place)
        line = clean_line(line[:, :2])
        if len(line) < least:
            raise self.fault(f"{place} has {len(line)} points that differ, need {least}")
        return line

    def ring(self, points: Any, place: str) -> shapely.Polygon:
        """The largest valid part of the polygon that a line encloses."""
        return largest_part(shapely.Polygon(self.line(points, place, least=3)))

    def area(self, wkb: bytes, place: str) -> shapely.Polygon:
        """The largest valid part of a polygon."""
        shape = shapely.from_wkb(wkb, on_invalid="ignore")
        if shape is None or shape.geom_type != "Polygon" or shape.is_empty:
            raise self.fault(f"{place} is no polygon")
        self.require("position", shapely.get_coordinates(shape), place)
        return largest_part(shapely.force_2d(shape))

    def known(self, value: Any, all_known: Collection[Any], place: str) -> Any:
        """A value that is one of those that are known."""
        if value not in all_known:
            hint = f"known are: {', '.join(map(str, all_known))}"
            raise self.fault(f"{place} {value!r} is unknown", hint)
        return value

    def unpack(
        self, data: bytes | None, load: Callable[[bytes], Any], form: Any, place: str
    ) -> Any:
        """What JSON or msgpack holds, of a form as in `expect`; `load` reads it."""
        try:
            found = None if data is None else load(data)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise self.fault(f"{place} cannot be unpacked ({error})") from error
        self.expect(found, form, place)
        return found

    def expect(self, value: Any, form: Any, place: str) -> None:
        """Raise an error unless what JSON or msgpack holds has a form.

        A form is a type; `[form]`: a list of such; `{name: form}`: a map with at least these names;
        `{str: form}`: a map with any names; `(form,)`: such, or nothing.
        """
        if value is None and isinstance(form, tuple):
            return
        form = form[0] if isinstance(form, tuple) else form
        if value is None:
            raise self.fault(f"{place} is missing")
        name, types = _KINDS[form if isinstance(form, type) else type(form)]
        if type(value) not in types:
            raise self.fault(f"{place} is {readable(value)[:40]!r}, need {name}")
        if isinstance(form, list):
            for number, item in enumerate(value):
                self.expect(item, form[0], f"{place}, item {number}")
        elif isinstance(form, dict):
            each = dict.fromkeys(value, form[str]) if str in form else form
            for key, inner in each.items():
                self.expect(value.get(key), inner, f"{place}: {key!r}")

    def columns(
        self, wanted: Mapping[str, pa.DataType], *, optional: Collection[str] = ()
    ) -> pa.Table:
        """Columns of a Parquet file, or of an Arrow IPC file (`.arrow`), and its metadata.

        All have the type that is `wanted`, and no nulls but in lists whose type allows them; those
        that are `optional` may be missing. Else it is a ConversionError.
        """
        self.require_size()
        try:
            table = self._read(wanted)
            table.validate(full=True)
        except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
            raise self.fault(f"cannot be read ({error})") from error
        self._require_rows(len(table))
        columns = {}
        for name, kind in wanted.items():
            count = table.column_names.count(name)
            if not count and name in optional:
                continue
            if count != 1:
                what = f"there {count} times" if count else "missing"
                raise self.fault(f"column {name!r} is {what}")
            column = table[name]
            if self.casts:
                with suppress(ValueError, pa.ArrowException):
                    column = column.cast(kind)
            if _bare(column.type) != _bare(kind):
                raise self.fault(f"column {name!r} is {column.type}, need {_bare(kind)}")
            if nulls := sum(_nulls(chunk, kind) for chunk in column.chunks):
                raise self.fault(f"column {name!r} holds {nulls} nulls, need a value everywhere")
            columns[name] = column
        return pa.table(columns, metadata=table.schema.metadata)

    def _read(self, wanted: Mapping[str, pa.DataType]) -> pa.Table:
        """The columns that are there."""
        if self.path.suffix != ".arrow":
            file = pq.ParquetFile(self.path)
            self._require_rows(file.metadata.num_rows)
            known = [name for name in wanted if name in file.schema_arrow.names]
            texts = [name for name in known if pa.types.is_dictionary(wanted[name])]
            file = pq.ParquetFile(self.path, read_dictionary=texts)  # these are not repeated
            return file.read(known, use_threads=False)
        with pa.OSFile(str(self.path)) as source:
            schema = pa.ipc.open_file(source).schema
            known_at = [i for i, name in enumerate(schema.names) if name in wanted]
            options = pa.ipc.IpcReadOptions(included_fields=known_at, use_threads=False)
            return pa.ipc.open_file(source, options=options).read_all()

    def _require_rows(self, count: int) -> None:
        remedy = "split the recording" if count else ""
        self.require_that(0 < count <= _MAX_ROWS, f"{count} rows, need 1 to {_MAX_ROWS}", remedy)

    def numbers(self, table: pa.Table, column: str, field: str) -> FloatArray:
        """(R,) a column as float64, all in the range of the field."""
        values = table[column].to_numpy().astype(np.float64, copy=False)
        self.require(field, values, f"column {column!r}")
        return values

    def lists(self, table: pa.Table) -> tuple[IntArray, list[pa.Array]]:
        """The row of each item of lists in columns that belong together, and the items."""
        columns = [column.combine_chunks() for column in table.columns]
        rows = [pc.list_parent_indices(column).to_numpy() for column in columns]
        for name, one in zip(table.column_names, rows, strict=True):
            if not np.array_equal(one, rows[0]):
                raise self.fault(f"lists of {name!r} have lengths of their own")
        return rows[0], [column.flatten() for column in columns]


def items(kind: pa.DataType, length: int = -1) -> pa.DataType:
    """The type of lists without nulls, all of a length if it is given."""
    return pa.list_(pa.field("item", kind, nullable=False), length)


def vectors(column: pa.Array, count: int) -> FloatArray:
    """(R, count) the first parts of a column of vectors; NaN where there is none."""
    parts = [pc.list_element(column, i).to_numpy(zero_copy_only=False) for i in range(count)]
    return np.column_stack(parts)


def _bare(kind: pa.DataType) -> pa.DataType:
    """A type, whatever it calls the items of lists, and whether there may be nulls among them."""
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(_bare(kind.value_type), kind.list_size)
    if pa.types.is_list(kind):
        return pa.list_(_bare(kind.value_type))
    return pa.string() if pa.types.is_large_string(kind) else kind


def _nulls(found: pa.Array, kind: pa.DataType, *, allowed: bool = False) -> int:
    """How many nulls there are where there may be none."""
    count = 0 if allowed else found.null_count
    if isinstance(found, pa.ListArray | pa.FixedSizeListArray):
        count += _nulls(found.flatten(), kind.value_type, allowed=kind.value_field.nullable)
    return count


class SceneFolder(Reader):
    """What the readers of folders of scenes share; each scene has a map of its own.

    `source` may be the only scene itself. With `vehicles` every vehicle that drives is an ego, not
    the recording car alone.
    """

    name = ""  # of the data set
    pattern = ""  # of the files that scenes are named by
    hint = ""  # where there is none
    site = None

    def __init__(self, source: Path, *, vehicles: bool = False) -> None:
        self.source, self.vehicles = source, vehicles
        self.settings = {"vehicles": vehicles}

    def recordings(self) -> list[str]:
        """Paths that name the scenes, sorted."""
        is_file = self.source.is_file()
        paths = [self.source] if is_file else sorted(self.source.rglob(self.pattern))
        if not paths:
            raise ConversionError(f"{self.source}: no {self.pattern} below it", self.hint)
        return [str(path) for path in paths]

    def recorded_ego(self, name: str) -> dict[str, Any]:
        """Which objects of a scene become egos: `name`, whatever it does, or all vehicles."""
        return {} if self.vehicles else {"egos": (name,), "config": _RECORDED}
