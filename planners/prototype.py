"""A planner as its constructor left it.

Every scenario of a run is driven by a copy, so that scores depend neither on the scenarios that the
same planner has driven before nor on how scenarios are shared out among workers.
"""

import io
import logging
import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from shiftsim.errors import readable
from shiftsim.sim.planner import BatchPlanner, Planner


class PlannerPrototype:
    """A planner that drives nothing itself, and what its copies are made from."""

    def __init__(self, make: Callable[[], Planner]) -> None:
        """`make` makes a planner."""
        self._make = make
        self.planner = make()
        self._shared: list[Any] = []
        self._content = b""
        if not isinstance(self.planner, BatchPlanner):
            with suppress(Exception):  # of users' code; then each copy is a new planner
                stream = io.BytesIO()
                _Writer(stream, self._shared).dump(self.planner)
                self._content = stream.getvalue()
                self.release(self.copy())

    def copy(self) -> Planner:
        """A planner for one scenario: a fork, or a copy that shares the weights, or a new one."""
        if isinstance(self.planner, BatchPlanner):
            return self.planner.fork()
        if not self._content:
            return self._make()
        copied: Planner = _Reader(io.BytesIO(self._content), self._shared).load()
        return copied

    def release(self, copied: Planner) -> None:
        """Let a copy release what it holds; a fork has nothing of its own."""
        if copied is not self.planner and not isinstance(copied, BatchPlanner):
            close_planner(copied)


class _Writer(pickle.Pickler):
    """Leaves out what copies share: networks, and arrays that nobody can write."""

    def __init__(self, stream: io.BytesIO, shared: list[Any]) -> None:
        super().__init__(stream)
        torch: Any = sys.modules.get("torch")
        self._network = (torch.nn.Module,) if torch else ()
        self._shared = shared

    def persistent_id(self, value: object) -> int | None:
        """The place of a shared object."""
        fixed = isinstance(value, np.ndarray) and not value.flags.writeable
        apart = getattr(type(value), "shares_nothing", False)  # has a copy per scenario elsewhere
        if not (fixed or apart or isinstance(value, self._network)):
            return None
        self._shared.append(value)
        return len(self._shared) - 1


class _Reader(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, shared: list[Any]) -> None:
        super().__init__(stream)
        self._shared = shared

    def persistent_load(self, place: int) -> Any:
        return self._shared[place]


def close_planner(planner: object) -> None:
    """Let a planner release what it holds; where it cannot, its results are there nevertheless."""
    close = getattr(planner, "close", None)
    if callable(close):
        try:
            close()
        except (Exception, SystemExit) as error:
            name = type(planner).__name__
            logging.getLogger(__name__).warning("%s.close(): %s", name, readable(error))
