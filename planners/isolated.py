"""A planner in a process of its own: only arrays and plain values cross, never code.

The child runs `stub.py`, in our interpreter with everything of ours, or in another one that needs
NumPy alone. What it computes is the same, and so are the scores.
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from shiftsim.errors import PlannerError
from shiftsim.planners import stub
from shiftsim.planners.prototype import PlannerPrototype
from shiftsim.planners.registry import load_planner, planner_fingerprint
from shiftsim.processes import Process
from shiftsim.sim import planner as interface
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world import layers, state
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Trajectory

_GIVEN = (
    *(interface.SceneInfo, interface.Observation, interface.History, Scenario, VectorMap),
    *(layers.Layer, layers.Polygons, layers.Polylines, layers.Lists),
    *(state.Tracks, state.TrafficLights, state.VehicleParameters),
)
# how many values answer what is asked
_PARTS = {("done", "make"): 3, ("done", "map"): 0, ("done", "reset"): 0, ("done", "plan"): 2}
_PARTS |= {("failed", verb): 3 for _, verb in _PARTS}
_RETURNED = {kind.__name__: kind for kind in (Trajectory, Command)}


class Isolated:
    """Drives with a planner that lives in a child process."""

    shares_nothing = True  # every scenario gets a planner of its own there

    def __init__(self, spec: str, arguments: Mapping[str, Any], python: str = "") -> None:
        """The planner `spec` (see `load_planner`) in an interpreter, ours if empty; begun later."""
        self.name, self.degraded = spec, ""
        self._given = (spec, dict(arguments), python)
        self._process: Process | None = None
        self._map: VectorMap | None = None
        self._about: Any = None
        self._asked = 0  # number of the last message

    def __reduce__(self) -> Any:
        return Isolated, self._given

    def identify(self) -> dict[str, Any]:
        """The fingerprint of the planner, which is made to see that it works, or a PlannerError."""
        return dict(self._started()[0])

    @property
    def sees_recording(self) -> bool:
        """Whether the planner declares that it looks at the recording."""
        return bool(self._started()[1])

    @property
    def called(self) -> str:
        """The planner's own name; empty where it has none."""
        return str(self._started()[2])

    def _started(self) -> Any:
        """What the child says of its planner; it is started where there is none."""
        if self._process is not None and self._process.popen.poll() is None:
            return self._about
        self.close()
        self._map = None
        spec, arguments, python = self._given
        interpreter = python or sys.executable
        try:
            self._process = Process([interpreter, stub.__file__])
        except OSError as error:
            raise PlannerError(
                f"planner {spec!r}: {interpreter!r} cannot be started ({error.strerror})",
                hint="--planner-python takes the path of a Python interpreter",
            ) from error
        plain = {name: str(v) if isinstance(v, Path) else v for name, v in arguments.items()}
        path = [] if python else [*filter(None, sys.path)]
        self._about = self._ask("make", {"spec": spec, "arguments": plain, "path": path})
        return self._about

    def reset(self, scene: SceneInfo) -> None:
        """Send the scene, its map only where it is another one than before; or a PlannerError."""
        self._started()
        if self._map is not scene.map:
            self._ask("map", scene.map)
            self._map = scene.map
        nothing: Any = None
        expert = None if scene.expert is None else replace(scene.expert, map=nothing)
        self._ask("reset", replace(scene, map=nothing, expert=expert))

    def plan(self, observation: Observation) -> Trajectory | Command:
        """What the planner in the child returns, or a PlannerError."""
        plan: Trajectory | Command
        plan, self.degraded = self._ask("plan", observation)
        return plan

    def _ask(self, verb: str, value: object) -> Any:
        """What the child answers; it is ended, and started anew, where that is no answer."""
        process = self._process
        assert process is not None
        self._asked += 1
        try:
            stub.write(process.connection, (self._asked, verb, value))
            number, state, answer = stub.read(process.connection, _RETURNED)
            parts = () if answer is None else tuple(answer)
            if number != self._asked or len(parts) != _PARTS[state, verb]:
                raise ValueError("a message that answers nothing")
        except BaseException as error:  # an interrupt leaves a message under way as well
            process.kill()
            end = process.end()
            if not isinstance(error, Exception):
                raise
            if not isinstance(error, (EOFError, ConnectionError)):
                end = f"was ended: it sent what cannot be read ({error})"
            raise PlannerError(
                f"the process of planner {self.name!r} {end}",
                hint="what it wrote to the standard error may say why",
            ) from error
        if state == "failed":
            text, hint, trace = map(str, parts)
            failure = PlannerError(text, hint)
            failure.add_note(f"in the process of planner {self.name!r}:\n{trace}")
            raise failure
        return parts

    def close(self) -> None:
        """End the process, once its planner has released what it holds."""
        process, self._process = self._process, None
        if process is not None:
            process.end()

    def __del__(self) -> None:
        if self._process is not None:
            self._process.kill()


def at_home(hello: Mapping[str, Any]) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """In the child: what makes planners, the classes of what they are given, and a fingerprint."""
    spec, arguments = hello["spec"], hello["arguments"]
    prototype = PlannerPrototype(lambda: load_planner(spec, arguments))
    classes = {kind.__name__: kind for kind in _GIVEN}
    return prototype.copy, classes, planner_fingerprint(spec, arguments)
