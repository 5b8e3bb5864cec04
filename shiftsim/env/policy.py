"""Policies as planners: what acts in `shiftsim/Driving-v0` drives in a run, with the same scores.

A policy is a function of an observation, an object with `predict` as Stable-Baselines3 has them, or
a file with the network of one.
"""

import hashlib
import inspect
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from shiftsim.env.driving import ACTIONS, OBSERVATIONS, bounded, high_of, plan_of
from shiftsim.env.episode import Observer
from shiftsim.env.terms import Terms, compute_reward_terms, make_state
from shiftsim.errors import ConfigError, MissingExtraError, ShiftsimError, one_of, readable
from shiftsim.files import expand, make_table, read_toml
from shiftsim.planners.learned.checkpoint import prepare_inference, require_torch
from shiftsim.planners.registry import state_digest
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import Command, Trajectory

CRITIC = "value_measurements"  # part of the raster's that is made from the recording


class PlannerEpisode:
    """Stands where an `Episode` stands for those who make observations: what a planner knows.

    `terms` are there where the planner is shown the recording.
    """

    terms: Terms | None = None

    def __init__(self, scene: SceneInfo, action: NDArray[np.float32]) -> None:
        """`action` is the last one, zeros at the beginning."""
        self.scene, self.action = scene, action
        self._now: Any = None
        self._log: Any = None
        self._state: Any = None

    def observe(self) -> Observation:
        """What the planner sees now."""
        return self._now

    def advance(self, observation: Observation) -> None:
        """Note the next observation of the scenario."""
        self._now, row = observation, observation.iteration
        expert, history = self.scene.expert, observation.history
        if expert is None:
            return
        if row == 0:
            self._log = Rollout(expert, None, controller="log-playback").log()
        self._log.ego[row] = history.ego[-1]
        for name in ("valid", "poses", "velocities", "sizes"):
            getattr(self._log.tracks, name)[row] = getattr(history.tracks, name)[-1]
        if row == 0:
            self._state = make_state(self._log, self.scene.map)
        self.terms = compute_reward_terms(self._state, self._log, row)


class PolicyPlanner:
    """Drives with a policy; see `policy_planner`."""

    def __init__(self, policy: Any, observer: Observer, action: str, name: str) -> None:
        """The policy, what it is shown, its kind of action, and its name in tables."""
        self.name, self._policy, self.observer = name, policy, deepcopy(observer)
        self._high, self._memory = high_of(action), None
        space = getattr(policy, "observation_space", None)
        self._parts = tuple(space) if isinstance(space, spaces.Dict) else ()
        self.sees_recording = CRITIC in self._parts
        self.source, self.uses = "", ""  # in the fingerprint: of a function the name is pickled
        with suppress(OSError, TypeError):  # of what is no function, or of a console
            self.source = hashlib.sha256(inspect.getsource(policy).encode()).hexdigest()
            names = inspect.getclosurevars(policy).globals
            self.uses = state_digest({n: v for n, v in names.items() if not inspect.ismodule(v)})
        self.is_seen = bool(self.uses) or not inspect.isroutine(policy)

    def reset(self, scene: SceneInfo) -> None:
        """Forget the scenario before."""
        self._episode, self._memory = PlannerEpisode(scene, np.zeros_like(self._high)), None

    def plan(self, observation: Observation) -> Trajectory | Command:
        """The plan that the policy's action stands for."""
        episode: Any = self._episode
        episode.advance(observation)
        if observation.iteration == 0:
            self.observer.start(episode)
        episode.action = self.act(self.observer.look(episode))
        return plan_of(episode.action, observation.history.ego[-1])

    def act(self, seen: Any) -> NDArray[np.float32]:
        """The action at an observation, within its bounds.

        Raises:
            ConfigError: The policy returned something else.
        """
        if self._parts:
            seen = {name: part for name, part in seen.items() if name in self._parts}
        if not hasattr(self._policy, "predict"):
            return bounded(self._policy(seen), self._high)
        memory: dict[str, Any] = {} if self._memory is None else {"state": self._memory}
        action, self._memory = self._policy.predict(seen, deterministic=True, **memory)
        return bounded(action, self._high)


def policy_planner(
    policy: Any, *, observation: str | Observer = "", action: str = ""
) -> PolicyPlanner:
    """A planner that drives as a policy acts in the environment `shiftsim/Driving-v0`.

    Args:
        policy: A function that returns the action at an observation, or an object with
            `predict(observation, deterministic=True)`, such as a model of Stable-Baselines3.
        observation: `vector`, `raster`, `none`, or an `Observer` of one's own; if empty, that of
            the policy's `observation_space`, or else `vector`.
        action: `command` or `trajectory`; if empty, that of the policy's `action_space`, or else
            `command`.

    Raises:
        ConfigError: It is no policy, or one for another environment.
        MissingExtraError: Gymnasium is missing.

    Example:
        ```python
        planner = shiftsim.policy_planner(lambda seen: [0.1, 0.0], observation="none")
        log = shiftsim.simulate(shiftsim.open_store("demo")["01f13e"], planner)
        ```
    """
    predicts = hasattr(policy, "predict")
    if not predicts and not callable(policy):
        raise ConfigError(
            f"{readable(policy)} is no policy",
            hint="a policy is called with an observation, or has predict(observation)",
        )
    name = getattr(policy, "__name__", type(policy).__name__).strip("<>")  # of a lambda
    if predicts and hasattr(inner := getattr(policy, "policy", None), "predict"):
        policy = inner  # the network of a model, without what trained it
    seen, acts = (getattr(policy, f"{what}_space", None) for what in ("observation", "action"))
    if isinstance(observation, str):
        names = [one_of("observation", observation, OBSERVATIONS)] if observation else OBSERVATIONS
        known = {name: OBSERVATIONS[name]().space for name in names}
        observation = (_fitting(seen, known) if seen is not None else observation) or "vector"
        observation = OBSERVATIONS[observation]()
    kinds = [one_of("action", action, ACTIONS)] if action else ACTIONS
    known = {name: spaces.Box(-high_of(name), high_of(name)) for name in kinds}
    action = (_fitting(acts, known) if acts is not None else action) or "command"
    return PolicyPlanner(policy, observation, action, name)


def _fitting(space: Any, known: Mapping[str, Any]) -> str:
    """The name of a space, or of one that has all its parts."""
    for name, other in known.items():
        are_parts = isinstance(space, spaces.Dict) and isinstance(other, spaces.Dict)
        if space == other or (are_parts and space.spaces.items() <= other.spaces.items()):
            return name
    raise ConfigError(
        f"the policy was made for {space}, which is "
        f"{'neither' if len(known) > 1 else 'not'} {' nor '.join(known)}",
        hint="where a wrapper made it so, give a function that does the same to policy_planner",
    )


@dataclass(frozen=True, slots=True)
class Interface:
    """How a network acts in the environment: the keys of the TOML beside its file."""

    observation: str
    action: str


class FilePolicy:
    """The network of a file; a copy in another process is made of the same bytes."""

    shares_nothing = True  # it keeps nothing of a scenario: one is enough for a process

    def __init__(self, content: bytes, kind: str) -> None:
        """The bytes of a file, and which of `_LOADERS` reads it."""
        prepare_inference("cpu")
        self._made_of = content, kind
        self._network = _LOADERS[kind](BytesIO(content))
        self.observation_space = getattr(self._network, "observation_space", None)
        self.action_space = getattr(self._network, "action_space", None)

    def __reduce__(self) -> Any:
        return FilePolicy, self._made_of

    def predict(self, seen: Any, **settings: Any) -> tuple[Any, Any]:
        """The action, and what a recurrent network remembers."""
        if hasattr(self._network, "predict"):
            return self._network.predict(seen, **settings)
        import torch

        parts = (seen["raster"], seen["measurements"]) if isinstance(seen, dict) else (seen,)
        with torch.inference_mode():
            out = self._network(*(torch.from_numpy(np.array(part)[None]) for part in parts))
        return (out[0] if isinstance(out, torch.Tensor) and len(out) == 1 else out), None


def _load_model(file: BytesIO) -> Any:
    """The policy of a model of Stable-Baselines3, without what trained it."""
    try:
        from stable_baselines3.common.save_util import load_from_zip_file
    except ImportError as error:
        what = "the policy is a model of Stable-Baselines3, which is not installed"
        raise MissingExtraError(what, hint="pip install stable-baselines3") from error
    # schedules, which only training needs, are code of the Python that wrote them
    unread = dict.fromkeys(("learning_rate", "lr_schedule", "clip_range", "clip_range_vf"))
    data, tensors, _ = load_from_zip_file(file, device="cpu", custom_objects=unread)
    kind, settings = data["policy_class"], dict(data["policy_kwargs"])
    if "use_sde" in inspect.signature(kind).parameters:
        settings.setdefault("use_sde", data["use_sde"])
    policy = kind(data["observation_space"], data["action_space"], lambda _: 0.0, **settings)
    policy.load_state_dict(tensors["policy"])
    policy.set_training_mode(False)
    return policy


_MODEL = "policy.pth"
_LOADERS: dict[str, Callable[[BytesIO], Any]] = {  # by what such archives have in them
    _MODEL: _load_model,
    "constants.pkl": lambda file: import_module("torch").jit.load(file, map_location="cpu").eval(),
    "archive_format": lambda file: import_module("torch").export.load(file).module(),
}
_HINT = "a policy is a zip of Stable-Baselines3, or a file of TorchScript or torch.export"


def _kind_of(path: Path) -> str:
    """Which of `_LOADERS` reads a file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.rpartition("/")[2] for name in archive.namelist()}
        why = "holds weights, but no network" if "data.pkl" in names else "is another archive"
    except (OSError, zipfile.BadZipFile) as error:
        names, why = set(), readable(getattr(error, "strerror", None) or error)
    for kind in _LOADERS:
        if kind in names:
            return kind
    raise ConfigError(f"{str(path)!r} is no policy: {why}", hint=_HINT)


def from_spec(spec: str) -> Callable[[], PolicyPlanner]:
    """What makes the planner `policy:FILE`; its `files` are what it is made of.

    Raises:
        ConfigError: There is no such file, or it holds no policy.
    """
    path = expand(spec.partition(":")[2])
    files, kind = {"policy": path}, _kind_of(path)
    if kind != _MODEL:
        files["interface"] = beside = path.with_name(f"{path.name}.toml")
        if not beside.is_file():
            what = f"{str(path)!r} needs a file {beside.name!r} beside it that says how it acts"
            raise ConfigError(what, hint='two lines: observation = "vector" and action = "command"')

    def make() -> PolicyPlanner:
        require_torch("a policy")
        about = {}
        if kind != _MODEL:
            about = asdict(make_table(Interface, read_toml(beside), str(beside)))
        try:
            planner = policy_planner(FilePolicy(path.read_bytes(), kind), **about)
            planner.name, space = spec, planner.observer.space
            # what does not fit is said before anything is driven
            planner.act(spaces.unflatten(space, np.ones(spaces.flatdim(space), np.float32)))
        except ShiftsimError as error:
            raise type(error)(f"{str(path)!r}: {error.message}", error.hint) from error
        except Exception as error:  # of other libraries
            text = f"{str(path)!r} cannot act: {type(error).__name__}: {readable(error)}"
            raise ConfigError(text, hint="it is called with one observation at a time") from error
        return planner

    vars(make)["files"] = files
    return make
