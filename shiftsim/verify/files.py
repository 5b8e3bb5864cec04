"""Reference files: named values, which of them were used, and their comparison with ours.

The values of a file are the arrays of an `.npz`, the columns of a `.parquet` or the fields of a
`.json`. All three are a `Source`: what it hands out counts as used, `finish` names the rest as not
covered. `match` compares values of ours with those of the same names.
"""

import json
import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

from shiftsim.errors import DataError
from shiftsim.verify.report import Report

# keys and tolerances of tables, and how folders are recognised
COMPARED: dict[str, Any] = tomllib.loads(
    (Path(__file__).parent / "compared.toml").read_text("utf-8")
)
EXACT = 0.0
TOLERANCE = 1e-9  # of floats, unless a comparison names another
DAMAGED = "the file is damaged, or not what its name says; make it or get it again"
# Tolerance of all, or by name, "" being that of all others; exact where there is none
Tolerances: TypeAlias = float | Mapping[str, ArrayLike]


@dataclass
class Source:
    """Named values of one file, or of a part of it."""

    name: str  # name of the file without its ending; begins the names of compared quantities
    what: str  # what one of its values is called
    values: Mapping[str, Any]  # all values by name
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

    def groups(self, *key: str) -> "dict[tuple[str, ...], Source]":
        """The rows by the values of key columns, in the order of the file."""
        groups: dict[tuple[str, ...], list[int]] = {}
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
        ours: Mapping[str, Any],
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


def read_arrays(path: Path, report: Report, name: str = "") -> Source:
    """The arrays of an `.npz`; `name` is another name for it."""
    with np.load(path, allow_pickle=False) as archive:
        return Source(name or path.stem, "array", {n: archive[n] for n in archive.files}, report)


def read_table(path: Path, report: Report) -> Source:
    """The columns of a `.parquet`: strings are object arrays, absent values None or NaN."""
    try:
        table = pq.read_table(path)
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except (OSError, UnicodeError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a readable Parquet file ({error})", DAMAGED) from error
    return Source(path.stem, "column", columns, report)


def read_fields(path: Path, report: Report, name: str = "") -> Source:
    """The fields of a `.json`, a list as the field `rows`; `name` is another name for it."""
    content = read_json(path)
    fields = {"rows": content} if isinstance(content, list) else content
    return Source(name or path.stem, "field", fields, report)


def read_json(path: Path) -> Any:
    """Content of a `.json`; a `DataError` if it cannot be read."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable JSON: {error}") from error


class Groups(dict[tuple[str, ...], Source]):
    """The rows of a `.parquet` by key, and which of them were asked for; other keys have no rows.

    `atol` holds unless a comparison names another.
    """

    def __init__(self, table: Source, key: Sequence[str], atol: Tolerances = EXACT) -> None:
        self.table, self.atol, self._asked = table, atol, set[tuple[str, ...]]()
        super().__init__(table.groups(*key) if table.values else {})

    def __getitem__(self, key: tuple[str, ...]) -> Source:
        self._asked.add(key)
        return super().__getitem__(key) if key in self else self.table.at(np.zeros(0, np.int64))

    def of_mode(self, mode: str | None) -> list[tuple[str, ...]]:
        """Keys of the runs of one mode, or all."""
        return [key for key in self if mode is None or mode in key]

    def match(
        self,
        key: tuple[str, ...],
        ours: Mapping[str, Any],
        atol: Tolerances | None = None,
        **options: Any,
    ) -> bool:
        """`Source.match` for the rows of a key."""
        return self[key].match(" ".join(key), ours, self.atol if atol is None else atol, **options)

    def match_keys(self, key: tuple[str, ...], ours: list[tuple[str, ...]]) -> None:
        """Compare which keys begin with `key`, by the rest of them."""
        theirs = [name[len(key) :] for name in self if name[: len(key)] == key]
        label, where = f"{self.table.name} present", " ".join(key)
        self.table.report.compare(label, where, sorted(ours), sorted(theirs))

    def finish(self, mode: str | None = None) -> None:
        """Name rows that nothing asked for (of one mode only), and columns that nothing used."""
        for key in self.of_mode(mode):
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
        if not path.is_file():
            report.skip(f"{path.name} is missing")
        table = (
            read_table(path, report) if path.is_file() else Source(path.stem, "column", {}, report)
        )
        tables[path.stem] = Groups(table, **COMPARED[path.name])
    return tables


def verify_file(compare: Compare, path: Path, report: Report) -> None:
    """`compare` the values of a file; those that it does not use are not covered.

    The file is named without the number that its name may end with.
    """
    read = {".npz": read_arrays, ".parquet": read_table}.get(path.suffix, read_fields)
    file = replace(read(path, report), name=re.sub(r"_\d+$", "", path.stem))
    compare(file, path.stem)
    if file.what != "column" or file.num_rows:
        file.finish()


def verify_files(
    folder: Path,
    report: Report,
    parts: Mapping[str, Callable[[Path], object] | None],
    files: Mapping[str, Compare] | None = None,
) -> None:
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
