"""All tables and pictures of some runs, and the folder they are written to."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shiftsim.errors import one_of
from shiftsim.report import data_tables, details, paper
from shiftsim.report.figures import Figure
from shiftsim.report.groups import Group, made_up_note
from shiftsim.report.published import Published
from shiftsim.report.scores import scores
from shiftsim.report.tables import Table
from shiftsim.report.writers import ENDINGS, render

# the kinds of tables: names up to the first "_"
TABLES = (
    "semantic-shift",
    "noise-robustness",
    "planner-comparison",
    "planner-comparison-noise",
    "scenario-types",
    "scores",
    "planning-time",
    "data-statistics",
    "benchmark-comparison",
)
_LONG = ("planner-comparison-noise", "data-statistics", "benchmark-comparison")
BRIEF = tuple(name for name in TABLES if name not in _LONG)  # what a terminal shows


@dataclass(frozen=True, slots=True)
class Options:
    """What a report shows.

    Attributes:
        tables: Kinds of tables, of `TABLES`.
        by: Splits the rows of the score table further.
        beside: Show the published figures as well.
        allow_partial: Show labelled means of incomplete groups.
    """

    tables: tuple[str, ...] = TABLES
    by: str | None = None
    beside: bool = False
    allow_partial: bool = False

    def __post_init__(self) -> None:
        for name in self.tables:
            one_of("table", name, TABLES)


def make_tables(
    groups: Sequence[Group], published: Published | None = None, options: Options | None = None
) -> list[Table]:
    """The tables of a report, in the order of `TABLES`.

    Args:
        groups: What was run.
        published: Figures of the paper.
        options: What is shown; everything by default.
    """
    chosen = options or Options()
    partial = chosen.allow_partial
    beside = published if chosen.beside else None
    out: list[Table | None] = []
    if "semantic-shift" in chosen.tables:
        out += paper.semantic_shift(groups, published, beside=chosen.beside, allow_partial=partial)
    if "noise-robustness" in chosen.tables:
        out.append(paper.noise_robustness(groups, beside, allow_partial=partial))
    if "planner-comparison" in chosen.tables:
        out.append(details.planner_comparison(groups))
    if "planner-comparison-noise" in chosen.tables:
        out.append(details.planner_comparison(groups, noisy=True))
    if "scenario-types" in chosen.tables:
        out += details.scenario_types(groups, allow_partial=partial)
    if "scores" in chosen.tables:
        out.append(scores(groups, by=chosen.by, allow_partial=partial))
    if "planning-time" in chosen.tables:
        out.append(details.planning_times(groups))
    made_up = made_up_note(group.run for group in groups)
    driven = [_noted(table, made_up) for table in out if table is not None]
    about_data = [table for table in _data_tables(groups, published, chosen) if table is not None]
    return _named_apart([*driven, *about_data])


def _noted(table: Table, note: str) -> Table:
    """The table with one more note, unless it says so already."""
    if not note or any(note in other for other in table.notes):
        return table
    return replace(table, notes=(*table.notes, note))


def _named_apart(tables: Sequence[Table]) -> list[Table]:
    """The same tables, numbered where several have one name."""
    out: list[Table] = []
    for table in tables:
        name, number = table.name, 1
        while name in {other.name for other in out}:
            number += 1
            name = f"{table.name}-{number}"
        out.append(replace(table, name=name))
    return out


def _data_tables(
    groups: Sequence[Group], published: Published | None, options: Options
) -> list[Table | None]:
    if not {"data-statistics", "benchmark-comparison"} & set(options.tables):
        return []
    found = data_tables.own_statistics(groups)
    out: list[Table | None] = []
    if "data-statistics" in options.tables:
        out.append(data_tables.data_statistics(found))
    if "benchmark-comparison" in options.tables and published is not None:
        out.append(data_tables.benchmark_comparison(published, found))
    return out


def write_report(
    folder: Path, tables: Sequence[Table], drawn: Sequence[Figure], styles: Sequence[str]
) -> list[Path]:
    """Write tables and pictures.

    Args:
        folder: Where to; made if needed. Files of the same names are replaced.
        tables: The tables: one file per format, and one per table for `csv`.
        drawn: The pictures, written as PNG, and shown in the HTML page.
        styles: Of `FORMATS`.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = [figure.save(folder) for figure in drawn]
    out = [*pictures]
    for style in styles:
        ending = ENDINGS[style]
        if style == "csv":
            files = {f"{table.name}.csv": render(table, style) for table in tables}
        else:
            text = "\n\n".join(render(table, style) for table in tables)
            titles = [figure.title for figure in drawn]
            if style == "html":
                text = _page(text, pictures, titles)
            elif style == "md":
                named = zip(titles, pictures, strict=True)
                text = "\n\n".join([text, *(f"![{t}]({path.name})" for t, path in named)])
            files = {f"report.{ending}": text}
        for name, text in files.items():
            path = folder / name.replace("/", "-")
            path.write_text(f"{text}\n", encoding="utf-8")
            out.append(path)
    return out


_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; padding: 0 1rem;
  color: #1c1c1c; background: #fff; }
h2 { font-size: 1.05rem; margin: 2.2rem 0 .5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { padding: .22rem .6rem; text-align: left; white-space: nowrap; }
th { border-bottom: 1.5px solid #444; }
tbody tr:nth-child(even) { background: #f4f5f7; }
.n { text-align: right; }
p { color: #555; font-size: .8rem; margin: .25rem 0; }
img { max-width: 100%; margin-top: 1.5rem; }
"""


def _page(body: str, pictures: Sequence[Path], titles: Sequence[str]) -> str:
    """One HTML file that holds its pictures."""
    images = (
        f'<img alt="{html.escape(title)}" src="data:image/png;base64,'
        f'{base64.b64encode(path.read_bytes()).decode()}">'
        for title, path in zip(titles, pictures, strict=True)
    )
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8"><title>shiftsim report</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{_STYLE}</style></head><body>",
            body,
            *images,
            "</body></html>",
        ]
    )
