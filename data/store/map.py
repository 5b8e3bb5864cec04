"""A VectorMap as one row of a Parquet file, one list column per array, and back.

Only what cannot be made of the rest is stored: no arc lengths, bounds and grids, which stores of
version 1 hold and which are made again for those, too.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.store.plausible import require_sound, require_vertices
from shiftsim.data.store.tables import REPAIR, Table, write_blocks
from shiftsim.errors import DataError
from shiftsim.kernels import readonly
from shiftsim.world.layers import Layer, Lists, index_polygons, index_polylines
from shiftsim.world.map import LAYERS, VectorMap

LINES = ("baselines", "left_boundaries", "right_boundaries")
LISTS = ("incoming", "outgoing", "stop_lines", "block_edges", "block_incoming", "block_outgoing")
_ARRAYS = {"speed_limits": "speed_limits_mps"} | {  # field -> column with its unit
    name: name
    for name in "lane_index left_lane right_lane block_of has_traffic_lights intersection_of"
    " turn_type is_bike intersection_kinds stop_kinds".split()
}
_NOTES = {"name": str, "epsg": int, "num_lanes": int, "num_roadblocks": int, "flaws": dict}
_POINTERS = {name: ("ring_ptr", "poly_ptr") for name in LAYERS} | dict.fromkeys(LINES, ("ptr",))


def _schema(points: tuple[str, ...]) -> pa.Schema:
    """The columns, where vertices are in columns that end as given."""
    out: dict[str, pa.DataType] = {}
    for name, pointers in _POINTERS.items():
        out |= {f"{name}_{part}": pa.float64() for part in points}
        out |= {f"{name}_{part}": pa.int64() for part in pointers}
    for name in LISTS:
        out |= {f"{name}_{part}": pa.int64() for part in Lists._fields}
    for name, column in _ARRAYS.items():
        numbers = pa.float64() if name == "speed_limits" else pa.int64()
        out[column] = pa.bool_() if name in ("has_traffic_lights", "is_bike") else numbers
    for name in LAYERS:
        out[f"{name}_ids"] = pa.string()
    out["left_boundary_ids"] = out["right_boundary_ids"] = pa.string()
    return pa.schema(
        [
            pa.field(column, pa.list_(pa.field("item", kind, nullable=False)), nullable=False)
            for column, kind in out.items()
        ]
    )


SCHEMA = _schema(("x_m", "y_m"))
_FIRST_SCHEMA = _schema(("xy_m",))  # of version 1, x and y in turn


def write_map(path: Path, road: VectorMap) -> None:
    """Write a map; equal maps give equal bytes.

    Raises:
        DataError: A number is outside of its range, or an index of something that is not there.
    """
    require_sound(road, str(path))
    values: dict[str, Any] = {}
    for name, pointers in _POINTERS.items():
        group = getattr(road, name)
        flat = group.polygons if isinstance(group, Layer) else group
        values[f"{name}_x_m"], values[f"{name}_y_m"] = np.ascontiguousarray(flat.xy.T)
        values |= {f"{name}_{part}": getattr(flat, part) for part in pointers}
    for name in LISTS:
        values |= {f"{name}_{part}": getattr(getattr(road, name), part) for part in Lists._fields}
    for name, column in _ARRAYS.items():
        values[column] = getattr(road, name)
    for name in LAYERS:
        values[f"{name}_ids"] = list(getattr(road, name).ids)
    values["left_boundary_ids"] = [left for left, _ in road.boundary_ids]
    values["right_boundary_ids"] = [right for _, right in road.boundary_ids]
    columns = [_one_row(values[field.name], field.type) for field in SCHEMA]
    footer = {name: getattr(road, name) for name in _NOTES}
    write_blocks(path, [pa.Table.from_arrays(columns, schema=SCHEMA)], footer)


def _one_row(values: Any, kind: pa.DataType) -> pa.Array:
    items = pa.array(values, kind.value_type)
    offsets = pa.array([0, len(items)], pa.int32())
    return pa.ListArray.from_arrays(offsets, items, type=kind)


def read_map_file(path: Path) -> VectorMap:
    """Read a map back; its arrays are read-only.

    Raises:
        DataError: The file is missing or damaged.
    """
    file = Table(path, SCHEMA, _FIRST_SCHEMA)
    if file.num_rows != 1:
        raise DataError(f"{path}: {file.num_rows} rows, not 1", hint=REPAIR)
    # column by column: decoding a city at once takes three times its size
    items = {name: _items(file.read(columns=[name])[name]) for name in file.names}
    try:
        road = _assemble(file.footer, items, str(path))
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(f"{path}: the arrays do not fit together: {error}", hint=REPAIR) from error
    del items
    pa.default_memory_pool().release_unused()
    require_sound(road, str(path))
    return road


def _items(column: pa.ChunkedArray) -> Any:
    values = column.chunk(0).flatten()
    if pa.types.is_string(values.type):
        return tuple(values.to_pylist())
    return values.to_numpy(zero_copy_only=False)


def _assemble(footer: dict[str, Any], items: dict[str, Any], where: str) -> VectorMap:
    parts: dict[str, Any] = {}
    for name, pointers in _POINTERS.items():
        together = items.get(f"{name}_xy_m")
        if together is None:
            together = np.column_stack([items[f"{name}_x_m"], items[f"{name}_y_m"]])
        given = [together.reshape(-1, 2), *(items[f"{name}_{part}"] for part in pointers)]
        require_vertices(f"{where}: {name}", *given)
        parts[name] = index_polygons(*given) if name in LAYERS else index_polylines(*given)
    for name in LISTS:
        parts[name] = Lists(*(readonly(items[f"{name}_{part}"]) for part in Lists._fields))
    for name in LAYERS:
        ids = items[f"{name}_ids"]
        if len(ids) != len(parts[name].poly_ptr) - 1:
            raise ValueError(f"{name}: {len(ids)} ids")
        parts[name] = Layer(ids, parts[name])
    parts.update({name: items[column] for name, column in _ARRAYS.items()})
    for name, kind in _NOTES.items():
        if type(footer[name]) is not kind:
            raise TypeError(f"{name} in the footer is {footer[name]!r}")
    pairs = zip(items["left_boundary_ids"], items["right_boundary_ids"], strict=True)
    return VectorMap(boundary_ids=tuple(pairs), **parts, **footer)
