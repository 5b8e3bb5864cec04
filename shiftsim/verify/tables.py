"""Tables to compare with: named values, which of them were used, and their comparison with ours.

A `Source` counts what it hands out as used; `finish` names the rest as not covered. `Groups` are
the rows of a table by key.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

from shiftsim.errors import DataError
from shiftsim.verify.report import Report

EXACT = 0.0
TOLERANCE = 1e-9  # of floats, unless a comparison names another
DAMAGED = "the file is damaged, or not what its name says; make it or get it again"
Named: TypeAlias = Mapping[str, Any]  # values by name
Key: TypeAlias = tuple[str, ...]  # of rows that belong together
# Tolerance of all, or by name, "" being that of all others; exact where there is none
Tolerances: TypeAlias = float | Mapping[str, ArrayLike]


@dataclass
class Source:
    """Named values of one file, or some rows of them.

    Attributes:
        name: Begins the names of compared quantities.
        what: What one of its values is called.
        values: All of them.
        report: Receives the comparisons.
        used: Names of the values that were read; shared by all parts of a file.
        rows: Which rows of the values this part has; None for all.
    """

    name: str
    what: str
    values: Named
    report: Report
    used: set[str] = field(default_factory=set)
    rows: Any = None

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def __iter__(self) -> Any:
        return iter(self.values)

    def __getitem__(self, name: str) -> Any:
        """A value, which is used from now on; a `DataError` if there is none."""
        if name not in self.values:
            raise DataError(f"{self.name}: {self.what} {name!r} is missing")
        self.used.add(name)
        return self.values[name] if self.rows is None else self.values[name][self.rows]

    @property
    def num_rows(self) -> int:
        """Rows of a table, or of a part of one."""
        return len(next(iter(self.values.values())) if self.rows is None else self.rows)

    def at(self, rows: Any) -> Self:
        """Some rows of every value: an index, indices or a mask."""
        if getattr(rows, "dtype", None) == np.bool_:
            rows = np.flatnonzero(rows)
        return replace(self, rows=rows if self.rows is None else self.rows[rows])

    def groups(self, *key: str) -> dict[Key, Self]:
        """The rows by the values of key columns, in the order of the file."""
        groups: dict[Key, list[int]] = {}
        for row, values in enumerate(zip(*(self[name].tolist() for name in key), strict=True)):
            groups.setdefault(tuple(map(str, values)), []).append(row)
        return {values: self.at(np.array(rows)) for values, rows in groups.items()}

    def match(
        self, where: str, ours: Named, atol: Tolerances = EXACT, *, quantity: str | None = None
    ) -> bool:
        """Compare values of ours with those of the same names; a missing one is a mismatch.

        `quantity` begins the names of the quantities, instead of the name of the file. Returns
        whether all agree.
        """
        prefix, agree = self.name if quantity is None else quantity, True
        for name, value in ours.items():
            label = f"{prefix} {name}".strip()
            if name not in self:
                agree = self.report.fail(label, where, f"no {self.what} {name!r}")
                continue
            bound = atol if isinstance(atol, float) else atol.get(name, atol.get("", EXACT))
            agree &= self.report.compare(label, where, value, self[name], atol=bound)
        return agree

    def finish(self) -> None:
        """Name the values that nothing used."""
        for name in self.values:
            if name not in self.used:
                self.report.skip(f"{self.name}: {self.what} {name!r}")


def read_table(path: Path, report: Report) -> Source:
    """The columns of a `.parquet`: strings as object arrays, absent values None or NaN."""
    try:
        table = pq.read_table(path)
        columns = {column: table[column].to_numpy() for column in table.column_names}
    except (OSError, UnicodeError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a readable Parquet file ({error})", DAMAGED) from error
    return Source(path.stem, "column", columns, report)


class Groups(dict[Key, Source]):
    """The rows of a table by key, and which of them were asked for; other keys have no rows."""

    def __init__(self, table: Source, key: Sequence[str]) -> None:
        self.table, self._asked = table, set[Key]()
        super().__init__(table.groups(*key) if table.values else {})

    def __getitem__(self, key: Key) -> Source:
        self._asked.add(key)
        return super().__getitem__(key) if key in self else self.table.at(np.zeros(0, np.int64))

    def finish(self) -> None:
        """Name rows that nothing asked for, and columns that nothing used."""
        for key in self:
            if key not in self._asked:
                self.table.report.skip(f"{self.table.name}: rows of {' '.join(key)}")
        if self._asked & set(self):
            self.table.finish()
