"""Files of a store: where each is, written the same way every time, read with clear errors."""

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.store import schema
from shiftsim.errors import DataError
from shiftsim.files import atomic_write, safe_join, write_text
from shiftsim.world.ranges import STORE, require

MANIFEST, SCENARIOS = "store.json", "scenarios.parquet"
FRAMES, LIGHTS, TRACKS = "frames.parquet", "lights.parquet", "tracks.parquet"  # of a recording
REVIEW = "review/review.jsonl"
REPORTS = "reports"  # folder; pictures may be there before the store is
PARTIAL = ".partial"  # folder of a conversion under way
REPAIR = "the store is damaged: convert it again"
_SHA256 = re.compile("[0-9a-f]{64}")
_FOOTER = "shiftsim"
# columns of few values in any file
_REPEATING = (
    *("log", "recording", "ego", "type", "city", "duration_s", "offset_s", "subsample_ratio"),
    *("connector", "status", "token", "kind", "length_m", "width_m"),
    *("planner", "noise", "track_tokens", "track_length_m", "track_width_m"),  # of rollouts
)
_NAMED = ("token", "connector")  # columns that name what a row is about


def file_name(name: str) -> str:
    """A file name for any log, city or ego name."""
    return quote(name, safe=" @+,=").replace(".", "%2E")


def map_file(store: Path, city: str) -> Path:
    """File of a map."""
    return safe_join(store, f"maps/{file_name(city)}.arrow")


def report_file(store: Path, city: str) -> Path:
    """File of what is known about the conversion of a city."""
    return safe_join(store, f"{REPORTS}/{file_name(city)}.json")


def picture_file(store: Path, city: str, recording: str) -> Path:
    """Picture of a recording on its map, beside the report; no part of the store's content."""
    return safe_join(store, f"{REPORTS}/{file_name(city)}_{file_name(recording)}.png")


def recording_folder(store: Path, recording: str) -> Path:
    """Folder of a recording."""
    return safe_join(store, f"recordings/{file_name(recording)}")


def ego_file(folder: Path, name: str) -> Path:
    """File of an ego's states in the folder of a recording."""
    return folder / f"ego-{file_name(name)}.parquet"


def read_manifest(store: Path) -> dict[str, Any]:
    """Content of `store.json`, or a DataError."""
    path = store / MANIFEST
    if not path.is_file():
        if (store / PARTIAL).is_dir():
            what = f"{store}: the conversion of this store was interrupted"
            raise DataError(what, "start the same shiftsim convert again, it goes on")
        what = f"{store}: not a scenario store: {MANIFEST} is missing"
        is_near = not store.exists() and Path(store.name).is_dir()
        here = f"; ./{store.name} has no {MANIFEST} either" if is_near else ""
        raise DataError(what, f"give the folder that `shiftsim convert` wrote{here}")
    try:
        manifest = json.loads(path.read_text("utf-8"))
        kind, version = manifest["format"], manifest["version"]
        files, content = manifest["files"], manifest["hash"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{path}: damaged: {error!r}"[:400], hint=REPAIR) from error
    if kind != schema.FORMAT or version != schema.VERSION:
        raise DataError(
            f"{path}: format {kind!r}, version {version!r}, not {schema.FORMAT!r} version"
            f" {schema.VERSION}",
            hint=f"python tools/upgrade.py {store}, or convert the data again",
        )
    if not isinstance(manifest.get("generator", {}), dict):
        raise DataError(f"{path}: damaged: 'generator' is no table", hint=REPAIR)
    if not isinstance(files, dict):
        raise DataError(f"{path}: damaged: no list of files", hint=REPAIR)
    for name, value in {"hash": content, **files}.items():
        if not isinstance(value, str) or not _SHA256.fullmatch(value):
            raise DataError(f"{path}: damaged: {name!r} has no SHA-256 digest", hint=REPAIR)
    return manifest


def write_blocks(
    path: Path, blocks: Iterable[pa.Table], footer: Mapping[str, object] | None = None
) -> None:
    """Write tables of one schema, at least one, as one file with a row group each, in one step.

    Equal content gives equal bytes. Row groups have the least and the largest `row`, by which a
    reader finds those of a window.
    """
    remaining = iter(blocks)
    first = next(remaining)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        atomic_write(path) as partial,
        pq.ParquetWriter(
            partial,
            first.schema,
            **_encodings(first.schema),
            write_statistics=["row"] if "row" in first.schema.names else False,
            store_schema=False,
        ) as writer,
    ):
        for block in chain([first], remaining):
            writer.write_table(block, row_group_size=max(len(block), 1))
        if footer is not None:
            writer.add_key_value_metadata({_FOOTER: json.dumps(footer, sort_keys=True)})


def _encodings(described: pa.Schema) -> dict[str, Any]:
    """How columns are written: floats as bytes in planes, integers as differences, then compressed.

    Both are encodings of Parquet that compress much better than numbers as they are. Codes of few
    values are small as they are.
    """
    dictionaries, encoded, compressed = list[str](), dict[str, str](), list[str]()
    for field in described:
        is_list = pa.types.is_list(field.type)
        kind = field.type.value_type if is_list else field.type
        name = f"{field.name}.list.element" if is_list else field.name
        if field.name in _REPEATING:
            dictionaries.append(name)
        elif pa.types.is_floating(kind):
            encoded[name] = "BYTE_STREAM_SPLIT"
        elif kind in (pa.int32(), pa.int64()):
            encoded[name] = "DELTA_BINARY_PACKED"
        if is_list or field.name not in _REPEATING:
            compressed.append(name)
    codec = {"compression": dict.fromkeys(compressed, "zstd")}
    level = {"compression_level": dict.fromkeys(compressed, 3)}
    return {"use_dictionary": dictionaries, "column_encoding": encoded, **codec, **level}


def write_json(path: Path, content: object) -> None:
    """Write a JSON file in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1, sort_keys=True) + "\n")


class Table:
    """An open Parquet file of a store, and its `footer`, empty where there is none."""

    def __init__(self, path: Path, expected: pa.Schema) -> None:
        self.path = path
        # boxes of a track have its name each, and most files are not about boxes
        self._named = [
            name for name in _NAMED if name in expected.names and "row" in expected.names
        ]
        try:
            with pa.memory_map(str(path)) as file:
                content = pa.BufferReader(file.read_buffer())  # mapped; the file need not stay open
            self._file = pq.ParquetFile(content, pre_buffer=False, read_dictionary=self._named)
        except (OSError, ValueError, KeyError, pa.ArrowException) as error:  # KeyError: a name
            is_there = os.path.exists(path)
            what = f"is not a readable Parquet file: {error}" if is_there else "is missing"
            raise DataError(f"{path}: the file {what}", hint=REPAIR) from error
        found = self._file.schema_arrow
        for field in expected:
            column = f"{path}: column {field.name!r}"
            if found.get_field_index(field.name) < 0:
                raise DataError(f"{column} is missing", hint=REPAIR)
            kind = found.field(field.name).type
            if pa.types.is_dictionary(kind):
                kind = kind.value_type
            if not kind.equals(field.type):
                raise DataError(f"{column} is {kind}, not {field.type}", hint=REPAIR)
        self._names = expected.names
        self._texts = [field.name for field in expected if pa.types.is_string(field.type)]
        self._validated: set[int] = set()  # row groups whose numbers are in their ranges
        self._full = [f.name for f in expected if found.field(f.name).nullable and not f.nullable]
        self.footer = self._read_footer()

    def _read_footer(self) -> dict[str, object]:
        text = (self._file.metadata.metadata or {}).get(_FOOTER.encode(), b"{}")
        try:
            footer: dict[str, object] = json.loads(text)
            if not isinstance(footer, dict):
                raise ValueError("not an object")
        except (ValueError, RecursionError) as error:
            raise DataError(f"{self.path}: unreadable footer: {error}", hint=REPAIR) from error
        return footer

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return int(self._file.metadata.num_rows)

    @cached_property
    def _spans(self) -> list[tuple[int, int, int]]:
        """Number of every row group that is not empty, its least and its largest `row`."""
        column, spans = self._file.schema_arrow.get_field_index("row"), []
        for block in range(self._file.num_row_groups):
            group = self._file.metadata.row_group(block)
            known = group.column(column).statistics
            if known is None or not known.has_min_max:  # written by somebody else
                spans.append((block, -sys.maxsize, sys.maxsize))
            elif group.num_rows:
                spans.append((block, int(known.min), int(known.max)))
        return spans

    def blocks(self, first: int, last: int) -> list[int]:
        """The row groups that hold rows first … last - 1 of the recording."""
        return [block for block, low, high in self._spans if low < last and high >= first]

    def read(
        self,
        blocks: list[int] | None = None,
        columns: list[str] | None = None,
        *,
        validate: bool = True,
    ) -> pa.Table:
        """Rows of some row groups and columns; of all where None.

        Raises DataError: the file is damaged or, where `validate` is asked for, holds a number
        outside of its range; that is looked at once while the file is open.
        """
        groups = list(range(self._file.num_row_groups)) if blocks is None else blocks
        wanted = self._names if columns is None else columns
        try:
            found = self._file.read_row_groups(groups, wanted, use_threads=False)
            if len(groups) != 1:
                found = found.combine_chunks()
            is_new = not self._validated.issuperset(groups)
            for name in self._texts if is_new else ():
                if name in wanted:
                    found[name].validate(full=True)  # that it is UTF-8
        except (OSError, pa.ArrowException) as error:
            raise DataError(f"{self.path}: damaged: {error}", hint=REPAIR) from error
        for name in self._full:
            if name in wanted and (missing := found[name].null_count):
                what = f"{missing} of {len(found)} values are missing"
                raise DataError(f"{self.path}: column {name!r}: {what}", hint=REPAIR)
        if validate and is_new:
            require_ranges(found, str(self.path))
            self._validated.update(groups if columns is None else ())
        return found


def require_ranges(table: pa.Table, where: str) -> None:
    """Refuse a table with a number outside of the range that `STORE` has for its column."""
    names = table.column_names
    named = next((name for name in _NAMED if name in names and "row" in names), "")
    for name in filter(STORE.__contains__, names):
        values, may_be_nan = column(table, name), named == "token" and name in schema.MAY_BE_NAN
        bad = STORE[name].outside(values, may_be_nan=may_be_nan)
        if not len(bad):
            continue
        if named:
            at = int(bad[0][0])
            place = f"{named} {table[named][at].as_py()!r}, row {table['row'][at]}"
            require(STORE, name, values[at], f"{where}: {place}: column")
        require(STORE, name, values, f"{where}: column", may_be_nan=may_be_nan)


def column(table: pa.Table, name: str) -> Any:
    """Numbers of a column, those of lists one after the other; read-only."""
    values = whole(table[name])
    flat = values.flatten() if pa.types.is_list(values.type) else values
    array: np.ndarray = flat.to_numpy(zero_copy_only=False)
    array.flags.writeable = False
    return array


def whole(column: pa.ChunkedArray) -> pa.Array:
    """A column in one piece."""
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
