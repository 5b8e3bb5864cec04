"""Pictures of a report: robustness curves, scores per city and per metric.

Planners differ in colour, marker and dash, so that they stay apart without colour. Nothing is drawn
of groups whose score is withheld.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.report.groups import COLUMNS, DataSet, Group, distinct_sets
from shiftsim.report.palette import Look, looks, new_figure, save_picture
from shiftsim.report.paper import METRICS, traffics
from shiftsim.report.statistics import score_interval
from shiftsim.report.tables import Estimate, Interval

LEVELS = ("none", "low", "mid", "high")
_KINDS = {"awgn": "white noise (AWGN)", "ou": "correlated noise (OU)"}
_TRAFFIC = {"NR": "non-reactive traffic", "R": "reactive traffic"}
_DASHES = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 2, 2)), (0, (7, 2, 2, 2, 2, 2)))
_SIZES = {"*": 1.7, "P": 1.2, "X": 1.2, "D": 0.85}  # markers of equal weight to the eye
_SPREAD = 0.62  # how much of a place on the axis the planners share
_GREY = "0.45"


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture.

    Attributes:
        name: Of its file, without ending.
        title: What it shows.
        drawn: The matplotlib figure.
    """

    name: str
    title: str
    drawn: Any

    def save(self, folder: Path, ending: str = "png") -> Path:
        """Write the picture and return where it is; the same picture gives the same bytes."""
        path = folder / f"{self.name}.{ending}"
        save_picture(self.drawn, path)
        return path


def figures(groups: Sequence[Group], *, allow_partial: bool = False) -> list[Figure]:
    """All pictures that the groups allow.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    out = []
    styles = looks(dict.fromkeys(group.planner for group in groups))
    for data in _named_apart(distinct_sets(groups)):
        mine = [group for group in groups if group.data.key[1:] == data.key[1:]]
        shown = [g for g in mine if _estimate(g, allow_partial) is not None]
        out += _robustness(data, shown, styles, allow_partial)
        clean = [group for group in shown if group.noise == "none"]
        if clean:
            out += _cities(data, clean, styles, allow_partial)
            out.append(_metrics(data, clean, styles, allow_partial))
    return out


def _named_apart(sets: Sequence[DataSet]) -> list[DataSet]:
    """The same sets, numbered where several have one name: it becomes that of a file."""
    names = [data.name for data in sets]
    return [
        replace(data, name=f"{data.name}-{i + 1}") if data.name in names[:i] else data
        for i, data in enumerate(sets)
    ]


def _estimate(
    group: Group, allow_partial: bool, name: str = "cls", where: Any = None
) -> Estimate | None:
    """A score that may be shown."""
    found = group.estimate(name, where, allow_partial=allow_partial)
    return None if found is None or found.mean is None else found


def _robustness(
    data: DataSet, groups: Sequence[Group], styles: dict[str, Look], allow_partial: bool
) -> list[Figure]:
    kinds = [kind for kind in _KINDS if any(g.noise.startswith(f"{kind}-") for g in groups)]
    modes = traffics(groups)
    if not kinds:
        return []
    figure, panels = _panels(len(modes), len(kinds), (4.1, 3.3))
    planners = list(dict.fromkeys(group.planner for group in groups))
    for row, traffic in enumerate(modes):
        for column, kind in enumerate(kinds):
            axes = panels[row][column]
            for place, planner in enumerate(planners):
                found = {
                    group.noise: _estimate(group, allow_partial)
                    for group in groups
                    if (group.traffic, group.planner) == (traffic, planner)
                }
                style = _line(styles[planner]) | {"linestyle": _DASHES[place % len(_DASHES)]}
                label = _label(planner, found.values())
                _curve(axes, found, kind, label, place - len(planners) / 2, style)
            axes.set_xticks(range(len(LEVELS)), LEVELS)
            axes.set_title(f"{_KINDS[kind]}, {_TRAFFIC.get(traffic, traffic)}", fontsize=9)
            _score_axis(axes)
    _finish(
        figure, panels[0][0], data, "Noise robustness", "error bars: standard deviation over seeds"
    )
    return [Figure(f"robustness_{data.name}", f"Noise robustness on {data.label}", figure)]


def _curve(
    axes: Any,
    found: dict[str, Estimate | None],
    kind: str,
    label: str,
    offset: float,
    style: dict[str, Any],
) -> None:
    """One planner's scores by level; shifted a little, so that error bars do not cover others."""
    names = ["none", *(f"{kind}-{level}" for level in LEVELS[1:])]
    points = [(i, found[name]) for i, name in enumerate(names) if found.get(name) is not None]
    if not points:
        return
    places = [place + 0.02 * offset for place, _ in points]
    means = [cell.mean for _, cell in points if cell]
    errors = [(cell.std or 0.0) if cell else 0.0 for _, cell in points]
    axes.errorbar(places, means, yerr=errors, label=label, capsize=2, **style)


def _label(planner: str, found: Iterable[Estimate | None]) -> str:
    return f"{planner} (partial)" if any(cell and cell.label for cell in found) else planner


def _named(group: Group) -> str:
    return group.planner if group.is_complete else f"{group.planner} (partial)"


def _line(look: Look) -> dict[str, Any]:
    return {
        "color": look.colour,
        "marker": look.marker,
        "markersize": 6.0 * _SIZES.get(look.marker, 1.0),
        "linewidth": 1.4,
        "markeredgecolor": "white",
        "markeredgewidth": 0.5,
    }


def _cities(
    data: DataSet, groups: Sequence[Group], styles: dict[str, Look], allow_partial: bool
) -> list[Figure]:
    cities = sorted({city for city in data.cities if city})
    if len(cities) < 2:
        return []
    counts = {city: int(np.sum(np.array(data.cities) == city)) for city in cities}
    names = [f"all\n({len(data.tokens)})", *(f"{city}\n({counts[city]})" for city in cities)]

    def cell(group: Group, place: int) -> tuple[Estimate | None, Interval | None]:
        where = None if place == 0 else data.within(cities[place - 1])
        return _estimate(group, allow_partial, "cls", where), score_interval(group, "cls", where)

    figure = _dots(groups, names, cell, styles)
    note = "bars: 95 % bootstrap interval over recordings (none for a single recording)"
    _finish(figure[0], figure[1], data, "Score per city", note)
    return [Figure(f"cities_{data.name}", f"Score per city of {data.label}", figure[0])]


def _metrics(
    data: DataSet, groups: Sequence[Group], styles: dict[str, Look], allow_partial: bool
) -> Figure:
    columns = ["cls", *METRICS]

    def cell(group: Group, place: int) -> tuple[Estimate | None, Interval | None]:
        name = columns[place]
        return _estimate(group, allow_partial, name), score_interval(group, name)

    figure = _dots(groups, [COLUMNS[name] for name in columns], cell, styles)
    note = "bars: 95 % bootstrap interval over recordings"
    _finish(figure[0], figure[1], data, "Metrics", note)
    return Figure(f"metrics_{data.name}", f"Metrics on {data.label}", figure[0])


def _dots(
    groups: Sequence[Group],
    names: Sequence[str],
    cell: Callable[[Group, int], tuple[Estimate | None, Interval | None]],
    styles: dict[str, Look],
) -> tuple[Any, Any]:
    """Planners side by side at every place, one panel per traffic mode."""
    modes = traffics(groups)
    planners = list(dict.fromkeys(group.planner for group in groups))
    figure, panels = _panels(len(modes), 1, (max(5.5, 1.05 * len(names)), 2.9))
    for row, traffic in enumerate(modes):
        axes = panels[row][0]
        here = [group for group in groups if group.traffic == traffic]
        for group in here:
            look = styles[group.planner]
            shift = _SPREAD * ((planners.index(group.planner) + 0.5) / len(planners) - 0.5)
            for place in range(len(names)):
                label = _named(group) if place == 0 else None
                _dot(axes, place + shift, cell(group, place), look, label)
        for place in range(1, len(names)):
            axes.axvline(place - 0.5, color="0.9", linewidth=0.7, zorder=0)
        axes.set_xticks(range(len(names)), names)
        axes.set_xlim(-0.5, len(names) - 0.5)
        axes.set_title(_TRAFFIC.get(traffic, traffic), fontsize=9)
        _score_axis(axes)
    return figure, panels[0][0]


def _dot(
    axes: Any,
    x: float,
    found: tuple[Estimate | None, Interval | None],
    look: Look,
    label: str | None,
) -> None:
    estimate, interval = found
    if estimate is None or estimate.mean is None:
        return
    if interval is not None:
        axes.vlines(x, interval.low, interval.high, color=look.colour, linewidth=1.3)
    style = _line(look) | {"linestyle": "none"}
    axes.plot([x], [estimate.mean], label=label, **style)


def _panels(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    figure = new_figure(figsize=(size[0] * columns + 0.6, size[1] * rows + 1.1))
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=True)


def _score_axis(axes: Any) -> None:
    axes.set_ylim(-3.0, 103.0)
    axes.set_ylabel("score x 100", fontsize=9)
    axes.grid(axis="y", color="0.9", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def _finish(figure: Any, axes: Any, data: DataSet, title: str, note: str) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=min(4, max(1, len(labels))),
        frameon=False,
        fontsize=8,
        handlelength=3.2,
        title=f"{title}: {data.label}",
        title_fontsize=10,
    )
    figure.supxlabel(f"{data.rules}\n{note}", fontsize=6.5, color=_GREY)
