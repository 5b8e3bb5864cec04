"""A table as data, with cells that know how they are printed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from shiftsim.report.groups import Estimate
from shiftsim.report.statistics import Interval


@dataclass(frozen=True, slots=True)
class Number:
    """A number and how many digits of it are shown.

    Attributes:
        value: The number.
        digits: Behind the point.
    """

    value: float
    digits: int = 2


Cell: TypeAlias = str | Number | Estimate | Interval | None


@dataclass(frozen=True, slots=True)
class Table:
    """A table.

    Attributes:
        name: Of its files and LaTeX label.
        title: What it shows.
        header: Names of the columns.
        rows: Cells; None where there is nothing to say.
        num_labels: Leading columns that hold text.
        notes: What a reader must know to use the numbers.
        full: The same for machines, where it is another table.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    num_labels: int
    notes: tuple[str, ...] = ()
    full: "Table | None" = None

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"table {self.name}: {len(row)} cells, {len(self.header)} columns")


def shown(cell: Cell) -> str:
    """A cell as people read it."""
    if cell is None:
        return ""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Number):
        return f"{cell.value:.{cell.digits}f}"
    if isinstance(cell, Interval):
        return f"[{cell.low:.2f}, {cell.high:.2f}]"
    if cell.mean is None:
        return f"– ({cell.done}/{cell.expected})"
    spread = "" if cell.std is None else f" ± {cell.std:.2f}"
    return f"{cell.mean:.2f}{spread}{f' {cell.label}' if cell.label else ''}"


def plain_columns(table: Table) -> tuple[list[str], list[list[str]]]:
    """Header and rows with every number in full and in a column of its own, for machines.

    What stands below a printed table is the last column of every row.
    """
    if table.full is not None:
        return plain_columns(table.full)
    header: list[str] = []
    columns: list[list[str]] = []
    for index, name in enumerate(table.header):
        cells = [row[index] for row in table.rows]
        for ending, values in _parts(cells):
            header.append(f"{name}{ending}")
            columns.append(values)
    labels = [_labels(row, table.header) for row in table.rows]
    if any(labels):
        header.append("label")
        columns.append(labels)
    if table.notes:
        header.append("notes")
        columns.append([" | ".join(table.notes)] * len(table.rows))
    return header, [list(line) for line in zip(*columns, strict=True)]


def _parts(cells: Sequence[Cell]) -> list[tuple[str, list[str]]]:
    """One or several columns, by what the cells hold."""
    if any(isinstance(cell, Interval) for cell in cells):
        ends = [(c.low, c.high) if isinstance(c, Interval) else (None, None) for c in cells]
        return [(" low", [_full(e[0]) for e in ends]), (" high", [_full(e[1]) for e in ends])]
    out = [("", [_plain(cell) for cell in cells])]
    spreads = [cell.std if isinstance(cell, Estimate) else None for cell in cells]
    if any(spread is not None for spread in spreads):
        out.append((" std", [_full(spread) for spread in spreads]))
    return out


def _plain(cell: Cell) -> str:
    if cell is None or isinstance(cell, str):
        return cell or ""
    if isinstance(cell, Number):
        return f"{cell.value:.0f}" if cell.digits == 0 else _full(cell.value)
    assert isinstance(cell, Estimate)
    return _full(cell.mean)


def _full(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _labels(row: Sequence[Cell], header: Sequence[str]) -> str:
    named = zip(header, row, strict=True)
    found = [f"{n} {c.label}" for n, c in named if isinstance(c, Estimate) and c.label]
    return "; ".join(found)
