"""Simulation logs of nuPlan's devkit: the plain values in them, read without running anything.

A log is an xz file with a pickle of the devkit's objects, as one msgpack string where its name says
so. Every object becomes a plain record, whatever its class: nothing that a log names is imported or
called. Classes that are not listed here are named as left out.
"""

import lzma
import pickle
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from pickletools import genops
from struct import error as StructError
from struct import pack, unpack
from typing import Any

import numpy as np

from shiftsim.errors import DataError, MissingExtraError
from shiftsim.kernels import IntArray
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.elsewhere import Entry
from shiftsim.runs.rollouts.elsewhere import Source as Rollouts
from shiftsim.runs.rollouts.poses import Boxes, Driven
from shiftsim.verify.report import DAMAGED, Report, Source
from shiftsim.verify.rollouts import CENTER_COLUMNS, origin, read_ego, tracks_of
from shiftsim.world.state import AgentKind, LightStatus, rear_poses

DEVKIT = "nuPlan's devkit 1.2.2"  # whose folders are known here
OTHER_VERSION = f"another version than {DEVKIT}, the one known here, wrote this folder"
_PACKED = ".msgpack"  # in the name of a log
_MAX_BYTES = 1 << 30  # of a log, unpacked
_MAX_MEMORY = 1 << 28  # bytes to unpack it with: the highest level of xz needs a quarter
_CLASSES = (  # of nuPlan and NumPy: what is read, and what holds it
    *("Agent", "CarFootprint", "DetectionsTracks", "DynamicCarState", "EgoState", "IDMPlanner"),
    *("InterpolatedTrajectory", "LogFuturePlanner", "NuPlanScenario", "OrientedBox"),
    *("SceneObjectMetadata", "ScenarioExtractionInfo", "SimplePlanner", "SimulationHistory"),
    *("SimulationHistorySample", "SimulationIteration", "SimulationLog", "StateSE2"),
    *("StateVector2D", "StaticObject", "TimePoint", "TrackedObjects"),
    *("TrackedObjectType", "TrafficLightStatusData", "TrafficLightStatusType"),
    *("VehicleParameters", "scalar", "_frombuffer", "dtype"),
)
_NUMBERS = {"f8": "<d", "f4": "<f", "i8": "<q", "i4": "<i", "b1": "<?"}  # of NumPy, for `struct`
_POSE = ("x", "y", "heading")
_MOTION = "_dynamic_car_state"
_FOOTPRINT = "_car_footprint"
_EGO = {  # columns of an `EgoState` but for the pose of its rear axle
    "ego_time_us": "_time_point.time_us",
    **{f"center_{name}": f"{_FOOTPRINT}._center.{name}" for name in _POSE},
    **{f"v{name}": f"{_MOTION}._rear_axle_velocity_2d._{name}" for name in "xy"},
    **{f"a{name}": f"{_MOTION}._rear_axle_acceleration_2d._{name}" for name in "xy"},
    "tire_steering_angle": "_tire_steering_angle",
    "tire_steering_rate": f"{_MOTION}._tire_steering_rate",
    "angular_velocity": f"{_MOTION}._angular_velocity",
    "angular_acceleration": f"{_MOTION}._angular_acceleration",
    "rear_axle_to_center": f"{_MOTION}._rear_axle_to_center_dist",
    **{name: f"{_FOOTPRINT}._{name}" for name in ("length", "width", "height")},
}
_OBJECT = {
    "track_token": "_metadata.track_token",
    "time_us": "_metadata.timestamp_us",
    **{name: f"_box._center.{name}" for name in _POSE},
    **{name: f"_box._{name}" for name in ("length", "width", "height")},
}
_SAMPLE = {"iteration": "iteration.index", "time_us": "iteration.time_point.time_us"}
_LIGHT = {"lane_connector_id": "lane_connector_id", "timestamp": "timestamp"}
_BROKEN = (  # what reading a damaged log raises
    *(ArithmeticError, LookupError, RuntimeError, TypeError, ValueError, OSError, EOFError),
    *(MemoryError, pickle.UnpicklingError, lzma.LZMAError, StructError),
)
_CUT = ("scenario_duration", "extraction_offset", "subsample_ratio")


class _Record:
    """An object in a log, with the attributes that the log gives it."""

    def __new__(cls, *arguments: Any, **_: Any) -> "_Record":
        record = super().__new__(cls)
        record.arguments = arguments  # where it is made by a call
        return record

    arguments: tuple[Any, ...]

    def _ignore(self, *_: Any) -> None:
        """Members of containers that are not read, and states of NumPy's types."""

    append = extend = add = __setitem__ = _ignore


class _LogReader(pickle.Unpickler):
    """Makes a record of every object; `left_out` names the classes that are not known here."""

    def __init__(self, content: bytes) -> None:
        for operation, argument, _ in genops(content):
            # a reader of pickles allocates memory for all objects up to a number
            if operation.name in ("PUT", "LONG_BINPUT") and int(argument or 0) > len(content):
                raise ValueError(f"object number {argument} in a pickle of {len(content)} bytes")
        super().__init__(BytesIO(content), encoding="utf-8")
        self.left_out: set[str] = set()
        self._classes: dict[tuple[str, str], Any] = {}

    def find_class(self, module: str, name: str) -> Any:
        """A class of records for a name in the log."""
        is_known = name in _CLASSES and module.partition(".")[0] in ("nuplan", "numpy")
        if not is_known:
            self.left_out.add(f"{module}.{name}")
        state = {"__setstate__": _Record._ignore} if not is_known or name == "dtype" else {}
        return self._classes.setdefault((module, name), type(name, (_Record,), state))


def _values(records: Sequence[Any], path: str) -> list[Any]:
    """An attribute, or one of an attribute (`a.b`), of every record; numbers as plain ones."""
    found = map(attrgetter(path), records)
    return [_plain(one) if isinstance(one, _Record) else one for one in found]


def _plain(value: Any) -> Any:
    """A number of NumPy as a plain one, everything else as it is."""
    if type(value).__name__ != "scalar":
        return value
    kind, raw = value.arguments
    return unpack(_NUMBERS[kind.arguments[0]], raw)[0]


@dataclass(frozen=True)
class Recorded:
    """What a simulation log says of K samples."""

    facts: dict[str, Any]  # of the scenario, and the vehicle's dimensions
    ego: Source  # a row per sample: state, centre, size
    objects: Source  # a row per sample and object
    lights: Source  # a row per sample and listed connector
    plans: Source | None  # a row per sample and state of the plan; None where it is left out
    seconds: Any  # what the planner took at every sample [s]; None where it is left out
    is_exported: bool  # whether it is a rollout of shiftsim, whose plans are kept in part
    left_out: frozenset[str]  # names of the classes whose objects were left out
    dropped_us: int | None  # iteration time of a last sample whose ego has the time before [us]


def find_simulation_logs(folder: Path) -> dict[tuple[str, str], Path]:
    """The logs in a result folder by token and planner, or a MissingExtraError."""
    root = folder / "simulation_log"
    found = {
        (path.name.partition(".")[0], path.relative_to(root).parts[0]): path
        for path in sorted(root.glob("**/*.xz"))
    }
    _require_msgpack(found.values())
    return found


def _require_msgpack(files: Iterable[Path]) -> None:
    if any(_PACKED in path.suffixes for path in files) and not find_spec("msgpack"):
        what = "simulation logs of nuPlan need msgpack"
        raise MissingExtraError(what, hint="pip install 'shiftsim[nuplan]'")


def log_source(path: Path) -> Rollouts | None:
    """The rollouts of a log, or of all logs in a folder; None where there is none."""
    files = sorted(path.rglob("*.xz")) if path.is_dir() else [path] * (path.suffix == ".xz")
    if not files:
        return None
    _require_msgpack(files)
    entries = [Entry(Task(*_names(file)), partial(_driven, file)) for file in files]
    entries.sort(key=lambda entry: (entry.task.token, entry.task))
    return Rollouts(path.name, tuple(files), tuple(entries), True, is_whole=False)


def _names(file: Path) -> tuple[str, str, int, str]:
    """Planner, noise, seed and scenario of a log, by the names of its folders and its own."""
    folders = file.resolve().parts[:-1]
    planner = folders[-1]
    if "simulation_log" in folders[:-1]:
        planner = folders[folders.index("simulation_log") + 1]
    return planner, "none", 0, file.name.partition(".")[0]


def _driven(path: Path) -> Driven:
    """What a log says of a rollout, and what its reader must know."""
    recorded = read_simulation_log(path, Report())
    ego, plans, count = read_ego(recorded.ego), recorded.plans, recorded.ego.num_rows
    words = [origin("NR", recorded.ego, plans).replace("other", "driven by another controller")]
    if plans is not None:
        steps = np.diff(plans["time_us"].astype(np.int64))
        steps = steps[np.diff(plans["iteration"]) == 0] * 1e-6
        words.append(f"plans every {np.median(steps):.2g} s" if len(steps) else "no plans")
    if recorded.dropped_us:
        words.append("the last sample repeats a time and is dropped")
    remarks = (f"simulation log: {', '.join(words)}",)
    times = recorded.ego["time_us"].astype(np.int64)
    boxes, rows = partial(Boxes, times, tracks_of(recorded.objects, count)), np.arange(count)
    return Driven(path.name, times, ego, rows, boxes, {}, remarks, is_simulated=True)


def read_simulation_log(path: Path, report: Report) -> Recorded:
    """Read one log; a DataError if it is damaged, or not as the known devkit writes it."""
    try:
        reader = _LogReader(_unpacked(path))
        return _recorded(reader.load(), report, frozenset(reader.left_out))
    except AttributeError as error:
        raise DataError(f"{path}: {error}", OTHER_VERSION) from error
    except _BROKEN as error:
        raise DataError(f"{path}: not a readable simulation log ({error})", DAMAGED) from error


def _unpacked(path: Path) -> bytes:
    unpacker = lzma.LZMADecompressor(memlimit=_MAX_MEMORY)
    content: Any = unpacker.decompress(path.read_bytes(), _MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise ValueError(f"it holds more than {_MAX_BYTES} bytes")
    if not unpacker.eof:
        raise ValueError("its end is missing")
    if _PACKED in path.suffixes:
        import msgpack

        content = msgpack.unpackb(content, max_bin_len=_MAX_BYTES)
    if not isinstance(content, bytes):
        raise ValueError(f"it holds a {type(content).__name__}, not a pickle")
    return content


def _recorded(log: Any, report: Report, left_out: frozenset[str]) -> Recorded:
    scenario, history = log.scenario.arguments, log.simulation_history
    goal, cut, samples = history.mission_goal, scenario[8], history.data
    times = _values(samples[-2:], "ego_state._time_point.time_us")
    dropped_us = None
    if len(times) > len(set(times)):
        *samples, last = samples
        dropped_us = last.iteration.time_point.time_us
    egos = _egos(_values(samples, "ego_state")) | _columns(samples, _SAMPLE)
    return Recorded(
        facts={
            "token": scenario[2],
            "scenario_type": scenario[4],
            "map": scenario[7],
            "mapping": [getattr(cut, name) for name in _CUT],
            "goal": None if goal is None else [_plain(getattr(goal, name)) for name in _POSE],
            "vehicle": scenario[9].arguments,
        },
        ego=Source("ego", "column", egos, report),
        objects=Source("objects", "column", _objects(samples), report),
        lights=Source("lights", "column", _lights(samples), report),
        plans=_plans(_values(samples, "trajectory"), report),
        seconds=getattr(log.planner, "_compute_trajectory_runtimes", None),
        is_exported=hasattr(log.planner, "shiftsim"),
        left_out=left_out,
        dropped_us=dropped_us,
    )


def _columns(records: Sequence[Any], paths: Mapping[str, str]) -> dict[str, Any]:
    return {name: np.array(_values(records, path)) for name, path in paths.items()}


def _egos(states: Sequence[Any]) -> dict[str, Any]:
    """Columns of ego states; what the devkit computes when it is asked for is there in any case."""
    found = _columns(states, _EGO)
    for name in ("velocity", "acceleration"):
        _agreeing(_values(states, f"{_MOTION}._rear_axle_{name}_2d"))
    rear = rear_poses(np.column_stack([found[name] for name in CENTER_COLUMNS]))
    found["speed"] = np.hypot(found["vx"], found["vy"])
    found["acceleration"] = np.hypot(found["ax"], found["ay"])
    for row, state in enumerate(states):  # what somebody asked for is kept
        footprint, motion = vars(state._car_footprint), vars(state._dynamic_car_state)
        if "rear_axle" in footprint:
            rear[row] = [_plain(getattr(footprint["rear_axle"], name)) for name in _POSE]
        for name in ("speed", "acceleration"):
            if name in motion:
                found[name][row] = _plain(motion[name])
    return found | dict(zip(_POSE, rear.T, strict=True))


def _objects(samples: Sequence[Any]) -> dict[str, Any]:
    iteration, flat = _flat(samples, "observation.tracked_objects.tracked_objects")
    # agents have another name for it than what stands
    moves = _agreeing(vars(one).get("_velocity") or one.velocity for one in flat)
    kinds = [AgentKind(one._tracked_object_type.arguments[0]).name for one in flat]
    columns = {**_columns(moves, {"vx": "_x", "vy": "_y"}), **_columns(flat, _OBJECT)}
    return {"iteration": iteration, "type": np.array(kinds), **columns}


def _lights(samples: Sequence[Any]) -> dict[str, Any]:
    iteration, flat = _flat(samples, "traffic_light_status")
    status = [LightStatus(one.status.arguments[0]).name for one in flat]
    return {"iteration": iteration, "status": np.array(status), **_columns(flat, _LIGHT)}


def _agreeing(vectors: Iterable[Any]) -> list[Any]:
    """Vectors, each of which is in a log twice."""
    out = list(vectors)
    for one, x, y in zip(out, _values(out, "_x"), _values(out, "_y"), strict=True):
        if isinstance(one._array, _Record) and one._array.arguments[0] != pack("<2d", x, y):
            raise ValueError(f"a vector has two values, one of which is ({x}, {y})")
    return out


def _flat(samples: Sequence[Any], path: str) -> tuple[IntArray, list[Any]]:
    """The members of lists that samples hold, and the sample of each."""
    lists = _values(samples, path)
    counts = [len(one) for one in lists]
    return np.repeat(np.arange(len(lists)), counts), [one for members in lists for one in members]


def _plans(trajectories: Sequence[Any], report: Report) -> Source | None:
    if {type(one).__name__ for one in trajectories} != {"InterpolatedTrajectory"}:
        return None
    plans = [one.arguments[0] for one in trajectories]
    states = [state for plan in plans for state in plan]
    if {type(state).__name__ for state in states} != {"EgoState"}:
        return None
    columns, counts = _egos(states), [len(plan) for plan in plans]
    columns["iteration"] = np.repeat(np.arange(len(plans)), counts)
    columns["index"] = np.concatenate([np.arange(count) for count in counts])
    columns["time_us"] = columns.pop("ego_time_us")
    return Source("plan", "column", columns, report)
