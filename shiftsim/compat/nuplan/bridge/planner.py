"""A planner for shiftsim around one for nuPlan."""

import copy
import hashlib
import inspect
import pickle
from collections.abc import Mapping
from typing import Any

from nuplan.common.actor_state.state_representation import StateSE2
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks
from nuplan.planning.simulation.planner.abstract_planner import PlannerInitialization
from shiftsim.compat.nuplan.bridge.map import BridgeMap
from shiftsim.compat.nuplan.bridge.world import HistoryKeeper, to_trajectory
from shiftsim.errors import ConfigError, PlannerError
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.map import PerMap
from shiftsim.world.state import Trajectory

_maps = PerMap(BridgeMap)


class NuplanPlanner:
    """Drives with a nuPlan planner; `shiftsim.compat.nuplan.wrap` makes it."""

    def __init__(self, source: Any, arguments: Mapping[str, Any]) -> None:
        self._source, self._arguments = source, dict(arguments)
        self._planner = self._make()
        self.code = _hash_of_code(type(self._planner))
        self.name = str(self._planner.name())
        self.report: Any = None  # what the planner reported of the scenario before
        self._scene: SceneInfo | None = None
        self._history: HistoryKeeper | None = None

    def _make(self) -> Any:
        fresh = inspect.isclass(self._source)
        return self._source(**self._arguments) if fresh else self._source

    def reset(self, scene: SceneInfo) -> None:
        """Initialize the planner; of a class a new one, unless the present one is still unused.

        Raises:
            ConfigError: It asks for sensor data.
        """
        if self._scene is not None:
            self.close()
            self._planner = self._make()
        wanted = self._planner.observation_type()
        if not (inspect.isclass(wanted) and issubclass(wanted, DetectionsTracks)):
            raise ConfigError(
                f"planner {self.name!r} wants to observe {getattr(wanted, '__name__', wanted)}",
                hint="shiftsim has tracks, no sensor data: observation_type() must be "
                "DetectionsTracks",
            )
        self._scene, self._history = scene, HistoryKeeper(scene)
        goal: Any = None if scene.goal is None else StateSE2(*scene.goal.tolist())
        self._planner.initialize(PlannerInitialization(list(scene.route), goal, _maps(scene.map)))

    def plan(self, observation: Observation) -> Trajectory:
        """The planner's trajectory.

        Raises:
            PlannerError: It returned something else.
        """
        if self._scene is None or self._history is None:
            raise PlannerError(f"planner {self.name!r}: plan() was called before reset()")
        found = self._planner.compute_trajectory(self._history.planner_input(observation))
        times = self._scene.times
        following = min(observation.iteration + 1, len(times) - 1)
        now_us, next_us = int(observation.time_us), int(times[following])
        return to_trajectory(found, now_us, next_us, self.name)

    def close(self) -> None:
        """Take the last report."""
        if self._scene is not None:
            self.report = self._planner.generate_planner_report()

    def __deepcopy__(self, memo: dict[int, Any]) -> "NuplanPlanner":
        return NuplanPlanner(copy.deepcopy(self._source, memo), self._arguments)

    def __reduce__(self) -> Any:
        kind = self._source if inspect.isclass(self._source) else type(self._source)
        if kind.__module__ == "__main__":
            raise pickle.PicklingError(f"{kind.__name__} is defined in the main script")
        # where it arrives this class comes first, and with its package the `nuplan.*` names
        return NuplanPlanner, (self._source, self._arguments)


def _hash_of_code(kind: type) -> str:
    try:
        return hashlib.sha256(inspect.getsource(kind).encode()).hexdigest()
    except (OSError, TypeError):
        return ""
