"""One process owns a device: it holds the networks, and workers ask it for outputs.

A worker makes features and decodes outputs, and needs neither torch nor the device. What it sends
is one forward pass: requests of different workers are not joined, as the last digits of a GPU
depend on what is computed together, and who asks at the same time is chance. While one pass is
computed, the next request is already read.
"""

import logging
import secrets
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing import AuthenticationError
from multiprocessing.connection import (
    Client,
    Connection,
    Listener,
    answer_challenge,
    deliver_challenge,
)
from threading import Lock, Thread
from time import monotonic, sleep
from typing import Any, NamedTuple

from shiftsim.errors import PlannerError, ShiftsimError

PATIENCE = 60.0  # s, for an owner that has ended to be there again
_TRIES = 2  # of one request: an owner that has ended by chance, and one that ends of it
_PAUSE = 0.05  # s


class Address(NamedTuple):
    """Where an owner is found."""

    place: str  # of its socket
    key: bytes  # who does not know it is not let in


def new_address() -> Address:
    """An address that nobody else uses."""
    name = f"shiftsim-{secrets.token_hex(8)}"
    place = rf"\\.\pipe\{name}" if sys.platform == "win32" else f"\0{name}"
    return Address(place, secrets.token_bytes(32))


class InferenceServer:
    """Answers for planners, on threads, as long as it lives."""

    def __init__(self, planners: Mapping[str, Callable[[], Any]], address: Address) -> None:
        """Make the planners, by name, each of which has a network, and listen."""
        self._planners = {name: make() for name, make in planners.items()}
        self._pass = Lock()  # one at a time is on the device
        self._key, self._listener = address.key, Listener(address.place)
        Thread(target=self._admit, daemon=True).start()

    def _admit(self) -> None:
        while True:
            try:
                connection = self._listener.accept()
            except OSError:  # too many files are open: a connection may end
                sleep(_PAUSE)
                continue
            Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: "Connection[Any, Any]") -> None:
        # until the worker has gone; who keeps silent keeps nobody else waiting
        with suppress(AuthenticationError, EOFError, OSError), connection:
            deliver_challenge(connection, self._key)
            answer_challenge(connection, self._key)
            while True:
                connection.send(self._answer(*connection.recv()))

    def _answer(self, name: str, features: Sequence[Any]) -> Any:
        """The outputs, or the error and its traceback."""
        try:
            with self._pass:
                return self._planners[name].infer(features), ""
        except Exception as error:  # becomes that of the scenario
            ours = isinstance(error, ShiftsimError)
            reported = error if ours else PlannerError(f"{type(error).__name__}: {error}")
            return reported, traceback.format_exc()


class InferenceClient:
    """Takes the place of `infer` where an owner has the network; copies of a planner share it."""

    def __init__(self, address: Address, name: str) -> None:
        """Ask the owner at an address for the planner of that name."""
        self.address, self.name = address, name
        self._connection: Connection[Any, Any] | None = None
        self._patience = PATIENCE

    def __reduce__(self) -> Any:
        return InferenceClient, (self.address, self.name)

    def __call__(self, features: Sequence[Any]) -> Sequence[Any]:
        """What `infer` returns or raises; a PlannerError if no owner answers, twice."""
        for left in reversed(range(_TRIES)):
            try:
                self._connection = self._connection or self._connected()
                self._connection.send((self.name, features))
                answer, trace = self._connection.recv()
                break
            except (EOFError, OSError) as error:
                self.close()
                if not left:
                    raise PlannerError(
                        f"planner {self.name!r}: the process that holds its network has ended",
                        hint="its memory may not suffice: use a smaller --batch-size, and "
                        "--resume --retry-failed",
                    ) from error
                logging.getLogger(__name__).info("planner %s: asking again", self.name)
        if isinstance(answer, Exception):
            answer.add_note(f"in the process that holds the network:\n{trace}")
            raise answer
        outputs: Sequence[Any] = answer
        return outputs

    def close(self) -> None:
        """Close the connection; the next request makes a new one."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None

    def _connected(self) -> "Connection[Any, Any]":
        """A new connection; who has waited in vain does not wait again."""
        until = monotonic() + self._patience
        while True:
            try:
                found = Client(self.address.place, authkey=self.address.key)
            except (EOFError, OSError):
                if monotonic() > until:
                    self._patience = 0.0
                    raise
                sleep(_PAUSE)
            else:
                self._patience = PATIENCE
                return found
