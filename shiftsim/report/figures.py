"""Pictures of a report: robustness curves, scores per city and per metric.

Planners and noise are drawn as everywhere (`palette`): clean scores are full marks and solid lines,
those under noise hollow marks on dashed lines. Nothing is drawn of groups whose score is withheld.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from textwrap import wrap
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from shiftsim.edits.sampling import GRADES, graded
from shiftsim.kernels import BoolArray
from shiftsim.report.details import recorded_interval, recorded_score
from shiftsim.report.groups import COLUMNS, DataSet, Group, distinct_sets
from shiftsim.report.palette import Style, dashes, new_figure, planner_styles, save_picture
from shiftsim.report.paper import traffics
from shiftsim.report.statistics import score_interval
from shiftsim.report.tables import Estimate
from shiftsim.report.words import LONG

LEVELS = ("none", "low", "mid", "high")
_KINDS = {"awgn": "white noise (AWGN)", "ou": "correlated noise (OU)"}
_TRAFFIC = {"NR": "non-reactive traffic", "R": "reactive traffic"}
_SPREAD = 0.62  # how much of a place on the axis the planners share
_GREY = "0.45"
_NOTE = 6.5  # points
_NONE: Mapping[str, str] = MappingProxyType({})
_BARS = "clean rollouts; bars: 95 % bootstrap interval over recordings"


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture."""

    name: str  # of its file, without ending
    title: str  # what it shows
    drawn: Any  # the matplotlib figure

    def save(self, folder: Path, ending: str = "png") -> Path:
        """Write the picture and return where it is; the same picture gives the same bytes."""
        path = folder / f"{self.name}.{ending}"
        save_picture(self.drawn, path)
        return path


class _Place(NamedTuple):
    """A place on the axis: its heading, and the score that is drawn there."""

    heading: str
    column: str = "cls"
    where: BoolArray | None = None


def figures(groups: Sequence[Group], *, allow_partial: bool = False) -> list[Figure]:
    """All pictures that the groups allow.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    out = []
    styles = planner_styles(dict.fromkeys(group.planner for group in groups))
    for data in _named_apart(distinct_sets(groups)):
        mine = [group for group in groups if group.data.key[1:] == data.key[1:]]
        shown = [g for g in mine if _estimate(g, allow_partial) is not None]
        clean = [group for group in shown if group.noise == "none"]
        out += _robustness(data, shown, styles, allow_partial)
        if any(grade for _, grade in map(graded, data.types)):
            out.append(_difficulty(data, clean, groups, styles, allow_partial))
        cities = sorted({city for city in data.cities if city})
        places = [_Place(f"all\n({len(data.tokens)})")]
        for city in cities:
            places.append(_Place(f"{city}\n({data.cities.count(city)})", "cls", data.within(city)))
        if clean and len(cities) > 1:
            drawn = _dots(clean, places, styles, allow_partial)
            note = f"{_BARS} (none for a single recording)"
            _finish(drawn, data, "Score per city", note)
            out.append(Figure(f"cities_{data.name}", f"Score per city of {data.label}", drawn))
        if clean:
            places = [
                _Place("\n".join([*wrap(LONG[short], 12), f"({short})"]), name)
                for name, short in COLUMNS.items()
            ]
            drawn = _dots(clean, places, styles, allow_partial)
            _finish(drawn, data, "Metrics", _BARS)
            out.append(Figure(f"metrics_{data.name}", f"Metrics on {data.label}", drawn))
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
    data: DataSet, groups: Sequence[Group], styles: dict[str, Style], allow_partial: bool
) -> list[Figure]:
    """Scores by strength of the noise, a panel for each of its models; none where all is clean."""
    kinds = [kind for kind in _KINDS if any(g.noise.startswith(f"{kind}-") for g in groups)]
    if not kinds:
        return []
    figure, panels = _panels(traffics(groups), kinds, (4.1, 3.3))
    planners = list(dict.fromkeys(group.planner for group in groups))
    for axes, traffic, kind in panels:
        names = ["none", *(f"{kind}-{level}" for level in LEVELS[1:])]
        for place, planner in enumerate(planners):
            found = {
                group.noise: _estimate(group, allow_partial)
                for group in groups
                if (group.traffic, group.planner) == (traffic, planner)
            }
            cells = {i: cell for i, name in enumerate(names) if (cell := found.get(name))}
            if cells:
                is_partial = any(cell and cell.label for cell in found.values())
                label = f"{planner} (partial)" if is_partial else planner
                # shifted a little, so that error bars do not cover those of others
                shift = 0.02 * (place - len(planners) / 2)
                _curve(axes, label, cells, shift, styles[planner])
                for group in groups:
                    mine = (group.traffic, group.planner) == (traffic, planner)
                    if mine and group.noise in names and (of := score_interval(group)):
                        look = {"color": styles[planner].colour, "alpha": 0.3, "linewidth": 3.0}
                        axes.vlines(names.index(group.noise) + shift, of.low, of.high, **look)
        axes.set_xticks(range(len(LEVELS)), LEVELS)
        axes.set_xlabel("strength of the noise", fontsize=8)
        _finish_axes(axes, f"{_KINDS[kind]}, {_TRAFFIC.get(traffic, traffic)}")
    note = (
        f"n = {len(data.tokens)} scenarios; error bars: standard deviation over seeds; broad bars: "
        "95 % bootstrap interval over recordings; thin line: the clean score"
    )
    _finish(figure, data, "Noise robustness", note, {"clean": "none", "under noise": "some"})
    return [Figure(f"robustness_{data.name}", f"Noise robustness on {data.label}", figure)]


def _curve(axes: Any, label: str, cells: dict[int, Estimate], shift: float, style: Style) -> None:
    """One planner's scores by level."""
    means = [cell.mean for cell in cells.values()]
    look = {**style.marks("some"), "linestyle": dashes("some"), "linewidth": 1.3, "capsize": 2}
    bars = [cell.std or 0.0 for cell in cells.values()]
    axes.errorbar([place + shift for place in cells], means, yerr=bars, **look)
    clean = means[0] if 0 in cells else math.nan
    if 0 in cells:
        axes.axhline(clean, linewidth=0.8, alpha=0.35, color=style.colour, zorder=1)
    axes.plot([shift], [clean], label=label, linestyle="none", zorder=4, **style.marks("none"))


def _difficulty(
    data: DataSet,
    clean: Sequence[Group],
    groups: Sequence[Group],
    styles: dict[str, Style],
    allow_partial: bool,
) -> Figure:
    """Scores by difficulty, a panel for each kind of edit."""
    found = [graded(name) for name in data.types]
    kinds = sorted({kind for kind, grade in found if grade})
    figure, panels = _panels(traffics(clean), kinds, (3.4, 3.1))
    planners = list(dict.fromkeys(group.planner for group in clean))
    for axes, traffic, kind in panels:
        parts = [np.array([pair == (kind, grade) for pair in found]) for grade in GRADES]
        for group in (group for group in clean if group.traffic == traffic):
            shift = 0.06 * (planners.index(group.planner) - (len(planners) - 1) / 2)
            of_kind = np.array([k == kind for k, _ in found])
            cells = [recorded_score(group, of_kind, groups)]
            cells += [_estimate(group, allow_partial, "cls", where) for where in parts]
            points = {i + shift: cell.mean for i, cell in enumerate(cells) if cell is not None}
            bars = [recorded_interval(group, of_kind, groups)]
            bars += [score_interval(group, "cls", where) for where in parts]
            style = styles[group.planner]
            look = {**style.marks("none"), "linestyle": dashes("none"), "linewidth": 1.3}
            axes.plot([*points], [*points.values()], label=_label(group), **look)
            for x, interval in enumerate(bars):
                if interval is not None:
                    axes.vlines(x + shift, interval.low, interval.high, color=style.colour)
        counts = [np.sum(parts), *map(np.sum, parts)]
        ticks = [f"{n}\n(n = {c})" for n, c in zip(["recorded", *GRADES], counts, strict=True)]
        axes.set_xticks(range(1 + len(GRADES)), ticks)
        axes.set_xlim(-0.35, len(GRADES) + 0.35)
        axes.set_xlabel("difficulty of the edit", fontsize=8)
        _finish_axes(axes, f"{kind}, {_TRAFFIC.get(traffic, traffic)}")
    note = (
        "recorded: the same scenarios without the edit; bars: 95 % bootstrap interval over "
        "recordings"
    )
    _finish(figure, data, "Edits", note)
    return Figure(f"edits_{data.name}", f"Scores by difficulty of the edits: {data.label}", figure)


def _dots(
    groups: Sequence[Group], places: Sequence[_Place], styles: dict[str, Style], allow_partial: bool
) -> Any:
    """Planners side by side at every place, one panel per traffic mode."""
    planners = list(dict.fromkeys(group.planner for group in groups))
    figure, panels = _panels(traffics(groups), [""], (max(5.5, 1.05 * len(places)), 2.9))
    for axes, traffic, _ in panels:
        for group in (group for group in groups if group.traffic == traffic):
            style = {**styles[group.planner].marks("none"), "linestyle": "none"}
            shift = _SPREAD * ((planners.index(group.planner) + 0.5) / len(planners) - 0.5)
            for x, place in enumerate(places):
                estimate = _estimate(group, allow_partial, place.column, place.where)
                interval = score_interval(group, place.column, place.where)
                if estimate is not None and interval is not None:
                    low, high = interval.low, interval.high
                    axes.vlines(x + shift, low, high, color=style["color"], linewidth=1.3)
                if estimate is not None:
                    label = None if x else _label(group)
                    axes.plot([x + shift], [estimate.mean], label=label, **style)
        for x in range(1, len(places)):
            axes.axvline(x - 0.5, color="0.9", linewidth=0.7, zorder=0)
        axes.set_xticks(range(len(places)), [place.heading for place in places])
        axes.set_xlim(-0.5, len(places) - 0.5)
        several = len({place.column for place in places}) > 1
        scores = "score" if several else "closed-loop score"
        _finish_axes(axes, _TRAFFIC.get(traffic, traffic), scores)
    return figure


def _label(group: Group) -> str:
    return f"{group.planner}{'' if group.is_complete else ' (partial)'}"


def _panels(
    rows: Sequence[str], columns: Sequence[str], size: tuple[float, float]
) -> tuple[Any, list[tuple[Any, str, str]]]:
    """A figure, and its axes with the names of their row and column."""
    figure = new_figure(figsize=(size[0] * len(columns) + 0.6, size[1] * len(rows) + 1.1))
    axes = figure.subplots(len(rows), len(columns), squeeze=False, sharey=True)
    names = product(rows, columns)
    return figure, [(one, *name) for one, name in zip(axes.flat, names, strict=True)]


def _finish_axes(axes: Any, title: str, scores: str = "closed-loop score") -> None:
    axes.set_title(title, fontsize=9)
    axes.set_ylim(-3.0, 103.0)
    axes.set_ylabel(f"{scores} × 100", fontsize=9)
    axes.label_outer()
    axes.grid(axis="y", color="0.9", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def _sample(noise: str) -> Any:
    """What lines of clean or disturbed rollouts look like, for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle=dashes(noise), **Style(_GREY, "o").marks(noise))


def _finish(
    figure: Any, data: DataSet, title: str, note: str, samples: Mapping[str, str] = _NONE
) -> None:
    """Legend, title and what stands beside every score; `samples` are noises by their label."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    handles += [*map(_sample, samples.values())]
    labels += samples
    look = {"loc": "outside upper center", "frameon": False, "fontsize": 8, "handlelength": 3.2}
    look |= {"title": "\n".join(wrap(f"{title}: {data.label}", _per_line(figure, 10)))}
    for columns in range(min(4, max(1, len(labels))), 0, -1):  # as many as fit
        legend = figure.legend(handles, labels, ncols=columns, title_fontsize=10, **look)
        box = legend.get_window_extent(figure.canvas.get_renderer())
        if box.width <= figure.bbox.width or columns == 1:
            break
        legend.remove()
    lines = [*wrap(data.rules, _per_line(figure, _NOTE)), *wrap(note, _per_line(figure, _NOTE))]
    figure.supxlabel("\n".join(lines), fontsize=_NOTE, color=_GREY)


def _per_line(figure: Any, size: float) -> int:
    """How many characters of a size [points] surely fit into the width of a figure."""
    return int(figure.get_figwidth() * 72.0 / (0.62 * size))
