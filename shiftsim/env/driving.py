"""The environment `shiftsim/Driving-v0`.

An episode is one scenario. It is truncated when the scenario is at its end, and terminated by an
infraction: a corner of the ego off the road, or a collision of the moving ego.
"""

import signal
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import fields, replace
from functools import cache, partial
from math import isfinite
from multiprocessing import TimeoutError as NoAnswerError
from multiprocessing.connection import wait
from numbers import Real
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from shiftsim.data import open_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.env.episode import REWARDS, Episode, NoObservation, Observer, Reward
from shiftsim.env.raster import RasterObserver, picture_of
from shiftsim.env.vector import VectorObserver
from shiftsim.errors import ConfigError, DataError, ShiftsimError, beginning, one_of, readable
from shiftsim.geometry.boxes import from_frame
from shiftsim.kernels import FloatArray
from shiftsim.planners.learned.carl.planner import command_of
from shiftsim.runs.scenarios import find_split, require_scenarios, usable_tokens
from shiftsim.sim.log import Setting, Snapshot
from shiftsim.sim.noise import NoiseModel
from shiftsim.sim.perception import Localization, Perception, make_drift
from shiftsim.sim.traffic import Traffic, make_traffic, traffic_name
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Trajectory

POSES, SPACING = 10, 0.1  # of a trajectory action; s between them
REACH = 50.0  # m from the ego that a pose of it may be
OBSERVATIONS: dict[str, Callable[[], Observer]] = {
    "none": NoObservation,
    "raster": RasterObserver,
    "vector": VectorObserver,
}
ACTIONS = ("command", "trajectory")
# which values some settings and options may have, and in words
_VALUES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "terminate": (lambda one: isinstance(one, (bool, np.bool_)), "True or False"),
    "penalty": (lambda one: isinstance(one, Real) and isfinite(one), "a finite number"),
    "token": (lambda one: isinstance(one, str), "one token of the store"),
    "noise_seed": (
        lambda one: isinstance(one, (int, np.integer)) and type(one) is not bool and bool(one >= 0),
        "a whole number, 0 or more",
    ),
    "snapshot": (lambda one: isinstance(one, Snapshot), "the `snapshot` of an info"),
}

Make = Callable[[], gymnasium.Env[Any, Any]]


class Source(Protocol):
    """Where scenarios come from, if not from a store."""

    tokens: Sequence[str]

    def read(self, token: str) -> Scenario:
        """The scenario of a token."""


def _require_values(values: dict[str, Any]) -> None:
    for name, value in values.items():
        fits, wanted = _VALUES[name]
        if not fits(value):
            raise ConfigError(f"{name} is {value!r}", hint=f"give {wanted}")


@cache
def _opened(name: str) -> Any:
    """A store, opened once in a process: many environments share its maps."""
    return open_store(name)


class DrivingEnv(gymnasium.Env[Any, Any]):
    """A scenario per episode, driven by commands or trajectories."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        *,
        store: str | Source = "demo",
        split: str = "",
        observation: str | Observer = "vector",
        reward: str | Reward = "regular",
        noise: str | NoiseModel = "none",
        perception: str | Perception = "none",
        localization: str | Localization = "none",
        latency: int = 0,
        traffic: str | Traffic = "nonreactive",
        action: str = "command",
        terminate: bool = True,
        penalty: float = 0.0,
        render_mode: str | None = None,
    ) -> None:
        """Open the store and check the settings.

        Args:
            store: Store by name, path or URL, or an object with `tokens` and `read(token)`.
            split: Name or file of a split of the store; if empty, all its scenarios but those that
                filter or review have dropped.
            observation: `vector`, `raster`, `none`, or an `Observer` of one's own.
            reward: `regular`, `nuplan` or `survival` as CaRL has them, `score`, or a function of
                the `Episode`.
            noise: Actuation noise, by name or model.
            perception: How boxes are seen, by name or model; rewards and scores know the truth.
            localization: Where the ego takes itself to be, by name or model.
            latency: Time from an action until it acts [ms], a multiple of 100.
            traffic: Traffic, by name or model.
            action: `command` or `trajectory`.
            terminate: Whether an infraction ends the episode.
            penalty: Added to the reward of every step with an infraction.
            render_mode: `rgb_array` or None.

        Raises:
            ConfigError: A setting is unknown.
            DataError: The store is not there, or has no scenario.
        """
        self._settings = {name: value for name, value in locals().items() if name != "self"}
        _require_values({"terminate": terminate, "penalty": penalty})
        self._store: Any = _opened(store) if isinstance(store, str) else store
        held = tuple(self._store.tokens)
        if type(self._store) is ScenarioStore:  # what filter and review say is of recorded ones
            self._tokens = usable_tokens(self._store, split)
        else:
            found = find_split(split, Path(getattr(store, "path", "")), held)
            require_scenarios(found.name, found.tokens, str(store), held)
            self._tokens = found.tokens
        if not self._tokens:
            raise DataError(f"store {str(store)!r} has no scenarios", hint="choose another store")
        named = traffic_name(traffic) if isinstance(traffic, str) else deepcopy(traffic)
        drift = make_drift(noise, perception, localization, latency)
        models: Any = {item.name: getattr(drift, item.name) for item in fields(drift)}
        self._setting = Setting(traffic=named, **models)
        if isinstance(traffic, str):
            make_traffic(traffic)
        if isinstance(observation, str):
            observation = OBSERVATIONS[one_of("observation", observation, OBSERVATIONS)]()
        self.observer = deepcopy(observation)
        if isinstance(reward, str):
            reward = REWARDS[one_of("reward", reward, REWARDS)]
        self._reward = reward
        self._high = high_of(action)
        self._terminate, self._penalty = terminate, penalty
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode {render_mode!r} unknown", hint="use 'rgb_array'")
        self.render_mode = render_mode
        self.observation_space = self.observer.space
        self.action_space = spaces.Box(-self._high, self._high)
        self._episode: Episode | None = None

    def __reduce__(self) -> Any:
        """Copies come to the same iteration: the arrays of an episode are views of one another."""
        generator = {"_np_random": self._np_random, "_np_random_seed": self._np_random_seed}
        state = {**generator, "spec": self.spec, "observer": self.observer}
        snapshot = None if self._episode is None else self._episode.snapshot()
        return _resume, (type(self), self._settings, snapshot), state

    @property
    def episode(self) -> Episode:
        """The episode under way.

        Raises:
            ConfigError: There was no reset.
        """
        if self._episode is None:
            raise ConfigError("no episode is under way", hint="call reset() first")
        return self._episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a scenario, drawn at random; `options` may name its `token` and `noise_seed`.

        The token may be shortened. Or they have a `snapshot` as steps return it, and nothing else:
        the episode goes on from there. The observer then looks at the beginning and at the present.

        Raises:
            ConfigError: An option is unknown or has a wrong value, the store has no scenario of
                that token, or the snapshot has another setting.
        """
        super().reset(seed=seed)
        drawn: dict[str, Any] = {
            "token": self._tokens[int(self.np_random.integers(len(self._tokens)))],
            "noise_seed": int(self.np_random.integers(2**31)),
        }
        chosen = dict(options or {})
        for name in chosen:
            one_of("option of reset", name, [*drawn, "snapshot"])
        _require_values(chosen)
        snapshot: Snapshot | None = chosen.pop("snapshot", None)
        if snapshot is not None:
            if chosen:
                what = f"a snapshot has its own {' and '.join(chosen)}"
                raise ConfigError(what, hint="give no other option beside it")
            chosen = {"token": snapshot.token, "noise_seed": snapshot.setting.seed}
        elif "token" in chosen:
            held = self._store.tokens
            chosen["token"] = beginning("the store", "scenario", chosen["token"], held)
        chosen = drawn | chosen
        scenario = self._store.read(chosen["token"])
        setting = replace(self._setting, seed=chosen["noise_seed"])
        self._episode = episode = Episode(scenario, setting, np.zeros_like(self._high))
        self.observer.start(episode)
        seen, first = self.observer.look(episode), episode.snapshot()
        if snapshot is not None:
            if snapshot.setting != first.setting:
                raise ConfigError(f"the snapshot has {snapshot.setting}, this {first.setting}")
            episode.resume(snapshot)
            seen, first = self.observer.look(episode), snapshot
        info = {"scenario_type": scenario.scenario_type, "log_name": scenario.log_name}
        return seen, chosen | info | {"snapshot": first}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive one step of 0.1 s.

        Raises:
            ConfigError: The episode has ended.
        """
        if self.episode.is_over:
            raise ConfigError("the episode has ended", hint="call reset()")
        episode = self.episode
        episode.action = given = bounded(action, self._high)
        episode.advance(plan_of(given, episode.observe().history.ego[-1]))
        infraction, is_over = episode.infraction, episode.is_over
        info: dict[str, Any] = {"terms": episode.terms, "infraction": infraction}
        info["snapshot"] = episode.snapshot()
        if is_over:
            info["scores"] = episode.scores
            info["error"] = episode.error
        paid = self._reward(episode)
        try:
            reward = float(paid) + (self._penalty if infraction else 0.0)
        except (TypeError, ValueError) as error:
            what = f"reward {getattr(self._reward, '__name__', self._reward)} returned {paid!r}"
            raise ConfigError(what, hint="return a number") from error
        terminated = self._terminate and infraction != ""
        return self.observer.look(episode), reward, terminated, is_over, info

    def render(self) -> np.ndarray | None:
        """(256, 256, 3) uint8: 128 m around the ego, which drives to the right."""
        return picture_of(self.episode) if self.render_mode == "rgb_array" else None


def _resume(
    kind: type[DrivingEnv], settings: dict[str, Any], snapshot: Snapshot | None
) -> DrivingEnv:
    """An environment whose episode has come as far as another's."""
    env = kind(**settings)
    if snapshot is not None:
        env.reset(options={"snapshot": snapshot})
    return env


def high_of(action: str) -> NDArray[np.float32]:
    """The largest action of a kind, `command` (2,) or `trajectory` (10, 3)."""
    is_command = one_of("action", action, ACTIONS) == "command"
    high = np.ones(2) if is_command else np.tile([REACH, REACH, np.pi], (POSES, 1))
    return high.astype(np.float32)


def bounded(action: Any, high: NDArray[np.float32]) -> NDArray[np.float32]:
    """An action, cut at its bounds.

    Raises:
        ConfigError: It is none, or has another shape.
    """
    try:
        given = np.asarray(action, np.float32)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError is torch's
        what = f"the action is a {type(action).__name__}, no array ({readable(error)})"
        raise ConfigError(what, hint=f"return {high.size} numbers of shape {high.shape}") from error
    if given.shape != high.shape:
        raise ConfigError(f"the action has shape {given.shape}; it must be {high.shape}")
    return np.minimum(np.maximum(given, -high), high)


def plan_of(action: NDArray[np.float32], ego: FloatArray) -> Trajectory | Command:
    """The plan that an action stands for: a command, or poses in the frame of the rear axle."""
    if action.ndim == 1:
        return command_of(action, ego)
    poses = np.concatenate([ego[None, :3], from_frame(action.astype(np.float64), ego[:3])])
    return Trajectory.from_poses(SPACING * np.arange(POSES + 1), poses)


def DrivingVectorEnv(
    num_envs: int = 1,
    *,
    num_workers: int = 1,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    timeout: float = 600.0,
    **settings: Any,
) -> "VectorEnv[Any, Any, Any]":
    """Environments side by side: Gymnasium's `SyncVectorEnv`, or its `AsyncVectorEnv`.

    Args:
        num_envs: Number of environments.
        num_workers: 1 to step all of them in this process; with more, each of them has a process
            of its own.
        autoreset_mode: When an ended episode is followed by a new one, as in Gymnasium.
        timeout: How long a reset or a step may take in other processes [s]; kernels are compiled
            in the first ones.
        settings: Those of `DrivingEnv`.

    Raises:
        ConfigError: A setting is wrong.
        DataError: The store is not there, or has no scenario.
    """
    if not 1 <= num_workers <= num_envs:
        what = f"{num_workers} workers for {num_envs} environments"
        raise ConfigError(what, hint="num_workers must be at least 1, and at most num_envs")
    makers = [partial(DrivingEnv, **settings)] * num_envs
    return vector_env(makers, num_workers, timeout, autoreset_mode=autoreset_mode)


def vector_env(
    makers: Sequence[Make], num_workers: int, timeout: float = 600.0, **settings: Any
) -> "VectorEnv[Any, Any, Any]":
    """Environments side by side, in this process or in one each; `settings` as in Gymnasium."""
    if num_workers == 1:
        return SyncVectorEnv(makers, **settings)
    return ProcessVectorEnv(makers, timeout, **settings)


class ProcessVectorEnv(AsyncVectorEnv):
    """Environments in a process each; an error, the death or the silence of one closes all."""

    def __init__(self, makers: Sequence[Make], timeout: float, **settings: Any) -> None:
        """Start the processes; forking is unsafe beside the threads of torch."""
        self._timeout = timeout
        self._close_on_error(partial(super().__init__, context="spawn", **settings), makers)

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """As Gymnasium's."""
        self._close_on_error(partial(self.reset_async, **arguments))
        return self._close_on_error(self.reset_wait, self._timeout)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """As Gymnasium's."""
        self._close_on_error(self.step_async, actions)
        return self._close_on_error(self.step_wait, self._timeout)

    def close_extras(self, timeout: float | None = None, terminate: bool = True) -> None:
        """End the processes; there is nothing that they would have to write."""
        processes = getattr(self, "processes", ())  # none where a setting was refused
        for process in processes:
            process.kill()  # also one that is stopped
        for process in processes:
            process.join()

    def _close_on_error(self, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except NoAnswerError as error:
            number = next(n for n, pipe in enumerate(self.parent_pipes) if not pipe.poll())
            self.close()
            raise ShiftsimError(
                f"environment {number} has not answered for {self._timeout:g} s",
                hint="its process is stopped or busy; a longer `timeout` waits for it",
            ) from error
        except (EOFError, ConnectionError) as error:
            ended = wait([process.sentinel for process in self.processes], timeout=5.0)
            number = next(n for n, one in enumerate(self.processes) if one.sentinel in ended)
            self.processes[number].join()
            code = self.processes[number].exitcode or 0
            self.close()
            how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
            raise ShiftsimError(
                f"the process of environment {number} ended with {how}",
                hint="what it printed is above; a script that makes processes needs the guard "
                "if __name__ == '__main__'",
            ) from error
        except BaseException:
            self.close()
            raise
