"""A process that knows all of shiftsim and runs commands in forks of itself, under the shim.

One command per line of the standard input, as JSON: words, root, mode, at. One answer per line.
With mode `warm` the process itself runs the command, so that its forks find everything loaded.
"""

import ctypes
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from functools import cache
from types import SimpleNamespace

MODES = ("count", "before", "after", "eio", "eio on", "full")
PATIENCE = 120.0  # s


def serve(library: str) -> None:
    shim = ctypes.CDLL(library)
    shim.shim_calls.restype = ctypes.c_char_p
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    look_once()
    for line in sys.stdin:
        answers.write(json.dumps(answer(shim, json.loads(line))) + "\n")
        answers.flush()


def look_once() -> None:
    """Remember what commands look up anew each time, and which no call to the shim changes."""
    from shiftsim.runs import manifest

    for name in ("versions", "_git_state"):
        setattr(manifest, name, cache(getattr(manifest, name)))


def answer(shim: ctypes.CDLL, asked: dict) -> dict:
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as calls:
        if asked["mode"] == "warm":
            code = command(asked["words"])
            gc.collect()
            gc.freeze()  # so that forks do not copy every page to look for garbage
            return {"code": code, "output": "", "calls": []}
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            os._exit(work(shim, asked, calls.fileno()))
        code = wait(child)
        output.seek(0)
        calls.seek(0)
        text = output.read().decode(errors="replace")
        return {"code": code, "output": text, "calls": calls.read().decode().splitlines()}


class Forked:
    """A worker process of a run, which has everything loaded; not counted, as a fresh one is not.

    Fresh interpreters, as runs start them, would take most of the time.
    """

    def __init__(self, shim: ctypes.CDLL, socket: int) -> None:
        from shiftsim import processes

        parent = os.getpid()
        self.pid = os.fork()
        if self.pid == 0:
            shim.shim_arm(b"", MODES.index("count"), 0)
            os.setpgid(0, 0)
            code, handle = 1, os.dup2(socket, 3)
            os.closerange(4, os.sysconf("SC_OPEN_MAX"))  # else no end of a socket is the last one
            try:
                processes.serve(parent, handle)
                code = 0
            finally:
                os._exit(code)

    def wait(self, timeout: float | None = None) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


def work(shim: ctypes.CDLL, asked: dict, calls: int) -> int:
    from shiftsim import processes

    fake = SimpleNamespace(**vars(subprocess))
    fake.Popen = lambda words, **options: (
        Forked(shim, int(words[-1])) if "-P" in words else subprocess.Popen(words, **options)
    )
    processes.subprocess = fake
    shim.shim_arm(os.fsencode(asked["root"]), MODES.index(asked["mode"]), asked["at"])
    code = command(asked["words"])
    with os.fdopen(calls, "wb") as file:
        file.write(shim.shim_calls())
    return code


def command(words: list[str]) -> int:
    from shiftsim.cli import main

    sys.argv = ["shiftsim", *words]
    code: object = 70
    try:
        main(words)
    except SystemExit as error:
        code = error.code or 0
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    return code if isinstance(code, int) else 71


def wait(child: int) -> int:
    deadline = time.monotonic() + PATIENCE
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.001)


if __name__ == "__main__":
    serve(sys.argv[1])
