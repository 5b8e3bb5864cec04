"""How everything but the ego moves: replayed from the log, or reactive.

A traffic model owns the tracks of a rollout from iteration 0 on. The simulator hands it one buffer
of tracks whose rows are the past samples followed by the iterations, filled from the log; the model
rewrites rows as the rollout proceeds. A model is any object with the two methods of `Traffic`;
`mixed.Mixed` makes one of several, each for some of the tracks (docs/own_traffic.md).
"""

import inspect
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import load_attribute
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

_MODELS = {
    "nonreactive": "shiftsim.sim.traffic:LogReplay",
    "reactive": "shiftsim.sim.traffic.idm.model:IdmTraffic",
    "constant-velocity": "shiftsim.sim.traffic.mixed:ConstantVelocity",
    "learned": "shiftsim.sim.traffic.learned.model:LearnedTraffic",
}
PLANNER = "planner:"  # begins the name of traffic whose vehicles a planner drives
_SHORT = {"nr": "nonreactive", "r": "reactive"}


class Traffic(Protocol):
    """What the simulator asks of a traffic model."""

    def start(self, scenario: Scenario, tracks: Tracks, row: int) -> None:
        """Prepare for a new rollout.

        Args:
            scenario: The scenario.
            tracks: (B, N, …) tracks of the rollout, filled from the log, writable.
            row: Row of `tracks` that is iteration 0; earlier rows are history and stay as they are.
        """

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move everyone from one iteration to the next.

        Args:
            iteration: The iteration that ends, i.
            ego: (11,) ego state at iteration i.
            tracks: The buffer of `start`.
            row: Row of `tracks` that is iteration i + 1; the model writes it.
        """


class Move(NamedTuple):
    """One call of `Traffic.step`."""

    iteration: int  # the iteration that ends
    ego: FloatArray  # (11,) ego state at it
    tracks: Tracks  # the buffer of `start`
    row: int  # row of the next iteration


@runtime_checkable
class BatchTraffic(Traffic, Protocol):
    """A traffic model that can move several rollouts with one forward pass."""

    def fork(self) -> "BatchTraffic":
        """A model for one more rollout that shares the network with this one."""

    def step_batch(self, models: Sequence["BatchTraffic"], moves: Sequence[Move]) -> None:
        """What `step` does, for forks that are in lock step, one call each."""


class LogReplay:
    """Non-reactive traffic: everyone does what the recording did, which the buffer holds."""

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Nothing to prepare."""

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Nothing to do."""


def traffic_name(name: str) -> str:
    """The full name of a traffic mode: `nr` and `r` are accepted.

    Raises:
        ConfigError: The name is unknown.
    """
    full = _SHORT.get(name, name)
    others = "planner:NAME", "package.module:Model"
    return full if ":" in full else one_of("traffic", full, [*_MODELS, *others])


def make_traffic(name: str, device: str = "") -> Traffic:
    """A traffic model by name, or by `package.module:Model`.

    That is called without arguments, or with the `device` where it is given and has a parameter of
    that name.

    Raises:
        ConfigError: The name is unknown, or what it names is not a traffic model.
    """
    target = _MODELS.get(full := traffic_name(name), full)
    if full.startswith(PLANNER):
        raise ConfigError(
            f"traffic {name!r} needs the planner itself here",
            hint="give traffic=PlannedTraffic(make) of shiftsim.sim.traffic.planned",
        )
    hint = "give package.module:Model of a class on the Python path"
    make = load_attribute("traffic", target, hint)
    model: Traffic = make(device=device) if device and _takes_device(make) else make()
    for method in ("start", "step"):
        if not callable(getattr(model, method, None)):
            raise ConfigError(
                f"traffic {name!r} has no method {method!r}",
                hint="a traffic model has start(scenario, tracks, row) and "
                "step(iteration, ego, tracks, row), see docs/own_traffic.md",
            )
    return model


@cache  # takes as long as ten steps
def _takes_device(make: Any) -> bool:
    try:
        return "device" in inspect.signature(make).parameters
    except (TypeError, ValueError):
        return False
