"""All tables and pictures of some runs, and the folder they are written to."""

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import write_text
from shiftsim.report import data_tables, details, paper
from shiftsim.report.figures import Figure
from shiftsim.report.groups import Group, is_stand_in, made_up_note, weights_note
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
_ASK = "the run must say --checkpoint PLANNER=shiftsim"
_ABOUT_DATA = ("data-statistics", "benchmark-comparison")
_LONG = ("planner-comparison-noise", *_ABOUT_DATA)
BRIEF = tuple(name for name in TABLES if name not in _LONG)  # what a terminal shows


@dataclass(frozen=True, slots=True)
class Options:
    """What a report shows."""

    tables: tuple[str, ...] = TABLES  # kinds of tables, of `TABLES`
    by: str | None = None  # splits the rows of the score table further
    beside: bool = False  # show the published figures as well
    allow_partial: bool = False  # show labelled means of incomplete groups

    def __post_init__(self) -> None:
        for name in self.tables:
            one_of("table", name, TABLES)


def make_tables(
    groups: Sequence[Group], published: Published | None = None, options: Options | None = None
) -> list[Table]:
    """The tables of a report, in the order of `TABLES`; without `options` everything is shown.

    Beside published figures stands no planner with weights of our own that nobody asked for.

    Raises:
        ConfigError: Nothing is left beside them.
    """
    chosen = options or Options()
    partial = chosen.allow_partial
    left_out = [group for group in groups if chosen.beside and is_stand_in(group)]
    groups = [group for group in groups if group not in left_out]
    stand_ins = weights_note(group.run for group in left_out)
    if left_out and not groups:
        raise ConfigError(f"nothing to show beside published figures: {stand_ins}", hint=_ASK)
    beside = published if chosen.beside else None
    statistics = cache(lambda: data_tables.own_statistics(groups))
    makers: dict[str, Callable[[], Sequence[Table | None]]] = {
        "semantic-shift": lambda: paper.semantic_shift(
            groups, published, beside=chosen.beside, allow_partial=partial
        ),
        "noise-robustness": lambda: [paper.noise_robustness(groups, beside, allow_partial=partial)],
        "planner-comparison": lambda: [details.planner_comparison(groups)],
        "planner-comparison-noise": lambda: [details.planner_comparison(groups, noisy=True)],
        "scenario-types": lambda: details.scenario_types(groups, allow_partial=partial),
        "scores": lambda: [scores(groups, by=chosen.by, allow_partial=partial)],
        "planning-time": lambda: [details.planning_times(groups)],
        "data-statistics": lambda: [data_tables.data_statistics(statistics())],
        "benchmark-comparison": lambda: (
            [data_tables.benchmark_comparison(published, statistics())] if published else []
        ),
    }
    runs = [group.run for group in groups]
    notes = [made_up_note(runs), weights_note(runs), stand_ins and f"left out: {stand_ins}; {_ASK}"]
    out: list[Table] = []
    for name in (name for name in TABLES if name in chosen.tables):
        for table in filter(None, makers[name]()):
            of_planners = [] if name in _ABOUT_DATA else filter(None, notes)
            more = (n for n in of_planners if not any(n in other for other in table.notes))
            named = _unused(table.name, out)
            out.append(replace(table, name=named, notes=(*table.notes, *more)))
    return out


def _unused(name: str, tables: Sequence[Table]) -> str:
    """The name, numbered where tables have it already."""
    numbered = (name, *(f"{name}-{number + 2}" for number in range(len(tables))))
    return next(one for one in numbered if one not in {table.name for table in tables})


def write_report(
    folder: Path, tables: Sequence[Table], drawn: Sequence[Figure], styles: Sequence[str]
) -> list[Path]:
    """Write tables and pictures to a folder, made if needed, and return the files.

    There is one file per style, of `FORMATS`, and one per table for `csv`; the pictures are PNG
    files and shown in the HTML page. Files of the same names are replaced.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {figure.save(folder): figure.title for figure in drawn}
    out = [*pictures]
    for style in styles:
        parts = [render(table, style) for table in tables]
        if style == "csv":
            files = {f"{t.name}.csv": part for t, part in zip(tables, parts, strict=True)}
        else:
            text = "\n\n".join(parts)
            if style == "html":
                text = _page(text, pictures)
            elif style == "md":
                images = (f"![{title}]({path.name})" for path, title in pictures.items())
                text = "\n\n".join([text, *images])
            files = {f"report.{ENDINGS[style]}": text}
        for name, text in files.items():
            path = folder / name.replace("/", "-")
            write_text(path, f"{text}\n")
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


def _page(body: str, pictures: Mapping[Path, str]) -> str:
    """One HTML file that holds its pictures."""
    images = (
        f'<img alt="{html.escape(title)}" src="data:image/png;base64,'
        f'{base64.b64encode(path.read_bytes()).decode()}">'
        for path, title in pictures.items()
    )
    head = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>shiftsim report</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{_STYLE}</style></head><body>"""
    return "\n".join([head, body, *images, "</body></html>"])
