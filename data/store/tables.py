"""Files of a store: where each is, written the same way every time, read with clear errors."""

import hashlib
import json
import os
import re
from collections.abc import Container, Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.store import schema
from shiftsim.errors import DataError
from shiftsim.files import atomic_write, safe_join, write_text

MANIFEST, SCENARIOS = "store.json", "scenarios.parquet"
FRAMES, TRACKS = "frames.parquet", "tracks.parquet"  # in the folder of a recording
REVIEW = "review/review.jsonl"
REPORTS = "reports"  # folder; pictures may be there before the store is
PARTIAL = ".partial"  # folder of a conversion under way
REPAIR = "the store is damaged: convert it again"
_SHA256 = re.compile("[0-9a-f]{64}")
_FOOTER = "shiftsim"
# how hard they are tried; reading takes the same time
_LEVELS = {"zstd": 3, "lz4": 9}
_BUFFER = 1 << 20  # bytes


def file_name(name: str) -> str:
    """A file name for any log, city or ego name."""
    return quote(name, safe=" @+,=").replace(".", "%2E")


def map_file(store: Path, city: str) -> Path:
    """File of a map."""
    return safe_join(store, f"maps/{file_name(city)}.parquet")


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
    """Content of `store.json`.

    Raises:
        DataError: It is missing or broken, or of another version.
    """
    path = store / MANIFEST
    if not path.is_file():
        if (store / PARTIAL).is_dir():
            raise DataError(
                f"{store}: the conversion of this store was interrupted",
                hint="start the same shiftsim convert again, it goes on",
            )
        raise DataError(
            f"{store}: not a scenario store: {MANIFEST} is missing",
            hint="give the folder that `shiftsim convert` wrote",
        )
    try:
        manifest = json.loads(path.read_text("utf-8"))
        kind, version = manifest["format"], manifest["version"]
        files, content = manifest["files"], manifest["hash"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{path}: damaged: {error!r}"[:400], hint=REPAIR) from error
    if kind != schema.FORMAT or version not in schema.READABLE:
        raise DataError(
            f"{path}: format {kind!r}, version {version!r}, not {schema.FORMAT!r} version"
            f" {schema.VERSION}",
            hint="convert the data again with this version of shiftsim",
        )
    if not isinstance(manifest.get("generator", {}), dict):
        raise DataError(f"{path}: damaged: 'generator' is no table", hint=REPAIR)
    if not isinstance(files, dict):
        raise DataError(f"{path}: damaged: no list of files", hint=REPAIR)
    for name, value in {"hash": content, **files}.items():
        if not isinstance(value, str) or not _SHA256.fullmatch(value):
            raise DataError(f"{path}: damaged: {name!r} has no SHA-256 digest", hint=REPAIR)
    return manifest


class TableWriter(pq.ParquetWriter):  # type: ignore[misc]
    """Writes a Parquet file in few large pieces, where Arrow would write each part of a column."""

    def __init__(self, path: Path, described: pa.Schema, **options: Any) -> None:
        """Begin the file; the options are those of Arrow's writer."""
        self._stream = pa.output_stream(path, compression=None, buffer_size=_BUFFER)
        super().__init__(self._stream, described, **options)

    def close(self) -> None:
        """Finish the file."""
        try:
            super().close()
        finally:
            self._stream.close()


def write_blocks(
    path: Path,
    blocks: Iterable[pa.Table],
    footer: Mapping[str, object] | None = None,
    repeating: Iterable[str] = (),
    codec: str = "zstd",
) -> None:
    """Write tables of one schema, at least one, as one file with a row group each, in one step.

    Columns of few values, `repeating`, are written by a dictionary. `lz4` makes files that are a
    twentieth larger than with `zstd`, and read in half the time. Equal content gives equal bytes.
    """
    remaining = iter(blocks)
    first = next(remaining)
    notes = json.dumps({} if footer is None else footer, sort_keys=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        atomic_write(path) as partial,
        TableWriter(
            partial,
            first.schema,
            compression=codec,
            compression_level=_LEVELS[codec],
            **_encodings(first.schema, {*repeating, *schema.REPEATING}),
            write_statistics=False,
            store_schema=False,
        ) as writer,
    ):
        for block in chain([first], remaining):
            writer.write_table(block, row_group_size=max(len(block), 1))
        writer.add_key_value_metadata({_FOOTER: notes})


def _encodings(described: pa.Schema, repeating: Container[str]) -> dict[str, Any]:
    """How columns are written: floats and codes as bytes in planes, integers as differences.

    Both compress much better than numbers as they are, and any reader undoes them.
    """
    dictionaries, encodings = list[str](), dict[str, str]()
    for field in described:
        is_list = pa.types.is_list(field.type)
        kind = field.type.value_type if is_list else field.type
        name = f"{field.name}.list.element" if is_list else field.name
        if field.name in repeating:
            dictionaries.append(name)
        elif kind == pa.float64() or field.name.endswith(schema.CODED):
            encodings[name] = "BYTE_STREAM_SPLIT"
        elif kind in (pa.int32(), pa.int64()):
            encodings[name] = "DELTA_BINARY_PACKED"
    return {"use_dictionary": dictionaries, "column_encoding": encodings}


def write_json(path: Path, content: object) -> None:
    """Write a JSON file in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1, sort_keys=True) + "\n")


class Table:
    """An open Parquet file of a store.

    Attributes:
        path: The file.
        footer: Content of the footer.
        names: Its columns, as far as they are known.
    """

    def __init__(self, path: Path, expected: pa.Schema, former: pa.Schema | None = None) -> None:
        """`former` is what files have that lack the first column of what is expected."""
        self.path = path
        try:
            self._file = pq.ParquetFile(path, memory_map=True, pre_buffer=False)
        except (OSError, ValueError, pa.ArrowException) as error:
            what = (
                "is missing"
                if not os.path.exists(path)
                else f"is not a readable Parquet file: {error}"
            )
            raise DataError(f"{path}: the file {what}", hint=REPAIR) from error
        found = self._file.schema_arrow
        if former is not None and found.get_field_index(expected.names[0]) < 0:
            expected = former if found.get_field_index(former.names[0]) >= 0 else expected
        for field in expected:
            column = f"{path}: column {field.name!r}"
            if found.get_field_index(field.name) < 0:
                raise DataError(f"{column} is missing", hint=REPAIR)
            kind = found.field(field.name).type
            if not kind.equals(field.type):
                raise DataError(f"{column} is {kind}, not {field.type}", hint=REPAIR)
        self.names = expected.names
        self._texts = [field.name for field in expected if pa.types.is_string(field.type)]
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

    @property
    def num_blocks(self) -> int:
        """Number of row groups."""
        return int(self._file.num_row_groups)

    def read(self, blocks: list[int] | None = None, columns: list[str] | None = None) -> pa.Table:
        """Rows of some row groups and columns; of all where None.

        Raises:
            DataError: The file is damaged.
        """
        groups = list(range(self.num_blocks)) if blocks is None else blocks
        wanted = self.names if columns is None else columns
        try:
            found = self._file.read_row_groups(groups, wanted, use_threads=False)
            for name in self._texts:
                if name in wanted:
                    found[name].validate(full=True)  # that it is UTF-8
        except (OSError, pa.ArrowException) as error:
            raise DataError(f"{self.path}: damaged: {error}", hint=REPAIR) from error
        for name in self._full:
            if name in wanted and (missing := found[name].null_count):
                what = f"{missing} of {len(found)} values are missing"
                raise DataError(f"{self.path}: column {name!r}: {what}", hint=REPAIR)
        return found


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
