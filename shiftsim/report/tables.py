"""A table as data, its cells, and its plain text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import wrap
from typing import TypeAlias

from shiftsim.report.words import LONG, legend

_GAP = 2  # blanks between columns of text


@dataclass(frozen=True, slots=True)
class Number:
    """A number and how many digits of it are shown."""

    value: float  # the number
    digits: int = 2  # behind the point

    def __str__(self) -> str:
        return f"{self.value:.{self.digits}f}"


@dataclass(frozen=True, slots=True)
class Interval:
    """Where a mean lies, with a confidence of 95 %."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"[{self.low:.2f}, {self.high:.2f}]"


@dataclass(frozen=True, slots=True)
class Estimate:
    """A score times 100, or the reason why there is none."""

    mean: float | None  # mean over scenarios, then over seeds; None when withheld
    # standard deviation over the seeds' means; None for one seed or when withheld
    std: float | None
    done: int  # finished rollouts
    expected: int  # rollouts of a complete group

    @property
    def label(self) -> str:
        """Empty for a complete score."""
        if self.done == self.expected:
            return ""
        count = f"({self.done}/{self.expected})"
        return f"{'withheld' if self.mean is None else 'partial'} {count}"

    def __str__(self) -> str:
        if self.mean is None:
            return f"– ({self.done}/{self.expected})"
        spread = "" if self.std is None else f" ± {self.std:.2f}"
        return f"{self.mean:.2f}{spread}{f' {self.label}' if self.label else ''}"


Cell: TypeAlias = str | Number | Estimate | Interval | None


@dataclass(frozen=True, slots=True)
class Table:
    """A table."""

    name: str  # of its files and LaTeX label
    title: str  # what it shows
    header: tuple[str, ...]  # names of the columns
    rows: tuple[tuple[Cell, ...], ...]  # cells; None where there is nothing to say
    num_labels: int  # leading columns that hold text
    notes: tuple[str, ...] = ()  # what a reader must know to use the numbers
    full: "Table | None" = None  # the same for machines, where it is another table
    words: Mapping[str, str] = field(default_factory=lambda: LONG)  # what headings are short for

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"table {self.name}: {len(row)} cells, {len(self.header)} columns")

    @property
    def lines(self) -> list[list[str]]:
        """Header and rows as people read them."""
        return [[*self.header], *([shown(cell) for cell in row] for row in self.rows)]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the short headings mean, as "no at-fault collision (NCR), …", and the notes."""
        known = legend(self.header, self.words)
        return (f"columns: {known}", *self.notes) if known else self.notes


def shown(cell: Cell) -> str:
    """A cell as people read it."""
    return "" if cell is None else str(cell)


def text(table: Table, width: int = 0) -> str:
    """A table in plain text; wider than `width` it is printed in pieces, 0 for any."""
    lines = table.lines
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    out = [table.title] if table.title else []
    for piece, columns in enumerate(_pieces(widths, table.num_labels, width)):
        out += [""] if piece else []
        chosen = [[line[i] for i in columns] for line in lines]
        out += [f" {line}".rstrip() for line in aligned(chosen, table.num_labels)]
    fitted = (wrap(note, width - 1, subsequent_indent="  ") for note in table.remarks)
    notes = [line for lines in fitted for line in lines] if width else table.remarks
    return "\n".join([*out, *(f" {note}" for note in notes)])


def aligned(lines: Sequence[Sequence[str]], num_labels: int) -> list[str]:
    """Lines of cells with columns of equal width, the leading `num_labels` to the left."""
    columns = []
    for index, cells in enumerate(zip(*lines, strict=True)):
        width = max(map(len, cells))
        columns.append([c.ljust(width) if index < num_labels else c.rjust(width) for c in cells])
    return [(" " * _GAP).join(cells) for cells in zip(*columns, strict=True)]


def _pieces(widths: Sequence[int], num_labels: int, width: int) -> list[list[int]]:
    """Column numbers of each piece; the labels are repeated."""
    labels = list(range(num_labels))
    start = used = 1 + sum(widths[i] + _GAP for i in labels)
    pieces = [[*labels]]
    for column in range(num_labels, len(widths)):
        if width and used + widths[column] > width and len(pieces[-1]) > num_labels:
            pieces.append([*labels])
            used = start
        pieces[-1].append(column)
        used += widths[column] + _GAP
    return pieces
