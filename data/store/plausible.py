"""Is what a store holds usable? Rows of windows, numbers in their ranges, indices that exist."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shiftsim.data.recording import Window
from shiftsim.data.store.schema import EGO_COLUMNS, MOTION, SCENARIOS
from shiftsim.data.store.tables import FRAMES, REPAIR, ego_file
from shiftsim.data.store.tables import TRACKS as TRACKS_FILE
from shiftsim.errors import DataError
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel, readonly
from shiftsim.world.layers import Layer, Lists, Polygons, Polylines
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.ranges import MAP_EXTENT, STORE, require
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks, TrafficLights

_BOX = (*MOTION, "length_m", "width_m")
_EGO_LIMITS, BOX_LIMITS = (
    np.array([STORE[name][:2] for name in names]) for names in (EGO_COLUMNS, _BOX)
)

_TIMES, _LIGHTS = STORE["time_us"][:2], STORE["light_status"][:2]


def require_rows(window: Window, where: str) -> None:
    """Refuse a window whose iterations are not increasing rows of it."""
    rows = window.iteration_rows
    inside = len(rows) and window.first_row <= rows[0] and rows[-1] < window.last_row
    if not inside or (rows[1:] <= rows[:-1]).any():
        what = f"{where}: scenario {window.token!r}: iteration_rows do not increase within its rows"
        raise DataError(what, REPAIR)


def require_scenarios(table: pa.Table, where: str) -> None:
    """Refuse a table of scenarios with a number outside of its range."""
    for field in SCENARIOS:
        column = table[field.name]
        if field.name == "goal_pose" and not set(
            pc.list_value_length(column).unique().to_pylist()
        ) <= {0, 3}:
            raise DataError(f"{where} 'goal_pose' holds no pose", REPAIR)
        if field.name in STORE:
            flat = column.combine_chunks()
            values = flat.flatten() if pa.types.is_list(field.type) else flat
            require(STORE, field.name, values.to_numpy(zero_copy_only=False), where)


def require_plausible(scene: Scenario, ego: str, folder: Path, *, boxes: bool = True) -> None:
    """Refuse a scenario with a number outside of its range; `folder` is that of its recording.

    Without `boxes`, those of the tracks are known to be good.
    """
    if boxes:
        require_boxes(scene.tracks, len(scene.time_us), folder / TRACKS_FILE)
    if _is_plausible(scene):
        return
    _require_frames(scene.time_us, scene.traffic_lights, folder)
    if (np.diff(scene.iteration_times) <= 0).any():
        raise DataError(f"{folder / FRAMES}: column 'time_us' does not increase", REPAIR)
    require_states(scene.ego, ego_file(folder, ego))


def _is_plausible(scene: Scenario) -> bool:
    """Whether times, lights and ego states are sound; quick, and does not say what is not."""
    lights, (low, high) = scene.traffic_lights.status, _LIGHTS
    if lights.size and not low <= lights.min() <= lights.max() <= high:
        return False
    if scene.ego.shape[1:] != _EGO_LIMITS.shape[:1]:
        return False
    arrays = scene.time_us, scene.iteration_times, scene.ego
    plain = [readonly(np.ascontiguousarray(array)) for array in arrays]
    return bool(_increase_within(*plain, _TIMES, _EGO_LIMITS))


@kernel
def _increase_within(
    time_us: IntArray,
    steps: IntArray,
    ego: FloatArray,
    times: tuple[float, float],
    limits: FloatArray,
) -> bool:
    """Whether times do not decrease, steps increase, and times and ego are within the limits."""
    if len(time_us) == 0:
        return False
    good = time_us[0] >= times[0] and time_us[-1] <= times[1]
    one = np.uint64(1)
    for row in range(one, np.uint64(len(time_us))):
        good &= time_us[row] >= time_us[row - one]
    for at in range(one, np.uint64(len(steps))):
        good &= steps[at] > steps[at - one]
    for row in range(np.uint64(ego.shape[0])):
        for column in range(np.uint64(ego.shape[1])):
            value = ego[row, column]
            good &= (value >= limits[column, 0]) & (value <= limits[column, 1])
    return good


def require_states(states: FloatArray, file: Path) -> None:
    """Refuse ego states (R, 11) with a number outside of its range."""
    _require(states.ndim == 2 and states.shape[1] == len(EGO_COLUMNS), str(file))
    low, high = _EGO_LIMITS.T
    if not ((states >= low) & (states <= high)).all():
        for name, values in zip(EGO_COLUMNS, states.T, strict=True):
            require(STORE, name, values, f"{file}: column")


def require_recording(
    time_us: IntArray, tracks: Tracks, lights: TrafficLights, folder: Path
) -> None:
    """Refuse a recording whose arrays do not fit together, or with a number outside of its range.

    `folder` is where it is, or is to be written.
    """
    _require_frames(time_us, lights, folder)
    require_boxes(tracks, len(time_us), folder / TRACKS_FILE)


def _require_frames(time_us: IntArray, lights: TrafficLights, folder: Path) -> None:
    frames = f"{folder / FRAMES}: column"
    require(STORE, "time_us", time_us, frames)
    if (np.diff(time_us) < 0).any():  # they may repeat, nuPlan rule 431
        raise DataError(f"{frames} 'time_us' does not increase", REPAIR)
    _require(lights.status.shape == (len(time_us), len(lights.connector_ids)), frames)
    require(STORE, "light_status", lights.status, frames)


def require_boxes(tracks: Tracks, num_rows: int, boxes: Path) -> None:
    """Refuse tracks whose arrays do not fit together, or with a number outside of its range.

    `boxes` is the file where they are, or are to be written.
    """
    shape = (num_rows, len(tracks.tokens))
    _require(tracks.valid.shape == shape and tracks.kinds.shape == shape[1:], str(boxes))
    require(STORE, "kinds", tracks.kinds, f"{boxes}: footer")
    arrays = tracks.poses, tracks.velocities, tracks.sizes
    for array, width in zip(arrays, (3, 2, 2), strict=True):
        _require(array.shape == (*shape, width), str(boxes))
    poses, velocities, sizes = (_plain(array, np.float64) for array in arrays)
    valid = _plain(tracks.valid, np.bool_)
    row, track = _first_outside(valid, poses, velocities, sizes, BOX_LIMITS)
    if row >= 0:
        where = f"{boxes}: track {tracks.tokens[track]!r}, row {row}: column"
        values = np.concatenate([array[row, track] for array in arrays])
        for name, value in zip(_BOX, values, strict=True):
            require(STORE, name, value, where, may_be_nan=name in ("vx_mps", "vy_mps"))


def _plain(array: Any, kind: Any) -> Any:
    """As the kernel takes it."""
    return readonly(np.ascontiguousarray(array, kind))


@kernel
def _first_outside(
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
    limits: FloatArray,
) -> tuple[int, int]:
    """Row and track of the first box with a number outside of `limits` (7, 2), or -1 and -1."""
    low, high = limits[:, 0], limits[:, 1]
    for row in range(valid.shape[0]):
        for track in range(valid.shape[1]):
            if not valid[row, track]:
                continue
            good = True
            for axis in range(3):
                value = poses[row, track, axis]
                good &= (value >= low[axis]) & (value <= high[axis])
            for axis in range(2):
                value = sizes[row, track, axis]
                good &= (value >= low[5 + axis]) & (value <= high[5 + axis])
                value = velocities[row, track, axis]  # NaN where the object is static
                good &= not ((value < low[3 + axis]) | (value > high[3 + axis]))
            if not good:
                return row, track
    return -1, -1


def require_sound(road: VectorMap, where: str) -> None:
    """Refuse a map with a number outside of its range, or an index of something that is not there.

    Kernels follow the indices without looking.
    """
    num_edges, num_blocks = len(road.edges), len(road.blocks)
    for name, part in vars(road).items():
        column = f"{where}: {name}:"
        if isinstance(part, Layer):
            _require_polygons(part.polygons, column)
            if len(part.ids) != len(part.polygons.bounds) or len(part.index) != len(part.ids):
                raise DataError(f"{column} an id is missing or occurs twice", REPAIR)
        elif isinstance(part, Polylines):
            _require_places(part.xy, column)
            require(STORE, "arc", part.arc, column)
            _require_parts(
                part.ptr, len(part.xy), num_edges, column, least=2 * (name == "baselines")
            )
            _require(len(part.arc) == len(part.xy), column)
    require(STORE, "speed_limits", road.speed_limits, f"{where}:", may_be_nan=True)
    lists = {
        "incoming": (num_edges, num_edges),
        "outgoing": (num_edges, num_edges),
        "stop_lines": (num_edges, len(road.stop_polygons)),
        "block_edges": (num_blocks, num_edges),
        "block_incoming": (num_blocks, num_blocks),
        "block_outgoing": (num_blocks, num_blocks),
    }
    for name, (count, others) in lists.items():
        found: Lists = getattr(road, name)
        _require_parts(found.ptr, len(found.items), count, f"{where}: {name}")
        _require_index(found.items, 0, others, f"{where}: {name}")
    for name, others in {
        "left_lane": num_edges,
        "right_lane": num_edges,
        "block_of": num_blocks,
        "intersection_of": len(road.intersections),
    }.items():
        _require_index(getattr(road, name), NONE, others, f"{where}: {name}")
    per_edge = "speed_limits lane_index left_lane right_lane block_of has_traffic_lights"
    for name in f"{per_edge} intersection_of turn_type is_bike boundary_ids".split():
        _require(len(getattr(road, name)) == num_edges, f"{where}: {name}")
    _require(
        len(road.intersection_kinds) == len(road.intersections), f"{where}: intersection_kinds"
    )
    _require(len(road.stop_kinds) == len(road.stop_polygons), f"{where}: stop_kinds")
    _require(0 <= road.num_lanes <= num_edges, f"{where}: num_lanes")
    _require(0 <= road.num_roadblocks <= num_blocks, f"{where}: num_roadblocks")


def require_vertices(where: str, xy: FloatArray, *pointers: IntArray) -> None:
    """Refuse vertices (V, 2) of which no lines, or polygons with a grid, can be made.

    `pointers` are those of lines, or of rings and of polygons.
    """
    _require_places(xy, where)
    total = len(xy)
    for ptr in pointers:
        _require(len(ptr) > 0, where)
        _require_parts(ptr, total, len(ptr) - 1, where, least=len(pointers) - 1)
        total = len(ptr) - 1


def _require_places(xy: FloatArray, where: str) -> None:
    """Refuse vertices out of their range, or too far apart for a grid over them."""
    require(STORE, "xy", xy, where)
    if len(xy):
        require(MAP_EXTENT, "extent", max(np.ptp(xy[:, 0]), np.ptp(xy[:, 1])), where)


def _require_polygons(flat: Polygons, where: str) -> None:
    count = len(flat.bounds)
    _require_places(flat.xy, where)
    for name in ("bounds", "grid"):
        require(STORE, name, getattr(flat, name), where)
    _require_parts(flat.poly_ptr, len(flat.ring_ptr) - 1, count, where, least=1)
    _require_parts(flat.ring_ptr, len(flat.xy), len(flat.ring_ptr) - 1, where, least=1)
    _require(len(flat.grid) == 3 and flat.grid[2] > 0 and len(flat.shape) == 2, where)
    cells = int(flat.shape[0]) * int(flat.shape[1])
    _require(flat.shape.min() >= 0 and cells == len(flat.cell_ptr) - 1, where)
    _require_parts(flat.cell_ptr, len(flat.cell_items), cells, where)
    _require_index(flat.cell_items, 0, count, where)


def _require_parts(ptr: IntArray, total: int, count: int, where: str, least: int = 0) -> None:
    """Whether `ptr` cuts `total` items into `count` parts of at least so many."""
    whole = len(ptr) == count + 1 and ptr[0] == 0 and ptr[-1] == total
    _require(whole and (np.diff(ptr) >= least).all(), where)


def _require_index(items: IntArray, lowest: int, count: int, where: str) -> None:
    if items.size and not (items.min() >= lowest and items.max() < count):
        raise DataError(f"{where} names something that does not exist", REPAIR)


def _require(good: object, where: str) -> None:
    if not good:
        raise DataError(f"{where.removesuffix(':')}: the arrays do not fit together", REPAIR)
