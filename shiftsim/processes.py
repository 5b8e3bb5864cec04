"""How a process is started, talked to and ended: worker pools, GPU owners and isolated planners.

A process is a fresh interpreter that talks over one socket: nothing is forked, and the main script
of the caller is not imported again. It ends with its parent, and an interrupt from the terminal
does not reach it. The standard pools give neither, and break as a whole when one process dies.
"""

import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from threading import Event, Thread
from typing import Any

from shiftsim.errors import ConfigError
from shiftsim.files import PACKAGE, take_search_path, user_folders

_PAUSE = 0.5  # s, before a process that ended is started again
_PATIENCE = 5.0  # s, for a process to end by itself
# one thread per process: the parallelism is across scenarios
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("NUMBA", "OMP", "OPENBLAS", "MKL")}
_SERVE = "import sys, shiftsim.processes as p; p.serve(*map(int, sys.argv[1:]))"


class ProcessEndedError(Exception):
    """A process has ended; the text says how."""


class Process:
    """An interpreter, and the socket to it."""

    def __init__(self, words: Sequence[str], env: Mapping[str, str] | None = None) -> None:
        """Start a program; its last two arguments are the parent's process id and its socket.

        On Windows the socket comes through the standard input instead. It is an OSError if the
        program cannot be started.
        """
        ours, theirs = socket.socketpair()
        with ours, theirs:
            words = [*words, str(os.getpid()), str(theirs.fileno())]
            # what is printed there is not output of the command
            options: dict[str, Any] = {"env": env, "stdout": sys.__stderr__}
            if sys.platform == "win32":
                options["creationflags"] = subprocess.CREATE_NEW_PROCESS_GROUP
                self.popen = subprocess.Popen(words, stdin=subprocess.PIPE, **options)
                assert self.popen.stdin is not None
                with self.popen.stdin as pipe:
                    pipe.write(theirs.share(self.popen.pid))
            else:
                options |= {"pass_fds": [theirs.fileno()], "process_group": 0}
                self.popen = subprocess.Popen(words, stdin=subprocess.DEVNULL, **options)
            self.connection: Connection[Any, Any] = Connection(ours.detach())

    def send(self, value: object) -> None:
        """Send a value; a process that has ended is noticed when it is listened to."""
        with suppress(OSError):
            self.connection.send(value)

    def receive(self) -> Any:
        """The next value that the process sends, or a ProcessEndedError."""
        try:
            return self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise ProcessEndedError(self.end()) from error

    def kill(self) -> None:
        """End the process at once."""
        self.popen.kill()

    def end(self) -> str:
        """Close the socket, wait for the process to end, and say how it did."""
        self.connection.close()
        try:
            code = self.popen.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            code = self.popen.wait()
        if code < 0:
            with suppress(ValueError):
                return f"killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


def packed(make: Callable[[], object]) -> bytes:
    """What `start` needs to call `make` in another process: our search path and `make`."""
    return pickle.dumps((sys.path, user_folders(), pickle.dumps(make)))


def start(payload: bytes) -> Process:
    """A process that makes a function, sends "ready", and then answers what it is sent."""
    search = [str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")]
    env = {"PYTHONPATH": os.pathsep.join(filter(None, search))}
    process = Process([sys.executable, "-P", "-c", _SERVE], {**os.environ, **env, **_ONE_THREAD})
    with suppress(OSError):
        process.connection.send_bytes(payload)
    return process


def serve(parent: int, handle: int) -> None:
    """Main function of a process of `start`: answer with what the function returns."""
    _end_with(parent)
    if sys.platform == "win32":
        handle = socket.fromshare(sys.stdin.buffer.read()).detach()
    connection: Connection[Any, Any] = Connection(handle)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the parent has ended
        path, folders, pickled = pickle.loads(connection.recv_bytes())
        take_search_path(path, folders)
        function = pickle.loads(pickled)()
        try:
            connection.send("ready")
            while True:
                connection.send(function(connection.recv()))
        finally:
            close(function)


def close(function: object) -> None:
    """Call the method `close` of a function that has one."""
    if (method := getattr(function, "close", None)) is not None:
        method()


@contextmanager
def in_background(make: Callable[[], object]) -> Iterator[None]:
    """Keep what `make` makes in a process that is started again when it ends; or a ConfigError."""
    payload, leaving = packed(make), Event()
    process = start(payload)

    def restart() -> None:
        nonlocal process
        while True:
            try:
                process.receive()  # "ready", once after every start
            except ProcessEndedError as end:
                if leaving.wait(_PAUSE):
                    return
                text = "the process for the device %s, and is started again"
                logging.getLogger(__name__).warning(text, end)
                process = start(payload)

    try:
        process.receive()
    except ProcessEndedError as end:
        what = f"the process for the device cannot start: it {end}"
        raise ConfigError(what, hint="run with --workers 1 to see why") from end
    # the thread that starts a process must outlive it, as that is killed when its parent ends
    keeper = Thread(target=restart, daemon=True)
    keeper.start()
    try:
        yield
    finally:
        leaving.set()
        while keeper.is_alive():
            process.kill()
            keeper.join(_PAUSE)


def _end_with(parent: int) -> None:
    """Have this process killed when its parent dies, even during an endless task.

    Elsewhere than on Linux it notices at its next message only.
    """
    if sys.platform != "linux":
        return
    import ctypes

    set_parent_death_signal = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>
    ctypes.CDLL(None).prctl(set_parent_death_signal, int(signal.SIGKILL))
    if os.getppid() != parent:
        raise SystemExit("the parent ended before its process had begun")
