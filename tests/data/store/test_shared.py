"""Maps kept as they are in memory: the same to the last bit, whatever happens to the files."""

import dataclasses
import logging
import re
from pathlib import Path

import numpy as np
import places
import pytest

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.data.nuplan.map import read_map
from shiftsim.data.store import shared
from shiftsim.data.store.map import read_map_file, write_map
from shiftsim.data.store.shared import shared_map
from shiftsim.errors import DataError
from shiftsim.world.layers import Layer

GOLDEN = places.GOLDEN / "nuplan_format" / "maps" / "fixture-town" / "1.0.0" / "map.gpkg"

SMAPS = Path("/proc/self/smaps")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """The folder of the kept maps, in which small ones are kept, too."""
    monkeypatch.setenv("SHIFTSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(shared, "_PACKED", 0)
    monkeypatch.setattr(shared, "_UNPACKED", 0)
    return tmp_path / "cache" / "maps"


@pytest.fixture
def stored(tmp_path):
    """A map as a store has it; one number is none, one text is not plain."""
    road = read_map(GOLDEN, "fixture-town")
    limits = np.array(road.speed_limits)
    limits[0] = np.nan
    ids = ('\U0001f600 \\ "x"\n', *road.crosswalks.ids[1:])
    crosswalks = dataclasses.replace(road.crosswalks, ids=ids)
    path = tmp_path / "town.parquet"
    write_map(path, dataclasses.replace(road, speed_limits=limits, crosswalks=crosswalks))
    return path


def parts(road):
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


def assert_same(found, expected):
    assert list(parts(found)) == list(parts(expected))
    kinds = [[type(value) for value in vars(road).values()] for road in (found, expected)]
    assert kinds[0] == kinds[1]


def kept_file(cache):
    (path,) = cache.iterdir()
    return path


def test_a_kept_map_is_the_same_to_the_last_bit(stored, cache):
    expected = read_map_file(stored)
    assert_same(shared_map(stored), expected)
    before = kept_file(cache).stat()
    assert_same(shared_map(stored), expected)
    after = kept_file(cache).stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


@pytest.mark.skipif(not SMAPS.exists(), reason="needs the tables of Linux")
def test_a_process_has_only_the_parts_of_a_kept_map_that_it_looks_at(tmp_path, cache):
    path = tmp_path / "city.parquet"
    write_map(path, bench_scene(1, 0).map)
    for _ in range(2):  # made, then found
        road = shared_map(path)
    tables = SMAPS.read_text("utf-8").partition(str(kept_file(cache)))[2]
    size, resident = (int(re.search(rf"^{n}:\s*(\d+)", tables, re.M)[1]) for n in ("Size", "Rss"))
    assert size > 20_000  # kB
    assert resident < 0.2 * size
    assert road.num_lanes > 1000  # and it is still open


DAMAGES = {
    "empty": lambda data: b"",
    "cut off": lambda data: data[: len(data) // 2],
    "one byte less": lambda data: data[:-1],
    "more": lambda data: data + b"x",
    "no number": lambda data: b"\xff" * 40 + data[40:],
    **{
        f"byte at {share:.0%}": lambda data, share=share: (
            data[: (at := int(share * (len(data) - 1)))] + bytes([data[at] ^ 1]) + data[at + 1 :]
        )
        for share in (0.0, 0.0005, 0.01, 0.1, 0.5, 0.99)
    },
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_told_once_and_made_again(damage, stored, cache, caplog):
    expected = read_map_file(stored)
    shared_map(stored)
    path = kept_file(cache)
    sound = path.read_bytes()
    path.unlink()  # it is mapped
    path.write_bytes(DAMAGES[damage](sound))
    with caplog.at_level(logging.WARNING):
        assert_same(shared_map(stored), expected)
        assert_same(shared_map(stored), expected)
    (record,) = caplog.records
    assert f"{path} is damaged and made again" in record.getMessage()
    assert path.read_bytes() == sound


def test_what_other_code_made_is_not_used_and_goes_away(stored, cache, monkeypatch):
    shared_map(stored)
    former = kept_file(cache)
    monkeypatch.setattr(shared, "_code", lambda: "other")
    assert_same(shared_map(stored), read_map_file(stored))
    assert kept_file(cache) != former


def test_other_content_is_another_file(stored, cache):
    shared_map(stored)
    road = read_map_file(stored)
    changed = dataclasses.replace(road, name="other")
    write_map(stored, changed)
    assert shared_map(stored).name == "other"
    assert len(list(cache.iterdir())) == 2


def test_where_nothing_can_be_kept_maps_are_read_all_the_same(stored, tmp_path, caplog):
    (tmp_path / "cache").write_text("not a folder")
    with caplog.at_level(logging.WARNING):
        assert_same(shared_map(stored), read_map_file(stored))
    assert caplog.records == []


def test_small_maps_are_not_kept(stored, cache, monkeypatch):
    monkeypatch.setattr(shared, "_UNPACKED", 4 << 20)
    assert_same(shared_map(stored), read_map_file(stored))
    assert not cache.exists()


def test_a_map_that_is_kept_does_not_hide_that_the_store_is_damaged(stored, cache):
    shared_map(stored)
    data = stored.read_bytes()
    stored.write_bytes(data[:-200])
    with pytest.raises(DataError, match=r"town\.parquet"):
        shared_map(stored)
    stored.unlink()
    with pytest.raises(DataError, match="is missing"):
        shared_map(stored)
