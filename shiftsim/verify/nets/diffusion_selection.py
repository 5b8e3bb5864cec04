"""Diffusion Planner: which agents, objects and lanes are kept where there are too many."""

import json
from pathlib import Path

import numpy as np

from shiftsim.errors import DataError
from shiftsim.planners.learned.diffusion.features import (
    LANES,
    ROUTE_LANES,
    agent_features,
    lane_features,
    lanes_on_route,
)
from shiftsim.planners.learned.diffusion.kernels import (
    SAMPLES,
    LaneLines,
    line_bounds,
    nearest_lanes,
    resample_lanes,
)
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nets.common import FEATURE
from shiftsim.verify.report import Report
from shiftsim.world.layers import Polylines, make_polygons, make_polylines
from shiftsim.world.state import AgentKind, Tracks

_COLUMNS = ["track", "vx", "vy", "heading", "width", "length", "x", "y"]
_STATIC = (
    AgentKind.CZONE_SIGN,
    AgentKind.BARRIER,
    AgentKind.TRAFFIC_CONE,
    AgentKind.GENERIC_OBJECT,
)
_LIGHTS = "green, yellow, red, unknown"


def verify_agents(path: Path, report: Report) -> None:
    """Compare the choice and the histories of agents and objects (`overflow_agents_*.npz`)."""
    file = ArrayFile(path, report)
    columns = json.loads(str(file["meta"]))
    report.compare("diffusion_planner meta", path.name, columns, {"frame_columns": _COLUMNS})
    if f"in.frame{SAMPLES:02d}" in file.arrays:
        file.note("older than what the network reads; says no more than the types", "in.frame00")
    agents, objects, chosen = agent_features(_tracks(file), file.take("in.anchor", 3))
    _compare(file, "out.agents", agents)
    _compare(file, "out.static", objects)
    _compare(file, "out.selected", chosen)
    file.finish()


def _tracks(file: ArrayFile) -> Tracks:
    """The frames as tracks, in the order of the last frame; static objects after them."""
    names = sorted(n for n in file.arrays if n.startswith("in.frame") and not n.endswith("_type"))
    frames = [file.take(name, -1, len(_COLUMNS)) for name in names]
    kinds = [
        file.take(f"{name}_type", len(frame)) for name, frame in zip(names, frames, strict=True)
    ]
    kind_of = {
        int(track): int(kind)
        for frame, kind_row in zip(frames[::-1], kinds[::-1], strict=True)
        for track, kind in zip(frame[:, 0], kind_row, strict=True)
    }
    for frame, row in zip(frames, kinds, strict=True):
        if [kind_of[int(track)] for track in frame[:, 0]] != row.tolist():
            raise DataError("a track changes its type")
    static = file.take("in.static", -1, 5)
    column = {track: index for index, track in enumerate(kind_of)}
    shape = (len(frames), len(column) + len(static))
    poses, velocities, sizes = (np.full((*shape, n), np.nan) for n in (3, 2, 2))
    valid = np.zeros(shape, np.bool_)
    for sample, frame in enumerate(frames):
        where = [column[int(track)] for track in frame[:, 0]]
        valid[sample, where] = True
        poses[sample, where] = frame[:, [6, 7, 3]]
        velocities[sample, where] = frame[:, [1, 2]]
        sizes[sample, where] = frame[:, [5, 4]]
    valid[-1, len(column) :] = True
    poses[-1, len(column) :] = static[:, :3]
    sizes[-1, len(column) :] = static[:, [4, 3]]
    static_kinds = [_STATIC[kind] for kind in file.take("in.static_type", len(static)).tolist()]
    return Tracks(
        valid,
        poses,
        velocities,
        sizes,
        np.array([*kind_of.values(), *static_kinds], np.int64),
        tuple(map(str, range(shape[1]))),
    )


def verify_lanes(path: Path, report: Report) -> None:
    """Compare the choice and the rows of lanes and route lanes (`overflow_lanes_*.npz`)."""
    file = ArrayFile(path, report)
    meta = json.loads(str(file["meta"]))
    report.compare("diffusion_planner meta", path.name, meta, {"light": _LIGHTS})
    anchor, owner = file.take("in.anchor", 3), file["in.owner"].tolist()
    lines, left, right = (_lines(file, n) for n in ("lane", "left_boundary", "right_boundary"))
    index = {name: block for block, name in enumerate(dict.fromkeys(owner))}
    limits = np.where(file["in.has_limit"], file["in.limit"].astype(np.float64), np.nan)
    lanes = LaneLines(
        resample_lanes(lines, left, right),
        line_bounds(lines),
        limits,
        np.array([index[name] for name in owner], np.int64),
    )
    # the lanes come in the order of the distance to their areas, which are not there
    point = make_polygons([[anchor[:2] + np.array([[0, 0], [1, 0], [0, 1.0]])]] * len(owner))
    edges = nearest_lanes(np.arange(len(owner)), point, lines, anchor[0], anchor[1], LANES)
    lights = file.take("in.light", len(owner), 4)
    report.compare(
        "diffusion_planner lights", path.name, lights.sum(axis=1), np.ones(len(owner), np.int64)
    )
    rows = lane_features(lanes, edges, lights.argmax(axis=1)[edges], anchor, LANES)
    route = [index.get(name, -1) for name in file["in.route"].tolist()]
    on_route = lanes_on_route(lanes.blocks[edges], route)
    names = ("lanes", "lanes_speed_limit", "lanes_has_speed_limit")
    for name, array in zip(names, rows, strict=True):
        _compare(file, f"out.{name}", array)
        chosen = np.zeros((ROUTE_LANES, *array.shape[1:]), array.dtype)
        chosen[: len(on_route)] = array[on_route]
        _compare(file, f"out.route_{name}", chosen)
    file.finish()


def _lines(file: ArrayFile, name: str) -> Polylines:
    xy, lengths = file.take(f"in.{name}", -1, 2), file.take(f"in.{name}_len", -1)
    if lengths.sum() != len(xy):
        raise DataError(f"array 'in.{name}_len' does not divide 'in.{name}' into lines")
    return make_polylines(np.split(xy, np.cumsum(lengths)[:-1]))


def _compare(file: ArrayFile, name: str, ours: np.ndarray) -> None:
    quantity = f"diffusion_planner {name.removeprefix('out.')} of many"
    file.report.compare(quantity, file.name, ours, file[name], atol=FEATURE)
