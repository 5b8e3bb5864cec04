"""A VectorMap as an Arrow IPC file: one row, one list column per array.

The file is mapped into memory and its arrays are used as they lie there, so that all processes of a
machine share them. Kernels follow the indices of a map without looking: they are checked here.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.store.schema import list_of, make_schema
from shiftsim.data.store.tables import REPAIR
from shiftsim.errors import DataError
from shiftsim.files import atomic_write
from shiftsim.kernels import FloatArray, IntArray, readonly
from shiftsim.world.layers import Layer, Lists, Polygons, Polylines
from shiftsim.world.map import LAYERS, NONE, VectorMap
from shiftsim.world.ranges import MAP_EXTENT, STORE, require

_F64, _I64, _TEXT = pa.float64(), pa.int64(), pa.string()
_LINES = ("baselines", "left_boundaries", "right_boundaries")
# the objects that have a list each, and those that the lists name
_LISTS = {
    "incoming": ("edges", "edges"),
    "outgoing": ("edges", "edges"),
    "stop_lines": ("edges", "stop_polygons"),
    "block_edges": ("blocks", "edges"),
    "block_incoming": ("blocks", "blocks"),
    "block_outgoing": ("blocks", "blocks"),
}
# arrays with a value per object: of which objects, its type, and the objects that it names
_ARRAYS = {
    "speed_limits": ("edges", _F64, ""),
    "lane_index": ("edges", _I64, ""),
    "left_lane": ("edges", _I64, "edges"),
    "right_lane": ("edges", _I64, "edges"),
    "block_of": ("edges", _I64, "blocks"),
    "has_traffic_lights": ("edges", pa.bool_(), ""),
    "intersection_of": ("edges", _I64, "intersections"),
    "turn_type": ("edges", _I64, ""),
    "is_bike": ("edges", pa.bool_(), ""),
    "intersection_kinds": ("intersections", _I64, ""),
    "stop_kinds": ("stop_polygons", _I64, ""),
}
_NUMBERS = ("epsg", "num_lanes", "num_roadblocks")
_KINDS: dict[str, Any] = {  # what has several arrays each
    **dict.fromkeys(LAYERS, Polygons),
    **dict.fromkeys(_LINES, Polylines),
    **dict.fromkeys(_LISTS, Lists),
}
_PARTS = {  # arrays of floats of these: unit and type of the column; all others are indices
    "xy": ("_m", pa.list_(pa.field("item", _F64, nullable=False), 2)),
    "bounds": ("_m", pa.list_(pa.field("item", _F64, nullable=False), 4)),
    "grid": ("_m", _F64),
    "arc": ("_m", _F64),
}


def _parts(name: str) -> dict[str, pa.DataType]:
    """Columns of the arrays of a field, and the types of their items."""
    found = {part: _PARTS.get(part, ("", _I64)) for part in _KINDS[name]._fields}
    return {f"{name}_{part}{unit}": kind for part, (unit, kind) in found.items()}


def _array(name: str) -> str:
    """Column of an array with a value per object."""
    return f"{name}_mps" if name == "speed_limits" else name


_COLUMNS = {  # type of the items of every list column
    **{column: kind for name in _KINDS for column, kind in _parts(name).items()},
    **{_array(name): kind for name, (_, kind, _) in _ARRAYS.items()},
    **{f"{name}_ids": _TEXT for name in (*LAYERS, "left_boundary", "right_boundary")},
    "flaws": _TEXT,
    "flaw_counts": _I64,
}
SCHEMA = make_schema(
    name=_TEXT,
    **dict.fromkeys(_NUMBERS, _I64),
    **{name: list_of(kind) for name, kind in _COLUMNS.items()},
)


def write_map(path: Path, road: VectorMap) -> None:
    """Write a map, equal ones with equal bytes; a DataError if it holds what cannot be."""
    require_sound(road, str(path))
    values: dict[str, Any] = {name: getattr(road, name) for name in ("name", *_NUMBERS)}
    values |= {_array(name): getattr(road, name) for name in _ARRAYS}
    for name in _KINDS:
        value = getattr(road, name)
        if isinstance(value, Layer):
            values[f"{name}_ids"] = list(value.ids)
            value = value.polygons
        values |= zip(_parts(name), value, strict=True)
    values["left_boundary_ids"] = [left for left, _ in road.boundary_ids]
    values["right_boundary_ids"] = [right for _, right in road.boundary_ids]
    values["flaws"], values["flaw_counts"] = list(road.flaws), list(road.flaws.values())
    columns = [_one_row(values[field.name], field.type) for field in SCHEMA]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial, pa.ipc.new_file(str(partial), SCHEMA) as writer:
        writer.write_table(pa.Table.from_arrays(columns, schema=SCHEMA))


def _one_row(values: Any, kind: pa.DataType) -> pa.Array:
    if not pa.types.is_list(kind):
        return pa.array([values], kind)
    if pa.types.is_fixed_size_list(kind.value_type):
        flat = pa.array(np.ascontiguousarray(values).reshape(-1), _F64)
        items = pa.FixedSizeListArray.from_arrays(flat, type=kind.value_type)
    else:
        items = pa.array(values, kind.value_type)
    return pa.ListArray.from_arrays(pa.array([0, len(items)], pa.int32()), items, type=kind)


def read_map_file(path: Path) -> VectorMap:
    """Read a map back, or a DataError; its arrays are read-only, and lie in the file."""
    try:
        table = pa.ipc.open_file(pa.memory_map(str(path))).read_all()
        if table.schema != SCHEMA:
            raise ValueError(_difference(table.schema))
        table.validate(full=True)
        if len(table) != 1 or any(column.null_count for column in table.columns):
            raise ValueError(f"{len(table)} rows, not 1, or values are missing")
        items = {name: table[name].chunk(0) for name in SCHEMA.names}
        road = _assemble({name: _value(array) for name, array in items.items()})
    except (OSError, KeyError, ValueError, TypeError, pa.ArrowException) as error:
        is_there = os.path.exists(path)
        what = f"not a readable map: {error}" if is_there else "the file is missing"
        raise DataError(f"{path}: {what}", hint=REPAIR) from error
    require_sound(road, str(path))
    return road


def _difference(found: pa.Schema) -> str:
    for field in SCHEMA:
        if found.get_field_index(field.name) < 0:
            return f"column {field.name!r} is missing"
        if found.field(field.name) != field:
            return f"column {field.name!r} is {found.field(field.name).type}, not {field.type}"
    return "there are other columns"


def _value(array: pa.Array) -> Any:
    """The one value of a column: a scalar, a tuple of texts, or a read-only array."""
    if not pa.types.is_list(array.type):
        return array[0].as_py()
    items, width = array.flatten(), 0
    if pa.types.is_fixed_size_list(items.type):
        items, width = items.flatten(), items.type.list_size
    if items.null_count:
        raise ValueError("values are missing")
    if pa.types.is_string(items.type):
        return tuple(items.to_pylist())
    numbers = items.to_numpy(zero_copy_only=False)
    return readonly(numbers.reshape(-1, width) if width else numbers)


def _assemble(values: dict[str, Any]) -> VectorMap:
    parts: dict[str, Any] = {name: values[name] for name in ("name", *_NUMBERS)}
    for name, kind in _KINDS.items():
        parts[name] = kind(*(values[column] for column in _parts(name)))
        if name in LAYERS:
            parts[name] = Layer(values[f"{name}_ids"], parts[name])
    parts |= {name: values[_array(name)] for name in _ARRAYS}
    pairs = zip(values["left_boundary_ids"], values["right_boundary_ids"], strict=True)
    flaws = dict(zip(values["flaws"], values["flaw_counts"].tolist(), strict=True))
    return VectorMap(boundary_ids=tuple(pairs), flaws=flaws, **parts)


def require_sound(road: VectorMap, where: str) -> None:
    """Refuse a map with a number out of its range or an index of nothing, with a DataError."""
    count = {name: len(getattr(road, name)) for name in LAYERS}
    for name in LAYERS:
        layer: Layer = getattr(road, name)
        if len(layer.ids) != len(layer.polygons.bounds) or len(layer.index) != len(layer.ids):
            raise DataError(f"{where}: {name}: an id is missing or occurs twice", REPAIR)
        _require_polygons(layer.polygons, f"{where}: {name}:")
    for name in _LINES:
        lines: Polylines = getattr(road, name)
        _require_places(lines.xy, f"{where}: {name}:")
        require(STORE, "arc", lines.arc, f"{where}: {name}:")
        least = 2 * (name == "baselines")
        _require_parts(lines.ptr, len(lines.xy), count["edges"], f"{where}: {name}", least=least)
        _require(len(lines.arc) == len(lines.xy), f"{where}: {name}")
    for name, (owner, target) in _LISTS.items():
        lists: Lists = getattr(road, name)
        _require_parts(lists.ptr, len(lists.items), count[owner], f"{where}: {name}")
        _require_index(lists.items, 0, count[target], f"{where}: {name}")
    for name, (owner, _, target) in _ARRAYS.items():
        _require(len(getattr(road, name)) == count[owner], f"{where}: {name}")
        if target:
            _require_index(getattr(road, name), NONE, count[target], f"{where}: {name}")
    require(STORE, "speed_limits", road.speed_limits, f"{where}:", may_be_nan=True)
    _require(len(road.boundary_ids) == count["edges"], f"{where}: boundary_ids")
    _require(0 <= road.num_lanes <= count["edges"], f"{where}: num_lanes")
    _require(0 <= road.num_roadblocks <= count["blocks"], f"{where}: num_roadblocks")


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
    has_all = len(ptr) == count + 1 and ptr[0] == 0 and ptr[-1] == total
    _require(has_all and (np.diff(ptr) >= least).all(), where)


def _require_index(items: IntArray, lowest: int, count: int, where: str) -> None:
    if items.size and not (items.min() >= lowest and items.max() < count):
        raise DataError(f"{where} names something that does not exist", REPAIR)


def _require(fits: object, where: str) -> None:
    if not fits:
        raise DataError(f"{where.removesuffix(':')}: the arrays do not fit together", REPAIR)
