"""Collects the comparisons of one verification and prints them.

A *case* is one compared quantity of one thing (an array of one run, say). Everything in a reference
folder is compared, or named: as not covered (counts against `--require-all`) or as informative (a
label, or a value that need not be compared). A `Source` counts which of its values are used.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely
from numpy.typing import ArrayLike

from shiftsim.errors import DataError, ShiftsimError

EXACT = 0.0
TOLERANCE = 1e-9  # of floats, unless a comparison names another
DAMAGED = "the file is damaged, or not what its name says; make it or get it again"
Named: TypeAlias = Mapping[str, Any]  # values by name
Key: TypeAlias = tuple[str, ...]  # of rows that belong together
# Tolerance of all, or by name, "" being that of all others; exact where there is none
Tolerances: TypeAlias = float | Mapping[str, ArrayLike]
ERRORS = (  # what may be raised by content that has not the form of the reference
    *(ShiftsimError, OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError),
    shapely.errors.ShapelyError,
)


@dataclass
class Quantity:
    """Tally of one quantity over all cases."""

    cases: int = 0
    mismatches: int = 0
    max_error: float = 0.0
    tolerance: float = 0.0


@dataclass
class Report:
    """All comparisons so far."""

    quantities: dict[str, Quantity] = field(default_factory=dict)  # by first appearance
    mismatches: list[str] = field(default_factory=list)  # a line per case that differs
    # count by description of what should be compared and was not
    not_covered: dict[str, int] = field(default_factory=dict)
    informative: list[str] = field(default_factory=list)  # what need not be compared
    remarks: list[str] = field(default_factory=list)  # what else the reader should know

    def compare(
        self,
        quantity: str,
        where: str,
        actual: object,
        expected: object,
        *,
        atol: ArrayLike = 0.0,
        angle: bool = False,
    ) -> bool:
        """Compare one case; returns whether ours is as expected.

        Values are scalars, strings, arrays or lists, also of lists of several lengths. NaN (None in
        references) equals NaN, infinities must agree, other shapes differ; `angle`s [rad] are equal
        up to whole turns. `atol`, of all values or of each, is the absolute tolerance of floats:
        strings, booleans and integers are compared exactly.
        """
        tally = self.quantities.setdefault(quantity, Quantity())
        tally.tolerance = max(tally.tolerance, float(np.max(atol, initial=0.0)))
        ours, theirs = _array(actual), _array(expected)
        if ours.shape != theirs.shape:
            return self.fail(quantity, where, f"shape {ours.shape}, not {theirs.shape}")
        if ours.dtype.kind == "f" and theirs.dtype.kind == "O":
            with suppress(TypeError, ValueError):  # not numbers
                theirs = theirs.astype(np.float64)
        kinds = {ours.dtype.kind, theirs.dtype.kind}
        if kinds <= set("fiub") and "f" in kinds:
            error = _errors(ours.astype(np.float64), theirs.astype(np.float64), angle)
            tally.max_error = max(tally.max_error, float(error.max(initial=0.0)))
            bad = np.atleast_1d(error > np.asarray(atol))
        else:
            bad = np.atleast_1d(ours != theirs)
        if bad.any():
            first = tuple(np.argwhere(bad)[0].tolist())
            got, want = (np.asarray(np.atleast_1d(x)[first]).tolist() for x in (ours, theirs))
            at = f" at {', '.join(map(str, first))}" if ours.ndim else ""
            count = f" ({int(bad.sum())} of {bad.size} values)" if bad.size > 1 else ""
            return self.fail(quantity, where, f"{got!r}, not {want!r}{at}{count}")
        tally.cases += 1
        return True

    def fail(self, quantity: str, where: str, why: str) -> bool:
        """Count one case as differing; False."""
        tally = self.quantities.setdefault(quantity, Quantity())
        tally.cases += 1
        tally.mismatches += 1
        self.mismatches.append(f"{quantity}: {where}: {why}")
        return False

    @contextmanager
    def attempt(self, quantity: str, where: str) -> Iterator[None]:
        """Count one case as differing where the block raises any of `ERRORS`."""
        try:
            yield
        except ERRORS as error:
            self.fail(quantity, where, f"cannot be compared: {type(error).__name__}: {error}")

    def skip(self, what: str, count: int = 1) -> None:
        """Name something that should be compared and is not."""
        self.not_covered[what] = self.not_covered.get(what, 0) + count

    def note(self, what: str) -> None:
        """Name something that need not be compared."""
        if what not in self.informative:
            self.informative.append(what)

    @property
    def num_cases(self) -> int:
        """Cases compared."""
        return sum(tally.cases for tally in self.quantities.values())

    def lines(self, max_mismatches: int = 50) -> list[str]:
        """The report as text; the last line is the summary."""
        more, skipped = len(self.mismatches) - max_mismatches, sum(self.not_covered.values())
        return [
            *(
                f"{name}: {tally.cases - tally.mismatches}/{tally.cases} equal, "
                f"max |Δ| {tally.max_error:.3g} (tolerance {tally.tolerance:.3g})"
                for name, tally in self.quantities.items()
            ),
            *self.remarks,
            *(f"not compared: {what}" for what in self.informative),
            *(f"not covered: {what} ({count})" for what, count in self.not_covered.items()),
            *(f"MISMATCH {line}" for line in self.mismatches[:max_mismatches]),
            *([f"… and {more} more mismatches"] if more > 0 else []),
            f"{self.num_cases} cases covered, {len(self.mismatches)} mismatches, "
            f"{skipped} not covered",
        ]

    def exit_code(self, *, require_all: bool = False) -> int:
        """0 all equal, 1 a mismatch, 2 nothing covered, 3 not all covered and all required."""
        if self.mismatches:
            return 1
        if self.num_cases == 0:
            return 2
        return 3 if require_all and self.not_covered else 0


@dataclass
class Source:
    """Named values of one file, or some rows of them."""

    name: str  # begins the names of compared quantities
    what: str  # what one of its values is called
    values: Named
    report: Report  # receives the comparisons
    used: set[str] = field(default_factory=set)  # values that were read, of all parts of a file
    rows: Any = None  # which rows of the values this part has; None for all

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
        """Compare values of ours with those of the same names; returns whether all agree."""
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


def _errors(ours: np.ndarray, theirs: np.ndarray, angle: bool) -> np.ndarray:
    """Distances of floats; 0 between NaNs, infinite between a NaN and a number."""
    with np.errstate(invalid="ignore"):
        gap = ours - theirs
        gap = np.abs((gap + np.pi) % (2.0 * np.pi) - np.pi) if angle else np.abs(gap)
    same = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs))
    return np.where(same, 0.0, np.where(np.isnan(gap), np.inf, gap))


def _array(value: Any) -> np.ndarray[Any, Any]:
    try:
        return np.asarray(value)
    except ValueError:  # lists of several lengths
        return np.fromiter(value, np.object_, len(value))
