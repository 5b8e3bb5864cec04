"""A share of many environments, those that one process steps, and what all processes see.

There are a few sets of arrays for observations, so that one can be written while another is read.
"""

import multiprocessing
from collections.abc import Iterator
from math import prod
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import CustomSpaceError
from gymnasium.vector.utils import create_shared_memory, read_from_shared_memory

from shiftsim.env.driving import DrivingEnv
from shiftsim.env.terms import Terms
from shiftsim.errors import ConfigError
from shiftsim.kernels import FloatArray

SETS = 3  # of arrays for observations
SPAWN: Any = multiprocessing.get_context("spawn")  # forking is unsafe beside the threads of torch
# columns of the figures: the reward, these two, and the terms
TERMINATED, TRUNCATED, TERMS = 1, 2, 3
NUM_FIGURES = TERMS + len(Terms._fields)

Infos = dict[int, dict[str, Any]]  # what else environments have to say, by their place


class Memory(NamedTuple):
    """What all processes see; it can be sent to a process only when that begins."""

    observations: list[Any]  # `SETS` of them
    actions: Any  # numbers of all environments
    figures: Any  # `NUM_FIGURES` of each


def make_memory(env: DrivingEnv, count: int) -> Memory:
    """Memory for so many environments like this one.

    Raises:
        ConfigError: The observation is not made of arrays of fixed shape.
    """
    space = env.observation_space
    try:
        sets = [create_shared_memory(space, count, SPAWN) for _ in range(SETS)]
        parts = list(leaves(read_from_shared_memory(space, sets[0], count)))
    except (CustomSpaceError, TypeError):
        parts = [None]
    if not all(isinstance(part, np.ndarray) for part in parts):
        raise ConfigError(
            f"observations of {space} are not arrays of fixed shape",
            hint="use vectorization_mode='sync', or a space of boxes",
        )
    actions = SPAWN.RawArray("f", count * prod(env.action_space.shape or ()))
    return Memory(sets, actions, SPAWN.RawArray("d", count * NUM_FIGURES))


def actions_in(memory: Memory, env: DrivingEnv) -> np.ndarray:
    """(count, …) the actions, as a view."""
    return np.frombuffer(memory.actions, np.float32).reshape(-1, *(env.action_space.shape or ()))


def figures_in(memory: Memory) -> FloatArray:
    """(count, NUM_FIGURES) the figures, as a view; NaN for terms that there are none of."""
    return np.frombuffer(memory.figures).reshape(-1, NUM_FIGURES)


class EnvWorker:
    """Some of the environments, one after the other."""

    def __init__(
        self, settings: dict[str, Any], places: range, same_step: bool, memory: Memory
    ) -> None:
        """Make the environments at these places among all."""
        self._envs = {place: DrivingEnv(**settings) for place in places}
        self._same_step, first = same_step, self._envs[places.start]
        self._actions, self._figures = actions_in(memory, first), figures_in(memory)
        space, count = first.observation_space, len(self._figures)
        self._seen: list[Any] = [
            read_from_shared_memory(space, one, count) for one in memory.observations
        ]

    def reset(
        self, chosen: int, seeds: list[int | None], options: dict[str, Any] | None
    ) -> tuple[Infos, Infos]:
        """Begin new episodes; what is seen goes to the chosen set of arrays."""
        infos: Infos = {}
        self._figures[list(self._envs)] = 0.0
        for place, env in self._envs.items():
            infos[place] = env.begin(seeds[place], options)
            self._figures[place, TERMS:] = np.nan
            self._look(chosen, place)
        return infos, {}

    def step(self, chosen: int) -> tuple[Infos, Infos]:
        """Drive one step, or begin a new episode where the last one has ended.

        Returns:
            What there is to say beside the figures, and the ends of episodes where a new one has
            been begun at once.
        """
        infos: Infos = {}
        ends: Infos = {}
        for place, env in self._envs.items():
            figures = self._figures[place]
            if not self._same_step and (figures[TERMINATED] or figures[TRUNCATED]):
                figures[:TERMS], figures[TERMS:] = 0.0, np.nan
                infos[place] = env.begin(None, None)
            else:
                reward, terminated, truncated, info = env.drive(self._actions[place])
                figures[:TERMS] = reward, terminated, truncated
                figures[TERMS:] = info["terms"]
                if self._same_step and (terminated or truncated):
                    ends[place] = {"final_obs": env.observer.look(env.episode), "final_info": info}
                    figures[TERMS:] = np.nan
                    infos[place] = env.begin(None, None)
                elif truncated:
                    infos[place] = {name: info[name] for name in ("scores", "error")}
            self._look(chosen, place)
        return infos, ends

    def render(self) -> list[np.ndarray | None]:
        """A picture of each."""
        return [env.render() for env in self._envs.values()]

    def _look(self, chosen: int, place: int) -> None:
        """Put the observation of one environment among those of all."""
        env, seen = self._envs[place], self._seen[chosen]
        fill = getattr(env.observer, "fill", None)
        if fill is None:
            _write(env.observer.look(env.episode), seen, place)
        else:
            fill(env.episode, {name: values[place] for name, values in seen.items()})


def leaves(seen: Any) -> Iterator[Any]:
    """The arrays that an observation is made of."""
    if isinstance(seen, (dict, tuple)):
        for part in seen.values() if isinstance(seen, dict) else seen:
            yield from leaves(part)
    else:
        yield seen


def _write(seen: Any, arrays: Any, place: int) -> None:
    if isinstance(arrays, dict):
        for name, part in arrays.items():
            _write(seen[name], part, place)
    elif isinstance(arrays, tuple):
        for value, part in zip(seen, arrays, strict=True):
            _write(value, part, place)
    else:
        arrays[place] = seen
