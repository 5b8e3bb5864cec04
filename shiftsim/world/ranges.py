"""Plausible ranges of the numbers in every file format that is read.

The widest that a sound file could mean, not the usual: what lies outside is damaged, in another
unit or hostile. A reader refuses it with the file, the element and the value; in nuPlan's logs it
is a warning, as nuPlan runs them. `docs/input_ranges.md` lists these tables.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shiftsim.errors import DataError, ShiftsimError

CHECK = "check the unit of that value, and that the file is whole"


class Range(NamedTuple):
    """Lowest and highest value, and the unit of both."""

    low: float
    high: float
    unit: str = ""

    def holds(self, values: Any) -> NDArray[np.bool_]:
        """Which values are finite numbers in the range."""
        with np.errstate(invalid="ignore"):
            return (values >= self.low) & (values <= self.high)

    def outside(self, values: NDArray[Any], *, may_be_nan: bool = False) -> NDArray[np.int64]:
        """(n, D) indices of the values of an array of D axes that are not in the range."""
        least, most = (np.fmin, np.fmax) if may_be_nan else (np.minimum, np.maximum)
        if not values.size or (
            least.reduce(values, None) >= self.low and most.reduce(values, None) <= self.high
        ):
            return np.zeros((0, values.ndim), np.int64)  # quick
        good = self.holds(values)
        return np.argwhere(~(good | np.isnan(values) if may_be_nan else good))

    def __str__(self) -> str:
        return f"{self.low:g} … {self.high:g} {self.unit}".rstrip()


Table: TypeAlias = Mapping[str, Range]


def require(
    ranges: Table,  # of the format
    field: str,
    values: Any,  # one number, or an array of them
    where: str,  # file and element, for the message
    *,
    error: type[ShiftsimError] = DataError,
    may_be_nan: bool = False,  # whether NaN stands for a missing value
) -> None:
    """Raise an error that names the first value outside the range of its field, and the place."""
    allowed = ranges[field]
    array = np.atleast_1d(values)
    if array.dtype == object:  # an integer of any size
        array = np.array([min(max(value, -_ANY), _ANY) for value in array.flat], np.float64)
    bad = allowed.outside(array, may_be_nan=may_be_nan)
    if not len(bad):
        return
    value = array[tuple(bad[0])]
    row = f", row {bad[0][0]}" if np.ndim(values) else ""
    what = f"beyond {allowed}" if np.isfinite(value) else "not a finite number"
    more = f" ({len(bad)} such values)" if len(bad) > 1 else ""
    raise error(f"{where} {field!r}{row}: {value:.10g} is {what}{more}", CHECK)


def single_step(values: NDArray[np.float64], unit: float = 1.0) -> float:
    """Steps of positions (n,) [m] that are of single precision where it is coarse; else 0."""
    single = values.astype(np.float32)
    step = unit * float(np.spacing(np.abs(single).max()))
    return step if step > _COARSE and np.ptp(values) > 0.0 and (values == single).all() else 0.0


def _same(names: str, low: float, high: float, unit: str = "") -> dict[str, Range]:
    return dict.fromkeys(names.split(", "), Range(low, high, unit))


_TIME = Range(-(2.0**55), 2.0**55, "us")  # a thousand years; sums of two stay exact enough
_COUNT = 2.0**31
_ROUNDING = 1e-9
_COARSE = 0.02  # m
_ANY = float(np.finfo(np.float64).max)

# attributes of OpenDRIVE by element; a road whose geometry has no place is left out instead
OPENDRIVE: Table = {
    **_same("offset x, offset y, offset z", -1e8, 1e8, "m"),
    **_same("geometry hdg, offset hdg, object hdg", -1e3, 1e3, "rad"),
    **_same("geometry x, geometry y", -1e8, 1e8, "m"),
    **_same("geometry s, geometry length", -1e5, 1e5, "m"),
    **_same("arc curvature, spiral curvStart, spiral curvEnd", -100, 100, "1/m"),
    **_same("poly3 a, paramPoly3 aU, paramPoly3 aV", -1e5, 1e5, "m"),
    **_same("poly3 b, poly3 c, poly3 d", -1e5, 1e5, "1 … 1/m²"),
    **_same("paramPoly3 bU, paramPoly3 cU, paramPoly3 dU", -1e6, 1e6, "m"),
    **_same("paramPoly3 bV, paramPoly3 cV, paramPoly3 dV", -1e6, 1e6, "m"),
    **_same("road length", 0, 1e5, "m"),
    **_same("laneSection s, laneOffset s, elevation s, type s", -1e5, 1e5, "m"),
    **_same("width sOffset, border sOffset, speed sOffset", -1e5, 1e5, "m"),
    **_same("width a, border a, laneOffset a, elevation a", -1e4, 1e4, "m"),
    **_same("width b, border b, laneOffset b, elevation b", -1e4, 1e4),
    **_same("width c, border c, laneOffset c, elevation c", -1e7, 1e7, "1/m"),
    **_same("width d, border d, laneOffset d, elevation d", -1e9, 1e9, "1/m²"),
    **_same("speed max", -1e3, 1e3, "as the file says"),
    **_same("object s, object t, signal s, signal t", -1e5, 1e5, "m"),
    **_same("signalReference s, signalReference t, cornerRoad s, cornerRoad t", -1e5, 1e5, "m"),
    **_same("repeat s, repeat length, repeat distance", -1e5, 1e5, "m"),
    **_same("repeat tStart, repeat tEnd", -1e5, 1e5, "m"),
    **_same("cornerLocal u, cornerLocal v", -1e4, 1e4, "m"),
    **_same("object length, object width, signal width, signalReference width", -1, 1e4, "m"),
    **_same("signal value, signalReference value", -1e9, 1e9, "as the file says"),
}
MAP_EXTENT: Table = {"extent": Range(0, 2e5, "m")}  # of a map

# columns of a DSC3D recording, and keys of its data_meta.json
DSC3D: Table = {
    **_same("translation_x, translation_y, translation_z", -1e5, 1e5, "m"),
    **_same("rotation_x, rotation_y, rotation_z", -100, 100, "rad"),
    **_same("dimension_x, dimension_y, dimension_z", -500, 500, "m"),  # and positive
    **_same("velocity_x, velocity_y", -_ANY, _ANY, "m/s"),  # beyond 200 m/s it is not believed
    **_same("frame_id, track_id", 0, 2.0**53),
    "time": _TIME,
    **_same("reference_utm.zone", 1, 60),
    **_same("reference_utm.offset", -2e7, 2e7, "m"),
    **_same("frame_rate", 1e-3, 1e4, "Hz"),
    **_same("frame_distance", 1, 1e6, "frames"),
}

# what open data sets say of tracks and lanes, whatever their files call it
OPEN_DATA: Table = {
    **_same("position", -1e8, 1e8, "m"),
    **_same("heading", -1e3, 1e3, "rad"),
    **_same("rotation", -1.1, 1.1),  # parts of a quaternion
    **_same("velocity", -1e4, 1e4, "m/s"),  # one that does not fit the positions is not believed
    **_same("size", 1e-3, 500, "m"),
    **_same("speed limit", 0, 1e3, "m/s"),
    **_same("step", -1e9, 1e9),
    **_same("step length", 1e-3, 1e3, "s"),
    "time": _TIME,
    "time_ns": Range(-(2.0**65), 2.0**65, "ns"),
}

# columns of a nuPlan log; what is outside is a warning
NUPLAN_LOG: Table = {
    **_same("ego_pose x, ego_pose y, lidar_box x, lidar_box y", -1e8, 1e8, "m"),
    **_same("ego_pose heading, lidar_box heading", -100, 100, "rad"),
    **_same("ego_pose vx, ego_pose vy, lidar_box vx, lidar_box vy", -150, 150, "m/s"),
    **_same("ego_pose acceleration_x, ego_pose acceleration_y", -150, 150, "m/s²"),
    **_same("lidar_box length, lidar_box width", 1e-3, 150, "m"),
    "lidar_pc timestamp": _TIME,
}
# columns of the layers of a nuPlan map
NUPLAN_MAP: Table = {
    **_same("speed_limit_mps", 0, 1e3, "m/s"),
    **_same("lane_index, lane_type_fid, turn_type_fid", -1, 1e4),
    **_same("intersection_type_fid, stop_polygon_type_fid", -1, 1e4),
}

# columns of a store; wider than those above, as a nuPlan log is stored whatever it holds
STORE: Table = {
    **_same("x_m, y_m", -1e9, 1e9, "m"),
    **_same("heading_rad, steering_angle_rad", -1e6, 1e6, "rad"),
    **_same("vx_mps, vy_mps", -1e6, 1e6, "m/s"),
    **_same("ax_mps2, ay_mps2", -1e8, 1e8, "m/s²"),
    **_same("steering_rate_radps, yaw_rate_radps, yaw_accel_radps2", -1e8, 1e8, "rad/s, rad/s²"),
    **_same("length_m, width_m", 1e-9, 1e6, "m"),
    "time_us": _TIME,
    **_same("status", 0, 3),
    **_same("kind", 0, 6),
    **_same("row, first_row, last_row, iteration_rows", 0, _COUNT, "rows"),
    **_same("track, light", 0, _COUNT),
    **_same("row_step", 1, 1e6, "rows"),
    **_same("goal_pose", -1e9, 1e9, "m, rad"),
    **_same("duration_s", 0, 1e6, "s"),
    **_same("offset_s", -1e6, 1e6, "s"),
    **_same("subsample_ratio", 1e-6, 1, ""),
    **_same("xy, bounds, grid", -1e9, 1e9, "m"),
    **_same("arc", 0, 1e9, "m"),
    **_same("speed_limits", 0, 1e6, "m/s"),
}
# columns of a run folder
RUN: Table = {
    **_same("score", -_ROUNDING, 1 + _ROUNDING),
    **_same("duration", 0, 1e9, "s, ms"),
    **_same("rollout_row, rollout_rows, degraded_steps", 0, _COUNT),
    **_same("state", -1e12, 1e12, "as in a store"),
}
# weights of a checkpoint, and settings in its args.json
CHECKPOINT: Table = {
    **_same("weight", -1e9, 1e9),
    **_same("encoder_depth, decoder_depth", 1, 64),
    **_same("hidden_dim, num_heads", 1, 8192),
    **_same("mean", -1e6, 1e6),
    **_same("std", 1e-9, 1e6),
}
# settings in TOML files
SETTINGS: Table = {
    **_same("workers", 0, 4096),
    **_same("batch_size", 1, 65536),
    **_same("limit", 0, _COUNT),
    **_same("timeout", 0, 1e7, "s"),
    **_same("window_s, overlap_s, history_s, padding_s, max_hole_s", 0, 1e5, "s"),
    **_same("min_peak_speed", 0, 1e3, "m/s"),
    **_same("max_overlap", 0, 1e6, "m²"),
    **_same("max_lane_distance, route_extension", 0, 1e6, "m"),
    **_same("max_lane_angle", 0, 10, "rad"),
    **_same("min_drivable_share", 0, 1),
    **_same("route_extension_blocks", 0, _COUNT),
    **_same("max_per_window", 1, _COUNT),
}
FORMATS: Mapping[str, Table] = {
    "OpenDRIVE": {**OPENDRIVE, **MAP_EXTENT},
    "DSC3D": DSC3D,
    "Open data sets": OPEN_DATA,
    "nuPlan log": NUPLAN_LOG,
    "nuPlan map": {**NUPLAN_MAP, **MAP_EXTENT},
    "Store": {**STORE, **MAP_EXTENT},
    "Run folder": RUN,
    "Checkpoint": CHECKPOINT,
    "Settings": SETTINGS,
}
