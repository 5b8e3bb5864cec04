"""A journal keeps what was put into it, whatever happens to the process."""

import fcntl
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from shiftsim.errors import ConfigError, DataError
from shiftsim.files import lock
from shiftsim.runs.journal import Journal, has_entries

CODE = """
import os, sys
from pathlib import Path
from shiftsim.runs.journal import Journal
journal = Journal(Path(sys.argv[1]), keep=True)
for number in range(20):
    journal.put(f"key {number}", {"number": number}, bytes(50_000))
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "folder with a % and a ?" / "journal.sqlite"


@pytest.fixture
def journal(path):
    path.parent.mkdir()
    opened = Journal(path, keep=True)
    yield opened
    opened.close()


def entries(path):
    journal = Journal(path, keep=True)
    found = [(key, values["number"], has_data) for _, key, values, has_data in journal.items()]
    journal.close()
    return found


def test_what_was_put_survives_kill_9(path):
    path.parent.mkdir()
    done = subprocess.run([sys.executable, "-c", CODE, path], check=False)
    assert done.returncode == -9
    assert entries(path) == [(f"key {number}", number, True) for number in range(20)]


def test_nothing_is_in_the_file_before_the_first_entry(journal, path):
    assert not has_entries(path)
    assert list(journal.items()) == []
    journal.put("a", {"number": 1})
    assert has_entries(path)


def test_an_entry_is_read_by_its_number(journal):
    first = journal.put("a", {"number": 1, "nothing": None}, b"some bytes")
    second = journal.put("a", {"number": 2})
    assert journal.values(first) == {"number": 1, "nothing": None}
    assert (journal.data(first), journal.data(second)) == (b"some bytes", b"")


def test_several_entries_are_put_together_or_not_at_all(journal, path):
    def broken():
        yield "a", {"number": 1}
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        journal.put_all(broken())
    journal.close()
    assert entries(path) == []


def test_a_journal_that_is_begun_anew_is_empty(journal, path):
    journal.put("a", {"number": 1})
    killed = path.with_name("killed.sqlite")
    for end in ("", "-wal"):
        shutil.copy(f"{path}{end}", f"{killed}{end}")
    Journal(killed, keep=False).close()
    assert entries(killed) == []


def test_one_process_at_a_time_works_with_it(journal, path):
    with pytest.raises(ConfigError, match="another process is working on"):
        Journal(path, keep=True)


def test_what_is_no_journal_is_named(path):
    path.parent.mkdir()
    path.write_bytes(b"something else" * 100)
    with pytest.raises(DataError, match=r"journal\.sqlite' is damaged: file is not a database"):
        entries(path)


def test_removing_leaves_nothing_and_copies_nothing(journal, path, monkeypatch):
    journal.put("a", {"number": 1}, bytes(1 << 20))
    assert path.stat().st_size < 1 << 17
    journal.remove()
    assert not list(path.parent.iterdir())


def test_it_is_locked_until_it_is_gone(journal, path, monkeypatch):
    journal.put("a", {"number": 1})
    unlink, refused = Path.unlink, []

    def slowly(self, **options):
        try:  # another process, in the moment before
            Journal(path, keep=True).close()
        except ConfigError:
            refused.append(self.name)
        unlink(self, **options)

    monkeypatch.setattr(Path, "unlink", slowly)
    journal.remove()
    assert refused == [f"{path.name}-wal", path.name]


def test_who_waits_for_a_file_that_is_removed_locks_the_new_one(tmp_path, monkeypatch):
    path = tmp_path / "file"
    flock, calls = fcntl.flock, []

    def late(file, how):
        if not calls:
            path.unlink()
            path.write_bytes(b"new")
        calls.append(how)
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with lock(path) as file:
        assert file.seek(0, 2) == 3
    assert len(calls) == 2


def test_it_is_a_plain_database_for_other_tools(journal, path):
    journal.put("a", {"number": 1})
    journal.close()
    assert not os.path.exists(f"{path}-wal")
    rows = sqlite3.connect(path).execute("select key, content from entries").fetchall()
    assert rows == [("a", '{"number": 1}')]
