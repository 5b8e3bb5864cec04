"""Maps as Arrow IPC files: the same to the last bit, and shared by all processes that map them."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.data.store.map import SCHEMA, read_map_file, write_map
from shiftsim.errors import DataError
from shiftsim.world.layers import Layer
from shiftsim.world.map import VectorMap

SMAPS = Path("/proc/self/smaps")


def parts(road: VectorMap):
    """All that a map is made of, arrays as bytes."""
    for field in dataclasses.fields(road):
        value = getattr(road, field.name)
        if isinstance(value, Layer):
            yield field.name, (value.ids, dict(value.index))
            value = value.polygons
        for part in value if hasattr(value, "_fields") else (value,):
            if isinstance(part, np.ndarray):
                assert part.flags.c_contiguous
                assert part.flags.aligned
                with pytest.raises(ValueError, match="WRITEABLE"):
                    part.flags.writeable = True
                yield field.name, (part.dtype, part.shape, part.tobytes())
            else:
                yield field.name, part


def test_a_map_comes_back_to_the_last_bit(tmp_path: Path, road: VectorMap) -> None:
    limits = np.array(road.speed_limits)
    limits[0] = np.nan
    ids = ('\U0001f600 \\ "x"\n', *road.crosswalks.ids[1:])
    crosswalks = dataclasses.replace(road.crosswalks, ids=ids)
    odd = dataclasses.replace(
        road, speed_limits=limits, crosswalks=crosswalks, flaws={"edge names nothing": 3}
    )
    path = tmp_path / "town.arrow"
    write_map(path, odd)
    found = read_map_file(path)
    assert list(parts(found)) == list(parts(odd))
    kinds = [[type(value) for value in vars(each).values()] for each in (found, odd)]
    assert kinds[0] == kinds[1]
    before = path.read_bytes()
    write_map(path, found)  # over the file that is mapped
    assert path.read_bytes() == before


@pytest.mark.skipif(not SMAPS.exists(), reason="needs the tables of Linux")
def test_the_arrays_of_a_map_lie_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "city.arrow"
    write_map(path, bench_scene(1, 0).map)
    road = read_map_file(path)
    tables = SMAPS.read_text("utf-8").partition(str(path))[2]
    size, own = (
        int(re.search(rf"^{name}:\s*(\d+)", tables, re.M)[1]) for name in ("Size", "Anonymous")
    )
    assert (size > 20_000, own) == (True, 0)  # kB
    assert road.num_lanes > 1000  # and it is still open


def test_other_tools_read_a_map(tmp_path: Path, road: VectorMap) -> None:
    polars = pytest.importorskip("polars")
    path = tmp_path / "town.arrow"
    write_map(path, road)
    with pa.ipc.open_file(str(path)) as file:
        assert file.read_all()["edges_ids"][0].as_py() == list(road.edges.ids)
    found = polars.read_ipc(path)
    assert found.columns == SCHEMA.names
    assert found["baselines_xy_m"][0].to_numpy().tolist() == road.baselines.xy.tolist()


@pytest.mark.parametrize(
    ("name", "value"),
    [("incoming_items", 10**6), ("left_lane", -2), ("edges_cell_items", 10**6), ("block_of", 999)],
)
def test_an_index_of_nothing_is_refused(
    name: str, value: int, tmp_path: Path, road: VectorMap
) -> None:
    path = tmp_path / "town.arrow"
    write_map(path, road)
    table = pa.ipc.open_file(path.read_bytes()).read_all()
    numbers = table[name].to_pylist()
    numbers[0][0] = value
    at = table.column_names.index(name)
    table = table.set_column(at, table.schema.field(name), pa.array(numbers, SCHEMA.field(at).type))
    with pa.ipc.new_file(str(path), SCHEMA) as writer:
        writer.write_table(table)
    with pytest.raises(DataError, match=r"town\.arrow: .* names something that does not exist"):
        read_map_file(path)


def test_where_a_map_is_cut_off_or_spoilt_it_is_an_error(tmp_path: Path, road: VectorMap) -> None:
    path = tmp_path / "town.arrow"
    write_map(path, road)
    data = path.read_bytes()
    for damaged in (b"", data[: len(data) // 2], data[:-1]):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"town\.arrow: not a readable map"):
            read_map_file(path)
