"""Run a function over many tasks: here, in supervised worker processes, or on a dask cluster.

A worker that dies, or hangs and is killed, costs the one task it was working on. dask only hands
the tasks out: on each of its threads one supervised process does them, so that a crash costs one
task there as well, and no worker of the cluster. What a lost machine was doing, dask gives to
another one.
"""

import pickle
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from math import inf
from multiprocessing.connection import wait
from time import monotonic, time
from typing import Any, Generic, Literal, TypeVar
from uuid import uuid4

from shiftsim.errors import ConfigError, import_extra
from shiftsim.kernels import machine_code
from shiftsim.processes import Process, ProcessEndedError, close, packed, start
from shiftsim.runs.config import default_workers

T = TypeVar("T")
R = TypeVar("R")

MakeFunction = Callable[[], Callable[[T], R]]
_MAX_START_FAILURES = 3  # workers in a row that die before they are ready for a task
_LOOK_AHEAD = 128  # tasks among which one for a worker is chosen
_TIME_TO_LOAD = 10.0  # s, on top of the limit of a worker's first task
_TIME_TO_COMPILE = 20.0  # s, for one kernel: longer than any takes
_CONNECT = 30.0  # s, for a scheduler to answer
_HANDED_OUT = 64  # tasks at the scheduler at once, more where there are more threads
# on a worker of the cluster: its processes by job and thread; kept from one task to the next
_POOLS: "dict[tuple[str, int], Pool]" = {}


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
    workers: int = 0,
    alone: int = 0,
    limit: float = 0.0,
    in_batches: bool = False,
    group: Callable[[T], object] | None = None,
) -> Generator[Outcome[T, R], None, None]:
    """Apply a function to every task, in whatever order they finish.

    Args:
        make: Called once per worker; returns the function, whose `close` is called at the end. It,
            tasks and results must pickle, but for a single worker, this process, without a limit.
        tasks: The tasks.
        workers: Number of worker processes; 0 chooses from the cores and the tasks.
        alone: So many leading tasks are done one by one, so that kernels are compiled once.
        limit: Time per task or part of a batch [s]; 0 for any. Loading, compiling do not count.
        in_batches: Whether tasks are tuples of several; those of a dead worker are done one by one.
        group: What a worker should stay with, as it has read it already; neighbours only.

    Yields an outcome per task, or per part of such a batch. ConfigError: workers cannot be started.
    """
    tasks = list(tasks)
    workers = workers or min(default_workers(), len(tasks))
    if workers <= 1 and not limit:
        function = make()
        try:
            for task in tasks:
                yield Outcome(task, function(task))
        finally:
            close(function)
        return
    pool = Pool(packed(make), max(1, workers), limit, group, in_batches=in_batches)
    try:
        yield from pool.run(tasks, alone)
    finally:
        pool.close()


@dataclass(eq=False)
class _Worker:
    """A process of the pool, and the task that it is at."""

    process: Process
    task: Any = None
    state: Literal["starting", "idle", "busy"] = "starting"
    is_new: bool = True
    deadline: float = inf

    def give(self, task: object, seconds: float) -> None:
        """Hand over a task that may take so long."""
        self.task, self.state = task, "busy"
        self.deadline = monotonic() + seconds + _TIME_TO_LOAD * self.is_new
        self.is_new = False
        self.process.send(task)


class Pool:
    """Keeps a number of workers busy, and replaces those that die."""

    def __init__(
        self,
        payload: bytes,
        size: int,
        limit: float = 0.0,
        group: Callable[[Any], object] | None = None,
        *,
        in_batches: bool,
    ) -> None:
        """A pool without workers; `payload` is for `processes.start`."""
        self.payload, self.size, self.limit = payload, size, limit
        self.group, self.in_batches = group, in_batches
        self.workers: list[_Worker] = []
        self.failed_starts = 0

    def run(self, tasks: Iterable[Any], alone: int) -> Generator[Outcome[Any, Any], None, None]:
        """The outcomes of tasks; see `map_unordered`."""
        waiting = deque(tasks)
        done = 0
        while waiting or self._in("busy"):
            while len(self.workers) < min(self.size, len(waiting) + len(self._in("busy"))):
                self.workers.append(_Worker(start(self.payload)))
            ready = self._in("idle")
            if done < alone:
                ready = [] if self._in("busy") else ready[:1]
            for worker in ready[: len(waiting)]:
                task = waiting.popleft() if done < alone else self._next_task(waiting, worker)
                worker.give(task, self._seconds(task))
            for outcome in self._wait():
                done += 1
                if outcome.death and self.in_batches and len(outcome.task) > 1:
                    waiting.extendleft((part,) for part in reversed(outcome.task))
                else:
                    yield outcome

    def _next_task(self, waiting: deque[Any], worker: _Worker) -> Any:
        """The next task for a worker: of its own group, else of one that no other is at."""
        index = 0
        if self.group is not None:
            groups = [self.group(task) for task in islice(waiting, _LOOK_AHEAD)]
            # also of those that have just ended a task and are given their next one after this
            others = {
                self.group(other.task)
                for other in self.workers
                if other is not worker and other.task is not None
            }
            fresh = (i for i, found in enumerate(groups) if found not in others)
            last = None if worker.task is None else self.group(worker.task)
            index = groups.index(last) if last in groups else next(fresh, 0)
        task = waiting[index]
        del waiting[index]
        return task

    def _seconds(self, task: Any) -> float:
        return self.limit * (len(task) if self.in_batches else 1) or inf

    def _in(self, state: str) -> list[_Worker]:
        return [worker for worker in self.workers if worker.state == state]

    def _wait(self) -> Generator[Outcome[Any, Any], None, None]:
        """Outcomes of the workers that answer next; those that are late are killed."""
        workers: dict[Any, _Worker] = {
            worker.process.connection: worker for worker in self.workers if worker.state != "idle"
        }
        first = min(worker.deadline for worker in workers.values())
        patience = None if first == inf else max(0.0, first - monotonic())
        for connection in wait(list(workers), patience):
            outcome = self._receive(workers[connection])
            if outcome is not None:
                yield outcome
        now = monotonic()
        late = [worker for worker in self.workers if worker.deadline < now]
        files = machine_code() if late else ()
        compiled = max((path.stat().st_mtime for path in files), default=-inf)
        if time() - compiled < _TIME_TO_COMPILE:
            for worker in late:
                worker.deadline = now + _TIME_TO_COMPILE
            return
        for worker in late:
            worker.process.kill()
            worker.process.end()
            self.workers.remove(worker)
            allowed = self._seconds(worker.task)
            yield Outcome(worker.task, None, f"took longer than {allowed:g} s", is_late=True)

    def _receive(self, worker: _Worker) -> Outcome[Any, Any] | None:
        starting = worker.state == "starting"
        try:
            message = worker.process.receive()
        except ProcessEndedError as end:
            death = f"worker process {end}"
            self.workers.remove(worker)
            if not starting:
                return Outcome(worker.task, None, death)
            self.failed_starts += 1
            if self.failed_starts >= _MAX_START_FAILURES:
                what = f"workers cannot start: {death}"
                raise ConfigError(what, hint="run with --workers 1 to see why") from end
            return None
        worker.state, worker.deadline = "idle", inf
        self.failed_starts = 0
        return None if starting else Outcome(worker.task, message)

    def close(self) -> None:
        """End all workers: idle ones leave by themselves, the others are killed."""
        for worker in self.workers:
            if worker.state != "idle":
                worker.process.kill()
            worker.process.connection.close()
        for worker in self.workers:
            worker.process.end()


def map_on_cluster(
    make: MakeFunction[T, R],
    tasks: Iterable[T],
    *,
    scheduler: str,
    alone: int = 0,
    limit: float = 0.0,
    in_batches: bool = False,
) -> Generator[Outcome[T, R], None, None]:
    """As `map_unordered`, on the dask cluster of a scheduler; a ConfigError if none is there."""
    distributed: Any = import_extra("distributed", "cluster")
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no dask scheduler answers at {scheduler!r}: {error}",
            hint="start one with `dask scheduler`, and workers with `dask worker ADDRESS`",
        ) from error
    job = uuid4().hex
    work = partial(_work, job, pickle.dumps((packed(make), limit, in_batches)))
    waiting: deque[Any] = deque(tasks)
    pending: dict[Any, Any] = {}  # future -> task
    done, window = 0, 1
    futures = distributed.as_completed([], loop=client.loop)
    try:
        while waiting or pending:
            if done % _HANDED_OUT == 0 or done == alone:
                window = max(_HANDED_OUT, 2 * sum(client.nthreads().values()))
            while waiting and len(pending) < (window if done >= alone else 1):
                task = waiting.popleft()
                future = client.submit(work, task, pure=False)
                pending[future] = task
                futures.add(future)
            future = next(futures)
            task = pending.pop(future)
            done += 1
            try:
                yield from future.result()
            except distributed.KilledWorker as error:  # every worker that took it was lost
                if in_batches and len(task) > 1:
                    waiting.extendleft((part,) for part in reversed(task))
                else:
                    yield Outcome(task, None, f"lost with several workers: {error}")
    finally:
        client.cancel(list(pending), force=True)
        client.run(_forget, job)
        client.close()


def _work(job: str, payload: bytes, task: Any) -> list[Outcome[Any, Any]]:
    """Do one task on a thread of a worker of the cluster."""
    key = (job, threading.get_ident())
    if key not in _POOLS:
        for other in [other for other in _POOLS if other[1] == key[1]]:
            _POOLS.pop(other).close()  # of a run whose main process was killed
        given, limit, in_batches = pickle.loads(payload)
        paths, folders, make = pickle.loads(given)
        here = [*sys.path, *(path for path in paths if path not in sys.path)]
        _POOLS[key] = Pool(pickle.dumps((here, folders, make)), 1, limit, in_batches=in_batches)
    return list(_POOLS[key].run([task], 0))


def _forget(job: str) -> None:
    """End the processes of a job on a worker of the cluster."""
    for key in [key for key in _POOLS if key[0] == job]:
        _POOLS.pop(key).close()
