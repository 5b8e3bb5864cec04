"""Statistics of a store as tables and as a picture."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias

from shiftsim.data.store.statistics import (
    ALL,
    COLUMNS,
    PUBLISHED_SCENARIOS,
    PUBLISHED_SETS,
    StoreStats,
)
from shiftsim.errors import ConfigError, one_of
from shiftsim.report.palette import new_figure, save_picture
from shiftsim.report.tables import aligned
from shiftsim.report.writers import csv_text

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
_COLORS = {"vehicles": "#3b6ea5", "pedestrians": "#d1812f", "bicycles": "#4f9d69"}
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
    """Draw scenarios and agents per city as bars; the ending of the path decides the format.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ConfigError: The ending is none that can be drawn.
    """
    figure = new_figure(figsize=(11.0, 4.2))
    groups = stats.groups("city")
    cities = [name for name in groups if name != ALL]
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.7, 1.0))
    _draw_counts(left, cities, groups)
    _draw_agents(middle, [*cities, ALL], groups)
    _draw_interactions(right, [*cities, ALL], groups)
    for axes in (left, middle, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(axis="x", labelrotation=0 if len(cities) < 4 else 30)
    figure.suptitle(title)
    try:
        save_picture(figure, path)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}", hint="use .png, .svg or .pdf") from error


def _say_values(
    axes: Any, places: Iterable[float], values: Iterable[float], form: str = "{:.1f}", size: int = 9
) -> None:
    for place, value in zip(places, values, strict=True):
        axes.annotate(form.format(value), (place, value), ha="center", va="bottom", fontsize=size)


def _draw_counts(axes: Any, cities: list[str], groups: _Means) -> None:
    counts = [groups[name]["scenarios"] for name in cities]
    axes.bar(cities, counts, color="#3b6ea5", label="this store", width=0.6)
    published = [published_scenarios(name) for name in cities]
    if any(published):
        dashed = {"fill": False, "edgecolor": "black", "linestyle": "--", "width": 0.75}
        axes.bar(cities, [count or 0 for count in published], label="published", **dashed)
        axes.margins(y=0.18)
        axes.legend(frameon=False, ncols=2, loc="upper center")
    _say_values(axes, range(len(counts)), counts, "{:.0f}")
    axes.set_title("Scenarios", fontsize=9)
    sets = "\n".join(f"{name}  {count}" for name, count in PUBLISHED_SETS.items())
    axes.set_xlabel(f"published sets:\n{sets}", fontsize=8, color="0.35")


def _draw_agents(axes: Any, names: list[str], groups: _Means) -> None:
    width = 0.27
    for shift, (kind, color) in enumerate(_COLORS.items(), -1):
        places = [place + shift * width for place in range(len(names))]
        over = [groups[name].get(kind, 0.0) for name in names]
        start = [groups[name].get(f"{kind}_t0", 0.0) for name in names]
        axes.bar(places, over, width * 0.95, color=color, alpha=0.45)
        axes.bar(places, start, width * 0.95, color=color, label=kind)
        _say_values(axes, places, over, size=8)
    axes.set_xticks(range(len(names)), names)
    axes.set_title("Agents per scenario\n(full colour: at t0; pale: over the scenario)", fontsize=9)
    axes.margins(y=0.18)
    axes.legend(frameon=False, ncols=3, loc="upper center")


def _draw_interactions(axes: Any, names: list[str], groups: _Means) -> None:
    values = [groups[name].get("interactions", 0.0) for name in names]
    axes.bar(names, values, color="#8a5aa8", width=0.6)
    _say_values(axes, range(len(values)), values)
    axes.set_title("Interaction density\n(agents near the ego's path within 3 s)", fontsize=9)
