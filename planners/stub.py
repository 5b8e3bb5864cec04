"""The other end of `--isolate`: serves one planner in a process of its own.

This file runs by itself, with NumPy and Python 3.9 or newer. A message is a tree of plain values as
JSON, and then the bytes of its arrays; nothing that comes can name code.
"""

import sys

if __name__ == "__main__":
    sys.path[:1] = []  # the folder of this file: its neighbours are no modules of the planner's

import ctypes
import dataclasses
import hashlib
import importlib
import importlib.machinery
import json
import os
import signal
import socket
import traceback
import types
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

_KINDS = "biuf"  # of arrays that can be sent
LONGEST = 2**30  # bytes of a part of a message
_ALONE = "in an interpreter of the planner's own (with --isolate alone it runs in that of shiftsim)"


def write(connection: Any, value: Any) -> None:
    """Send a value; what cannot be sent arrives as an empty object of a class of that name."""
    arrays: Any = []
    connection.send_bytes(json.dumps(_pack(value, arrays)).encode())
    for array in arrays:
        connection.send_bytes(array.tobytes())


def read(connection: Any, classes: Any) -> Any:
    """What was sent; `classes` makes records, by name."""
    return _unpack(json.loads(connection.recv_bytes(LONGEST)), connection, classes)


def _pack(value: Any, arrays: Any) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item() if value.dtype.kind in _KINDS else {"?": type(value).__name__}
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in _KINDS:
            return {"?": "ndarray"}
        arrays.append(value)
        return {"@": [value.dtype.str, list(value.shape)]}
    if isinstance(value, dict):
        return {"%": [[_pack(k, arrays), _pack(v, arrays)] for k, v in value.items()]}
    names: Any = getattr(type(value), "_fields", ())
    if dataclasses.is_dataclass(value):
        names = [item.name for item in dataclasses.fields(value) if item.init]
    if names:
        parts = [_pack(getattr(value, name), arrays) for name in names]
        return {"!": [type(value).__name__, list(names), parts]}
    if isinstance(value, (list, tuple)):
        return [_pack(item, arrays) for item in value]
    return {"?": type(value).__name__}


def _unpack(tree: Any, connection: Any, classes: Any) -> Any:
    if isinstance(tree, list):
        return tuple(_unpack(item, connection, classes) for item in tree)
    if not isinstance(tree, dict):
        return tree
    ((sign, content),) = tree.items()
    if sign == "@":
        kind, shape = np.dtype(content[0]), tuple(content[1])
        if kind.kind not in _KINDS:
            raise ValueError("an array of " + content[0])
        return np.ndarray(shape, kind, connection.recv_bytes(LONGEST))  # read-only, as bytes are
    if sign == "%":
        pairs = [[_unpack(item, connection, classes) for item in pair] for pair in content]
        return dict(pairs)
    if sign == "?":
        return type(content, (), {})()
    name, names, parts = content
    values = [_unpack(part, connection, classes) for part in parts]
    return classes.get(name, Record)(**dict(zip(names, values)))  # noqa: B905


class Record:
    """Named values."""

    def __getattr__(self, name: str) -> Any:
        there = ", ".join(self.__dict__)
        raise AttributeError(f"there is no {name!r} {_ALONE}; there are: {there}")

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)


class _Lists(Record):
    def at(self, index: int) -> Any:
        values = self.xy if hasattr(self, "xy") else self.items
        return values[self.ptr[index] : self.ptr[index + 1]]


class _Ego:
    def __init__(self, time_us: int, values: Any) -> None:
        self.time_us, self.values = time_us, values
        self.pose, self.velocity, self.acceleration = values[:3], values[3:5], values[5:7]
        self.speed, self.steering_angle = float(np.hypot(*values[3:5])), float(values[7])


class _Observation(Record):
    @property
    def ego(self) -> Any:
        return _Ego(self.time_us, self.history.ego[-1])

    @property
    def tracks(self) -> Any:
        past = self.history.tracks
        parts = {n: getattr(past, n)[-1:] for n in ("valid", "poses", "velocities", "sizes")}
        return Record(kinds=past.kinds, tokens=past.tokens, **parts)

    @property
    def traffic_lights(self) -> Any:
        pairs = zip(self.lights.connector_ids, self.lights.status[0].tolist())  # noqa: B905
        return {name: status for name, status in pairs if status != -1}


@dataclasses.dataclass(frozen=True)
class Command:
    """As `shiftsim.Command`."""

    acceleration: float
    steering_rate: float


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """As `shiftsim.Trajectory`."""

    time_us: Any
    states: Any
    relative: bool = False

    @staticmethod
    def from_poses(times: Any, poses: Any) -> Any:
        """As that of shiftsim."""
        seconds, pose = np.asarray(times, np.float64), np.asarray(poses, np.float64)
        if seconds.ndim != 1 or pose.shape != (len(seconds), 3):
            raise ValueError(f"need times (H,) and poses (H, 3), got {seconds.shape}, {pose.shape}")
        states = np.zeros((len(seconds), 11))
        states[:, :3] = pose
        if len(seconds) > 1:
            step = np.diff(pose[:, :2], axis=0) / np.diff(seconds)[:, None]
            forward = step[:, 0] * np.cos(pose[:-1, 2]) + step[:, 1] * np.sin(pose[:-1, 2])
            states[:-1, 3] = forward
            states[-1, 3] = forward[-1]
        return Trajectory(np.rint(seconds * 1e6).astype(np.int64), states, True)


class _Folder:
    """Finds the planner's module in a folder, and for what it found there the neighbours."""

    def __init__(self, folder: str, name: str) -> None:
        self.folder, self.name = folder, name.partition(".")[0]
        self.found: Any = set()

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        if name.startswith("shiftsim."):
            raise ModuleNotFoundError(f"there is no module {name!r} {_ALONE}", name=name)
        frame: Any = sys._getframe(1)
        while frame and frame.f_globals.get("__name__", "").startswith("importlib."):
            frame = frame.f_back
        importer = frame and frame.f_globals.get("__name__", "").partition(".")[0]
        if path is None and (name == self.name or importer in self.found):
            spec = importlib.machinery.PathFinder.find_spec(name, [self.folder], target)
            if spec:
                self.found.add(name)
            return spec
        return None


def _alone(hello: Any) -> Any:
    """What makes planners, the classes of records, and the fingerprint, without shiftsim."""
    ours: Any = types.ModuleType("shiftsim")
    ours.Trajectory, ours.Command, ours.__path__ = Trajectory, Command, []
    ours.__getattr__ = Record(Trajectory=Trajectory, Command=Command).__getattr__
    sys.modules["shiftsim"] = ours
    module_name, _, name = hello["spec"].rpartition(":")
    folder, file = os.path.split(module_name) if module_name.endswith(".py") else ("", module_name)
    sys.meta_path.append(_Folder(os.path.abspath(folder), file.removesuffix(".py")))
    module: Any = importlib.import_module(file.removesuffix(".py"))
    kind = getattr(module, name)
    with open(module.__file__, "rb") as file:
        digest = hashlib.sha256(file.read()).hexdigest()
    about = {"planner": hello["spec"], "target": hello["spec"], "source": digest}
    about["arguments"] = dict(sorted(hello["arguments"].items()))
    classes = {"Observation": _Observation, "Lists": _Lists, "Polylines": _Lists}
    return (lambda: kind(**hello["arguments"])), classes, about


def _close(planner: Any) -> None:
    if callable(getattr(planner, "close", None)):
        planner.close()


def _main() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))  # PR_SET_PDEATHSIG: end with the parent
        if os.getppid() != int(sys.argv[1]):
            return
    handle = int(sys.argv[2])
    if sys.platform == "win32":
        handle = socket.fromshare(sys.stdin.buffer.read()).detach()
    connection: Any = Connection(handle)
    os.dup2(2, 1)  # what the planner prints is not the output of the command
    make: Any = None
    classes = planner = road = number = make
    while True:
        try:
            number, verb, value = read(connection, classes or {})
        except EOFError:
            return _close(planner)
        try:
            answer = None
            if verb == "make":
                if value["path"]:
                    sys.path[:] = value["path"]
                    host = importlib.import_module("shiftsim.planners.isolated")
                    make, classes, answer = host.at_home(value)
                else:
                    make, classes, answer = _alone(value)
                planner = make()
                for name in ("reset", "plan"):
                    if not callable(getattr(planner, name, None)):
                        raise TypeError(f"{type(planner).__name__} has no method {name}()")
                recording = getattr(planner, "sees_recording", False) is True
                own_name = getattr(planner, "name", "")
                answer = (answer, recording, own_name if isinstance(own_name, str) else "")
            elif verb == "map":
                road = value
            elif verb == "reset":
                object.__setattr__(value, "map", road)
                if value.expert is not None:
                    object.__setattr__(value.expert, "map", road)
                _close(planner)
                planner = make()
                planner.reset(value)
            else:
                answer = (planner.plan(value), str(getattr(planner, "degraded", "")))
            write(connection, (number, "done", answer))
        except (Exception, SystemExit) as error:
            hint = getattr(error, "hint", None)
            kind = "" if isinstance(hint, str) else type(error).__name__ + ": "
            text = traceback.format_exc()
            write(connection, (number, "failed", (kind + str(error), hint or "", text)))


if __name__ == "__main__":
    _main()
