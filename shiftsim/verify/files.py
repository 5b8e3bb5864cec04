"""Reference files: named values, which of them were used, and their comparison with ours.

The values of a file are the arrays of an `.npz`, the columns of a `.parquet` or the fields of a
`.json`. All three are a `Source`: what it hands out counts as used, `finish` names the rest as not
covered. `match` compares values of ours with those of the same names. `Scenes` are the logs and
maps that files refer to, in nuPlan's own formats.
"""

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

from shiftsim.data.nuplan.mapping import Mapping as LogMapping
from shiftsim.data.nuplan.scenarios import find_maps, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.files import read_toml
from shiftsim.verify.report import Report
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

# keys and tolerances of tables, and how folders are recognised
COMPARED = read_toml(Path(__file__).with_name("compared.toml"))
EXACT = 0.0
MAPPING: LogMapping = (15.0, 0.0, 0.5)  # the reference scenes start at their tag
TOLERANCE = 1e-9  # of floats, unless a comparison names another
DAMAGED = "the file is damaged, or not what its name says; make it or get it again"
Named: TypeAlias = Mapping[str, Any]  # values by name
Key: TypeAlias = tuple[str, ...]  # of rows that belong together
# Tolerance of all, or by name, "" being that of all others; exact where there is none
Tolerances: TypeAlias = float | Mapping[str, ArrayLike]


@dataclass
class Source:
    """Named values of one file, or of a part of it."""

    name: str  # name of the file without its ending; begins the names of compared quantities
    what: str  # what one of its values is called
    values: Named  # all of them
    report: Report  # receives the comparisons
    # names of the values that were read or noted; shared by all parts of a file
    used: set[str] = field(default_factory=set)
    rows: Any = None  # which rows of the values this part has; None for all
    prefix: str = ""  # of the names in the file, for a part with shorter ones
    _parts: "dict[str, list[Source]]" = field(init=False, default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name.partition("[")[0] in self.values

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __getitem__(self, name: str) -> Any:
        """A value, which is used from now on, or a part of one, as in `poses[:, :2]`.

        A `DataError` if there is none.
        """
        name, _, index = name.rstrip("]").partition("[")
        if name not in self.values:
            raise DataError(f"{self.name}: {self.what} {name!r} is missing")
        self.used.add(self.prefix + name)
        value = self.values[name] if self.rows is None else self.values[name][self.rows]
        return value[read_index(index)] if index else value

    def take(self, name: str, *shape: int) -> Any:
        """An array of a given shape, contiguous; -1 is any length."""
        array = np.ascontiguousarray(self[name])
        sizes = zip(shape, array.shape, strict=False)
        if array.ndim != len(shape) or any(wanted not in (-1, size) for wanted, size in sizes):
            found = f"{self.what} {name!r} has shape {array.shape}"
            raise DataError(f"{self.name}: {found}, not {shape}")
        return array

    @property
    def num_rows(self) -> int:
        """Rows of a table, or of a part of one."""
        return len(next(iter(self.values.values())) if self.rows is None else self.rows)

    def at(self, rows: Any) -> "Source":
        """Some rows of every value: an index, indices or a mask."""
        if getattr(rows, "dtype", None) == np.bool_:
            rows = np.flatnonzero(rows)
        return replace(self, rows=rows if self.rows is None else self.rows[rows])

    def below(self, prefix: str) -> "Source":
        """The values whose names begin with a prefix, by the rest of their names."""
        values = {n.removeprefix(prefix): v for n, v in self.values.items() if n.startswith(prefix)}
        return replace(self, values=values, prefix=self.prefix + prefix)

    def groups(self, *key: str) -> "dict[Key, Source]":
        """The rows by the values of key columns, in the order of the file."""
        groups: dict[Key, list[int]] = {}
        for row, values in enumerate(zip(*(self[name].tolist() for name in key), strict=True)):
            groups.setdefault(tuple(map(str, values)), []).append(row)
        return {values: self.at(np.array(rows)) for values, rows in groups.items()}

    def each(self, name: str) -> "list[Source]":
        """The objects in a list of a `.json`, as parts of the file; or the one that is not listed.

        `finish` names the fields of these objects that nothing used.
        """
        if name not in self._parts:
            found, label, used = self[name], f"{self.name} {name}", set[str]()
            items = found if isinstance(found, list) else [found]
            parts = [Source(label, self.what, item, self.report, used) for item in items]
            self._parts[name] = parts
        return self._parts[name]

    def match(
        self,
        where: str,
        ours: Named,
        atol: Tolerances = EXACT,
        *,
        quantity: str | None = None,
        angles: Collection[str] = (),
        unordered: Collection[str] = (),
    ) -> bool:
        """Compare values of ours with those of the same names; a missing one is a mismatch.

        `quantity` begins the names of the quantities, instead of the name of the file. `angles` are
        equal up to whole turns, `unordered` lists in any order. Returns whether all agree.
        """
        prefix, agree = self.name if quantity is None else quantity, True
        for name, value in ours.items():
            bound = atol if isinstance(atol, float) else atol.get(name, atol.get("", EXACT))
            label = f"{prefix} {name}".strip()
            if name not in self:
                agree = self.report.fail(label, where, f"no {self.what} {name!r}")
                continue
            sides = value, self[name]
            if name in unordered and isinstance(value, list):
                sides = sorted(map(repr, value)), sorted(map(repr, sides[1]))
            angle = name in angles
            agree &= self.report.compare(label, where, *sides, atol=bound, angle=angle)
        return agree

    def note(self, what: str, *names: str) -> None:
        """Name values that need not be compared."""
        self.used.update(self.prefix + name for name in names)
        self.report.note(f"{self.name} {', '.join(names)}{': ' if names else ''}{what}")

    def finish(self) -> None:
        """Name the values that nothing used."""
        for name in self.values:
            if self.prefix + name not in self.used:
                self.report.skip(f"{self.name}: {self.what} {name!r}")
        for part in (part for parts in self._parts.values() for part in parts):
            part.finish()


def read_index(text: str) -> Any:
    """The index that `-1`, `:, 0` or `..., :2` stands for; any other text is a key."""
    if not set(text) <= set("-:., 0123456789"):
        return text
    keys: list[Any] = []
    for part in text.split(","):
        numbers = [int(n) if n.strip() else None for n in part.split(":") if part.strip() != "..."]
        keys.append(slice(*numbers) if len(numbers) > 1 else numbers[0] if numbers else ...)
    return tuple(keys) if len(keys) > 1 else keys[0]


Compare: TypeAlias = Callable[[Source, str], object]  # of a file or case, and what it is called
Files: TypeAlias = Mapping[str, Compare]  # by pattern of names
Parts: TypeAlias = Mapping[str, Callable[[Path], object] | None]  # likewise


def read_file(path: Path, report: Report, name: str = "") -> Source:
    """The values of a file, which may have another `name`.

    Strings of a `.parquet` are object arrays, its absent values None or NaN; a `.json` that is a
    list has the one field `rows`.
    """
    name = name or path.stem
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return Source(name, "array", dict(archive), report)
    if path.suffix == ".parquet":
        try:
            table = pq.read_table(path)
            columns = {column: table[column].to_numpy() for column in table.column_names}
        except (OSError, UnicodeError, pa.ArrowException) as error:
            raise DataError(f"{path}: not a readable Parquet file ({error})", DAMAGED) from error
        return Source(name, "column", columns, report)
    content = read_json(path)
    fields = {"rows": content} if isinstance(content, list) else content
    return Source(name, "field", fields, report)


def read_json(path: Path) -> Any:
    """Content of a `.json`; a `DataError` if it cannot be read."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable JSON: {error}") from error


class Groups(dict[Key, Source]):
    """The rows of a `.parquet` by key, and which of them were asked for; other keys have no rows.

    `atol` holds unless a comparison names another.
    """

    def __init__(self, table: Source, key: Sequence[str], atol: Tolerances = EXACT) -> None:
        self.table, self.atol, self._asked = table, atol, set[Key]()
        self._mode = table.report.mode if "challenge" in key else None
        super().__init__(table.groups(*key) if table.values else {})

    def __getitem__(self, key: Key) -> Source:
        self._asked.add(key)
        return super().__getitem__(key) if key in self else self.table.at(np.zeros(0, np.int64))

    def of_mode(self) -> list[Key]:
        """Keys of what the report is about: of the runs of its mode, or all."""
        return [key for key in self if self._mode is None or self._mode in key]

    def match(self, key: Key, ours: Named, atol: Tolerances | None = None, **options: Any) -> bool:
        """`Source.match` for the rows of a key."""
        return self[key].match(" ".join(key), ours, self.atol if atol is None else atol, **options)

    def match_keys(self, key: Key, ours: list[Key]) -> None:
        """Compare which keys begin with `key`, by the rest of them."""
        theirs = [name[len(key) :] for name in self if name[: len(key)] == key]
        label, where = f"{self.table.name} present", " ".join(key)
        self.table.report.compare(label, where, sorted(ours), sorted(theirs))

    def finish(self) -> None:
        """Name rows of the mode that nothing asked for, and columns that nothing used."""
        for key in self.of_mode():
            if key not in self._asked:
                self.table.report.skip(f"{self.table.name}: rows of {' '.join(key)}")
        if self._asked & set(self):
            self.table.finish()


def open_tables(folder: Path, report: Report, *names: str) -> dict[str, Groups]:
    """The `.parquet` files of these names, with keys and tolerances as of `compared.toml`.

    One that does not exist has no rows, and is named as not covered.
    """
    tables = {}
    for path in (folder / f"{name}.parquet" for name in names):
        if path.is_file():
            table = read_file(path, report)
        else:
            report.skip(f"{path.name} is missing")
            table = Source(path.stem, "column", {}, report)
        tables[path.stem] = Groups(table, **COMPARED[path.name])
    return tables


class Scenes:
    """The scenarios of a nuplan reference folder by scene name, each read when first asked for.

    Attributes:
        folder: Holds `scenes.json`, `logs` and `maps`; without `scenes.json` there are no scenes.
        entries: What `scenes.json` says, by scene name; `report` takes what is compared with it.
        mapping: Duration [s], offset [s] and subsample ratio that the scenarios are cut with.
    """

    def __init__(
        self, folder: Path, report: Report | None = None, mapping: LogMapping = MAPPING
    ) -> None:
        path, used = folder / "scenes.json", report or Report()
        listed = read_json(path) if path.is_file() else []
        entries = [Source("scenes.json", "field", entry, used) for entry in listed]
        self.folder, self.entries = folder, {entry["scene"]: entry for entry in entries}
        self.mapping, self._read = mapping, dict[str, Scenario]()

    def __getitem__(self, scene: str) -> Scenario:
        if scene not in self._read:
            entry = self.entries[scene]
            if entry["map"] not in self.maps:
                raise DataError(f"{self.folder / 'scenes.json'}: unknown map {entry['map']!r}")
            path, road = self.folder / entry["db"], self.maps[entry["map"]]
            self._read[scene] = read_scenario(path, entry["token"], road, self.mapping)
        return self._read[scene]

    @cached_property
    def maps(self) -> dict[str, VectorMap]:
        """All maps of the folder by name."""
        files = find_maps(self.folder / "maps")
        return {name: load_map(files, name) for name in files}


def verify_file(compare: Compare, path: Path, report: Report) -> None:
    """`compare` the values of a file; those that it does not use are not covered.

    The file is named without the number that its name may end with.
    """
    file = read_file(path, report, re.sub(r"_\d+$", "", path.stem))
    compare(file, path.stem)
    if file.what != "column" or file.num_rows:
        file.finish()


def verify_files(folder: Path, report: Report, parts: Parts, files: Files | None = None) -> None:
    """Give every file of a folder to the part whose pattern is the first to match its name.

    A part compares such a file or sub-folder, and what it raises is a mismatch; it is None where
    nothing need be compared. `files` are parts that compare the values of a file. A file that no
    pattern matches is not covered, but for `README*`.
    """
    known = dict(parts)
    for pattern, compare in (files or {}).items():
        known[pattern] = partial(verify_file, compare, report=report)
    for path in sorted(folder.iterdir()):
        found = [part for pattern, part in known.items() if fnmatch(path.name, pattern)]
        if found and (part := found[0]):
            with report.attempt(path.stem, path.name):
                part(path)
        elif found or path.name.startswith("README"):
            report.note(f"{path.name} (for reading)")
        else:
            report.skip(f"file {path.name}")
