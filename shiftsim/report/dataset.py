"""Statistics of stores, as tables and as a picture, beside those of the published sets."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from shiftsim.data.store.statistics import (
    ALL,
    COLUMNS,
    PUBLISHED_SCENARIOS,
    PUBLISHED_SETS,
    StoreStats,
    store_stats,
)
from shiftsim.errors import ConfigError, DataError, one_of
from shiftsim.report.groups import DataSet, Group, distinct_sets
from shiftsim.report.palette import AGENTS, new_figure, save_picture
from shiftsim.report.paper import Published
from shiftsim.report.tables import Cell, Number, Table, aligned, csv_text
from shiftsim.runs.results import Run
from shiftsim.runs.scenarios import open_run_store

_Means: TypeAlias = dict[str, dict[str, float]]
FORMATS = ("text", "csv")
_HEADINGS = {
    "scenarios": "scenarios",
    "vehicles_t0": "veh t0",
    "pedestrians_t0": "ped t0",
    "bicycles_t0": "bic t0",
    "vehicles": "veh",
    "pedestrians": "ped",
    "bicycles": "bic",
    "interactions": "interact.",
    "mean_speed_mps": "v mean",
    "max_speed_mps": "v max",
    "path_m": "path",
    "route_m": "route",
    "intersection": "at inters.",
}
_MEANS = {
    "vehicles_t0": "vehicles t0",
    "pedestrians_t0": "pedestrians t0",
    "bicycles_t0": "bicycles t0",
    "vehicles": "vehicles",
    "pedestrians": "pedestrians",
    "bicycles": "bicycles",
    "interactions": "close agents",
    "mean_speed_mps": "mean speed",
    "path_m": "path",
}
_COLOURS = {f"{kind.name.lower()}s": colour for kind, colour in AGENTS.items()}
_OWN: dict[str, Any] = {"color": "#4a5560"}
_PUBLISHED: dict[str, Any] = {"facecolor": "white", "edgecolor": "#4a5560", "hatch": "////"}
_AXES = {
    "interactions": "mean number of agents near\nthe ego's path within 3 s",
    "mean_speed_mps": "mean speed of the ego [m/s]",
}
_LINE, _SETS_HEIGHT = 0.45, 1.5  # inches: a city, the published sets
_ALIASES = {"SIFI": "Sindelfingen", "STR": "Stuttgart", "MUC": "Munich", "BER": "Berlin"}
_ALIASES |= {"SFO": "San Francisco", "Muenchen": "Munich", "München": "Munich"}


def published_scenarios(city: str) -> int | None:
    """Scenarios that the published benchmark has of a site; None where it has none."""
    names = {name.casefold().replace(" ", ""): name for name in PUBLISHED_SCENARIOS}
    names |= {short.casefold(): name for short, name in _ALIASES.items()}
    plain = "".join(c for c in city.casefold() if c.isalpha())
    return PUBLISHED_SCENARIOS[names[plain]] if plain in names else None


def stats_table(stats: StoreStats, *, by: str = "city", style: str = "text") -> str:
    """Means per scenario of each group (`city` or `type`) and of all; `csv` has every scenario."""
    one_of("format", style, FORMATS)
    if style == "csv":
        rows = [["token", "city", "type", *COLUMNS]]
        for token, row in stats.rows.items():
            numbers = [repr(getattr(row, name)) for name in COLUMNS]
            rows.append([token, stats.cities[token], stats.types[token], *numbers])
        return csv_text(rows)
    lines = [[by, *_HEADINGS.values()]]
    for name, means in stats.groups(by).items():
        lines.append([name, *(_cell(column, means) for column in _HEADINGS)])
    notes = "means per scenario; t0 = at iteration 0, else over all iterations; m, m/s"
    sets = ", ".join(f"{name} {count}" for name, count in PUBLISHED_SETS.items())
    return "\n".join([*aligned(lines, 1), f" {notes}", f" published scenarios: {sets}"])


def _cell(name: str, row: dict[str, float]) -> str:
    if name not in row:
        return "–"
    if name == "intersection":
        return f"{100.0 * row[name]:.0f} %"
    return f"{row[name]:.0f}" if name == "scenarios" else f"{row[name]:.1f}"


def stats_dict(stats: StoreStats) -> dict[str, object]:
    """The means as JSON values, with the published numbers beside them."""
    cities = stats.groups("city")
    return {
        "cities": cities,
        "types": stats.groups("type"),
        "published": {
            "scenarios": PUBLISHED_SETS,
            "sites": {c: n for c in cities if (n := published_scenarios(c)) is not None},
        },
    }


def draw_stats(stats: StoreStats, path: Path, *, title: str) -> None:
    """Draw the store beside the published sets, and its cities; the path's ending is the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ConfigError: The ending is none that can be drawn.
    """
    figure = stats_figure(stats, title=title)
    try:
        save_picture(figure, path)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}", hint="use .png, .svg or .pdf") from error


def stats_figure(stats: StoreStats, *, title: str) -> Any:
    """The picture of `draw_stats` as a matplotlib figure; all bars lie, so that names have room.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    groups = stats.groups("city")
    cities = [name for name in groups if name != ALL]
    height = _LINE * (len(cities) + 1) + 0.5
    figure = new_figure(figsize=(10.0, _SETS_HEIGHT + height + 1.0))
    upper, lower = figure.subfigures(2, 1, height_ratios=(_SETS_HEIGHT, height))
    _draw_sets(upper.subplots(), len(stats.rows))
    panels = lower.subplots(1, 4, sharey=True, width_ratios=(1.0, 1.5, 1.0, 1.0))
    _draw_counts(panels[0], cities, groups)
    _draw_agents(panels[1], [*cities, ALL], groups)
    _draw_means(panels[2], [*cities, ALL], groups, "interactions")
    _draw_means(panels[3], [*cities, ALL], groups, "mean_speed_mps")
    panels[0].set_yticks(range(len(cities) + 1), [*cities, ALL])
    panels[0].invert_yaxis()
    figure.suptitle(title, fontsize=11)
    return figure


def _draw_sets(axes: Any, count: int) -> None:
    """Scenarios of this store beside the published sets."""
    counts = {"this store": count}
    counts |= {f"{name} (published)": number for name, number in PUBLISHED_SETS.items()}
    for place, value in enumerate(counts.values()):
        _bar(axes, place, value, "{:.0f}", 0.65, _PUBLISHED if place else _OWN)
    axes.set_yticks(range(len(counts)), list(counts))
    axes.invert_yaxis()
    _finish(axes, "scenarios of whole sets")


def _draw_counts(axes: Any, cities: list[str], groups: _Means) -> None:
    for place, city in enumerate(cities):
        published = published_scenarios(city)
        shift = 0.0 if published is None else 0.2
        width = 0.65 if published is None else 0.38
        _bar(axes, place - shift, groups[city]["scenarios"], "{:.0f}", width, _OWN)
        if published is not None:
            _bar(axes, place + shift, published, "{:.0f}", width, _PUBLISHED)
    known = any(published_scenarios(city) for city in cities)
    _finish(axes, "scenarios (hatched: published)" if known else "scenarios")


def _draw_agents(axes: Any, names: list[str], groups: _Means) -> None:
    width = 0.28
    for number, (kind, colour) in enumerate(_COLOURS.items()):
        places = [place + (number - 1) * width for place in range(len(names))]
        for place, name in zip(places, names, strict=True):
            over, start = groups[name].get(kind, 0.0), groups[name].get(f"{kind}_t0", 0.0)
            look = {"color": colour, "label": kind if place == places[0] else None}
            _bar(axes, place, over, "{:.1f}", width, {"color": colour, "alpha": 0.45})
            axes.barh(place, start, width * 0.9, **look)
    axes.legend(frameon=False, fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    _finish(axes, "agents per scenario: mean at its start (full),\nin all of it (pale)")


def _draw_means(axes: Any, names: list[str], groups: _Means, column: str) -> None:
    for place, name in enumerate(names):
        _bar(axes, place, groups[name].get(column, 0.0), "{:.1f}", 0.65, _OWN)
    _finish(axes, _AXES[column])


def _bar(
    axes: Any, place: float, value: float, form: str, width: float, look: dict[str, Any]
) -> None:
    """A lying bar with its value at its end."""
    axes.barh(place, value, width * 0.9, **look)
    where: dict[str, Any] = {"xytext": (2, 0), "textcoords": "offset points", "va": "center"}
    axes.annotate(form.format(value), (value, place), fontsize=7, **where)


def _finish(axes: Any, label: str) -> None:
    axes.set_xlabel(label, fontsize=8)
    axes.tick_params(labelsize=8)
    axes.margins(x=0.18)
    axes.set_xlim(left=0.0)
    axes.spines[["top", "right"]].set_visible(False)


def own_statistics(groups: Sequence[Group]) -> dict[str, StoreStats | str]:
    """Statistics of every data set by its label, or why there are none."""
    runs = {group.data.key: group.run for group in reversed(groups)}
    return {data.label: _statistics(runs[data.key], data) for data in distinct_sets(groups)}


def _statistics(run: Run, data: DataSet) -> StoreStats | str:
    try:
        store = open_run_store(run)
        held = set(store.tokens)
        return store_stats(store, [token for token in data.tokens if token in held])
    except DataError as error:
        return error.message


def data_statistics(found: Mapping[str, StoreStats | str]) -> Table | None:
    """Means per scenario by city; None where no store could be read."""
    rows: list[tuple[Cell, ...]] = []
    notes = [
        "means per scenario; t0: present at iteration 0, else at any iteration; close agents: "
        "mean number near the ego's path within 3 s; m, m/s"
    ]
    for label, stats in found.items():
        if isinstance(stats, str):
            notes.append(f"{label}: {stats}")
            continue
        for city, row in stats.groups("city").items():
            numbers = (Number(row[name], 1) if name in row else None for name in _MEANS)
            rows.append((label, city, Number(row["scenarios"], 0), *numbers))
    if not rows:
        return None
    header = ("set", "city", "scenarios", *_MEANS.values())
    return Table("data-statistics", "The scenarios", header, tuple(rows), 2, tuple(notes))


def benchmark_comparison(
    published: Published, found: Mapping[str, StoreStats | str], edited: Collection[str] = ()
) -> Table:
    """The paper's comparison of benchmarks, with own sets beside; `edited` are those of edits."""
    own = {label: stats for label, stats in found.items() if isinstance(stats, StoreStats)}
    rows: list[tuple[Cell, ...]] = [
        (name, *values, *(_property(name, stats, k in edited) for k, stats in own.items()))
        for name, values in published.comparison.items()
    ]
    notes = (
        f"nuPlan, interPlan, DeepPlan: {published.source}",
        "own sets: measured from the store; interaction density: mean number of agents near "
        "the ego's path within 3 s",
        *(["edited: made of recorded scenarios, as interPlan's are"] if edited else []),
    )
    header = (
        "property",
        *published.sets,
        *(f"{label} ({'own, edited' if label in edited else 'own'})" for label in own),
    )
    title = "Benchmarks compared"
    return Table("benchmark-comparison", title, header, tuple(rows), len(header), notes)


def _property(name: str, stats: StoreStats, is_edited: bool) -> str:
    groups = stats.groups("city")
    if name == "semantic shift" and is_edited:
        return "scenario"
    if name == "scenario count":
        return f"{groups[ALL]['scenarios']:.0f}"
    if name == "geographic coverage":
        return ", ".join(city for city in groups if city != ALL)
    if name == "interaction density":
        return f"{groups[ALL]['interactions']:.1f}"
    return "–"
