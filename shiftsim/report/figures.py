"""Pictures of a report: robustness curves, scores per city and per metric.

Planners and noise are drawn as everywhere (`palette`): clean scores are full marks and solid lines,
those under noise hollow marks on dashed lines. Nothing is drawn of groups whose score is withheld.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from shiftsim.edits.sampling import GRADES, graded
from shiftsim.kernels import BoolArray
from shiftsim.report.details import recorded_score
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
            places = [_Place(_heading(short), name) for name, short in COLUMNS.items()]
            drawn = _dots(clean, places, styles, allow_partial)
            _finish(drawn, data, "Metrics", _BARS)
            out.append(Figure(f"metrics_{data.name}", f"Metrics on {data.label}", drawn))
    return out


def _heading(short: str) -> str:
    """A metric in words, with its abbreviation, on lines of their own."""
    return "\n".join([*wrap(LONG[short], 12), f"({short})"])


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
                shift = 0.02 * (place - len(planners) / 2)
                _curve(axes, planner, found, kind, shift, styles[planner])
            axes.set_xticks(range(len(LEVELS)), LEVELS)
            axes.set_xlabel("strength of the noise", fontsize=8)
            axes.set_title(f"{_KINDS[kind]}, {_TRAFFIC.get(traffic, traffic)}", fontsize=9)
            _score_axis(axes)
    note = "error bars: standard deviation over seeds; thin line: the clean score"
    _finish(figure, data, "Noise robustness", note, {"clean": "none", "under noise": "some"})
    return [Figure(f"robustness_{data.name}", f"Noise robustness on {data.label}", figure)]


def _difficulty(
    data: DataSet,
    clean: Sequence[Group],
    groups: Sequence[Group],
    styles: dict[str, Style],
    allow_partial: bool,
) -> Figure:
    """Scores by difficulty, a panel for each kind of edit."""
    found = [graded(name) for name in data.types]
    kinds, modes = sorted({kind for kind, grade in found if grade}), traffics(clean)
    figure, panels = _panels(len(modes), len(kinds), (3.4, 3.1))
    planners = list(dict.fromkeys(group.planner for group in clean))
    for row, traffic in enumerate(modes):
        for column, kind in enumerate(kinds):
            axes = panels[row][column]
            for group in (group for group in clean if group.traffic == traffic):
                shift = 0.06 * (planners.index(group.planner) - (len(planners) - 1) / 2)
                cells = [recorded_score(group, np.array([k == kind for k, _ in found]), groups)]
                parts = [np.array([pair == (kind, grade) for pair in found]) for grade in GRADES]
                cells += [_estimate(group, allow_partial, "cls", where) for where in parts]
                points = {i: cell.mean for i, cell in enumerate(cells) if cell is not None}
                style = styles[group.planner]
                look = {**style.marks("none"), "linestyle": dashes("none"), "linewidth": 1.3}
                label = f"{group.planner}{'' if group.is_complete else ' (partial)'}"
                axes.plot([x + shift for x in points], [*points.values()], label=label, **look)
                for x, where in enumerate(parts, 1):
                    if interval := score_interval(group, "cls", where):
                        axes.vlines(x + shift, interval.low, interval.high, color=style.colour)
            axes.set_xticks(range(1 + len(GRADES)), ["recorded", *GRADES])
            axes.set_xlim(-0.35, len(GRADES) + 0.35)
            axes.set_xlabel("difficulty of the edit", fontsize=8)
            axes.set_title(f"{kind}, {_TRAFFIC.get(traffic, traffic)}", fontsize=9)
            _score_axis(axes)
    note = (
        "recorded: the same scenarios without the edit; bars: 95 % bootstrap interval over "
        "recordings"
    )
    _finish(figure, data, "Edits", note)
    return Figure(f"edits_{data.name}", f"Scores by difficulty of the edits: {data.label}", figure)


def _curve(
    axes: Any,
    planner: str,
    found: dict[str, Estimate | None],
    kind: str,
    shift: float,
    style: Style,
) -> None:
    """One planner's scores by level; shifted a little, so that error bars do not cover others."""
    names = ["none", *(f"{kind}-{level}" for level in LEVELS[1:])]
    points = {i: cell for i, name in enumerate(names) if (cell := found.get(name)) is not None}
    if not points:
        return
    means, errors = ([getattr(c, name) for c in points.values()] for name in ("mean", "std"))
    bars = [error or 0.0 for error in errors]
    look = {**style.marks("some"), "linestyle": dashes("some"), "linewidth": 1.3, "capsize": 2}
    axes.errorbar([place + shift for place in points], means, yerr=bars, **look)
    clean = means[0] if 0 in points else math.nan
    if 0 in points:
        axes.axhline(clean, linewidth=0.8, alpha=0.35, color=style.colour, zorder=1)
    partial = any(cell and cell.label for cell in found.values())
    label = f"{planner} (partial)" if partial else planner
    axes.plot([shift], [clean], label=label, linestyle="none", zorder=4, **style.marks("none"))


def _dots(
    groups: Sequence[Group], places: Sequence[_Place], styles: dict[str, Style], allow_partial: bool
) -> Any:
    """Planners side by side at every place, one panel per traffic mode."""
    modes = traffics(groups)
    planners = list(dict.fromkeys(group.planner for group in groups))
    figure, panels = _panels(len(modes), 1, (max(5.5, 1.05 * len(places)), 2.9))
    for (axes,), traffic in zip(panels, modes, strict=True):
        for group in (group for group in groups if group.traffic == traffic):
            style = {**styles[group.planner].marks("none"), "linestyle": "none"}
            shift = _SPREAD * ((planners.index(group.planner) + 0.5) / len(planners) - 0.5)
            label: str | None = f"{group.planner}{'' if group.is_complete else ' (partial)'}"
            for x, place in enumerate(places):
                estimate = _estimate(group, allow_partial, place.column, place.where)
                interval = score_interval(group, place.column, place.where)
                if estimate is not None and interval is not None:
                    low, high = interval.low, interval.high
                    axes.vlines(x + shift, low, high, color=style["color"], linewidth=1.3)
                if estimate is not None:
                    axes.plot([x + shift], [estimate.mean], label=label, **style)
                label = None
        for x in range(1, len(places)):
            axes.axvline(x - 0.5, color="0.9", linewidth=0.7, zorder=0)
        axes.set_xticks(range(len(places)), [place.heading for place in places])
        axes.set_xlim(-0.5, len(places) - 0.5)
        axes.set_title(_TRAFFIC.get(traffic, traffic), fontsize=9)
        several = len({place.column for place in places}) > 1
        _score_axis(axes, "score" if several else "closed-loop score")
    return figure


def _panels(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    figure = new_figure(figsize=(size[0] * columns + 0.6, size[1] * rows + 1.1))
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=True)


def _score_axis(axes: Any, scores: str = "closed-loop score") -> None:
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
