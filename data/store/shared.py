"""Maps of cities as they are in memory, in files that all processes of a machine map and share.

A map in a store is packed, and what follows from it is left out. That of a city takes a moment to
unpack and tens of megabytes, in every worker. So it is kept unpacked in the user's cache folder,
under a name made of its content and of our code. Such a file is checked whenever it is opened;
where it is damaged it is made again, and where none can be written each process has its own map.
"""

import hashlib
import json
import logging
import mmap
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from shiftsim.data.store.map import LINES, LISTS, read_map_file
from shiftsim.data.store.tables import digest
from shiftsim.files import PACKAGE, sources, user_cache
from shiftsim.kernels import readonly
from shiftsim.world.layers import Layer, Lists, Polygons, Polylines
from shiftsim.world.map import LAYERS, VectorMap

_LOG = logging.getLogger(__name__)
_PACKED, _UNPACKED = 100_000, 4 << 20  # bytes from which on a map is kept: in the store, in memory
_ALIGNMENT, _PIECE = 64, 1 << 18  # bytes; of an array, and read at once
_SUM, _LENGTH = 8, 16  # bytes: checksum of all that follows, and length of the description, in hex


def shared_map(path: Path) -> VectorMap:
    """The map in a file of a store, as `read_map_file` gives it; large ones in shared memory.

    Raises:
        DataError: The file is missing or damaged.
    """
    try:
        is_large = path.stat().st_size >= _PACKED
    except OSError:  # the reader says what is wrong with it
        is_large = False
    if not is_large:
        return read_map_file(path)
    content = digest(path)[:16]
    folder = user_cache("maps")
    kept = folder / f"{content}-{_code()}.map"
    try:
        return _open(kept)
    except OSError:
        pass  # not there, or not for us
    except (ValueError, KeyError, TypeError) as error:
        _LOG.warning("%s is damaged and made again: %s", kept, error)
    road = read_map_file(path)
    if sum(array.nbytes for _, array in _arrays(road)) < _UNPACKED:
        return road
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(kept, road)
        for former in folder.glob(f"{content}-*.map"):  # of other code
            if former != kept:
                with suppress(OSError):  # in use, on Windows
                    former.unlink()
        return _open(kept)
    except (OSError, ValueError) as error:
        _LOG.info("map %r is not kept in %s: %s", road.name, folder, error)
        return road


@cache
def _code() -> str:
    """Hash of all that makes a map of a file."""
    text = repr(sorted(sources([PACKAGE / "data/store/shared.py"]).items()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _arrays(road: VectorMap) -> Iterator[tuple[str, Any]]:
    """All arrays of a map by name: of a field, or of a field and a part of it."""
    for field in fields(road):
        value = getattr(road, field.name)
        flat = value.polygons if isinstance(value, Layer) else value
        if isinstance(flat, np.ndarray):
            yield field.name, flat
        elif hasattr(flat, "_fields"):
            yield from ((f"{field.name}.{part}", getattr(flat, part)) for part in flat._fields)


def _write(path: Path, road: VectorMap) -> None:
    places, end = dict[str, tuple[str, tuple[int, ...], int]](), 0
    for name, array in _arrays(road):
        places[name] = array.dtype.str, array.shape, end
        end += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    ids = {name: getattr(road, name).ids for name in LAYERS}
    plain = [item.name for item in fields(road) if item.name not in {*ids, *_names(places)}]
    notes = {name: getattr(road, name) for name in plain}
    about = json.dumps({"arrays": places, "ids": ids, "notes": notes}).encode()
    about += b" " * (-(_SUM + _LENGTH + len(about)) % _ALIGNMENT)
    # several workers may make it at the same time: each in a folder of its own
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as draft:
        partial = Path(draft) / path.name
        with partial.open("w+b") as file:
            file.write(b"%0*x%0*x" % (_SUM, 0, _LENGTH, len(about)) + about)
            for _, array in _arrays(road):
                file.write(np.ascontiguousarray(array).data.cast("B") if array.size else b"")
                file.write(bytes(-array.nbytes % _ALIGNMENT))
            total = _checksum(file)
            file.seek(0)
            file.write(b"%0*x" % (_SUM, total))
        partial.replace(path)


def _names(places: dict[str, Any]) -> set[str]:
    return {name.partition(".")[0] for name in places}


def _checksum(file: BinaryIO) -> int:
    """Of what follows the sum; read, as every page of a mapping that is looked at stays."""
    file.seek(_SUM)
    total = 0
    while piece := file.read(_PIECE):
        total = zlib.crc32(piece, total)
    return total


def _open(path: Path) -> VectorMap:
    """The map of a file that `_write` made.

    Raises:
        OSError: It cannot be read.
        ValueError: It is damaged.
    """
    with path.open("rb") as file:
        whole = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if int(whole[:_SUM], 16) != _checksum(file):
            raise ValueError("the checksum is wrong")
    start = _SUM + _LENGTH + int(whole[_SUM : _SUM + _LENGTH], 16)
    about = json.loads(whole[_SUM + _LENGTH : start])
    arrays = {
        name: readonly(np.frombuffer(whole, kind, int(np.prod(shape)), start + at).reshape(shape))
        for name, (kind, shape, at) in about["arrays"].items()
    }
    parts: dict[str, Any] = {name: array for name, array in arrays.items() if "." not in name}
    kinds: dict[str, Any] = dict.fromkeys(LAYERS, Polygons) | dict.fromkeys(LINES, Polylines)
    for name, kind in (kinds | dict.fromkeys(LISTS, Lists)).items():
        parts[name] = kind(*(arrays[f"{name}.{part}"] for part in kind._fields))
    for name, ids in about["ids"].items():
        parts[name] = Layer(tuple(ids), parts[name])
    pairs = about["notes"].pop("boundary_ids")
    return VectorMap(boundary_ids=tuple(map(tuple, pairs)), **parts, **about["notes"])
