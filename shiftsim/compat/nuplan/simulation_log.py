"""Simulation logs as nuPlan's devkit writes them, without the devkit.

A log is a pickle of the devkit's objects: for every sample the ego, the plan, the boxes and the
lights. Classes of the same names stand in for the devkit's while it is written.
"""

import gc
import lzma
import pickle
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from struct import pack
from types import ModuleType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np

from shiftsim._version import __version__
from shiftsim.compat.nuplan.shims.boxes import dimensions_of
from shiftsim.data.nuplan.export_log import HEIGHTS, connector_number
from shiftsim.files import atomic_write
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.runs.rollouts import Task
from shiftsim.sim.dynamics.perfect import KEPT_US
from shiftsim.sim.log import SimulationLog
from shiftsim.world import state
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, AgentKind

MAP_VERSION = "nuplan-maps-v1.0"
T = TypeVar("T")
_FLOAT64 = np.dtype(np.float64)
_ACTOR, _SIMULATION = "nuplan.common.actor_state", "nuplan.planning.simulation"
_SCENARIO, _MAPS = "nuplan.planning.scenario_builder.nuplan_db", "nuplan.common.maps"
# classes that keep their attributes in slots
_SLOTTED = {f"{_ACTOR}.state_representation": "StateSE2 StateVector2D TimePoint"}
_PLAIN = {  # classes whose objects are made of their attributes, by module
    f"{_ACTOR}.agent": "Agent",
    f"{_ACTOR}.car_footprint": "CarFootprint",
    f"{_ACTOR}.dynamic_car_state": "DynamicCarState",
    f"{_ACTOR}.ego_state": "EgoState",
    f"{_ACTOR}.oriented_box": "OrientedBox",
    f"{_ACTOR}.scene_object": "SceneObjectMetadata",
    f"{_ACTOR}.static_object": "StaticObject",
    f"{_ACTOR}.tracked_objects": "TrackedObjects",
    f"{_MAPS}.maps_datatypes": "TrafficLightStatusData",
    f"{_SCENARIO}.nuplan_scenario_utils": "ScenarioExtractionInfo",
    f"{_SIMULATION}.history.simulation_history": "SimulationHistory SimulationHistorySample",
    f"{_SIMULATION}.observation.observation_type": "DetectionsTracks",
    f"{_SIMULATION}.planner.simple_planner": "SimplePlanner",
    f"{_SIMULATION}.simulation_log": "SimulationLog",
    f"{_SIMULATION}.simulation_time_controller.simulation_iteration": "SimulationIteration",
}
_CALLED = {  # classes and functions whose call makes an object, by module
    f"{_ACTOR}.tracked_objects_types": "TrackedObjectType",
    f"{_ACTOR}.vehicle_parameters": "VehicleParameters",
    f"{_MAPS}.maps_datatypes": "TrafficLightStatusType",
    f"{_MAPS}.nuplan_map.nuplan_map": "NuPlanMap",
    "nuplan.database.maps_db.gpkg_mapsdb": "GPKGMapsDB",
    f"{_SCENARIO}.nuplan_scenario": "NuPlanScenario",
    f"{_SIMULATION}.trajectory.interpolated_trajectory": "InterpolatedTrajectory",
    "pathlib": "PosixPath",
    "numpy.core.numeric": "_frombuffer",  # its place in NumPy 1, which the devkit needs
}


class _Plain:
    """An object with attributes."""

    def __init__(self, **attributes: Any) -> None:
        self.__dict__ = attributes


class _Slotted(_Plain):
    """An object whose attributes are in slots."""

    def __getstate__(self) -> tuple[None, dict[str, Any]]:
        return None, self.__dict__


class _Called:
    """An object that a call makes."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __reduce__(self) -> Any:
        return type(self), self.arguments


_DEVKIT: Any = SimpleNamespace(
    **{
        name: type(name, (base,), {"__module__": module})
        for base, classes in ((_Plain, _PLAIN), (_Slotted, _SLOTTED), (_Called, _CALLED))
        for module, names in classes.items()
        for name in names.split()
    }
)


@contextmanager
def _importable() -> Iterator[None]:
    """Have pickle find the classes where the devkit has them."""
    modules = {"nuplan": ModuleType("nuplan")}
    for name, kind in vars(_DEVKIT).items():
        module = modules.setdefault(kind.__module__, ModuleType(kind.__module__))
        setattr(module, name, kind)
    before = {name: sys.modules[name] for name in modules if name in sys.modules}
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]
        sys.modules.update(before)


def write_simulation_log(
    path: Path, task: Task, scenario: Scenario, log: SimulationLog, *, database: Path, maps: Path
) -> None:
    """Write a rollout as a simulation log; nuPlan's tools look in `database` and `maps`."""
    was_enabled = gc.isenabled()
    gc.disable()  # among so many objects that takes as long as all the rest
    seconds = log.planning_seconds.tolist()
    try:
        planner = _DEVKIT.SimplePlanner(
            _compute_trajectory_runtimes=seconds if any(seconds) else [],  # 0: not known
            name=partial(str, task.planner),
            shiftsim={"version": __version__, **task._asdict()},
        )
        found = _DEVKIT.SimulationLog(
            file_path=_DEVKIT.PosixPath(*path.absolute().parts),
            scenario=_scenario_of(scenario, database, maps),
            planner=planner,
            simulation_history=_history(scenario, log, maps),
        )
        with _importable():
            data = pickle.dumps(found, 5)
    finally:
        if was_enabled:
            gc.enable()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_bytes(lzma.compress(b"\xc6" + pack(">I", len(data)) + data, preset=0))


_VEHICLE = _DEVKIT.VehicleParameters(*dimensions_of(PACIFICA))


def _scenario_of(scenario: Scenario, database: Path, maps: Path) -> Any:
    """The scenario, which finds the rest of itself in the recording."""
    kind, (duration, offset, ratio) = scenario.scenario_type, map(float, scenario.mapping)
    # the token is that of the last row from which the offset leads to iteration 0
    start = int(scenario.iteration_times[0]) - round(offset * 1e6)
    row = max(0, int(np.searchsorted(scenario.time_us, start, "right")) - 1)
    cut = _DEVKIT.ScenarioExtractionInfo(
        scenario_name=kind,
        scenario_duration=duration,
        extraction_offset=offset,
        subsample_ratio=ratio,
    )
    at = (scenario.token, int(scenario.time_us[row]), kind)
    road = (str(maps), MAP_VERSION, scenario.city)
    return _DEVKIT.NuPlanScenario(
        str(database.parent), str(database), *at, *road, cut, _VEHICLE, None
    )


def _history(scenario: Scenario, log: SimulationLog, maps: Path) -> Any:
    """Map, goal and samples."""
    plan_times, plan_states, lengths = _planned(log)
    parts = zip(
        log.time_us.tolist(),
        _egos(log.time_us, log.ego),
        _grouped(_egos(plan_times, plan_states), lengths),
        _boxes(log),
        _lights(scenario, log),
        strict=True,
    )
    samples = [
        _DEVKIT.SimulationHistorySample(
            iteration=_DEVKIT.SimulationIteration(time_point=_time(time_us), index=index),
            ego_state=ego,
            trajectory=_DEVKIT.InterpolatedTrajectory(plan),
            observation=_DEVKIT.DetectionsTracks(
                tracked_objects=_DEVKIT.TrackedObjects(tracked_objects=boxes)
            ),
            traffic_light_status=lights,
        )
        for index, (time_us, ego, plan, boxes, lights) in enumerate(parts)
    ]
    goal = scenario.mission_goal
    database = _DEVKIT.GPKGMapsDB(MAP_VERSION, str(maps))
    return _DEVKIT.SimulationHistory(
        map_api=_DEVKIT.NuPlanMap(database, scenario.city),
        mission_goal=None if goal is None else _pose(*goal.tolist()),
        data=samples,
    )


def _pose(x: float, y: float, heading: float) -> Any:
    return _DEVKIT.StateSE2(heading=heading, x=x, y=y)


def _time(time_us: int) -> Any:
    return _DEVKIT.TimePoint(time_us=time_us)


def _vector(x: float, y: float) -> Any:
    """A vector, which holds its numbers twice."""
    array = _DEVKIT._frombuffer(bytearray(pack("<2d", x, y)), _FLOAT64, (2,), "C")
    return _DEVKIT.StateVector2D(_x=x, _y=y, _array=array)


def _egos(time_us: IntArray, states: FloatArray) -> Iterator[Any]:
    """Ego states (R, 11) at times (R,) [us]."""
    centers = state.center_poses(states[:, :3]).tolist()
    for time, center, row in zip(time_us.tolist(), centers, states.tolist(), strict=True):
        x, y, heading, vx, vy, ax, ay, steering, steering_rate, yaw_rate, yaw_accel = row
        footprint = _DEVKIT.CarFootprint(
            _center=_pose(*center),
            _length=PACIFICA.length,
            _width=PACIFICA.width,
            _height=PACIFICA.height,
            _vehicle_parameters=_VEHICLE,
            rear_axle=_pose(x, y, heading),
        )
        motion = _DEVKIT.DynamicCarState(
            _rear_axle_to_center_dist=PACIFICA.rear_axle_to_center,
            _angular_velocity=yaw_rate,
            _angular_acceleration=yaw_accel,
            _rear_axle_velocity_2d=_vector(vx, vy),
            _rear_axle_acceleration_2d=_vector(ax, ay),
            _tire_steering_rate=steering_rate,
        )
        yield _DEVKIT.EgoState(
            _car_footprint=footprint,
            _tire_steering_angle=steering,
            _is_in_auto_mode=True,
            _time_point=_time(time),
            _dynamic_car_state=motion,
        )


def _boxes(log: SimulationLog) -> Iterator[list[Any]]:
    """Agents and static objects of every sample."""
    tracks, types = log.tracks, [_DEVKIT.TrackedObjectType(kind.value) for kind in AgentKind]
    names = [kind.name.lower() for kind in AgentKind]
    rows, found = np.nonzero(tracks.valid)
    arrays = (tracks.poses, tracks.sizes, np.nan_to_num(tracks.velocities))
    numbers = (of[rows, found].tolist() for of in arrays)
    boxes = []
    for time_us, track, pose, (length, width), velocity in zip(
        log.time_us[rows].tolist(), found.tolist(), *numbers, strict=True
    ):
        kind, token = int(tracks.kinds[track]), tracks.tokens[track]
        about = _DEVKIT.SceneObjectMetadata(
            timestamp_us=time_us,
            token=token,
            track_id=track,
            track_token=token,
            category_name=names[kind],
        )
        box = _DEVKIT.OrientedBox(
            _center=_pose(*pose), _length=length, _width=width, _height=HEIGHTS[AgentKind(kind)]
        )
        thing = {"_metadata": about, "instance_token": None, "_box": box}
        thing |= {"_tracked_object_type": types[kind]}
        if kind > state.LAST_AGENT_KIND:
            still = {"predictions": None, "past_trajectory": None, "velocity": _vector(*velocity)}
            boxes.append(_DEVKIT.StaticObject(**thing, **still))
            continue
        agent = _DEVKIT.Agent(
            _initial_time_stamp=_time(time_us),
            _predictions=[],
            _past_trajectory=None,
            _velocity=_vector(*velocity),
            _angular_velocity=np.nan,
            **thing,
        )
        boxes.append(agent)
    return _grouped(boxes, tracks.valid.sum(axis=1))


def _lights(scenario: Scenario, log: SimulationLog) -> Iterator[list[Any]]:
    """Lights of every sample that are listed."""
    lights = log.traffic_lights
    types = [_DEVKIT.TrafficLightStatusType(code) for code in range(4)]
    numbers = {name: connector_number(scenario, name) for name in lights.connector_ids}
    for row, time_us in enumerate(log.time_us.tolist()):
        yield [
            _DEVKIT.TrafficLightStatusData(
                status=types[status], lane_connector_id=numbers[name], timestamp=time_us
            )
            for name, status in lights.listed(row)
        ]


def _grouped(pieces: Iterable[T], lengths: IntArray) -> Iterator[list[T]]:
    """The pieces in lists of these lengths."""
    left = iter(pieces)
    return (list(islice(left, length)) for length in lengths.tolist())


def _planned(log: SimulationLog) -> tuple[IntArray, FloatArray, IntArray]:
    """Times and ego states of all plans, and their lengths; where there is none, the ego stands."""
    poses, is_bare = log.plans.copy(), np.isnan(log.plans[:, 1, 0])
    poses[is_bare, :2] = log.ego[is_bare, None, :3]
    known = np.isfinite(poses[..., 0])
    states = np.zeros((*known.shape, state.NUM_STATE))
    states[..., :3], headings = poses, poses[..., 2]
    steps = np.diff(poses[..., :2], axis=1) / (np.diff(KEPT_US) * 1e-6)[:, None]
    # since the pose before
    states[:, 1:, state.VX] = steps[..., 0] * np.cos(headings[:, 1:])
    states[:, 1:, state.VX] += steps[..., 1] * np.sin(headings[:, 1:])
    states[:, 0] = log.ego
    return (log.time_us[:, None] + KEPT_US)[known], states[known], known.sum(axis=1)
