"""What the adapters of learned planners share: one network, a plan per scenario, batches.

An adapter is three steps: features of an observation (numpy), the network (one forward pass for a
whole batch), and the plan decoded from its output. Forks share the network; everything that belongs
to one scenario is made in `reset`.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Generic, Self, TypeAlias, TypeVar, cast

from shiftsim.planners.learned.checkpoint import (
    checkpoint_fingerprint,
    load_network,
    require_torch,
    resolve_device,
    weights_note,
)
from shiftsim.sim.planner import BatchPlanner, Observation, SceneInfo
from shiftsim.world.state import Command, Trajectory

Features = TypeVar("Features")
Output = TypeVar("Output")
Infer: TypeAlias = Callable[[Sequence[Any]], Sequence[Any]]  # features to outputs, as `infer`


class LearnedPlanner(ABC, Generic[Features, Output]):
    """Base of the adapters."""

    name: str  # of the planner, in the table of planners
    degraded: str = ""  # why the last plan is a fallback; empty when it is not

    def __init__(self, checkpoint: str = "", *, device: str = "cpu") -> None:
        """Load the network; arguments and errors are those of `load_weights`."""
        self.network = load_network(checkpoint, self.name, device=device)
        self.device = resolve_device(device)

    @classmethod
    def asking(cls, infer: Infer) -> Self:
        """A planner without a network: `infer`, which takes the method's place, has it."""
        planner = cls.__new__(cls)
        vars(planner)["infer"] = infer
        return planner

    @classmethod
    def fingerprint(cls, checkpoint: str = "", device: str = "cpu") -> dict[str, str]:
        """What tells the weights from others, what to say of them, and the kind of device."""
        require_torch(f"planner {cls.name!r}")
        found = {"checkpoint": checkpoint_fingerprint(checkpoint, cls.name)}
        if note := weights_note(found["checkpoint"], cls.name):
            found["weights"] = note
        return {**found, "device": resolve_device(device).partition(":")[0]}

    @abstractmethod
    def reset(self, scene: SceneInfo) -> None:
        """Make everything that belongs to this scenario, and nothing that does not."""

    @abstractmethod
    def features(self, observation: Observation) -> Features:
        """What the network reads."""

    @abstractmethod
    def infer(self, scenes: Sequence[Features]) -> Sequence[Output]:
        """One forward pass over a batch; the outputs in the same order."""

    @abstractmethod
    def decode(self, output: Output, observation: Observation) -> Trajectory | Command:
        """The plan of this scenario; sets `degraded`."""

    def fork(self) -> Self:
        """A planner for one more scenario that shares the network with this one."""
        return copy.copy(self)

    def plan(self, observation: Observation) -> Trajectory | Command:
        """The plan for one scenario alone."""
        (output,) = self.infer([self.features(observation)])
        return self.decode(output, observation)

    def plan_batch(
        self, planners: Sequence[BatchPlanner], observations: Sequence[Observation]
    ) -> list[Trajectory | Command | Exception]:
        """Plans of forks in lock step; an exception in place of a plan ends that scenario only."""
        forks = [cast(LearnedPlanner[Features, Output], planner) for planner in planners]
        read: list[Any] = [
            _caught(fork.features, observation)
            for fork, observation in zip(forks, observations, strict=True)
        ]
        good = [i for i, features in enumerate(read) if not isinstance(features, Exception)]
        plans: list[Any] = list(read)
        for i, output in zip(good, self._infer_all([read[i] for i in good]), strict=True):
            failed = isinstance(output, Exception)
            plans[i] = output if failed else _caught(forks[i].decode, output, observations[i])
        return plans

    def _infer_all(self, features: Sequence[Features]) -> Sequence[Any]:
        """Outputs of a batch; where that fails, of each alone, with an error where one fails."""
        if not features:
            return ()
        outputs = _caught(self.infer, features)
        if not isinstance(outputs, Exception):
            return cast(Sequence[Any], outputs)
        if len(features) == 1:
            return (outputs,)
        return [_caught(lambda one: self.infer([one])[0], one) for one in features]


def _caught(function: Any, *arguments: Any) -> Any:
    """The result, or the error: it must not reach the other scenarios of the batch."""
    try:
        return function(*arguments)
    except Exception as error:  # becomes this scenario's failure in the simulator
        return error
