"""Run a function over many tasks on a dask cluster.

dask only hands the tasks out. On each of its threads one supervised process does them, the same as
on a single machine: a crash or a hung planner costs one task there as well, and no worker of the
cluster. What a lost machine was doing, dask gives to another one.
"""

import pickle
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from functools import partial
from importlib import import_module
from typing import Any
from uuid import uuid4

from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.runs.workers import MakeFunction, Outcome, Pool, R, T

_CONNECT = 30.0  # s
_AT_LEAST = 64  # tasks handed to the scheduler at once, more where there are more threads
# on a worker of the cluster: its processes by job and thread; kept from one task to the next
_POOLS: dict[tuple[str, int], Pool] = {}


def map_on_cluster(
    make: MakeFunction[T, R],
    tasks: Iterable[T],
    *,
    scheduler: str,
    alone: int = 0,
    limit: float = 0.0,
    pieces: Callable[[T], Sequence[T]] | None = None,
) -> Generator[Outcome[T, R], None, None]:
    """As `workers.map_unordered`, on the cluster whose scheduler is at an address.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        ConfigError: There is no scheduler at that address.
    """
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise MissingExtraError(
            "executor 'dask' needs dask.distributed", hint="pip install 'shiftsim[cluster]'"
        ) from error
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no dask scheduler answers at {scheduler!r}: {error}",
            hint="start one with `dask scheduler`, and workers with `dask worker ADDRESS`",
        ) from error
    job = uuid4().hex
    work = partial(_work, job, pickle.dumps((sys.path, pickle.dumps(make), limit, pieces)))
    waiting = deque(tasks)
    handed: dict[Any, Any] = {}  # future -> task
    done, window = 0, 1
    futures = distributed.as_completed([], loop=client.loop)
    try:
        while waiting or handed:
            if done % _AT_LEAST == 0 or done == alone:
                window = max(_AT_LEAST, 2 * sum(client.nthreads().values()))
            while waiting and len(handed) < (window if done >= alone else 1):
                task = waiting.popleft()
                future = client.submit(work, task, pure=False)
                handed[future] = task
                futures.add(future)
            future = next(futures)
            task = handed.pop(future)
            done += 1
            try:
                yield from future.result()
            except distributed.KilledWorker as error:  # every worker that took it was lost
                parts = pieces(task) if pieces else (task,)
                if len(parts) > 1:
                    waiting.extendleft(reversed(parts))
                else:
                    yield Outcome(task, None, f"lost with several workers: {error}")
    finally:
        client.cancel(list(handed), force=True)
        client.run(_forget, job)
        client.close()


def _work(job: str, payload: bytes, task: Any) -> list[Outcome[Any, Any]]:
    """Do one task on a thread of a worker of the cluster."""
    key = (job, threading.get_ident())
    if key not in _POOLS:
        for other in [other for other in _POOLS if other[1] == key[1]]:
            _POOLS.pop(other).close()  # of a run whose main process was killed
        paths, make, limit, pieces = pickle.loads(payload)
        here = [*sys.path, *(path for path in paths if path not in sys.path)]
        _POOLS[key] = Pool(pickle.dumps((here, make)), 1, limit, pieces)
    return list(_POOLS[key].run([task], 0))


def _forget(job: str) -> None:
    """End the processes of a job on a worker of the cluster."""
    for key in [key for key in _POOLS if key[0] == job]:
        _POOLS.pop(key).close()
