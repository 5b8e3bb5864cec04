"""Tables as text, Markdown, CSV, LaTeX and HTML."""

import csv
import html
import io
import re
from collections.abc import Callable, Sequence

from shiftsim.errors import one_of
from shiftsim.report.tables import Table, plain_columns, shown

ENDINGS = {"text": "txt", "md": "md", "csv": "csv", "latex": "tex", "html": "html"}
FORMATS = tuple(ENDINGS)
_GAP = 2  # blanks between columns of text


def render(table: Table, style: str, *, width: int = 0) -> str:
    """A table in one of `FORMATS`.

    Args:
        table: The table.
        style: The format.
        width: Longest line of text; wider tables are printed in pieces. 0 for any.
    """
    one_of("format", style, FORMATS)
    if style == "text":
        return _text(table, width)
    return _WRITERS[style](table)


def _text(table: Table, width: int) -> str:
    lines = [list(table.header), *([shown(cell) for cell in row] for row in table.rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.header))]
    out = [table.title] if table.title else []
    for piece, columns in enumerate(_pieces(widths, table.num_labels, width)):
        out += [""] if piece else []
        for line in lines:
            cells = [
                line[i].ljust(widths[i]) if i < table.num_labels else line[i].rjust(widths[i])
                for i in columns
            ]
            out.append(f" {(' ' * _GAP).join(cells)}".rstrip())
    return "\n".join([*out, *(f" {note}" for note in table.notes)])


def _pieces(widths: Sequence[int], num_labels: int, width: int) -> list[list[int]]:
    """Column numbers of each piece; the labels are repeated."""
    labels = list(range(num_labels))
    start = 1 + sum(widths[i] + _GAP for i in labels)
    pieces: list[list[int]] = [[*labels]]
    used = start
    for column in range(num_labels, len(widths)):
        if width and used + widths[column] > width and len(pieces[-1]) > num_labels:
            pieces.append([*labels])
            used = start
        pieces[-1].append(column)
        used += widths[column] + _GAP
    return pieces


def _markdown(table: Table) -> str:
    rule = ["---"] * table.num_labels + ["---:"] * (len(table.header) - table.num_labels)
    lines = [
        [markdown_escape(name) for name in table.header],
        rule,
        *([markdown_escape(shown(cell)) for cell in row] for row in table.rows),
    ]
    body = [f"| {' | '.join(line)} |" for line in lines]
    title = [f"### {markdown_escape(table.title)}", ""] if table.title else []
    notes = [line for note in table.notes for line in ("", markdown_escape(note))]
    return "\n".join([*title, *body, *notes])


def markdown_escape(text: str) -> str:
    """Text that Markdown prints as it is, also inside a table."""
    return re.sub(r"([\\`*_{}\[\]<>|#~$])", r"\\\1", " ".join(text.split()))


def _csv(table: Table) -> str:
    header, rows = plain_columns(table)
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *rows])
    return out.getvalue().rstrip("\n")


_LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "±": r"$\pm$",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "−": r"$-$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "√": r"$\surd$",
    "σ": r"$\sigma$",
    "θ": r"$\theta$",
    "–": "--",
    "…": r"\dots{}",
    "→": r"$\rightarrow$",
}
_LATEX_TABLE = str.maketrans(_LATEX)


def latex_escape(text: str) -> str:
    """Text that LaTeX prints as it is."""
    return " ".join(text.split()).translate(_LATEX_TABLE)


def _latex(table: Table) -> str:
    columns = "l" * table.num_labels + "r" * (len(table.header) - table.num_labels)

    def line(cells: Sequence[str]) -> str:
        # a cell that begins with "[" would be read as an option of the \\ or \toprule before it
        safe = (f"{{{cell}}}" if cell.startswith("[") else cell for cell in cells)
        return f"  {' & '.join(safe)} \\\\"

    notes = "; ".join(latex_escape(note) for note in table.notes)
    caption = ". ".join(filter(None, (latex_escape(table.title), notes)))
    return "\n".join(
        [
            r"\begin{table}  % needs \usepackage{booktabs}",
            r"\centering",
            f"\\caption{{{caption}}}",
            f"\\label{{tab:{table.name}}}",
            f"\\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            line([latex_escape(name) for name in table.header]),
            r"\midrule",
            *(line([latex_escape(shown(cell)) for cell in row]) for row in table.rows),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
    )


def _html(table: Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        parts = (
            f"<{tag}{'' if i < table.num_labels else ' class=n'}>{html.escape(cell)}</{tag}>"
            for i, cell in enumerate(cells)
        )
        return f"<tr>{''.join(parts)}</tr>"

    return "\n".join(
        [
            f'<section id="{html.escape(table.name)}">',
            f"<h2>{html.escape(table.title)}</h2>",
            "<div class=wide><table>",
            f"<thead>{row(table.header, 'th')}</thead>",
            "<tbody>",
            *(row([shown(cell) for cell in cells], "td") for cells in table.rows),
            "</tbody></table></div>",
            *(f"<p>{html.escape(note)}</p>" for note in table.notes),
            "</section>",
        ]
    )


_WRITERS: dict[str, Callable[[Table], str]] = {
    "md": _markdown,
    "csv": _csv,
    "latex": _latex,
    "html": _html,
}
