"""Compiled kernels that were kept: never fatal, never wrong."""

import errno
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from shiftsim.arrays import kept as keeping
from shiftsim.files import PACKAGE

KERNEL = """
from shiftsim.arrays import kernel, lean_kernel

@lean_kernel
def twice(x):
    return FACTOR * x

@kernel
def add(x, y):
    return twice(x) + y
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A source file with two kernels, and a folder of its own for what is compiled."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path / "kept" / "of the user"))
    monkeypatch.setattr(keeping, "_SAID", set())
    path = tmp_path / "kernels.py"
    path.write_text(KERNEL.replace("FACTOR", "2"))
    return path


def load(file: Path, name: str = "add"):
    """A kernel of a file, which is run anew."""
    names = {}
    exec(compile(file.read_text(), str(file), "exec"), names)
    return names[name]


def hits(kernel) -> int:
    return sum(kernel.stats.cache_hits.values())


def kept(tmp_path: Path) -> list[Path]:
    return sorted(path for path in (tmp_path / "kept").rglob("*") if path.is_file())


def test_a_kernel_is_compiled_once_for_each_signature(file, tmp_path, caplog):
    first, again = load(file), load(file)
    assert first(1, 2) == again(1, 2) == 4
    assert first(1.5, 2) == again(1.5, 2) == 5.0
    assert (hits(first), hits(again)) == (0, 2)
    assert len(kept(tmp_path)) == 6  # of each type: both parts, and what Python calls
    assert not caplog.records


def damaged(content: bytes) -> list[bytes]:
    """Contents cut off, flipped, lengthened and zeroed at several places."""
    size = len(content)
    cut = [content[:at] for at in (0, 5, 31, 32, 40, size // 4, size // 2, size - 1)]
    flipped = [
        content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :]
        for at in (0, 31, 32, 60, size // 4, size // 2, 3 * size // 4, size - 1)
    ]
    return [*cut, *flipped, content + b"x", bytes(size)]


@pytest.mark.parametrize(("name", "arguments"), [("add", (1, 2)), ("twice", (1,))])
def test_a_damaged_file_is_noticed_wherever_the_damage_is(file, tmp_path, caplog, name, arguments):
    first = load(file)
    expected = (first(1, 2), load(file, name)(*arguments))
    path = next(path for path in kept(tmp_path) if path.name.startswith(f"kernels.{name}-"))
    whole = path.read_bytes()
    for content in damaged(whole):
        path.write_bytes(content)
        kernel = load(file, name)
        signature = (numba.int64,) * len(arguments)
        assert kernel._cache.load_overload(signature, kernel.targetctx) is None
    assert (first(1, 2), load(file, name)(*arguments)) == expected
    again = load(file, name)  # it was written anew
    assert again(*arguments) == expected[1]
    assert hits(again) == 1
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "kernels that were kept cannot be used and are compiled again"
    ]


def test_code_of_another_signature_source_or_constant_is_not_used(file, tmp_path, monkeypatch):
    add = load(file)
    assert (add(1, 2), add(1.5, 2)) == (4, 5.0)
    one, other = (path for path in kept(tmp_path) if re.search(r"\.add-.*\.nbc$", path.name))
    whole = one.read_bytes(), other.read_bytes()
    one.write_bytes(whole[1])
    other.write_bytes(whole[0])
    add = load(file)
    assert (add(1, 2), add(1.5, 2)) == (4, 5.0)
    assert hits(add) == 0
    # another file that the kernels depend on
    monkeypatch.setattr(keeping, "fingerprint", lambda path: "changed")
    again = load(file)
    assert again(1, 2) == 4
    assert hits(again) == 0
    # the file itself, whose names and lines stay the same
    file.write_text(file.read_text().replace("2 * x", "3 * x"))
    assert load(file)(1, 2) == 5


def test_a_full_disk_costs_time_only_and_is_said_once(file, tmp_path, monkeypatch, caplog):
    def write_part(path: Path, content: bytes) -> None:
        with path.open("wb") as out:
            out.write(content[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", write_part)
    assert load(file)(1, 2) == 4
    assert load(file)(1.5, 2) == 5.0
    assert not kept(tmp_path)
    assert [record.getMessage() for record in caplog.records] == [
        "compiled kernels cannot be kept and are compiled anew by every process: "
        "[Errno 28] No space left on device"
    ]


def test_a_folder_that_goes_away_or_becomes_a_file_costs_time_only(file, tmp_path, caplog):
    add = load(file)
    assert add(1.5, 2) == 5.0
    shutil.rmtree(tmp_path / "kept")
    assert add(1, 2) == 4
    assert len(kept(tmp_path)) == 3
    shutil.rmtree(tmp_path / "kept")
    (tmp_path / "kept").touch()
    assert load(file)(1, 2) == 4
    assert "Not a directory" in caplog.text


def test_without_any_folder_kernels_work_and_it_is_said_once(file, tmp_path, caplog):
    (tmp_path / "kept").touch()
    assert load(file)(1, 2) == 4
    assert load(file)(1.5, 2) == 5.0
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "compiled kernels cannot be kept and are compiled anew by every process"
    ]


def test_kernels_are_kept_for_the_user_where_the_first_folder_cannot_be_written(
    file, tmp_path, monkeypatch, caplog
):
    (tmp_path / "a file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "a file"))
    assert load(file)(1, 2) == 4
    assert len(kept(tmp_path)) == 3
    again = load(file)
    assert again(1, 2) == 4
    assert hits(again) == 1
    assert not caplog.records


def test_processes_at_the_same_time_leave_whole_files(file, tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import kernels;"
        "print(kernels.add(1, 2), kernels.add(1.5, 2), kernels.add(1, 2.5))"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    processes = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for _ in range(3)
    ]
    outputs = [process.communicate() for process in processes]
    assert outputs == [(b"4 5.0 4.5\n", b"")] * 3
    add = load(file)
    assert (add(1, 2), add(1.5, 2), add(1, 2.5)) == (4, 5.0, 4.5)
    assert hits(add) == 3
    assert len(kept(tmp_path)) == 8


CALLED = """
import sys
from shiftsim.arrays import kernel

@kernel
def inner(pair):
    return pair[0] + pair[1]

@kernel
def outer(pair):
    return inner(pair)

print(globals()[sys.argv[1]]((1.5, 2)))
"""


def test_python_calls_what_another_process_compiled_for_a_kernel(file, tmp_path):
    """The part is there before numba knows how to unpack what it takes."""
    file.write_text(CALLED)
    place = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(PACKAGE.parent)}
    for name in ("outer", "inner"):
        command = [sys.executable, str(file), name]
        done = subprocess.run(command, env=os.environ | place, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, "3.5\n"), done.stderr


LOADED = """
import sys
import numpy as np
from shiftsim.arrays import kernel

@kernel
def norms(points):
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = np.hypot(points[i, 0], points[i, 1]) % 4.0
    if out[0] < 0.0:
        raise ValueError("never")
    return out

@kernel
def digest(text):
    return hash(text) == hash("a") and text in {"a": 1}

@kernel
def product(points):
    return norms(points).sum() * np.linalg.norm(np.dot(points.T, points))

points = np.array([[3.0, 4.0], [6.0, 8.0]])
print(norms(points).tolist(), digest("a") if "hash" in sys.argv else "")
print("numba.np.arraymath" in sys.modules)
if "more" in sys.argv:
    print(round(product(points), 6), norms(points.T.copy()).round(6).tolist())
print(sum(norms.stats.cache_hits.values()), sum(digest.stats.cache_hits.values()))
"""


@pytest.mark.thorough
def test_kept_kernels_are_used_without_all_that_numba_compiles_with(tmp_path):
    """What is loaded calls only what is there, and what is compiled later finds the rest."""
    path = tmp_path / "program.py"
    path.write_text(LOADED)
    place = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(PACKAGE.parent)}

    def lines(*words: str) -> list[str]:
        command = [sys.executable, str(path), *words]
        done = subprocess.run(command, env=os.environ | place, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    assert lines("hash") == ["[1.0, 2.0] True", "True", "0 0"]
    assert lines() == ["[1.0, 2.0] ", "False", "1 0"]
    assert lines("hash") == ["[1.0, 2.0] True", "True", "1 1"]
    loaded, *rest = lines("more")[1:]
    assert (loaded, rest) == ("False", ["375.0 [2.708204, 0.944272]", "1 0"])
