"""Parquet files of a store: written the same way every time, and read with clear errors."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.store import schema
from shiftsim.errors import DataError

MEND = "the store is damaged: convert it again"
_FOOTER = "shiftsim"
_COMPRESSION, _LEVEL = "zstd", 1


def file_name(name: str) -> str:
    """A file name for any log, city or ego name."""
    return quote(name, safe=" @+,=").replace(".", "%2E")


def write_blocks(
    path: Path, blocks: list[pa.Table], footer: Mapping[str, object] | None = None
) -> None:
    """Write tables of one schema as one file with a row group each, in one step.

    Equal content gives equal bytes.
    """
    described = blocks[0].schema
    names = described.names
    notes = json.dumps({} if footer is None else footer, sort_keys=True)
    planes = [name for name in names if name in schema.PLANES]
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".tmp")
    with pq.ParquetWriter(
        partial,
        described,
        compression=_COMPRESSION,
        compression_level=_LEVEL,
        use_dictionary=[n for n in names if n in ("length_m", "width_m", "log", "type", "city")],
        use_byte_stream_split=planes,
        write_statistics=False,
        store_schema=False,
    ) as writer:
        for block in blocks:
            writer.write_table(block, row_group_size=max(len(block), 1))
        writer.add_key_value_metadata({_FOOTER: notes})
    os.replace(partial, path)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file in one step."""
    partial = path.with_name(path.name + ".tmp")
    partial.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", "utf-8")
    os.replace(partial, path)


class Table:
    """An open Parquet file of a store.

    Attributes:
        path: The file.
        footer: Content of the footer.
    """

    def __init__(self, path: Path, expected: pa.Schema) -> None:
        self.path = path
        try:
            self._file = pq.ParquetFile(path, memory_map=True)
        except (OSError, pa.ArrowException) as error:
            what = "is missing" if not path.exists() else f"is not a readable Parquet file: {error}"
            raise DataError(f"{path}: the file {what}", hint=MEND) from error
        found = self._file.schema_arrow
        for field in expected:
            if found.get_field_index(field.name) < 0:
                raise DataError(f"{path}: column {field.name!r} is missing", hint=MEND)
            if not found.field(field.name).type.equals(field.type):
                raise DataError(
                    f"{path}: column {field.name!r} is {found.field(field.name).type}, not"
                    f" {field.type}",
                    hint=MEND,
                )
        self._names = expected.names
        self.footer = self._read_footer()

    def _read_footer(self) -> dict[str, object]:
        text = (self._file.metadata.metadata or {}).get(_FOOTER.encode(), b"{}")
        try:
            footer: dict[str, object] = json.loads(text)
        except ValueError as error:
            raise DataError(f"{self.path}: unreadable footer: {error}", hint=MEND) from error
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
        try:
            return self._file.read_row_groups(groups, columns or self._names, use_threads=False)
        except (OSError, pa.ArrowException) as error:
            raise DataError(f"{self.path}: damaged: {error}", hint=MEND) from error


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
