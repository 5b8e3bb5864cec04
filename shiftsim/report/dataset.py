"""Statistics of stores, as tables and as a picture, beside those of the published sets."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeAlias

from shiftsim.data.store.statistics import ALL, COLUMNS, PUBLISHED_SETS, StoreStats, store_stats
from shiftsim.errors import DataError, one_of
from shiftsim.report import palette
from shiftsim.report.groups import Group, distinct_sets
from shiftsim.report.palette import DEFAULT_FORM, SMALL, FigureFormat
from shiftsim.report.paper import Published
from shiftsim.report.tables import Number, Record, Row, Table, render
from shiftsim.runs.scenarios import open_run_store

_Bars: TypeAlias = list[tuple[float, dict[str, Any]]]
FORMATS = ("text", "csv")
_COLOURS = {f"{kind.name.lower()}s": colour for kind, colour in palette.AGENTS.items()}
_MEANS = {  # headings of the means
    **{f"{kind}_t0": f"{kind} t0" for kind in _COLOURS},
    **{kind: kind for kind in _COLOURS},
    "interactions": "close agents",
    "mean_speed_mps": "mean speed",
    "max_speed_mps": "max speed",
    "path_m": "path",
    "route_m": "route",
}
_AXES = {
    "interactions": "mean agents near the\nego's path within 3 s",
    "mean_speed_mps": "mean speed of\nthe ego [m/s]",
}
_NOTE = (
    "means per scenario; t0: present at iteration 0, else at any iteration; close agents: "
    "mean number near the ego's path within 3 s; at intersections: share of the scenarios; m, m/s"
)
_OWN: dict[str, Any] = {"color": "#4a5560"}
_PUBLISHED: dict[str, Any] = {"facecolor": "white", "edgecolor": "#4a5560", "hatch": "////"}
_LINE, _SETS_HEIGHT = 0.4, 1.3  # inches: a city, the published sets
_WIDE = 5.0  # inches; what is narrower has two panels side by side, not four


def stats_table(stats: StoreStats, *, by: str = "city", style: str = "text", width: int = 0) -> str:
    """Means per scenario of each group (`city` or `type`) and of all; `csv` has every scenario."""
    one_of("format", style, FORMATS)
    each: list[Row] = [
        (
            *(token, stats.cities[token], stats.types[token]),
            *(Number(getattr(row, name)) for name in COLUMNS),
        )
        for token, row in stats.rows.items()
    ]
    full = Table("stats", "", ("token", "city", "type", *COLUMNS), each, 3)
    sets = ", ".join(f"{name} {count}" for name, count in PUBLISHED_SETS.items())
    notes = (_NOTE, f"published scenarios: {sets}")
    table = Table.of("stats", "", _means(stats, by), 1, notes=notes, full=full)
    return render(table, style, width=width)


def _means(stats: StoreStats, by: str) -> list[Record]:
    """Means of each group and of all."""
    return [
        {
            by: name,
            "scenarios": Number(row["scenarios"], 0),
            **{text: Number(row[n], 1) if n in row else None for n, text in _MEANS.items()},
            "at intersections [%]": (
                Number(100.0 * row["intersection"], 0) if "intersection" in row else None
            ),
        }
        for name, row in stats.groups(by).items()
    ]


def stats_dict(stats: StoreStats, published: Published) -> dict[str, object]:
    """The means as JSON values, with the published numbers beside them."""
    cities = stats.groups("city")
    return {
        "cities": cities,
        "types": stats.groups("type"),
        "published": {
            "scenarios": PUBLISHED_SETS,
            "sites": {c: n for c in cities if (n := published.count(c)) is not None},
        },
    }


@palette.in_format
def stats_figure(
    stats: StoreStats, published: Published, *, title: str, form: FigureFormat = DEFAULT_FORM
) -> Any:
    """The store beside the published sets, and its cities, as bars that lie: names have room."""
    groups = stats.groups("city")
    means, cities = [*groups.values()], [name for name in groups if name != ALL]
    width = form.width or palette.PAGE
    across = 4 if width > _WIDE else 2
    height = (_LINE * len(groups) + 0.8) * (4 // across)
    figure = palette.new_figure(figsize=(width, _SETS_HEIGHT + height + 0.3))
    upper, lower = figure.subfigures(2, 1, height_ratios=(_SETS_HEIGHT, height))
    sets = upper.subplots()
    whole: list[_Bars] = [[(number, _PUBLISHED)] for number in PUBLISHED_SETS.values()]
    _draw(sets, [[(len(stats.rows), _OWN)], *whole], "{:.0f}", "scenarios of whole sets")
    sets.set_yticks(range(4), ["this store", *(f"{name} (published)" for name in PUBLISHED_SETS)])
    sets.invert_yaxis()

    ratios = (1.0, 1.5, 1.0, 1.0) if across == 4 else (1.0, 1.5)
    panels = lower.subplots(4 // across, across, sharey=True, width_ratios=ratios).ravel()
    counts: list[_Bars] = [[(groups[city]["scenarios"], _OWN)] for city in cities]
    sites = [published.count(city) for city in cities]
    for bars, number in zip(counts, sites, strict=True):
        bars += [(number, _PUBLISHED)] if number is not None else []
    hatched = " (hatched: published)" if any(sites) else ""
    _draw(panels[0], counts, "{:.0f}", f"scenarios{hatched}")
    label = "mean agents per scenario: at its\nstart (full), in all of it (pale)"
    for ending, alpha, form_of_values in (("", 0.45, "{:.1f}"), ("_t0", None, "")):
        looks = {f"{kind}{ending}": {"color": c, "alpha": alpha} for kind, c in _COLOURS.items()}
        rows = [[(row.get(name, 0.0), look) for name, look in looks.items()] for row in means]
        _draw(panels[1], rows, form_of_values, label)
    handles = panels[1].containers[-len(_COLOURS) :]
    look = {"frameon": False, "fontsize": SMALL, "handlelength": 1.0, "columnspacing": 0.8}
    lower.legend(handles, _COLOURS, loc="outside upper center", ncols=3, **look)
    for axes, (column, words) in zip(panels[2:], _AXES.items(), strict=True):
        _draw(axes, [[(row.get(column, 0.0), _OWN)] for row in means], "{:.1f}", words)
    panels[0].set_yticks(range(len(groups)), [*groups])
    panels[0].invert_yaxis()
    if not form.plain:
        figure.suptitle(title, fontsize=palette.TEXT)
    return figure


def _draw(axes: Any, rows: Sequence[_Bars], form: str, label: str) -> None:
    """Lying bars, those of a row below each other, and their values at their ends in some form."""
    for place, bars in enumerate(rows):
        width = min(0.65, 0.84 / len(bars))
        for number, (value, look) in enumerate(bars):
            y = place + (number - (len(bars) - 1) / 2) * width
            axes.barh(y, value, 0.9 * width, **look)
            where: dict[str, Any] = {"xytext": (2, 0), "textcoords": "offset points"}
            if form:
                axes.annotate(form.format(value), (value, y), fontsize=SMALL, va="center", **where)
    axes.set_xlabel(label, fontsize=SMALL)
    axes.tick_params(labelsize=SMALL)
    axes.margins(x=0.18)
    axes.set_xlim(left=0.0)
    axes.spines[["top", "right"]].set_visible(False)


def own_statistics(groups: Sequence[Group]) -> dict[str, StoreStats | str]:
    """Statistics of every data set by its label, or why there are none."""
    runs = {group.data.key: group.run for group in reversed(groups)}
    out: dict[str, StoreStats | str] = {}
    for data in distinct_sets(groups):
        try:
            store = open_run_store(runs[data.key])
            held = set(store.tokens)
            out[data.label] = store_stats(store, [name for name in data.tokens if name in held])
        except DataError as error:
            out[data.label] = error.message
    return out


def data_statistics(found: Mapping[str, StoreStats | str]) -> Table | None:
    """Means per scenario by city; None where no store could be read."""
    records: list[Record] = []
    notes = [_NOTE]
    for label, stats in found.items():
        if isinstance(stats, str):
            notes.append(f"{label}: {stats}")
        else:
            records += [{"set": label, **record} for record in _means(stats, "city")]
    if not records:
        return None
    return Table.of("data-statistics", "The scenarios", records, 2, notes=notes)


def benchmark_comparison(
    published: Published, found: Mapping[str, StoreStats | str], edited: Collection[str] = ()
) -> Table:
    """The paper's comparison of benchmarks, with own sets beside; `edited` are those of edits."""
    own = {label: stats for label, stats in found.items() if isinstance(stats, StoreStats)}
    columns: dict[str, dict[str, str]] = {}
    for label, groups in ((label, stats.groups("city")) for label, stats in own.items()):
        columns[label] = {
            "semantic shift": "scenario" if label in edited else "–",
            "scenario count": f"{groups[ALL]['scenarios']:.0f}",
            "geographic coverage": ", ".join(city for city in groups if city != ALL),
            "interaction density": f"{groups[ALL].get('interactions', math.nan):.1f}",
        }
    rows = [
        (name, *values, *(column.get(name, "–") for column in columns.values()))
        for name, values in published.comparison.items()
    ]
    notes = (
        f"nuPlan, interPlan, DeepPlan: {published.source}",
        "own sets: measured from the store; interaction density: mean number of agents near "
        "the ego's path within 3 s",
        *(["edited: made of recorded scenarios, as interPlan's are"] if edited else []),
    )
    labels = (f"{label} ({'own, edited' if label in edited else 'own'})" for label in own)
    header = ("property", *published.sets, *labels)
    title = "Benchmarks compared"
    return Table("benchmark-comparison", title, header, rows, len(header), notes)
