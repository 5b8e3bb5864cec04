"""A table as data, and as text, Markdown, CSV, LaTeX and HTML."""

import csv
import html
import io
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from textwrap import wrap
from typing import Any, TypeAlias

from shiftsim.errors import one_of
from shiftsim.report.words import LONG, legend

ENDINGS = {"text": "txt", "md": "md", "csv": "csv", "latex": "tex", "html": "html"}
FORMATS = tuple(ENDINGS)
_GAP = 2  # blanks between columns of text
_COLUMN, _PAGE = 240.0, 504.0  # points, widths of a paper of two columns
_SETTINGS = ("set", "traffic", "noise")  # labels that a caption can say for all rows


@dataclass(frozen=True, slots=True)
class Number:
    """A number, or the reason why there is none; empty where nothing was expected."""

    value: float | None  # None when withheld; of scores, the mean over scenarios, then seeds
    digits: int = 2  # shown behind the point
    std: float | None = None  # standard deviation over the seeds' means; None for one seed
    done: int = 1  # finished rollouts
    expected: int = 1  # rollouts of a complete group

    @property
    def label(self) -> str:
        """Empty for a complete score."""
        if self.done == self.expected:
            return ""
        count = f"({self.done}/{self.expected})"
        return f"{'withheld' if self.value is None else 'partial'} {count}"

    @property
    def parts(self) -> dict[str, str]:
        """In full, by the ending of the column's name in CSV."""
        if self.value is not None and not self.digits:
            return {"": str(self)}
        numbers = {"": self.value, " std": self.std}
        return {end: repr(float(value)) for end, value in numbers.items() if value is not None}

    def __str__(self) -> str:
        if self.value is None:
            return f"– ({self.done}/{self.expected})" if self.expected else ""
        spread = "" if self.std is None else f" ± {self.std:.2f}"
        return f"{self.value:.{self.digits}f}{spread} {self.label}".rstrip()


@dataclass(frozen=True, slots=True)
class Interval:
    """Where a mean lies, with a confidence of 95 %."""

    low: float
    high: float

    @property
    def parts(self) -> dict[str, str]:
        """In full, by the ending of the column's name in CSV."""
        return {" low": repr(self.low), " high": repr(self.high)}

    def __str__(self) -> str:
        return f"[{self.low:.2f}, {self.high:.2f}]"


Cell: TypeAlias = str | Number | Interval | None
Row: TypeAlias = tuple[Cell, ...]
Record: TypeAlias = dict[str, Cell]


@dataclass(frozen=True, slots=True)
class Table:
    """A table."""

    name: str  # of its files and LaTeX label
    title: str  # what it shows
    header: Sequence[str]  # names of the columns
    rows: Sequence[Row]  # cells; None where there is nothing to say
    num_labels: int  # leading columns that hold text
    notes: Sequence[str] = ()  # what a reader must know to use the numbers
    findings: Sequence[str] = ()  # what the numbers say, in sentences
    # drawn in HTML pages, as SVG: a column's name, above it and per row
    drawn: tuple[str, Sequence[str]] = ("", ())
    full: "Table | None" = None  # the same for machines, where it is another table
    words: Mapping[str, str] = field(default_factory=lambda: LONG)  # what headings are short for
    # measured columns, and what chooses the best number of each, `max` or `min`
    best: Mapping[str, Callable[[Iterable[float]], float]] = field(default_factory=dict)
    paper: "Table | None" = None  # the same for a paper, where it is another table

    @classmethod
    def of(
        cls, name: str, title: str, records: Sequence[Record], num_labels: int, **more: Any
    ) -> "Table":
        """A table of records, one at least, whose keys are the header."""
        rows = [tuple(record.values()) for record in records]
        return cls(name, title, tuple(records[0]), rows, num_labels, **more)

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"table {self.name}: {len(row)} cells, {len(self.header)} columns")

    @property
    def lines(self) -> list[list[str]]:
        """Header and rows as people read them."""
        return [[*self.header], *([shown(cell) for cell in row] for row in self.rows)]

    @property
    def remarks(self) -> Sequence[str]:
        """Findings, what short headings mean, as "no at-fault collision (NCR), …", and notes."""
        known = legend(self.header, self.words)
        return (*self.findings, *([f"columns: {known}"] if known else []), *self.notes)


def shown(cell: Cell) -> str:
    """A cell as people read it."""
    return "" if cell is None else str(cell)


def text(table: Table, width: int = 0, mark: Callable[[str], str] = str) -> str:
    """A table in plain text, in pieces if wider than `width` > 0; the best numbers get a `mark`."""
    columns, best = [], _best(table) if mark is not str else ()
    for index, cells in enumerate(zip(*table.lines, strict=True)):
        side, size = "<" if index < table.num_labels else ">", max(map(len, cells))
        padded = [f"{cell:{side}{size}}" for cell in cells]
        columns.append([mark(c) if (n, index) in best else c for n, c in enumerate(padded, -1)])
    out = [table.title] if table.title else []
    for piece, chosen in enumerate(_pieces([len(c[0]) for c in columns], table.num_labels, width)):
        lines = zip(*(columns[i] for i in chosen), strict=True)
        out += [""] if piece else []
        out += [f" {(' ' * _GAP).join(cells)}".rstrip() for cells in lines]
    fitted = (wrap(note, width - 1, subsequent_indent="  ") for note in table.remarks)
    notes = [line for lines in fitted for line in lines] if width else table.remarks
    return "\n".join([*out, *(f" {note}" for note in notes)])


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


def render(table: Table, style: str, *, width: int = 0, mark: Callable[[str], str] = str) -> str:
    """A table in one of `FORMATS`; `width` and `mark` are those of `text`."""
    one_of("format", style, FORMATS)
    return text(table, width, mark) if style == "text" else _WRITERS[style](table)


def _markdown(table: Table) -> str:
    rule = ["---"] * table.num_labels + ["---:"] * (len(table.header) - table.num_labels)
    head, *rows = ([markdown_escape(cell) for cell in line] for line in table.lines)
    body = [f"| {' | '.join(line)} |" for line in (head, rule, *rows)]
    title = [f"### {markdown_escape(table.title)}", ""] if table.title else []
    notes = [line for note in table.remarks for line in ("", markdown_escape(note))]
    return "\n".join([*title, *body, *notes])


def markdown_escape(value: str) -> str:
    """Text that Markdown prints as it is, also inside a table."""
    return re.sub(r"([\\`*_{}\[\]<>|#~$])", r"\\\1", " ".join(value.split()))


def _csv(table: Table) -> str:
    """Every number in full and in a column of its own; notes are the last column of every row."""
    table = table.full or table
    columns = []
    for index, name in enumerate(table.header):
        parts = [_parts(row[index]) for row in table.rows]
        endings = dict.fromkeys(chain(*parts)) or [""]
        columns += [[f"{name}{end}", *(each.get(end, "") for each in parts)] for end in endings]
    labels = [
        "; ".join(f"{n} {c.label}" for n, c in named if isinstance(c, Number) and c.label)
        for named in (zip(table.header, row, strict=True) for row in table.rows)
    ]
    if any(labels):
        columns.append(["label", *labels])
    if table.notes:
        columns.append(["notes", *[" | ".join(table.notes)] * len(table.rows)])
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(zip(*columns, strict=True))
    return out.getvalue().rstrip("\n")


def _parts(cell: Cell) -> dict[str, str]:
    """What CSV holds of a cell, by the ending of the column's name."""
    return {"": cell} if isinstance(cell, str) else {} if cell is None else cell.parts


_TEXT = "backslash asciitilde asciicircum less greater bar".split()
_MATH = "pm times cdot geq leq surd sigma theta rightarrow Delta rho".split()
_LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    **{c: f"\\text{name}{{}}" for c, name in zip("\\~^<>|", _TEXT, strict=True)},
    **{c: f"$\\{name}$" for c, name in zip("±×·≥≤√σθ→Δρ", _MATH, strict=True)},
    **{c: f"${power}$" for c, power in zip("²³°−", ("^2", "^3", r"^\circ", "-"), strict=True)},
    **{'"': "''", "–": "--", "…": r"\dots{}"},
}
_LATEX_TABLE = str.maketrans(_LATEX)


def latex_escape(value: str) -> str:
    """Text that LaTeX prints as it is."""
    return " ".join(value.split()).translate(_LATEX_TABLE)


def _latex(table: Table) -> str:
    """A float for a paper of two columns; the best numbers are bold, notes stand below."""
    table = _for_paper(table)
    settings = [row[: table.num_labels - 1] if table.best else () for row in table.rows]
    bold = _best(table)
    body, before = list[str](), None
    for number, (row, setting) in enumerate(zip(table.rows, settings, strict=True)):
        cells = [_latex_cell(cell, is_bold=(number, i) in bold) for i, cell in enumerate(row)]
        if setting == before:
            cells[: len(setting)] = [""] * len(setting)
        elif body:
            body.append(r"\midrule")
        body.append(_latex_row(cells))
        before = setting
    columns = [*zip(*table.lines, strict=True)]
    sides = "".join("l" if i < table.num_labels else "r" for i in range(len(columns)))
    heads = [_stacked(name, cells) for name, *cells in columns]
    names = []
    for head, side in zip(heads, sides, strict=True):
        name = r" \\ ".join(map(_latex_cell, head))
        names.append(f"\\shortstack[{side}]{{{name}}}" if len(head) > 1 else name)
    # a subscript is about as wide as its text would be without blanks
    sizes = [
        max(map(len, (*head, *(cell.replace(" ± ", "±") for cell in cells))))
        for head, (_, *cells) in zip(heads, columns, strict=True)
    ]
    top = [f"\\begin{{tabular}}{{{sides}}}", r"\toprule", _latex_row(names), r"\midrule"]
    return _float(table, [*top, *body, r"\bottomrule", r"\end{tabular}"], sizes)


def _for_paper(table: Table) -> Table:
    """The measured columns and the labels that differ; what all rows share goes into the title."""
    table = table.paper or table
    shared, said = _shared(table)
    names = list(enumerate(table.header))
    kept = [i for i, name in names[: table.num_labels] if name not in shared]
    if table.best:
        kept.sort(key=lambda i: table.header[i] == "planner")
    measured = [i for i, name in names[table.num_labels :] if not table.best or name in table.best]
    rows = [tuple(row[i] for i in (*kept, *measured)) for row in table.rows]
    if table.best:
        places = list(dict.fromkeys(row[: len(kept) - 1] for row in rows))
        rows.sort(key=lambda row: places.index(row[: len(kept) - 1]))
    left_out = {name for i, name in names if i not in (*kept, *measured)}
    return replace(
        table,
        title="; ".join(filter(None, (table.title, said))),
        header=[table.header[i] for i in (*kept, *measured)],
        rows=rows,
        num_labels=len(kept),
        notes=[note for note in table.notes if note.partition(":")[0] not in left_out],
        paper=None,
    )


def _shared(table: Table) -> tuple[Collection[str], str]:
    """Settings among the labels that all rows share; in words, those that the title lacks."""
    columns = {name: {row[i] for row in table.rows} for i, name in enumerate(table.header)}
    labels = [name for name in table.header[: table.num_labels] if name in _SETTINGS]
    shared = {name: shown(*columns[name]) for name in labels if len(columns[name]) == 1}
    said = (f"{name} {value}" for name, value in shared.items() if value not in table.title)
    return shared, ", ".join(said)


def _best(table: Table) -> set[tuple[int, int]]:
    """Row and column of the best planner's numbers by setting, as printed, where they differ."""
    if "planner" not in table.header:
        return set()
    planner, labels = list(table.header).index("planner"), range(table.num_labels)
    settings: list[Row] = [
        tuple(row[i] for i in labels if i != planner) if row[planner] else (str(number),)
        for number, row in enumerate(table.rows)
    ]
    out = set()
    for setting in dict.fromkeys(settings):
        for name, choose in table.best.items():
            column = list(table.header).index(name)
            numbers = {
                (row, column): round(cell.value, cell.digits)
                for row, cells in enumerate(table.rows)
                if settings[row] == setting
                and isinstance(cell := cells[column], Number)
                and cell.value is not None
                and not cell.label
            }
            if len(set(numbers.values())) > 1:
                best = choose(numbers.values())
                out |= {place for place, value in numbers.items() if value == best}
    return out


def _float(table: Table, tabular: Sequence[str], sizes: Sequence[int]) -> str:
    """The float around a tabular whose columns are so many characters wide."""
    width = 4.4 * sum(sizes) + 8.0 * len(sizes)
    kind, font, gap, needs = "table" if width <= _COLUMN else "table*", "footnotesize", 4, ""
    if width > _PAGE:
        width, font, gap = 3.9 * sum(sizes) + 4.0 * len(sizes), "scriptsize", 2
    if width > _PAGE:
        needs, tabular = ",graphicx", [r"\resizebox{\textwidth}{!}{%", *tabular, "}"]
    notes = " ".join(f"{latex_escape(note.removesuffix('.'))}." for note in table.remarks)
    below = ["", r"\smallskip", r"\begin{minipage}{\linewidth}\scriptsize\raggedright", notes]
    lines = [
        f"\\begin{{{kind}}}  % needs \\usepackage{{booktabs{needs}}}",
        r"\centering",
        f"\\caption{{{latex_escape(table.title)}.}}",
        f"\\label{{tab:{table.name}}}",
        f"\\{font}\\setlength{{\\tabcolsep}}{{{gap}pt}}",
        *tabular,
        *([*below, r"\end{minipage}"] if notes else []),
        f"\\end{{{kind}}}",
    ]
    return "\n".join(lines)


def _latex_row(cells: Sequence[str]) -> str:
    return f"  {' & '.join(cells)} \\\\"


def _latex_cell(cell: Cell, *, is_bold: bool = False) -> str:
    """A cell in LaTeX; the deviation over the seeds is a subscript."""
    text = latex_escape(shown(cell))
    if isinstance(cell, Number) and cell.value is not None:
        text = f"{cell.value:.{cell.digits}f}"
        text = f"\\textbf{{{text}}}" if is_bold else text
        text += "" if cell.std is None else f"$_{{\\pm {cell.std:.2f}}}$"
        text = f"{text} {cell.label}".rstrip()
    if not isinstance(cell, str):
        text = re.sub(r"-(?=\d)", "$-$", text)
    # one that begins with "[" would be read as an option of the \\ or \toprule before it
    return f"{{{text}}}" if text.startswith("[") else text


def _stacked(name: str, cells: Sequence[str]) -> list[str]:
    """The lines of a heading that is not much wider than its column."""
    words = name.split()
    return wrap(name, max(map(len, (*cells, *words)))) if words else [""]


def latex_picture(name: str, title: str, *, is_wide: bool = False) -> str:
    """A picture in LaTeX by the name of its file, in one column of the paper or over both."""
    kind = "figure*" if is_wide else "figure"
    lines = (
        f"\\begin{{{kind}}}  % needs \\usepackage{{graphicx}}",
        r"\centering",
        f"\\includegraphics[width=\\linewidth]{{{name}}}",
        f"\\caption{{{latex_escape(title)}.}}",
        f"\\label{{fig:{name.partition('.')[0]}}}",
        f"\\end{{{kind}}}",
    )
    return "\n".join(lines)


def _html(table: Table) -> str:
    """A section: planner first, the best in bold, shared settings above, in a box that scrolls."""
    (shared, said), names = _shared(table), table.header
    places = [i for i, name in enumerate(names) if i >= table.num_labels or name not in shared]
    places.sort(key=lambda i: names[i] != "planner")
    bold = _best(table)

    def line(number: int, cells: Sequence[str], tag: str) -> str:
        parts = []
        for i in places:
            picture = table.drawn[1][number + 1] if names[i] == table.drawn[0] else ""
            kinds = ["n"] * (i >= table.num_labels) + ["best"] * ((number, i) in bold)
            kind = f' class="{" ".join(kinds)}"' if kinds else ""
            parts.append(f"<{tag}{kind}>{picture}{cells[i]}</{tag}>")
        return f"<tr>{''.join(parts)}</tr>"

    def heading(name: str) -> str:
        words = table.words.get(name)
        return f"<small>{html.escape(words)}</small> {name}" if words else html.escape(name)

    head, *rows = table.lines
    title, above = html.escape(table.title or table.name), html.escape(said)
    lines = [
        f'<section id="{html.escape(table.name)}">',
        f"<h2>{title}</h2>",
        *(f"<p class=finding>{html.escape(words)}</p>" for words in table.findings),
        *([f"<p>{above}</p>"] if above else []),
        f'<div class="wide" tabindex="0" role="region" aria-label="{title}"><table>',
        f"<thead>{line(-1, [*map(heading, head)], 'th')}</thead>\n<tbody>",
        *(line(number, [*map(html.escape, cells)], "td") for number, cells in enumerate(rows)),
        "</tbody></table></div>",
        *(f"<p>{html.escape(note)}</p>" for note in table.notes),
    ]
    return "\n".join([*lines, "</section>"])


_WRITERS = {"md": _markdown, "csv": _csv, "latex": _latex, "html": _html}
