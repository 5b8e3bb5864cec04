"""Simulation logs as nuPlan's devkit writes them, without the devkit.

A log is a pickle of the devkit's objects: for every sample the ego, the plan, the boxes and the
lights. Objects of one class differ in their numbers only, so one of them is pickled with cells in
place of its numbers, and its bytes are repeated for arrays of numbers.
"""

import lzma
from collections.abc import Iterable, Mapping
from itertools import chain, islice
from pathlib import Path
from struct import pack
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from shiftsim._version import __version__
from shiftsim.data.nuplan.export_log import HEIGHTS, connector_number
from shiftsim.files import atomic_write
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.runs.rollouts import Task
from shiftsim.sim.dynamics.perfect import KEPT_US
from shiftsim.sim.log import SimulationLog
from shiftsim.world import state
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, AgentKind, LightStatus

MAP_VERSION = "nuplan-maps-v1.0"
_COG = 1.67  # m, rear axle to centre of gravity, which nothing here depends on
_ACTOR, _SIMULATION = "nuplan.common.actor_state", "nuplan.planning.simulation"
_SCENARIO, _MAPS = "nuplan.planning.scenario_builder.nuplan_db", "nuplan.common.maps"
_CLASSES = {  # and functions, by module
    f"{_ACTOR}.agent": "Agent",
    f"{_ACTOR}.car_footprint": "CarFootprint",
    f"{_ACTOR}.dynamic_car_state": "DynamicCarState",
    f"{_ACTOR}.ego_state": "EgoState",
    f"{_ACTOR}.oriented_box": "OrientedBox",
    f"{_ACTOR}.scene_object": "SceneObjectMetadata",
    f"{_ACTOR}.state_representation": "StateSE2 StateVector2D TimePoint",
    f"{_ACTOR}.static_object": "StaticObject",
    f"{_ACTOR}.tracked_objects": "TrackedObjects",
    f"{_ACTOR}.tracked_objects_types": "TrackedObjectType",
    f"{_ACTOR}.vehicle_parameters": "VehicleParameters",
    f"{_MAPS}.maps_datatypes": "TrafficLightStatusData TrafficLightStatusType",
    f"{_MAPS}.nuplan_map.nuplan_map": "NuPlanMap",
    "nuplan.database.maps_db.gpkg_mapsdb": "GPKGMapsDB",
    f"{_SCENARIO}.nuplan_scenario": "NuPlanScenario",
    f"{_SCENARIO}.nuplan_scenario_utils": "ScenarioExtractionInfo",
    f"{_SIMULATION}.history.simulation_history": "SimulationHistory SimulationHistorySample",
    f"{_SIMULATION}.observation.observation_type": "DetectionsTracks",
    f"{_SIMULATION}.planner.simple_planner": "SimplePlanner",
    f"{_SIMULATION}.simulation_log": "SimulationLog",
    f"{_SIMULATION}.simulation_time_controller.simulation_iteration": "SimulationIteration",
    f"{_SIMULATION}.trajectory.interpolated_trajectory": "InterpolatedTrajectory",
    "pathlib": "PosixPath",
    "numpy.core.numeric": "_frombuffer",  # its place in NumPy 1, which the devkit needs
    "numpy": "dtype",
    "functools": "partial",
    "builtins": "str",
}
_MODULES = {name: module for module, names in _CLASSES.items() for name in names.split()}


class _Made(NamedTuple):
    """An object: by a call of its class or function, by its attributes, or both."""

    kind: str
    attributes: Any = None
    arguments: tuple[Any, ...] = ()
    has_slots: bool = False


class _Known(NamedTuple):
    """Something that the pickle holds already."""

    number: int


class _Cell(NamedTuple):
    """A number from a column of an array."""

    column: str
    opcode: bytes = b"G"
    dtype: str = ">f8"


class _Buffer(NamedTuple):
    """The bytes of two numbers."""

    x: _Cell
    y: _Cell


_Form: TypeAlias = tuple[bytes, list[tuple[int, _Cell]]]  # a coded value, and where its cells are


class _Pickle:
    """Codes values with the opcodes of protocol 5; bytes are values that are coded already."""

    def __init__(self) -> None:
        self._head = bytearray(b"\x80\x05")  # protocol, then what occurs often
        self._indices: dict[object, int] = {}

    def dump(self, value: Any) -> bytes:
        """The finished pickle."""
        body = self._form(value)[0]
        return bytes(self._head + body + b".")

    def rows(self, value: Any, columns: Mapping[str, Any]) -> list[bytes]:
        """The bytes of R values that differ in their cells, whose columns are (R,)."""
        code, cells = self._form(value)
        count = len(next(iter(columns.values())))
        rows = np.tile(np.frombuffer(code, np.uint8), (count, 1))
        for start, cell in cells:
            numbers = np.asarray(columns[cell.column]).astype(cell.dtype)
            size = numbers.itemsize
            rows[:, start : start + size] = numbers.view(np.uint8).reshape(count, size)
        return [row.tobytes() for row in rows]

    def known(self, key: object, value: Any) -> _Known:
        """Something that occurs often; `key` tells it from others, and from texts."""
        if key not in self._indices:
            code = self._form(value)[0]
            self._head += code + b"\x940"  # memoize, pop
            self._indices[key] = len(self._indices)
        return _Known(self._indices[key])

    def text(self, text: str) -> _Known:
        """A text, which is held once."""
        code = text.encode()
        return self.known(text, b"X" + pack("<I", len(code)) + code)

    def named(self, kind: str) -> _Known:
        """A class or function."""
        return self.known((kind,), self._join(b"", (_MODULES[kind], kind), b"\x93")[0])

    def _form(self, value: Any) -> _Form:
        match value:
            case bytes():
                return value, []
            case None:
                return b"N", []
            case bool():
                return b"\x88" if value else b"\x89", []
            case int():
                return b"\x8a\x08" + pack("<q", value), []
            case float():
                return b"G" + pack(">d", value), []
            case str():
                return self._form(self.text(value))
            case _Known(number):
                return b"j" + pack("<I", number), []
            case _Cell(_, opcode, dtype):
                return opcode + bytes(np.dtype(dtype).itemsize), [(len(opcode), value)]
            case _Buffer():
                raw = (cell._replace(opcode=b"", dtype="<f8") for cell in value)
                return self._join(b"\x96" + pack("<Q", 16), raw, b"")
            case _Made(kind, attributes, arguments, has_slots):
                parts = [self.named(kind), *([arguments, b"R"] if arguments else [b")\x81"])]
                if attributes is not None:
                    parts += [b"N", attributes, b"\x86b"] if has_slots else [attributes, b"b"]
                return self._join(b"", parts, b"")
            case list():
                return self._join(b"](", value, b"e")
            case tuple():
                return self._join(b"(", value, b"t")
            case dict():
                return self._join(b"}(", chain.from_iterable(value.items()), b"u")
        raise TypeError(f"no code for {type(value).__name__}")

    def _join(self, before: bytes, values: Iterable[Any], after: bytes) -> _Form:
        out, cells = bytearray(before), list[tuple[int, _Cell]]()
        for code, inner in map(self._form, values):
            cells += [(len(out) + start, cell) for start, cell in inner]
            out += code
        return bytes(out + after), cells


def _integer(column: str) -> _Cell:
    return _Cell(column, b"\x8a\x08", "<i8")


def _index(column: str) -> _Cell:
    """Things that the pickle holds already."""
    return _Cell(column, b"j", "<u4")


def _pose(x: Any, y: Any, heading: Any) -> _Made:
    return _Made("StateSE2", {"heading": heading, "x": x, "y": y}, has_slots=True)


def _cells(*columns: str) -> Iterable[_Cell]:
    return map(_Cell, columns)


_CLOCK = _Made("TimePoint", {"time_us": _integer("time_us")}, has_slots=True)
_BOX = {name: _Cell(name.strip("_")) for name in ("_length", "_width", "_height")}
_CENTER = {"_center": _pose(*_cells("center_x", "center_y", "center_heading"))}


def write_simulation_log(
    path: Path, task: Task, scenario: Scenario, log: SimulationLog, *, database: Path, maps: Path
) -> None:
    """Write a rollout as a simulation log, packed with msgpack and xz.

    Velocities of plans are derived from their poses. The planner is a stand-in: it has the name and
    the run times, and `shiftsim` says what was run.

    Args:
        path: File to write.
        task: What was run.
        scenario: The scenario.
        log: The rollout.
        database: The recording (.db), where nuPlan's tools look for the rest of the scenario.
        maps: Folder where they look for the map.

    Raises:
        ConversionError: A light belongs to a connector without an integer id.
    """
    writer = _LogWriter(scenario, log)
    planner = {
        "_compute_trajectory_runtimes": log.planning_seconds.tolist(),
        "name": _Made("partial", None, (writer.pickle.named("str"), task.planner)),
        "shiftsim": {"version": __version__, **task._asdict()},
    }
    parts = {
        "file_path": _Made("PosixPath", None, path.absolute().parts),
        "scenario": writer.scenario_of(database, maps),
        "planner": _Made("SimplePlanner", planner),
        "simulation_history": _Made("SimulationHistory", writer.history(maps)),
    }
    data = writer.pickle.dump(_Made("SimulationLog", parts))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_bytes(lzma.compress(b"\xc6" + pack(">I", len(data)) + data, preset=0))


class _LogWriter:
    """The parts of the log of one rollout, K samples."""

    def __init__(self, scenario: Scenario, log: SimulationLog) -> None:
        self.scenario, self.log, self.pickle = scenario, log, _Pickle()
        sizes = (PACIFICA.width, PACIFICA.front_length, PACIFICA.rear_length, _COG)
        about = (*sizes, PACIFICA.wheel_base, "pacifica", "gen1", PACIFICA.height)
        self._vehicle = self.pickle.known(
            ("pacifica", "gen1"), _Made("VehicleParameters", None, about)
        )
        order = (3, "<", None, None, None, -1, -1, 0)
        self._float64 = self.pickle.known(
            ("dtype", "f8"), _Made("dtype", order, ("f8", False, True))
        )

    def scenario_of(self, database: Path, maps: Path) -> _Made:
        """The scenario, which finds the rest of itself in the recording."""
        scenario, kind = self.scenario, self.scenario.scenario_type
        duration, offset, ratio = map(float, scenario.mapping)
        # the token is that of the last row from which the offset leads to iteration 0
        start = int(scenario.iteration_times[0]) - round(offset * 1e6)
        row = max(0, int(np.searchsorted(scenario.time_us, start, "right")) - 1)
        info = {"scenario_name": kind, "scenario_duration": duration}
        info |= {"extraction_offset": offset, "subsample_ratio": ratio}
        at = (scenario.token, int(scenario.time_us[row]), kind)
        road = (str(maps), MAP_VERSION, scenario.city)
        cut = _Made("ScenarioExtractionInfo", info)
        arguments = (str(database.parent), str(database), *at, *road, cut, self._vehicle, None)
        return _Made("NuPlanScenario", None, arguments)

    def history(self, maps: Path) -> dict[str, Any]:
        """Map, goal and samples."""
        log, goal, pickle = self.log, self.scenario.mission_goal, self.pickle
        plan_times, plan_states, lengths = _planned(log)
        plans = _grouped(self._egos(plan_times, plan_states), lengths)
        egos, clock = (
            self._egos(log.time_us, log.ego),
            pickle.rows(_CLOCK, {"time_us": log.time_us}),
        )
        parts = zip(clock, egos, plans, self._boxes(), self._lights(), strict=True)
        samples = []
        for index, (time, ego, plan, boxes, lights) in enumerate(parts):
            now = {"time_point": time, "index": index}
            tracked = _Made("TrackedObjects", {"tracked_objects": boxes})
            sample = {
                "iteration": _Made("SimulationIteration", now),
                "ego_state": ego,
                "trajectory": _Made("InterpolatedTrajectory", None, (plan,)),
                "observation": _Made("DetectionsTracks", {"tracked_objects": tracked}),
                "traffic_light_status": lights,
            }
            samples.append(_Made("SimulationHistorySample", sample))
        database = _Made("GPKGMapsDB", None, (MAP_VERSION, str(maps)))
        return {
            "map_api": _Made("NuPlanMap", None, (database, self.scenario.city)),
            "mission_goal": None if goal is None else _pose(*goal.tolist()),
            "data": samples,
        }

    def _vector(self, *columns: str) -> _Made:
        """A vector, which holds its numbers twice."""
        x, y = _cells(*columns)
        array = _Made("_frombuffer", None, (_Buffer(x, y), self._float64, (2,), "C"))
        return _Made("StateVector2D", {"_x": x, "_y": y, "_array": array}, has_slots=True)

    def _egos(self, time_us: IntArray, states: FloatArray) -> list[bytes]:
        """Ego states (R, 11) at times (R,) [us]."""
        poses = np.concatenate([states, state.center_poses(states[:, :3])], axis=1)
        names = (*state.STATE_COLUMNS, "center_x", "center_y", "center_heading")
        columns = {"time_us": time_us, **dict(zip(names, poses.T, strict=True))}
        sizes = (PACIFICA.length, PACIFICA.width, PACIFICA.height)
        footprint = {
            **_CENTER,
            **dict(zip(_BOX, sizes, strict=True)),
            "_vehicle_parameters": self._vehicle,
            "rear_axle": _pose(*_cells("x", "y", "heading")),
        }
        motion = {
            "_rear_axle_to_center_dist": PACIFICA.rear_axle_to_center,
            "_angular_velocity": _Cell("yaw_rate"),
            "_angular_acceleration": _Cell("yaw_accel"),
            "_rear_axle_velocity_2d": self._vector("vx", "vy"),
            "_rear_axle_acceleration_2d": self._vector("ax", "ay"),
            "_tire_steering_rate": _Cell("steering_rate"),
        }
        ego = {
            "_car_footprint": _Made("CarFootprint", footprint),
            "_tire_steering_angle": _Cell("steering_angle"),
            "_is_in_auto_mode": True,
            "_time_point": _CLOCK,
            "_dynamic_car_state": _Made("DynamicCarState", motion),
        }
        return self.pickle.rows(_Made("EgoState", ego), columns)

    def _boxes(self) -> list[list[bytes]]:
        """Agents and static objects of every sample."""
        tracks, pickle = self.log.tracks, self.pickle
        row, track = np.nonzero(tracks.valid)
        kinds = tracks.kinds[track]
        name = "TrackedObjectType"
        types = [pickle.known((name, k), _Made(name, None, (int(k),))) for k in AgentKind]
        names = [pickle.text(kind.name.lower()) for kind in AgentKind]
        tokens = [pickle.text(token) for token in tracks.tokens]
        numbers = [tracks.poses, tracks.sizes, np.nan_to_num(tracks.velocities)]
        values = np.concatenate([of[row, track] for of in numbers], axis=1).T
        words = ("center_x", "center_y", "center_heading", "length", "width", "vx", "vy")
        columns = {
            **dict(zip(words, values, strict=True)),
            "height": np.array([HEIGHTS[kind] for kind in AgentKind])[kinds],
            "time_us": self.log.time_us[row],
            "track": track,
            "token": np.array([one.number for one in tokens], np.int64)[track],
            "type": np.array([one.number for one in types])[kinds],
            "category": np.array([one.number for one in names])[kinds],
        }
        about = {
            "timestamp_us": _integer("time_us"),
            "token": _index("token"),
            "track_id": _integer("track"),
            "track_token": _index("token"),
            "category_name": _index("category"),
        }
        thing = {
            "_metadata": _Made("SceneObjectMetadata", about),
            "instance_token": None,
            "_tracked_object_type": _index("type"),
            "_box": _Made("OrientedBox", {**_CENTER, **_BOX}),
        }
        agent: dict[str, Any] = {
            "_initial_time_stamp": _CLOCK,
            "_predictions": [],
            "_past_trajectory": None,
        }
        motion = {"_velocity": self._vector("vx", "vy"), "_angular_velocity": np.nan}
        still = {"predictions": None, "past_trajectory": None, "velocity": motion["_velocity"]}
        moves = kinds <= state.LAST_AGENT_KIND
        agents, others = (
            iter(pickle.rows(made, {name: column[chosen] for name, column in columns.items()}))
            for made, chosen in (
                (_Made("Agent", agent | thing | motion), moves),
                (_Made("StaticObject", thing | still), ~moves),
            )
        )
        boxes = [next(agents if one else others) for one in moves.tolist()]
        return _grouped(boxes, tracks.valid.sum(axis=1))

    def _lights(self) -> list[list[bytes]]:
        """Lights of every sample that are listed."""
        lights, pickle = self.log.traffic_lights, self.pickle
        is_listed = lights.status != LightStatus.ABSENT
        row, connector = np.nonzero(is_listed)
        kind = "TrafficLightStatusType"
        codes = [pickle.known((kind, k), _Made(kind, None, (k,))).number for k in range(4)]
        numbers = [connector_number(self.scenario, name) for name in lights.connector_ids]
        columns = {
            "status": np.array(codes)[lights.status[row, connector]],
            "connector": np.array(numbers, np.int64)[connector],
            "time_us": self.log.time_us[row],
        }
        light = {
            "status": _index("status"),
            "lane_connector_id": _integer("connector"),
            "timestamp": _integer("time_us"),
        }
        listed = pickle.rows(_Made("TrafficLightStatusData", light), columns)
        return _grouped(listed, is_listed.sum(axis=1))


def _grouped(pieces: list[bytes], lengths: IntArray) -> list[list[bytes]]:
    """The pieces in lists of these lengths."""
    left = iter(pieces)
    return [list(islice(left, length)) for length in lengths.tolist()]


def _planned(log: SimulationLog) -> tuple[IntArray, FloatArray, IntArray]:
    """Times and ego states of all plans one after the other, and the length of each.

    A plan begins with the state of the ego. Where there is none, the ego stands.
    """
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
