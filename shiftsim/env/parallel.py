"""Many environments at once, in this process or in several: `gymnasium.make_vec` makes them.

Every process, this one included, holds a share of the environments. What they see goes into memory
that all processes see; one message per step and process says that it is there. Observations that
somebody still holds are never written over: a step takes arrays that have been let go, and copies
if there are none.
"""

import pickle
import signal
import weakref
from collections.abc import Sequence
from contextlib import suppress
from copy import deepcopy
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, read_from_shared_memory

from shiftsim.env import share
from shiftsim.env.driving import DrivingEnv
from shiftsim.env.share import SETS, SPAWN, TERMS, TRUNCATED, EnvWorker
from shiftsim.env.terms import make_terms
from shiftsim.errors import ConfigError, ShiftsimError

MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
_PATIENCE = 5.0  # s that a process may take to leave
_NO_PICKLE = (pickle.PicklingError, TypeError, AttributeError)
_GONE = (EOFError, BrokenPipeError, ConnectionResetError)


class _Holder(Protocol):
    """Where a share is."""

    def ask(self, name: str, *arguments: Any) -> None:
        """Have a method of the share called."""

    def answer(self) -> Any:
        """What it returned; its error is raised."""

    def close(self) -> None:
        """Let it go."""


class _Local:
    """A share in this process."""

    def __init__(self, *arguments: Any) -> None:
        self._share, self._answer = EnvWorker(*arguments), None

    def ask(self, name: str, *arguments: Any) -> None:
        self._answer = getattr(self._share, name)(*arguments)

    def answer(self) -> Any:
        return self._answer

    def close(self) -> None: ...


class _Remote:
    """A share in a process of its own."""

    def __init__(self, settings: bytes, places: range, *others: Any) -> None:
        self._connection, theirs = SPAWN.Pipe()
        self._places = places
        arguments = (theirs, settings, places, *others)
        self._process: BaseProcess = SPAWN.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, name: str, *arguments: Any) -> None:
        with suppress(OSError):  # a process that is dead is noticed when its answer is waited for
            self._connection.send((name, arguments))

    def answer(self) -> Any:
        try:
            value = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._death() from error
        if isinstance(value, Exception):
            raise value
        return value

    def _death(self) -> ShiftsimError:
        self._process.join(_PATIENCE)
        code, places = self._process.exitcode or 0, self._places
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        return ShiftsimError(
            f"the process of environments {places.start} to {places.stop - 1} ended with {how}",
            hint="what it printed is above; a script that makes processes needs the guard "
            "if __name__ == '__main__'",
        )

    def close(self) -> None:
        self._connection.close()
        self._process.join(_PATIENCE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(connection: Connection, settings: bytes, *others: Any) -> None:
    """Main function of a process: do what it is asked for until nobody is there any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asks decides
    with suppress(*_GONE):
        try:
            own = EnvWorker(pickle.loads(settings), *others)
            connection.send(None)
            while True:
                name, arguments = connection.recv()
                connection.send(getattr(own, name)(*arguments))
        except _GONE:
            raise
        except Exception as error:  # raised again where it was asked for
            connection.send(_portable(error))


def _portable(error: Exception) -> Exception:
    """The error, or its text where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever a foreign class does
        return ShiftsimError(f"{type(error).__name__}: {error}")
    return error


class DrivingVectorEnv(VectorEnv[Any, Any, np.ndarray]):
    """Environments `DrivingEnv` side by side."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        num_workers: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        """Make the environments and the processes.

        Args:
            num_envs: Number of environments.
            num_workers: Number of processes that step them, this one included.
            autoreset_mode: When an ended episode is followed by a new one: `NEXT_STEP`, in the
                step after, which ignores the action, or `SAME_STEP`.
            settings: Those of `DrivingEnv`.

        Raises:
            ConfigError: A setting is wrong, or cannot be sent to a process.
            DataError: The store is not there, or has no scenario.
        """
        mode = AutoresetMode(autoreset_mode)
        if mode not in MODES:
            raise ConfigError(f"autoreset_mode {mode.value!r} is not offered", "use 'NextStep'")
        if not 1 <= num_workers <= num_envs:
            raise ConfigError(
                f"{num_workers} workers for {num_envs} environments",
                hint="num_workers must be at least 1, and at most num_envs",
            )
        one = DrivingEnv(**settings)
        self.num_envs, self.render_mode = num_envs, one.render_mode
        self.metadata = {**one.metadata, "autoreset_mode": mode}
        self.single_observation_space = one.observation_space
        self.single_action_space = one.action_space
        self.observation_space = batch_space(one.observation_space, num_envs)
        self.action_space = batch_space(one.action_space, num_envs)
        self._memory = share.make_memory(one, num_envs)
        self._actions = share.actions_in(self._memory, one)
        self._figures = share.figures_in(self._memory)
        self._held: list[list[weakref.ref[Any]]] = [[] for _ in range(SETS)]
        self._shares: list[_Holder] = []
        rest = (mode is AutoresetMode.SAME_STEP, self._memory)
        parts = np.array_split(np.arange(num_envs), num_workers)
        *others, own = (range(int(part[0]), int(part[-1]) + 1) for part in parts)
        sent = _pickled(settings) if others else b""
        for places in others:
            self._shares.append(_Remote(sent, places, *rest))
        # the last one: it does at once what it is asked for, and meanwhile the others do so too
        self._shares.append(_Local(settings, own, *rest))
        self._answers()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each; an integer seeds them with `seed`, `seed` + 1, and so on."""
        seeds = list(range(seed, seed + self.num_envs)) if isinstance(seed, int) else seed
        seeds = [None] * self.num_envs if seeds is None else list(seeds)
        if len(seeds) != self.num_envs:
            raise ConfigError(f"{len(seeds)} seeds for {self.num_envs} environments")
        chosen = self._free_set()
        self._ask("reset", chosen, seeds, options)
        infos = self._infos(self._answers())
        return self._look(chosen), infos

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Drive one step of 0.1 s in each; `actions` has a row for each."""
        given = np.asarray(actions, np.float32)
        if given.shape != self._actions.shape:
            wanted = self._actions.shape
            raise ConfigError(f"the actions have shape {given.shape}; it must be {wanted}")
        self._actions[:] = given
        chosen = self._free_set()
        self._ask("step", chosen)
        infos = self._infos(self._answers())
        rewards, terminated, truncated = self._figures[:, : TRUNCATED + 1].T.copy()
        return self._look(chosen), rewards, terminated > 0.0, truncated > 0.0, infos

    def render(self) -> tuple[Any, ...]:
        """A picture of each."""
        self._ask("render")
        return tuple(picture for part in self._answers() for picture in part)

    def close_extras(self, **_: Any) -> None:
        """End the processes."""
        for one in getattr(self, "_shares", ()):
            one.close()

    def _ask(self, name: str, *arguments: Any) -> None:
        """Have all shares do something."""
        if self.closed:
            raise ConfigError("the environments are closed", hint="make new ones")
        try:
            for one in self._shares:
                one.ask(name, *arguments)
        except Exception:
            self.close()
            raise

    def _answers(self) -> list[Any]:
        """What all shares answer; after an error they are not in step, and all are closed."""
        try:
            return [one.answer() for one in self._shares]
        except Exception:
            self.close()
            raise

    def _infos(self, answers: list[Any]) -> dict[str, Any]:
        """What the environments have to say, put together as Gymnasium does it."""
        infos: dict[str, Any] = {}
        driven = ~np.isnan(self._figures[:, TERMS])
        if driven.any():
            terms, infractions = np.full((2, self.num_envs), None, dtype=object)
            rows = self._figures[:, TERMS:].tolist()
            for place in np.flatnonzero(driven).tolist():
                terms[place] = one = make_terms(rows[place])
                infractions[place] = one.infraction
            infos = {"terms": terms, "_terms": driven}
            infos |= {"infraction": infractions, "_infraction": driven.copy()}
        for each in answers:
            for more in reversed(each):
                for place, info in more.items():
                    infos = self._add_info(infos, info, place)
        return infos

    def _free_set(self) -> int:
        """Arrays that nobody holds, else the last ones, which are never given away."""
        free = (i for i, held in enumerate(self._held) if all(one() is None for one in held))
        return next(free)

    def _look(self, chosen: int) -> Any:
        memory, space = self._memory.observations[chosen], self.single_observation_space
        seen = read_from_shared_memory(space, memory, self.num_envs)
        if chosen == SETS - 1:
            return deepcopy(seen)
        # whatever is a view of these arrays holds their base
        self._held[chosen] = [weakref.ref(array.base) for array in share.leaves(seen)]
        return seen


def _pickled(settings: dict[str, Any]) -> bytes:
    for name, value in settings.items():
        try:
            pickle.dumps(value)
        except _NO_PICKLE as error:
            raise ConfigError(
                f"{name} {value!r} cannot be sent to a process: {error}",
                hint="define it at the top level of a module, or use num_workers=1",
            ) from error
    return pickle.dumps(settings)
