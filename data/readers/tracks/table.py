"""Tracks from CSV or Parquet: one row per object and time, in SI units afterwards."""

import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shiftsim.data.readers import build, motion
from shiftsim.data.readers.codes import KINDS, normalise_category
from shiftsim.data.readers.files import SourceFile
from shiftsim.data.readers.tracks.columns import QUANTITIES, Column, Columns, recognise
from shiftsim.errors import ConfigError, ConversionError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.ranges import single_step
from shiftsim.world.state import AgentKind

_DELIMITERS = ",;\t|"
_ENDINGS = re.compile(r"(\.[a-z]+)?(\.(gz|bz2|lz4|zst|br))?$", re.IGNORECASE)  # not the name
_MAX_ROWS = 40_000  # that statistics look at
_IN_US = Column("", "us")


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
    headings: FloatArray  # (A,) [rad], NaN where not given
    velocities: FloatArray  # (A, 2) [m/s], NaN where not given
    sizes: FloatArray  # (A, 2) length, width [m], NaN where not given
    origin: tuple[float, float] | None = None  # of the positions, where a file beside tells it [m]

    @cached_property
    def time(self) -> FloatArray:
        """(A,) since the first row [s]."""
        return (self.time_us - self.time_us.min()) / 1e6

    @cached_property
    def period(self) -> float:
        """Median time between rows of an object [s]; 0 where none has two rows."""
        step = np.diff(self.time_us)[np.diff(self.track) == 0] / 1e6
        return float(np.median(step)) if len(step) else 0.0

    @cached_property
    def ends(self) -> IntArray:
        """(N + 1,) first row of every object, and the number of rows."""
        return motion.track_ends(self.track)

    def name_of(self, row: int) -> str:
        """The object of a row, for messages."""
        return repr(self.track_ids[self.track[row]].item())

    def is_of(self, kind: AgentKind) -> BoolArray:
        """(A,) whether a row is of an object of a kind."""
        known = [KINDS.get(name) == kind for name in self.categories]
        return np.array(known, np.bool_)[self.category]

    @cached_property
    def is_vehicle(self) -> BoolArray:
        """(A,) whether a row is of a vehicle."""
        return self.is_of(AgentKind.VEHICLE)

    @cached_property
    def derived(self) -> FloatArray:
        """(A, 2) velocities by the positions [m/s]."""
        return motion.fitted_velocities(self.xy, self.time, self.track, self.period)

    @cached_property
    def speed(self) -> FloatArray:
        """(A,) by the positions [m/s]."""
        return np.hypot(self.derived[:, 0], self.derived[:, 1])

    @cached_property
    def vehicle_size(self) -> tuple[float, float] | None:
        """Length and width of the median vehicle [m], where vehicles have sizes."""
        known = motion.track_medians(self.sizes, self.track)[np.unique(self.track[self.is_vehicle])]
        known = known[(known > 0).all(axis=1)]
        if not len(known):
            return None
        length, width = np.median(known, axis=0).tolist()
        return length, width

    def moving_rows(self, faster: float) -> IntArray:
        """Some rows of vehicles that move faster [m/s]."""
        found = np.flatnonzero(self.is_vehicle & (self.speed > faster))
        return found[:: max(1, len(found) // _MAX_ROWS)]


def read_tracks(
    path: Path | Sequence[Path],
    *,
    overrides: Mapping[str, Any] | None = None,  # as of `columns.recognise`
    hz: float | None = None,  # frames per second, for time given in frames
) -> TrackTable:
    """The rows of a CSV or Parquet file, or of several that are one recording.

    `*Meta.csv` files of levelXdata beside it are read too. It is a ConversionError if a file cannot
    be read, a column is missing or holds something else, a ConfigError if an override does not fit.
    """
    paths = [path] if isinstance(path, Path) else path
    file = _TableFile(paths, {**(overrides or {}), **({"hz": hz} if hz is not None else {})})
    columns = file.columns_of
    time_us, rate = file.times()
    track_ids, track = build.index_ids(file.ids())
    category, categories = file.categories(track_ids, track)
    order = np.lexsort((time_us, track))

    def stacked(*roles: str) -> FloatArray:
        """(A, number of roles) their values; NaN where one is missing."""
        if not all(role in columns.found for role in roles):
            return np.full((len(order), len(roles)), np.nan)
        return np.column_stack([file.values(role)[order] for role in roles])

    headings, velocities = stacked("heading")[:, 0], stacked("vx", "vy")
    if np.isnan(velocities).all():
        velocities = stacked("speed") * motion.unit_vectors(headings)
    table = TrackTable(
        _ENDINGS.sub("", paths[0].name),
        columns,
        rate,
        time_us[order],
        track[order],
        track_ids,
        category[order],
        categories,
        stacked("x", "y") + columns.shift,
        headings,
        velocities,
        stacked("length", "width"),
        file.origin,
    )
    return replace(table, xy=_centers(table))


def _centers(table: TrackTable) -> FloatArray:
    """(A, 2) middles of the boxes, of whose positions the columns tell which point they are [m]."""
    reference, found = table.columns.reference, table.columns.found
    twice = build.find_twice(table.track_ids, table.track, table.time)
    if reference in ("", "center") or twice:
        return table.xy
    names = [table.categories[code] for code in table.category[table.ends[:-1]].tolist()]
    kinds = np.array([KINDS.get(name, AgentKind.VEHICLE) for name in names], np.int64)
    sizes = build.full_sizes(table.sizes, names, kinds, table.track, Counter())[table.track]
    if reference == "corner":  # the one with the least numbers in the file
        return table.xy + 0.5 * sizes * [found["x"].sign, found["y"].sign]
    headings = build.full_headings(table.headings, table.derived, table.track, Counter())
    back = -0.5 if reference == "front" else 0.5
    return table.xy + back * sizes[:, :1] * motion.unit_vectors(headings)


class _TableFile(SourceFile):
    """The columns of a file that are needed."""

    remedy = "repair the file, or name other columns with --columns"

    def __init__(self, paths: Sequence[Path], overrides: dict[str, Any]) -> None:
        tables = []
        for path in paths:
            super().__init__(path)
            if not path.is_file():
                what = "is no file" if path.exists() else "does not exist"
                raise ConversionError(f"{path} {what}", "give a CSV or Parquet file")
            tables.append(self._load(overrides.get("header")))
        self.kinds: dict[int, str] | None = None  # by id, from levelXdata's files
        self.origin: tuple[float, float] | None = None  # from the same [m]
        if len(tables) > 1:
            self.path = Path(" + ".join(map(str, paths)))
        self.table = self._joined(tables)
        names = self.table.column_names
        if path.stem.endswith("_tracks"):  # levelXdata: kinds and rate are in files beside it
            self._read_beside(overrides, names)
        self.columns_of = recognise(names, overrides, str(path))
        if not len(self.table):
            raise ConversionError(f"{path} has no rows", "export the tracks again")

    def _joined(self, tables: list[pa.Table]) -> pa.Table:
        """One table; what is a number in one and a text in another becomes a text."""
        if len(tables) == 1:
            return tables[0]
        texts = {f.name for table in tables for f in table.schema if pa.types.is_string(f.type)}
        try:
            for number, table in enumerate(tables):
                kinds = [f.with_type(pa.string()) if f.name in texts else f for f in table.schema]
                tables[number] = table.cast(pa.schema(kinds))
            return pa.concat_tables(tables, promote_options="permissive")
        except (pa.ArrowException, ValueError) as error:
            raise self.fault(f"not one table ({error})", "give each the same columns") from error

    def _load(self, header: object) -> pa.Table:
        """All columns; of CSV, the first two lines tell the delimiter and the decimal point.

        `header` are the names of the columns where the file does not tell them.
        """
        try:
            if self.path.suffix.lower() in (".parquet", ".pq"):
                table = pq.read_table(self.path, use_threads=False)
            else:
                table = self._read_csv(header)
            self.require_that(table.column_names, "it has no columns")  # all names are UTF-8
            return table
        except (OSError, pa.ArrowException, ValueError) as error:
            remedy = "give CSV in UTF-8, or Parquet (.parquet)"
            raise self.fault(f"not readable ({error})", remedy) from error

    def _read_csv(self, header: object) -> pa.Table:
        with pa.input_stream(str(self.path), compression="detect") as stream:
            data = stream.read()
        lines = data[: 1 << 16].decode("utf-8-sig", "replace").splitlines()[:2]
        if not lines:
            raise ConversionError(f"{self.path} is empty", "export the tracks again")
        delimiter = max(_DELIMITERS, key=lines[0].count)
        if delimiter not in lines[0] and len(lines[0].split()) > 1:  # any number of spaces
            data = b"\n".join(b",".join(row.split()) for row in data.splitlines())
            lines = [",".join(lines[0].split())]
        skipped = int(self._is_named(lines[0].split(delimiter), header) and header is not None)
        has_comma = delimiter != "," and "," in lines[-1] and "." not in lines[-1]
        read = pc.ReadOptions(use_threads=False, column_names=header, skip_rows=skipped)
        return pc.read_csv(
            io.BytesIO(data),
            read_options=read,
            parse_options=pc.ParseOptions(delimiter=delimiter),
            convert_options=pc.ConvertOptions(decimal_point="," if has_comma else "."),
        )

    def _is_named(self, cells: list[str], header: object) -> bool:
        """Whether the first line of a file are names, not numbers."""
        numbers = [bool(re.fullmatch(r'[\s"]*[-+\d.,eE:]*\d[\s".]*', cell)) for cell in cells]
        is_named = 2 * sum(numbers) < len(cells)
        if header is None and not is_named:
            raise self.fault(
                f"the first line holds numbers: no header ({', '.join(cells[:4])[:60]} …)",
                f"name all {len(cells)} columns in order in a TOML file for --columns:"
                " header = ['id', 'frame', 'x', 'y', 'kind', …] (those not needed ''), or write"
                " such names as the first line",
            )
        names = header if isinstance(header, list) else []
        fits = len(names) == len(cells) and all(isinstance(name, str) for name in names)
        if header is not None and not fits:
            raise ConfigError(f"header is {header!r}", f"give a list of {len(cells)} names")
        return is_named

    def _read_beside(self, overrides: dict[str, Any], names: list[str]) -> None:
        """Origin, rate and kinds from levelXdata's files; what the user gives goes first."""
        stem = self.path.stem.removesuffix("tracks")
        rates, kinds = (self.path.with_name(f"{stem}{p}Meta.csv") for p in ("recording", "tracks"))
        file = rates
        try:
            if rates.is_file():
                meta = pc.read_csv(rates).to_pydict()
                overrides.setdefault("hz", float(meta["frameRate"][0]))
                if "xUtmOrigin" in meta:
                    self.origin = float(meta["xUtmOrigin"][0]), float(meta["yUtmOrigin"][0])
            file = kinds
            if kinds.is_file() and not {"class", "kind"} & {*map(str.lower, names)}:
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
        values = self._cast(column.name, pa.float64(), "numbers").to_numpy().copy()
        needed = role in ("x", "y")
        self._refuse(
            column,
            ~np.isfinite(values) if needed else np.isinf(values),
            f"are {'empty or ' * needed}not finite",
            f"leave these {'rows out of the file' if needed else 'values empty'}",
        )
        raw, values = values, values * column.factor(role)
        if QUANTITIES[role] in ("position", "heading"):
            kept = values[np.isfinite(values)]
            self.require(QUANTITIES[role], kept, f"column {column.name!r}")
        if needed and (step := single_step(raw, abs(column.factor(role)))):
            what = f"is float32 in all rows, in steps of {step:g} m at {raw[0]:.10g} (data row 1)"
            raise self.fault(f"column {column.name!r} {what}", "write float64")
        return np.pi / 2 - values if column.unit == "compass" else values

    def times(self) -> tuple[IntArray, float | None]:
        """(A,) time stamps [us], and the frames per second, where they are given in frames."""
        found, rate = self.columns_of.found, self.columns_of.hz
        is_frame = "frame" in found and (rate is not None or "time" not in found)
        role = "frame" if is_frame else "time"
        column = found[role]
        if is_frame and not rate:
            what = f"time is given in frames ({column.name!r}) only"
            raise self.fault(what, "say how many there are per second: --hz 25")
        if not column.name:
            raise ConfigError(f"{role} is the same for all rows", f"name a column: {role} = 'NAME'")
        values = self.table[column.name]
        try:
            if pa.types.is_timestamp(values.type) or pa.types.is_duration(values.type):
                column = replace(column, unit=values.type.unit)
                values = values.cast(pa.int64())
            elif pa.types.is_time(values.type):
                values, column = values.cast(pa.time64("us")).cast(pa.int64()), _IN_US
            elif pa.types.is_string(values.type):  # a clock: 09:00:00.033
                dates = pa.compute.binary_join_element_wise("1970-01-01T", values, "")
                values, column = dates.cast(pa.timestamp("us")).cast(pa.int64()), _IN_US
            stamps = values.cast(pa.float64(), safe=False).to_numpy().copy()  # ns have 64 bits
        except (pa.ArrowException, ValueError) as error:
            what = f"column {column.name!r} is {values.type}, need times"
            hint = "give seconds, 13:02:03.040, or dates with times: 2024-05-01T13:02:03.040"
            raise self.fault(what, hint) from error
        stamps *= 1e6 if is_frame else column.factor(role)
        stamps /= rate if is_frame and rate else 1.0
        remedy = "check its unit: [units] time = 's', 'ms', 'us' or 'ns'; leave empty rows out"
        self._refuse(column, ~(np.abs(stamps) < 2.0**55), "are no times", remedy)
        return np.rint(stamps).astype(np.int64), rate if is_frame else None

    def _refuse(self, column: Column, is_bad: BoolArray, what: str, remedy: str) -> None:
        """Raise an error that tells how many rows of a column are bad, and which is the first."""
        if is_bad.any():
            what = f"holds {is_bad.sum()} values that {what}, the first in data row"
            raise self.fault(f"column {column.name!r} {what} {is_bad.argmax() + 1}", remedy)

    def ids(self) -> pa.ChunkedArray:
        """Integers or texts."""
        name = self.columns_of.found["id"].name
        cases = len(self.table["case_id"].unique()) if "case_id" in self.table.column_names else 1
        self.require_that(
            cases == 1,
            f"column 'case_id' tells {cases} recordings apart, which share ids and times",
            "write each into a file of its own",
        )
        column = self.table[name]
        is_float, is_integer = pa.types.is_floating(column.type), pa.types.is_integer(column.type)
        empty = column.is_null(nan_is_null=True).to_numpy()
        if not is_float and not is_integer:
            column = self._cast(name, pa.string(), "texts in UTF-8")
            empty = empty | (pa.compute.utf8_trim_whitespace(column).to_numpy() == "")
        if empty.any():
            what = f"column {name!r} is empty in {empty.sum()} rows, the first in data row"
            raise self.fault(f"{what} {empty.argmax() + 1}", "give objects ids")
        if is_float:
            values = column.to_numpy()
            is_integer = bool((values == np.rint(values)).all())
            column = pa.chunked_array([values.astype(np.int64)]) if is_integer else column
        return column if is_integer else self._cast(name, pa.string(), "texts in UTF-8")

    def _cast(self, name: str, kind: pa.DataType, need: str) -> pa.ChunkedArray:
        try:  # integers of 64 bits may be rounded
            return self.table[name].cast(kind, safe=not pa.types.is_floating(kind))
        except (pa.ArrowException, ValueError) as error:
            what = f"column {name!r} is {self.table[name].type}, need {need}"
            raise self.fault(what) from error

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
                values = self._cast(column.name, pa.string(), "texts in UTF-8")
            found, codes = build.dictionary_codes(values)
            names = [*map(str, found.to_pylist()), ""]
        plain = [normalise_category(name) for name in names]
        known = [self.columns_of.kinds.get(name, name) for name in plain]
        distinct, place = np.unique(known, return_inverse=True)
        return place[codes], tuple(distinct.tolist())
