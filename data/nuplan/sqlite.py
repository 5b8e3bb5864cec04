"""SQLite files: those from somewhere else are read only, and nothing in them is executed.

Only ordinary tables are read. A view or a virtual table under an expected name is refused, so that
no SQL of the file runs; triggers never fire, since nothing is written.
"""

import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

from shiftsim.errors import DataError
from shiftsim.files import atomic_write

Value: TypeAlias = int | float | str | bytes | None

_REPAIR = "the file is damaged or of another format; get it again from its source"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


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
        """All rows of a query whose names are ours or were checked by `require`.

        Raises DataError: the file cannot be read; the message says `what` is read.
        """
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
