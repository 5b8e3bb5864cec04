"""Run a function over many tasks: in this process, or in supervised worker processes.

A worker process is a fresh interpreter that talks over one socket: nothing is forked, the caller's
main script is not imported again, and a worker that dies, or hangs and is killed, costs the one
task it was working on. The standard pools do not give that: theirs break as a whole.
"""

import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from math import inf
from multiprocessing.connection import Connection, wait
from threading import Event, Thread
from time import monotonic, time
from typing import Any, Generic, Literal, TypeVar

from shiftsim.errors import ConfigError
from shiftsim.files import fresh_python
from shiftsim.kernels import machine_code

T = TypeVar("T")
R = TypeVar("R")

_LOG = logging.getLogger(__name__)
MakeFunction = Callable[[], Callable[[T], R]]
_MAX_START_FAILURES = 3  # workers in a row that die before they are ready for a task
_LOOK_AHEAD = 128  # tasks among which one for a worker is chosen
_PAUSE = 0.5  # s, before a process that ended is started again
_TIME_TO_LOAD = 10.0  # s, on top of the limit of a worker's first task
_TIME_TO_COMPILE = 20.0  # s, for one kernel: longer than any takes
# one thread per worker: the parallelism is across scenarios
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("NUMBA", "OMP", "OPENBLAS", "MKL")}


@dataclass(frozen=True, slots=True)
class Outcome(Generic[T, R]):
    """What became of one task."""

    task: T  # the task
    result: R | None  # what the function returned; None when the worker died
    death: str = ""  # how the worker died, empty when it did not
    is_late: bool = False  # whether it was killed because the task took longer than the limit


def map_unordered(
    make: MakeFunction[T, R],
    tasks: Iterable[T],
    *,
    workers: int,
    alone: int = 0,
    limit: float = 0.0,
    pieces: Callable[[T], Sequence[T]] | None = None,
    group: Callable[[T], object] | None = None,
) -> Generator[Outcome[T, R], None, None]:
    """Apply a function to every task, in whatever order they finish.

    Args:
        make: Called once per worker; returns the function. Must pickle when `workers` is above 1
            or there is a limit, and so must the tasks and results. A `close` attribute of the
            function is called at the end.
        tasks: The tasks.
        workers: Number of worker processes; with 1 and no limit everything happens in this process.
        alone: So many leading tasks are done one at a time before the others, so that kernels
            which are not in the disk cache yet are compiled once.
        limit: Time that each piece of a task may take [s]; 0 for any. What a worker has to load,
            or to compile, does not count.
        pieces: Splits a task that is several in one; when its worker dies, they are done one by
            one, so that only one of them is lost.
        group: What a worker should stay with, as it has read it already; neighbours only.

    Yields:
        One outcome per task, or per piece of one whose worker died.

    Raises:
        ConfigError: Workers cannot be started.
    """
    if workers <= 1 and not limit:
        yield from _serial(make, tasks)
        return
    payload = _payload(make)
    pool = Pool(payload, max(1, workers), limit, pieces, group)
    try:
        yield from pool.run(tasks, alone)
    finally:
        pool.close()


@contextmanager
def beside(make: Callable[[], object]) -> Iterator[None]:
    """Keep what `make` makes in a process of its own, which is started again when it ends.

    Raises:
        ConfigError: It cannot be made there.
    """
    payload, leaving = _payload(make), Event()
    worker = _Worker(payload)

    def keep() -> None:
        nonlocal worker
        while True:
            try:
                worker.receive()  # once, when it is ready again
            except _DeathError as death:
                if leaving.wait(_PAUSE):
                    return
                _LOG.warning("a process for the device is started again: %s", death)
                worker = _Worker(payload)

    try:
        worker.receive()
    except _DeathError as death:
        raise ConfigError(
            f"the process for the device cannot start: {death}",
            hint="run with --workers 1 to see why",
        ) from death
    # a process that a thread started is killed when this thread ends: it must outlive it
    keeper = Thread(target=keep, daemon=True)
    keeper.start()
    try:
        yield
    finally:
        leaving.set()
        while keeper.is_alive():
            worker.process.kill()
            keeper.join(_PAUSE)


def _seconds_since_compiling() -> float:
    """How long ago the last kernel was put into the cache [s]."""
    return time() - max((path.stat().st_mtime for path in machine_code()), default=-inf)


def _payload(make: Callable[[], object]) -> bytes:
    return pickle.dumps((sys.path, pickle.dumps(make)))


def _serial(make: MakeFunction[T, R], tasks: Iterable[T]) -> Generator[Outcome[T, R], None, None]:
    function = make()
    try:
        for task in tasks:
            yield Outcome(task, function(task))
    finally:
        _close(function)


def _close(function: object) -> None:
    if (close := getattr(function, "close", None)) is not None:
        close()


class _Worker:
    """One interpreter and the socket to it."""

    def __init__(self, payload: bytes) -> None:
        ours, theirs = socket.socketpair()
        self.process = _start(theirs)
        theirs.close()
        self.connection: Connection[Any, Any] = Connection(ours.detach())
        self.task: Any = None
        self.state: Literal["starting", "idle", "busy"] = "starting"
        self.is_new = True
        self.deadline = inf
        with suppress(OSError):  # a worker that is dead already is noticed when it is waited for
            self.connection.send_bytes(payload)

    def give(self, task: object, seconds: float) -> None:
        """Hand over a task that may take so long."""
        self.task, self.state = task, "busy"
        self.deadline = monotonic() + seconds + _TIME_TO_LOAD * self.is_new
        self.is_new = False
        with suppress(OSError):
            self.connection.send(task)

    def receive(self) -> Any:
        """The next message.

        Raises:
            _DeathError: The process has ended.
        """
        try:
            message = self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise _DeathError(self.end()) from error
        self.state, self.deadline = "idle", inf
        return message

    def end(self) -> str:
        """Close the socket, wait for the process, and say how it ended."""
        self.connection.close()
        try:
            code = self.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        if code < 0:
            with suppress(ValueError):
                return f"worker process killed by {signal.Signals(-code).name}"
        return f"worker process ended with exit code {code}"


class _DeathError(Exception):
    """A worker process has ended; the text says how."""


class Pool:
    """Keeps a number of workers busy, and replaces those that die."""

    def __init__(
        self,
        payload: bytes,
        size: int,
        limit: float = 0.0,
        pieces: Callable[[Any], Sequence[Any]] | None = None,
        group: Callable[[Any], object] | None = None,
    ) -> None:
        """A pool without workers; `payload` is what `serve` reads first."""
        self.payload, self.size, self.limit = payload, size, limit
        self.pieces = pieces or (lambda task: (task,))
        self.group = group
        self.workers: list[_Worker] = []
        self.failed_starts = 0

    def run(self, tasks: Iterable[Any], alone: int) -> Generator[Outcome[Any, Any], None, None]:
        """The outcomes of tasks; see `map_unordered`."""
        waiting = deque(tasks)
        done = 0
        while waiting or self._in("busy"):
            while len(self.workers) < min(self.size, len(waiting) + len(self._in("busy"))):
                self.workers.append(_Worker(self.payload))
            ready = self._in("idle")
            if done < alone:
                ready = [] if self._in("busy") else ready[:1]
            for worker in ready[: len(waiting)]:
                task = waiting.popleft() if done < alone else self._taken(waiting, worker)
                worker.give(task, self._seconds(task))
            for outcome in self._heard():
                done += 1
                parts = self.pieces(outcome.task) if outcome.death else ()
                if len(parts) > 1:
                    waiting.extendleft(reversed(parts))
                else:
                    yield outcome

    def _taken(self, waiting: deque[Any], worker: _Worker) -> Any:
        """The next task for a worker: of its own group, else of one that no other is at."""
        place = 0
        if self.group is not None:
            groups = [self.group(task) for task in islice(waiting, _LOOK_AHEAD)]
            own = None if worker.task is None else self.group(worker.task)
            # also of those that have just ended a task and are given their next one after this
            at = (other.task for other in self.workers if other is not worker)
            others = {self.group(task) for task in at if task is not None}
            fresh = (i for i, found in enumerate(groups) if found not in others)
            place = groups.index(own) if own in groups else next(fresh, 0)
        task = waiting[place]
        del waiting[place]
        return task

    def _seconds(self, task: object) -> float:
        return self.limit * len(self.pieces(task)) if self.limit else inf

    def _in(self, state: str) -> list[_Worker]:
        return [worker for worker in self.workers if worker.state == state]

    def _heard(self) -> Generator[Outcome[Any, Any], None, None]:
        """Wait for the workers; what they say, and those that are late are killed."""
        watched: dict[Any, _Worker] = {
            worker.connection: worker for worker in self.workers if worker.state != "idle"
        }
        first = min(worker.deadline for worker in watched.values())
        patience = None if first == inf else max(0.0, first - monotonic())
        for connection in wait(list(watched), patience):
            outcome = self._hear(watched[connection])
            if outcome is not None:
                yield outcome
        now = monotonic()
        late = [worker for worker in self.workers if worker.deadline < now]
        if late and _seconds_since_compiling() < _TIME_TO_COMPILE:
            for worker in late:
                worker.deadline = now + _TIME_TO_COMPILE
            return
        for worker in late:
            worker.process.kill()
            worker.end()
            self.workers.remove(worker)
            allowed = self._seconds(worker.task)
            yield Outcome(worker.task, None, f"took longer than {allowed:g} s", is_late=True)

    def _hear(self, worker: _Worker) -> Outcome[Any, Any] | None:
        starting = worker.state == "starting"
        try:
            message = worker.receive()
        except _DeathError as death:
            self.workers.remove(worker)
            if not starting:
                return Outcome(worker.task, None, str(death))
            self.failed_starts += 1
            if self.failed_starts >= _MAX_START_FAILURES:
                raise ConfigError(
                    f"workers cannot start: {death}", hint="run with --workers 1 to see why"
                ) from death
            return None
        self.failed_starts = 0
        return None if starting else Outcome(worker.task, message)

    def close(self) -> None:
        """End all workers: idle ones leave by themselves, the others are killed."""
        for worker in self.workers:
            if worker.state != "idle":
                worker.process.kill()
            worker.connection.close()
        for worker in self.workers:
            worker.end()


def _start(theirs: socket.socket) -> subprocess.Popen[bytes]:
    """Start an interpreter that serves a socket; interrupts from the terminal do not reach it."""
    command = "import sys, shiftsim.runs.workers as w; w.serve(*map(int, sys.argv[1:]))"
    words, env = fresh_python(command, str(os.getpid()), str(theirs.fileno()))
    env |= _ONE_THREAD
    if sys.platform == "win32":
        group = subprocess.CREATE_NEW_PROCESS_GROUP
        process = subprocess.Popen(words, stdin=subprocess.PIPE, creationflags=group, env=env)
        assert process.stdin is not None
        with process.stdin as pipe:
            pipe.write(theirs.share(process.pid))
        return process
    return subprocess.Popen(
        words, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, process_group=0, env=env
    )


def serve(parent: int, handle: int) -> None:
    """Main function of a worker process: do tasks from a socket until it closes."""
    _end_with(parent)
    if sys.platform == "win32":  # handles are not inherited: it comes through the standard input
        handle = socket.fromshare(sys.stdin.buffer.read()).detach()
    connection: Connection[Any, Any] = Connection(handle)
    try:
        path, pickled = pickle.loads(connection.recv_bytes())
        sys.path[:] = path
        function = pickle.loads(pickled)()
        try:
            connection.send("ready")
            while True:
                connection.send(function(connection.recv()))
        finally:
            _close(function)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the parent has gone


def _end_with(parent: int) -> None:
    """Have this process killed when its parent dies, even in the middle of an endless task.

    Elsewhere than on Linux it notices at its next message only.
    """
    if sys.platform != "linux":
        return
    import ctypes

    set_parent_death_signal = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>
    ctypes.CDLL(None).prctl(set_parent_death_signal, int(signal.SIGKILL))
    if os.getppid() != parent:
        raise SystemExit("the parent ended before its worker had begun")
