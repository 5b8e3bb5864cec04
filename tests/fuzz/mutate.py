"""Ways to damage a file: as bytes, and by what is in it. Everything follows from the generator."""

import copy
import json
import lzma
import re
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from random import Random
from typing import Any

import msgpack
import pyarrow as pa
import pyarrow.parquet as pq
from lxml import etree

NUMBERS = (
    *(float("nan"), float("inf"), float("-inf"), 1e300, -1e300, 1e18, 1e9, 1e6, 400.0, 1e-300),
    *(-1, 0, 1, 2**31, 2**53 + 1, 2**63 - 1, 2**63, 10**30),
)
TEXTS = ("", " ", "x", "nan", "-1", "../..", "\u202e\U0001f697", "a" * 100_000, "9" * 5_000)
DEEP = "[" * 20_000 + "]" * 20_000
_MOST_VALUES = 1_000_000  # bytes of what is very long
WHOLE = (-1, 0, 1, 127, 10**4, 2**31 - 1, 2**53 + 1, 2**63 - 1, -(2**63))
_TOKEN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
_QUOTED = re.compile(rb"\"[^\"\n]*\"")
# what no library writes: in the place of these marks
_DEEP_MARK, _LONG_MARK = "deep-mark", "long-mark"
_IN_JSON = {_DEEP_MARK: DEEP, _LONG_MARK: "9" * 5_000}
_IN_MSGPACK = {  # nested; lists, maps, texts and bytes of absurd lengths; an object of ours
    _DEEP_MARK: b"\x91" * 20_000 + b"\x90",
    _LONG_MARK: [
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\x7f\xff\xff\xff",
        b"\xdb\x7f\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
    ],
}


def damage(path: Path, random: Random) -> str:
    """Damage a file; says how."""
    ways = [_bytes, _bytes, *_WAYS.get(path.suffix, (_text,)) * 3]
    way = random.choice(ways)
    if not path.stat().st_size:
        return "nothing left"
    try:
        return f"{path.name}: {way(path, random) or way.__name__.strip('_')}"
    except Exception as error:  # what is damaged already cannot be damaged with care
        what = _bytes(path, random) if path.stat().st_size else "nothing left"
        return f"{path.name}: {what} ({type(error).__name__})"


def _bytes(path: Path, random: Random) -> str:
    data = bytearray(path.read_bytes())
    at = random.randrange(len(data))
    size = random.choice((1, 4, 16, 256, len(data)))
    kind = random.choice(
        ("flip", "flip", "cut off", "cut out", "repeat", "zeros", "ones", "splice")
    )
    if kind == "flip":
        for _ in range(random.choice((1, 1, 4, 32))):
            data[random.randrange(len(data))] ^= 1 << random.randrange(8)
    elif kind == "cut off":
        del data[at:]
    elif kind == "cut out":
        del data[at : at + size]
    elif kind == "repeat":
        data[at:at] = data[at : at + size]
    elif kind == "splice":
        start = random.randrange(len(data))
        data[at : at + size] = data[start : start + size]
    else:
        end = min(at + size, len(data))
        data[at:end] = (b"\0" if kind == "zeros" else b"\xff") * (end - at)
    path.write_bytes(data)
    return kind


def _text(path: Path, random: Random) -> str:
    """Another number or text in the place of one."""
    data = path.read_bytes()
    found = list(random.choice((_TOKEN, _TOKEN, _QUOTED)).finditer(data))
    if not found:
        return _bytes(path, random)
    spot = random.choice(found)
    if spot[0].startswith(b'"'):
        new = json.dumps(random.choice((*TEXTS, *map(str, NUMBERS))))
    else:
        words = (
            "",
            "true",
            '"x"',
            "[]",
            "{}",
            "null",
            "1979-05-27",
            *("9" * n for n in (400, 5_000)),
            DEEP,
        )
        new = str(random.choice((*NUMBERS, *words)))
    path.write_bytes(data[: spot.start()] + new.encode() + data[spot.end() :])
    return f"{spot[0][:40]!r} -> {new[:40]!r}"


def _lines(path: Path, random: Random) -> str:
    """A line twice, away, or elsewhere."""
    lines = path.read_bytes().splitlines(keepends=True)
    one = random.choice(lines)
    if random.random() < 0.5:
        lines.remove(one)
    lines[random.randrange(len(lines) + 1) : 0] = [one] * random.randrange(3)
    path.write_bytes(b"".join(lines))
    return f"line {one[:40]!r} moved"


def _cells(path: Path, random: Random) -> str:
    """A column of CSV twice, away or without values; a line of very many cells, or a long one."""
    rows = [line.split(",") for line in path.read_text("utf-8").splitlines()]
    at = random.randrange(len(rows[0]))
    kind = random.choice(("twice", "away", "empty", "some empty", "wide", "all wide", "long"))
    for number, row in enumerate(rows):
        cell = row[at]
        if kind in ("twice", "away"):
            row[at : at + 1] = [cell] * (2 if kind == "twice" else 0)
        elif number and (kind == "empty" or (kind == "some empty" and random.random() < 0.1)):
            row[at] = ""
        elif kind == "all wide":
            row += [f"{cell}{extra}" for extra in range(1_000)]
    if kind == "wide":
        random.choice(rows).extend(["1"] * 100_000)
    elif kind == "long":
        random.choice(rows)[at] = random.choice((DEEP, "9" * 5_000, "9" * 2_000_000, '"' + "x" * 9))
    path.write_text("\n".join(map(",".join, rows)) + "\n", "utf-8")
    return f"column {at} {kind}"


def _xml(path: Path, random: Random) -> str:
    """An element away or twice, or an attribute away or changed."""
    root = etree.parse(path).getroot()
    element = random.choice(list(root.iter(etree.Element)))
    parent = element.getparent()
    kind = random.random()
    if kind < 0.15 and parent is not None:
        parent.remove(element)
        what = "away"
    elif kind < 0.3 and parent is not None:
        for _ in range(random.choice((1, 2, 50))):
            parent.insert(random.randrange(len(parent) + 1), copy.deepcopy(element))
        what = "again"
    elif not element.attrib:
        return _xml(path, random)
    else:
        name = random.choice(list(element.attrib))
        value = random.choice((*map(str, NUMBERS), *map(str, NUMBERS), *TEXTS, None))
        what = f"{name}={str(value)[:30]}"
        if value is None:
            del element.attrib[name]
        else:
            element.set(name, value)
    root.getroottree().write(path)
    return f"{element.tag} {what}"


def _json(path: Path, random: Random) -> str:
    """A value of a JSON file, or of one line of it, away or changed."""
    text = path.read_text("utf-8")
    lines = text.splitlines() if path.suffix == ".jsonl" else [text]
    row = random.randrange(len(lines))
    content = json.loads(lines[row])
    what = change_value(content, random, _IN_JSON)
    lines[row] = json.dumps(content)
    for mark, new in _IN_JSON.items():
        lines[row] = lines[row].replace(f'"{mark}"', new)
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return what


def change_value(content: Any, random: Random, marks: Iterable[str] = ()) -> str:
    """Change or remove one value, at any depth, of plain lists and dictionaries.

    The value may be one of the `marks`, in whose place comes what plain values cannot say.
    """
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in list(items):
            places.append((node, key))
            if isinstance(value, dict | list):
                visit(value)

    visit(content)
    node, key = random.choice(places)
    deep: list[Any] = []
    for _ in range(90):
        deep = [deep]
    new = random.choice(
        (*NUMBERS, *TEXTS, None, True, [], {}, [1, "x", None], {"x": -1}, deep, *marks, *marks)
    )
    kind = random.random()
    if isinstance(node[key], dict) and kind > 0.7:
        new = [*node[key]]  # the names alone
    elif isinstance(node[key], list) and kind > 0.7:
        new = [[item] for item in node[key]]
    if kind < 0.15:
        del node[key]
        return f"{key!r} away"
    if kind < 0.25 and isinstance(node, list):
        node.insert(key, copy.deepcopy(node[key]))
        return f"{key!r} again"
    node[key] = new
    return f"{key!r} = {str(new)[:30]}"


def _database(path: Path, random: Random) -> str:
    """A cell changed; rows, columns or tables away; rows twice."""
    with closing(sqlite3.connect(path)) as base, base:
        tables = [
            row[0] for row in base.execute("select name from sqlite_master where type='table'")
        ]
        table = random.choice([t for t in tables if not t.startswith("sqlite_")])
        columns = [row[1] for row in base.execute(f'pragma table_info("{table}")')]
        column = random.choice(columns)
        rows = [row[0] for row in base.execute(f'select rowid from "{table}"')] or [0]
        row, kind = random.choice(rows), random.random()
        if kind < 0.05:
            base.execute(f'drop table "{table}"')
            return f"{table} away"
        if kind < 0.1:
            base.execute(f'alter table "{table}" rename column "{column}" to "other"')
            return f"{table}.{column} away"
        if kind < 0.2:
            base.execute(f'delete from "{table}" where rowid >= ?', (row,))
            return f"{table} cut off"
        if kind < 0.25:
            base.execute(f'delete from "{table}" where rowid = ?', (row,))
            return f"{table} row away"
        values = [v for v in (*NUMBERS, *WHOLE) if not isinstance(v, int) or abs(v) < 2**63]
        new = random.choice((*values, *TEXTS[:5], None, b"", b"\xff" * 9, "swap", "swap"))
        if new == "swap":
            new = base.execute(
                f'select "{column}" from "{table}" where rowid = ?', (random.choice(rows),)
            ).fetchone()
            new = new and new[0]
        if isinstance(new, bytes | None) or random.random() < 0.3:
            old = base.execute(f'select "{column}" from "{table}" where rowid=?', (row,)).fetchone()
            if old and isinstance(old[0], bytes) and len(old[0]) > 40:  # a geometry
                blob = bytearray(old[0])
                at = random.randrange(len(blob))
                blob[at : at + 8] = random.choice((b"\xff" * 8, b"\0" * 8, b"\x7f\xf0" * 4))
                new = bytes(blob)
        where = "" if random.random() < 0.1 else f" where rowid = {row}"
        base.execute(f'update "{table}" set "{column}" = ?{where}', (new,))
        return f"{table}.{column} = {str(new)[:30]}"


def _parquet(path: Path, random: Random) -> str:
    """A value changed; rows or columns away, twice, null or of another type; the footer changed."""
    file = pq.ParquetFile(path)
    table, notes = file.read(), dict(file.metadata.metadata or {})
    groups = max(file.metadata.row_group(0).num_rows, 1) if file.num_row_groups else 1
    keys = [key for key in notes if key != b"ARROW:schema"]
    if keys and random.random() < 0.1:
        key = random.choice(keys)
        content = json.loads(notes[key])
        what = "footer: " + change_value(content, random)
        notes[key] = json.dumps(content).encode()
    else:
        table, what = _table(table, random)
    notes.pop(b"ARROW:schema", None)
    with pq.ParquetWriter(path, table.schema, store_schema=False) as writer:
        writer.write_table(table, row_group_size=groups)
        writer.add_key_value_metadata(notes)
    return what


def _arrow(path: Path, random: Random) -> str:
    """As for Parquet; and what msgpack packed in the schema or a cell changed."""
    with pa.OSFile(str(path)) as source:
        table = pa.ipc.open_file(source).read_all()
    table.validate(full=True)  # a damaged one would end this process
    notes = dict(table.schema.metadata or {})
    packed = [name for name in ("features",) if name in table.column_names]
    if packed and random.random() < 0.4:
        cells = table[packed[0]].to_pylist()
        row = random.randrange(len(cells))
        cells[row], what = _repacked(cells[row], random)
        at = table.column_names.index(packed[0])
        table = table.set_column(at, packed[0], pa.array(cells, pa.binary()))
        what = f"{packed[0]}[{row}]: {what}"
    elif notes and random.random() < 0.3:
        key = random.choice(list(notes))
        notes[key], what = _repacked(notes[key], random)
        what = f"{key!r}: {what}"
    else:
        table, what = _table(table, random)
    table = table.replace_schema_metadata(notes)
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    return what


def _repacked(data: bytes, random: Random) -> tuple[bytes, str]:
    content = msgpack.unpackb(data, strict_map_key=False)
    arrays = [held for held in _maps(content) if b"__ndarray__" in held]
    if arrays and random.random() < 0.2:
        held, key = random.choice(arrays), random.choice((b"shape", b"dtype", b"data"))
        held[key] = random.choice((-1, [10**9, 10**9], [-1, -1], [], "O", "<f8,<f8", b"", None))
        return msgpack.packb(content), f"{key!r} = {held[key]!r}"
    holder = [content]
    what = change_value(holder, random, _IN_MSGPACK)
    packed = b"".join(map(msgpack.packb, holder))
    for mark, new in _IN_MSGPACK.items():
        new = new if isinstance(new, bytes) else random.choice(new)
        packed = packed.replace(msgpack.packb(mark), new)
    return packed, what


def _maps(content: Any) -> Iterator[dict[Any, Any]]:
    """All dictionaries in plain values."""
    if isinstance(content, dict):
        yield content
    if isinstance(content, dict | list):
        for value in content.values() if isinstance(content, dict) else content:
            yield from _maps(value)


def _table(table: pa.Table, random: Random) -> tuple[pa.Table, str]:
    name = random.choice(table.column_names)
    index, kind = table.column_names.index(name), random.random()
    field = table.schema.field(index)
    if kind < 0.05:
        return table.drop_columns([name]), f"{name} away"
    if kind < 0.09:
        other = random.choice((table[name], pa.nulls(len(table), field.type), table[0]))
        return table.append_column(field.name, other), f"{name} twice"
    if kind < 0.12:
        other = random.choice((pa.string(), pa.int64(), pa.float64(), pa.float32()))
        if pa.types.is_list(field.type) and random.random() < 0.7:
            other = pa.list_(other)
        new = table[name].cast(other) if random.random() < 0.7 else pa.nulls(len(table), other)
        return table.set_column(index, name, new), f"{name} as {other}"
    if kind < 0.2:
        row = random.randrange(max(len(table), 1))
        parts = random.choice(
            ([table[:row]], [table, table[:row]], [table[:row], table[row + 1 :]])
        )
        return pa.concat_tables(parts), "rows away or twice"
    if kind < 0.24:
        return _long(table, index, random)
    floats = [i for i, one in enumerate(table.schema.types) if pa.types.is_floating(one)]
    if kind < 0.27 and floats:
        index = random.choice(floats)
        field, name = table.schema.field(index), table.column_names[index]
    values = table.column(index).to_pylist()
    row = random.randrange(len(values))
    old, what = values[row], f"{name}[{row}]"
    if kind < 0.27 and floats:
        for other in random.sample(range(len(values)), min(3, len(values))):
            values[other] = None
        what = f"{name} with nulls"
    elif kind < 0.29:
        values = [None] * len(values)
        what = f"{name} = null"
    elif kind < 0.33:
        values[row] = None
        what += " = null"
    elif isinstance(old, list) and old and random.random() < 0.8:
        at = random.randrange(len(old))
        if isinstance(old[at], list) and old[at]:
            old, what = old[at], f"{what}[{at}]"
            at = random.randrange(len(old))
        old[at] = _like(old[at], random)
        what += f"[{at}] = {str(old[at])[:30]}"
    elif isinstance(old, list):
        values[row] = random.choice(([], old[:-1], old * 2, old[::-1], [*old, None]))
    else:
        values[row] = _like(old, random)
        what += f" = {str(values[row])[:30]}"
    field = field.with_nullable(True)
    return table.set_column(index, field, pa.array(values, field.type)), what


def _long(table: pa.Table, index: int, random: Random) -> tuple[pa.Table, str]:
    """Very many rows, columns or items, or texts that hold what nobody nests or counts."""
    name, field = table.column_names[index], table.schema.field(index)
    kind = random.choice(("rows", "columns", "items"))
    if kind == "rows":
        times = max(_MOST_VALUES // max(table.nbytes, 1), 2)
        return pa.concat_tables([table] * times), f"{times} times the rows"
    if kind == "columns":
        more = max(min(_MOST_VALUES // max(table[index].nbytes, 1), 2_000), 2)
        for number in range(more):
            table = table.append_column(f"{name}{number}", table[index])
        return table, f"{more} columns more"
    values = table.column(index).to_pylist()
    row = random.randrange(max(len(values), 1))
    if isinstance(values[row], list) and values[row]:
        values[row] = values[row] * max(100_000 // len(str(values[row])), 2)
    elif isinstance(values[row], str):
        values[row] = random.choice(
            (DEEP, "9" * 5_000, f'{{"x": {DEEP}}}', f'{{"x": {"9" * 5_000}}}')
        )
    else:
        return table, f"{name} as it is"
    return table.set_column(index, field, pa.array(values, field.type)), f"{name}[{row}] long"


def _like(old: Any, random: Random) -> Any:
    """A bad value of the type of another."""
    if isinstance(old, bool):
        return not old
    if isinstance(old, int):
        return random.choice((*WHOLE, old + 1, old - 1, old * 2))
    if isinstance(old, float):
        return float(random.choice(NUMBERS))
    if isinstance(old, str):
        return random.choice((*TEXTS, old + "x"))
    return None


def _checkpoint(path: Path, random: Random) -> str:
    """An entry, a tensor or a value of a tensor away or changed."""
    import torch

    entries = torch.load(path, weights_only=False)
    holder = random.choice([entries, *(v for v in entries.values() if isinstance(v, dict))])
    name = random.choice(list(holder))
    value, kind = holder[name], random.random()
    if kind < 0.2 or not isinstance(value, torch.Tensor):
        what = change_value(holder, random) if random.random() < 0.7 else f"{name} replaced"
        if what.endswith("replaced"):
            holder[name] = Exception("x")
    elif kind < 0.6 and value.numel() and value.is_floating_point():
        at = random.randrange(value.numel())
        value.reshape(-1)[at] = float(random.choice(NUMBERS))
        what = f"{name}[{at}]"
    elif kind < 0.8:
        holder[name] = random.choice(
            (value[:-1], value.expand(2, *value.shape), value.bool(), value.to(torch.complex64))
        )
        what = f"{name} of another shape or type"
    else:
        size = (10**9, 10**9) if value.ndim else (10**12,)
        holder[name] = torch.zeros(1).expand(*size)
        what = f"{name} huge"
    torch.save(entries, path)
    return what


def _header(path: Path, random: Random) -> str:
    """A value of the header of a safetensors file away or changed."""
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    what = change_value(header, random)
    if random.random() < 0.2:
        header["__metadata__"], what = {"args": DEEP}, "deep args"
    new = json.dumps(header).encode()
    path.write_bytes(len(new).to_bytes(8, "little") + new + data[end:])
    return what


def _packed(path: Path, random: Random) -> str:
    """What an xz file holds, damaged as bytes."""
    path.write_bytes(lzma.decompress(path.read_bytes()) or b"\0")
    if ".msgpack" in path.name and random.random() < 0.3:
        pickled, what = _repacked(path.read_bytes(), random)
        path.write_bytes(pickled)
    else:
        what = _bytes(path, random)
    path.write_bytes(lzma.compress(path.read_bytes(), preset=0))
    return f"inside: {what}"


_WAYS: dict[str, Any] = {
    ".xodr": (_xml, _xml, _text),
    ".xml": (_xml, _text, _text),
    ".db": (_database,),
    ".gpkg": (_database,),
    ".parquet": (_parquet,),
    ".arrow": (_arrow,),
    ".json": (_json, _text),
    ".jsonl": (_json, _text, _lines),
    ".toml": (_text, _lines),
    ".txt": (_text, _lines),
    ".pth": (_checkpoint,),
    ".ckpt": (_checkpoint,),
    ".safetensors": (_header,),
    ".csv": (_text, _text, _lines, _cells, _cells),
    ".xz": (_packed,),
}
