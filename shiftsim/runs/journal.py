"""A journal of work under way: what was put into it survives the process, whatever ends it.

It is one SQLite file and one transaction per entry. SQLite appends transactions to a second file,
`….sqlite-wal`, with a checksum each, and never copies them back here: that would write everything
twice. The lock is ours, as file systems of clusters often lack those that SQLite wants.
"""

import errno
import json
import os
import sqlite3
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

from shiftsim.errors import ConfigError, DataError
from shiftsim.files import lock, safe_join

_SETTINGS = (
    "locking_mode = exclusive",  # no third file, whose memory is shared between processes
    "journal_mode = wal",
    "synchronous = normal",  # a power failure takes the last entries, and nothing else
    "wal_autocheckpoint = 0",
)
# any other error is one of the disk
_DAMAGED = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class Journal:
    """Numbered entries: a key, JSON values, and bytes beside them."""

    def __init__(self, path: Path, *, keep: bool) -> None:
        """Begin a journal, or keep one; a ConfigError where another process works with it."""
        self.path = safe_join(path.parent, path.name)
        self._appended = safe_join(path.parent, f"{path.name}-wal")
        try:
            self._lock = lock(path)
        except BlockingIOError as error:
            what = f"another process is working on {str(path.parent)!r}"
            raise ConfigError(what, hint="wait until it has finished") from error
        if not keep:
            self._appended.unlink(missing_ok=True)
            self._lock.truncate(0)

    @cached_property
    def _database(self) -> sqlite3.Connection:
        vfs = "" if sys.platform == "win32" else "?vfs=unix-none"
        address = f"{self.path.absolute().as_uri()}{vfs}"
        database = sqlite3.connect(address, uri=True, isolation_level=None)
        with self._errors():
            for setting in _SETTINGS:
                database.execute(f"pragma {setting}")
            database.execute(
                "create table if not exists entries "
                "(number integer primary key, key text, content text, data blob)"
            )
        return database

    def put(self, key: str, values: Mapping[str, Any], data: bytes = b"") -> int:
        """Put an entry on disk, and return its number; of the same key, the last one counts."""
        # NumPy scalars as Python's
        row = (key, json.dumps(values, default=lambda value: value.item()), data)
        with self._errors():
            query = "insert into entries (key, content, data) values (?, ?, ?)"
            number = self._database.execute(query, row).lastrowid
        assert number is not None
        return number

    def put_all(self, entries: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        """Put entries on disk: all of them or, where the process is ended, none."""
        with self._errors():
            self._database.execute("begin")
            for key, values in entries:
                self.put(key, values)
            self._database.execute("commit")

    def items(self) -> Iterator[tuple[int, str, dict[str, Any], bool]]:
        """Number, key, values and whether there are bytes, of all entries in their order."""
        if self._lock.seek(0, os.SEEK_END) == 0:
            return
        query = "select number, key, content, length(data) from entries order by number"
        with self._errors():
            for number, key, content, size in self._database.execute(query):
                yield number, key, json.loads(content), size > 0

    def values(self, number: int) -> dict[str, Any]:
        """The values of an entry."""
        return dict(json.loads(self._column("content", number)))

    def data(self, number: int) -> bytes:
        """The bytes of an entry."""
        return bytes(self._column("data", number))

    def _column(self, name: str, number: int) -> Any:
        query = f"select {name} from entries where number = ?"
        with self._errors():
            return self._database.execute(query, (number,)).fetchone()[0]

    def close(self) -> None:
        """Let another process work with it."""
        if "_database" in vars(self):
            self._database.close()
        self._lock.close()

    def remove(self) -> None:
        """Close it, and remove it from disk."""
        with suppress(FileNotFoundError):
            os.truncate(self._appended, 0)  # else closing copies all of it
        if "_database" in vars(self):
            self._database.close()
        self._appended.unlink(missing_ok=True)
        if sys.platform == "win32":  # which removes no open file
            self._lock.close()
        self.path.unlink()  # still locked: whoever finds it comes here again
        self._lock.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode & 0xFF in _DAMAGED:
                what = f"{str(self.path)!r} is damaged: {error}"
                raise DataError(what, hint="remove it, and start again") from error
            full = error.sqlite_errorcode == sqlite3.SQLITE_FULL
            number = errno.ENOSPC if full else errno.EIO
            text = os.strerror(number) if full else str(error)
            raise OSError(number, text, str(self.path)) from error


def has_entries(path: Path) -> bool:
    """Whether there is a journal with something in it; another process may be working with it."""
    return path.is_file() and path.stat().st_size > 0
