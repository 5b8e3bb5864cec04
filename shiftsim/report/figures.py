"""Pictures of a report: robustness curves, scores per city, per metric, per difficulty of edits.

Planners and noise are drawn as everywhere (`palette`): clean scores are full marks and solid lines,
those under noise hollow marks on dashed lines. Nothing is drawn of groups whose score is withheld.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np

from shiftsim.edits.sampling import GRADES, graded
from shiftsim.errors import ConfigError
from shiftsim.kernels import BoolArray, FloatArray
from shiftsim.metrics import open_loop
from shiftsim.report import palette
from shiftsim.report.details import has_open_loop, open_loop_values, recorded_score
from shiftsim.report.groups import COLUMNS, DataSet, Group, by_set
from shiftsim.report.palette import DEFAULT_FORM, SMALL, TEXT, FigureFormat, Style, dashes
from shiftsim.report.statistics import rank_correlation, score_interval
from shiftsim.report.tables import Interval, Number
from shiftsim.report.words import LONG
from shiftsim.sim.perception import LEVELS, drift_order

_NOISES = {"awgn": "white noise (AWGN)", "ou": "correlated noise (OU)"}
_BOXES = {"perception": "errors", "miss": "misses", "dropout": "drop-outs"}
_TIMES = {"localization": "own pose", "latency": "latency"}
_CURVES = {  # figures by name: panels by kind, what planners are under, title
    "robustness": (_NOISES, "noise", "Noise robustness"),
    "perception": (_BOXES, "drift", "Perception"),
    "latency": (_TIMES, "drift", "Localization and latency"),
}
_LABELS = {  # of the axes of their panels
    "errors": "errors of the boxes",
    "misses": "missed detections",
    "drop-outs": "lost tracks",
    "own pose": "error of the pose",
    "latency": "latency of the plans [ms]",
}
_TRAFFIC = {"NR": "non-reactive traffic", "R": "reactive traffic"}
_SPREAD = 0.62  # how much of a place on the axis the planners share
_GREY = "0.45"
_MEAN = {"markeredgecolor": "black", "markeredgewidth": 0.9}
_ADE = "average displacement error (ADE) [m]"
_RHO = "ρ: Spearman's rank correlation, of scenarios by planner, and of the planners' means"
_HEIGHT, _AROUND, _HIGHEST = 1.9, 0.6, 8.0  # inches, of a panel, words around it, all panels
_LINE = 1.25 * SMALL / 72.0  # inches, of text
_BESIDE = 0.5  # inches, beside a panel: the labels of its axis
_LONGEST = 18  # palette.characters of a name at the end of a line
_WIDE = 5.0  # inches; what is wider needs both columns of a paper, and has panels side by side
_BARS = "bars: 95 % bootstrap interval over recordings"


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture."""

    name: str  # of its file, without ending
    title: str  # what it shows
    drawn: Any  # the matplotlib figure
    notes: str = ""  # lines that it leaves to its caption

    @property
    def caption(self) -> str:
        """What stands below it in a paper."""
        label, _, rest = self.notes.partition(": ")
        words = rest if self.title.endswith(label) else self.notes
        return f"{self.title}: {'; '.join(words.splitlines())}" if self.notes else self.title

    @property
    def is_wide(self) -> bool:
        """Whether it needs both columns of a paper."""
        return bool(self.drawn.get_figwidth() > _WIDE)

    def save(self, folder: Path, ending: str = "png") -> Path:
        """Write the picture and return where it is; the same picture gives the same bytes."""
        path = folder / f"{self.name}.{ending}"
        palette.save_picture(self.drawn, path)
        return path


class _Place(NamedTuple):
    """A place on the axis: its heading, and the score that is drawn there."""

    heading: str
    score: Callable[[Group], tuple[Number | None, Interval | None]]  # with its interval


class _End(NamedTuple):
    """Where a planner's line ends, and what names it there."""

    label: str
    x: float
    y: float
    colour: str


@palette.in_format
def figures(groups: Sequence[Group], *, form: FigureFormat = DEFAULT_FORM) -> list[Figure]:
    """All pictures that the groups allow; a MissingExtraError without matplotlib."""
    out: list[Figure] = []
    styles = palette.planner_styles(group.planner for group in groups)
    names: list[str] = []
    for data, mine in by_set(groups):
        # sets of one name are numbered, as it becomes that of a file
        name = f"{data.name}-{len(names) + 1}" if data.name in names else data.name
        names.append(data.name)

        def add(kind: str, title: str, drawn: Any, note: str, name: str = name, **how: Any) -> None:
            _finish(drawn, title, note, form, **how)
            out.append(Figure(f"{kind}_{name}", title, drawn, note if form.plain else ""))

        shown = [group for group in mine if group.estimate().value is not None]
        clean = [group for group in shown if group.noise == "none"]
        found = {g.noise.partition("-")[0] for g in shown if "+" not in g.noise}
        for kind, (panels, under, words) in _CURVES.items():
            if not (kinds := {panels[k]: _levels(k, shown) for k in panels if k in found}):
                continue
            labels = ("strength of the noise", "closed-loop score")
            drawn = _scores(shown, kinds, styles, form, noise="some", labels=labels)
            bars = f"bars: standard deviation over seeds; without several, {_BARS.split(': ')[1]}"
            note = f"n = {len(data.tokens)} scenarios; {bars}; thin line: the clean score"
            note, samples = f"{data.rules}\n{note}", {"clean": "none", f"under {under}": "some"}
            add(kind, f"{words} on {data.label}", drawn, note, samples=samples)
        if not clean:
            continue
        every = np.ones(len(data.tokens), np.bool_)
        if any(grade for _, grade in map(graded, data.types)):
            labels = ("difficulty of the edit", "closed-loop score")
            kinds = _difficulties(data, groups)
            drawn = _scores(clean, kinds, styles, form, noise="none", labels=labels)
            note = f"{data.rules}\nrecorded: the same scenarios without the edit; {_BARS}"
            add("edits", f"Scores by difficulty of the edits: {data.label}", drawn, note)
        note = f"{data.rules}\nclean rollouts; {_BARS}"
        parts = {city: data.within(city) for city in sorted({*data.cities} - {""})}
        if len(parts) > 1:
            places = [_place(f"all\n({len(every)})", every)]
            for city, where in parts.items():
                places.append(_place(f"{city}\n({data.cities.count(city)})", where))
            drawn = _scores(clean, {"": places}, styles, form)
            lone = f"{note} (none for a single recording)"
            add("cities", f"Score per city of {data.label}", drawn, lone)
        is_narrow = 0.0 < form.width < _WIDE  # where there is room for abbreviations only
        in_full = {name: "\n".join([*wrap(LONG[name], 12), f"({name})"]) for name in LONG}
        heads = {} if is_narrow else in_full
        places = [_place(heads.get(name, name), every, key) for key, name in COLUMNS.items()]
        drawn = _scores(clean, {"": places}, styles, form, labels=("", "score"))
        add("metrics", f"Metrics on {data.label}", drawn, note)
    more = [open_against_closed(groups, form=form)] if any(map(has_open_loop, groups)) else []
    return [*out, *more]


@palette.in_format
def open_against_closed(groups: Sequence[Group], *, form: FigureFormat = DEFAULT_FORM) -> Figure:
    """A mark per planner and scenario, and rank correlations; a ConfigError without open loop."""
    asked = [group for group in groups if has_open_loop(group)]
    if not asked:
        raise ConfigError("no open-loop scores", hint="shiftsim run --open-loop makes them")
    shown = [group for group in asked if group.noise == "none"] or asked
    styles = palette.planner_styles(group.planner for group in shown)
    ade = next(name for name, (short, *_) in open_loop.METRICS.items() if short == "ADE")
    kinds = {"open-loop score × 100": (open_loop.TOTAL, 100.0), _ADE: (ade, 1.0)}
    rows = list(dict.fromkeys(group.traffic for group in shown))
    figure, panels = _panels(rows, [*kinds], form)
    for axes, traffic, label in panels:
        metric, scale = kinds[label]
        points = [
            (group, scale * open_loop_values(group, metric), 100.0 * group.scenario_means())
            for group in shown
            if group.traffic == traffic
        ]
        _scatter(axes, points, styles)
        _finish_axes(axes, _TRAFFIC.get(traffic, traffic))
        axes.set_xlabel(label, fontsize=SMALL)
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.24), "borderaxespad": 0.0}
        legend = axes.legend(frameon=False, fontsize=SMALL, **below)
        across = axes.get_subplotspec().get_gridspec().ncols
        figure.set_figheight(figure.get_figheight() + _LINE * len(legend.get_texts()) / across)
    labels = ", ".join(dict.fromkeys(group.data.label for group in shown))
    rules = dict.fromkeys(group.data.rules for group in shown)
    title = f"Open loop against closed loop on {labels}"
    notes = "\n".join((*rules, _RHO))
    _add_words(figure, title, notes, form)
    return Figure("open-against-closed", title, figure, notes if form.plain else "")


def _scatter(
    axes: Any, points: Sequence[tuple[Group, FloatArray, FloatArray]], styles: Mapping[str, Style]
) -> None:
    """(N,) values of scenarios by group, and the means of the groups where there are several."""
    means = []
    for group, x, y in points:
        known = np.isfinite(x) & np.isfinite(y)
        label = f"{group.planner}: {_correlation(x[known], y[known])}"
        marks = styles[group.planner].marks(group.noise, 4.0)
        axes.plot(x[known], y[known], linestyle="none", alpha=0.55, label=label, **marks)
        means += [(group, x[known].mean(), y[known].mean())] if known.any() else []
    if len(means) < 2:
        return
    for group, x, y in means:
        look = styles[group.planner].marks(group.noise, 9.0) | _MEAN
        axes.plot([x], [y], linestyle="none", zorder=5, **look)
    correlation = _correlation(*np.array([(x, y) for _, x, y in means]).T)
    look = Style(_GREY, "o").marks("none") | _MEAN
    axes.plot([], [], linestyle="none", label=f"means of planners: {correlation}", **look)


def _correlation(first: FloatArray, second: FloatArray) -> str:
    found = rank_correlation(first, second)
    words = "undefined" if found is None else f"= {found:.2f}".replace("-", "−")
    return f"ρ {words}, n = {len(first)}"


def _place(heading: str, where: BoolArray, column: str = "cls") -> _Place:
    """The place of a column over some (N,) scenarios."""

    def score(group: Group) -> tuple[Number, Interval | None]:
        part = group.only(where)
        return part.estimate(column), score_interval(part, column)

    return _Place(heading, score)


def _difficulties(data: DataSet, groups: Sequence[Group]) -> dict[str, list[_Place]]:
    """The places of every kind of edit: the recorded scenarios, and each difficulty."""
    kinds, grades = np.array([graded(name) for name in data.types], str).T

    def recorded(kind: str) -> _Place:
        heading = f"recorded\n(n = {np.count_nonzero(kinds == kind)})"
        return _Place(heading, lambda group: recorded_score(group.only(kinds == kind), groups))

    def edited(kind: str, grade: str) -> _Place:
        where = (kinds == kind) & (grades == grade)
        return _place(f"{grade}\n(n = {np.count_nonzero(where)})", where)

    return {
        kind: [recorded(kind), *(edited(kind, grade) for grade in GRADES)]
        for kind in np.unique(kinds[grades != ""]).tolist()
    }


def _levels(kind: str, groups: Sequence[Group]) -> list[_Place]:
    """The places of every level of a noise; bars are deviations over seeds, or intervals."""
    scores = {(g.traffic, g.planner, g.noise): (g.estimate(), score_interval(g)) for g in groups}

    def place(noise: str) -> _Place:
        def score(group: Group) -> tuple[Number | None, Interval | None]:
            found, interval = scores.get((group.traffic, group.planner, noise), (None, None))
            if found is None or found.value is None or found.std is None:
                return found, interval
            low, high = found.value - found.std, found.value + found.std
            return found, Interval(max(low, 0.0), min(high, 100.0))

        return _Place(noise.partition("-")[2] or ("0" if kind == "latency" else "none"), score)

    levels = (f"{kind}-{level}" for level in LEVELS)
    if kind == "latency":
        levels = (n for n in drift_order(g.noise for g in groups) if n[8:].isdecimal())
    return [*map(place, ("none", *levels))]


def _scores(
    groups: Sequence[Group],
    columns: Mapping[str, Sequence[_Place]],
    styles: dict[str, Style],
    form: FigureFormat,
    *,
    noise: str = "",
    labels: tuple[str, str] = ("", "closed-loop score"),
) -> Any:
    """Planners side by side at every place of `columns`, joined by lines if there is a `noise`."""
    planners = list(dict.fromkeys(group.planner for group in groups))
    spread = {"": _SPREAD, "none": 0.06 * len(planners)}.get(noise, 0.02 * len(planners))
    rows = list(dict.fromkeys(group.traffic for group in groups))
    figure, panels = _panels(rows, [*columns], form, is_small=bool(noise))
    ends: dict[Any, list[_End]] = {}
    for axes, traffic, title in panels:
        mine = [group for group in groups if group.traffic == traffic]
        for group in {group.planner: group for group in mine}.values():
            shift = spread * ((planners.index(group.planner) + 0.5) / len(planners) - 0.5)
            is_whole = all(one.is_complete for one in mine if one.planner == group.planner)
            label = group.planner if is_whole else f"{group.planner} (partial)"
            style = styles[group.planner]
            last = _series(axes, group, columns[title], shift, style, noise, label)
            ends.setdefault(axes, []).append(_End(label, *last, style.colour))
        headings = [place.heading for place in columns[title]]
        for x in () if noise else range(1, len(headings)):
            axes.axvline(x - 0.5, color="0.9", linewidth=0.7, zorder=0)
        _set_headings(axes, headings)
        margin = 0.35 if noise else 0.5
        axes.set_xlim(-margin, len(headings) - 1 + margin)
        axes.set_xlabel(_LABELS.get(title, labels[0]), fontsize=SMALL)
        words = (title, _TRAFFIC.get(traffic, traffic))
        _finish_axes(axes, ", ".join(filter(None, words)), labels[1])
    if noise:
        _name_lines(ends)
    return figure


def _set_headings(axes: Any, headings: Sequence[str]) -> None:
    """Name the places on an axis, aslant where they would not fit else."""
    width = axes.figure.get_figwidth() / axes.get_subplotspec().get_gridspec().ncols - _BESIDE
    longest = max(len(line) for heading in headings for line in heading.splitlines())
    if longest <= palette.characters(width / len(headings)):
        axes.set_xticks(range(len(headings)), headings)
        return
    words = [heading.replace("\n", " ") for heading in headings]
    aslant = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(range(len(headings)), words, **aslant)
    axes.figure.set_figheight(axes.figure.get_figheight() + 0.04 * longest)


def _name_lines(ends: Mapping[Any, Sequence[_End]]) -> None:
    """Name the planners at the ends of their lines if all find room; no legend names them then."""
    from matplotlib.colors import to_rgb

    figure = next(iter(ends)).figure
    height = figure.get_figheight() / figure.axes[0].get_gridspec().nrows - _AROUND
    step = 106.0 * _LINE / height  # of lines of text, in scores
    found = [end for each in ends.values() for end in each]
    most = max(map(len, ends.values()))
    if max(len(end.label) for end in found) > _LONGEST or most * step > 104.0:
        return
    for axes, each in ends.items():
        named = sorted((end for end in each if math.isfinite(end.y)), key=lambda end: end.y)
        heights = [end.y for end in named]
        for i in range(1, len(heights)):  # each above the one before, but the last not too high
            heights[i] = max(heights[i], heights[i - 1] + step)
        highest = 101.0
        for i in reversed(range(len(heights))):
            heights[i] = min(heights[i], highest)
            highest = heights[i] - step
        for line in axes.lines:
            line.set_label(f"_{line.get_label()}")
        for end, height in zip(named, heights, strict=True):
            dark = tuple(0.65 * part for part in to_rgb(end.colour))
            place = {"xytext": (1.03, height), "textcoords": ("axes fraction", "data")}
            leader = {"arrowstyle": "-", "color": end.colour, "lw": 0.7, "shrinkA": 0, "shrinkB": 4}
            look = {"fontsize": SMALL, "va": "center", "color": dark, "arrowprops": leader}
            axes.annotate(end.label, (end.x, end.y), annotation_clip=False, **place, **look)


def _series(
    axes: Any,
    group: Group,
    places: Sequence[_Place],
    shift: float,
    style: Style,
    noise: str,
    label: str,
) -> tuple[float, float]:
    """Draw one planner's scores, a little beside the places, and return the last point."""
    xs, ys = np.arange(len(places)) + shift, np.full(len(places), math.nan)
    for index, (found, interval) in enumerate(place.score(group) for place in places):
        if interval is not None:
            low, high = interval.low, interval.high
            axes.vlines(xs[index], low, high, color=style.colour, linewidth=1.3)
        if found is not None and found.value is not None:
            ys[index] = found.value
    known = np.flatnonzero(np.isfinite(ys))
    last = (float(xs[known[-1]]), float(ys[known[-1]])) if len(known) else (math.nan, math.nan)
    line = {"linestyle": dashes(noise) if noise else "none", "linewidth": 1.3}
    if noise in ("", "none"):
        axes.plot(xs, ys, label=label, **style.marks("none"), **line)
        return last
    axes.plot(xs, ys, **style.marks(noise), **line)
    axes.axhline(ys[0], linewidth=0.8, alpha=0.35, color=style.colour, zorder=1)
    axes.plot(xs[:1], ys[:1], label=label, linestyle="none", zorder=4, **style.marks("none"))
    return last


def _panels(
    rows: Sequence[str], columns: Sequence[str], form: FigureFormat, *, is_small: bool = False
) -> tuple[Any, list[tuple[Any, str, str]]]:
    """A figure, and its axes by row and column; a single panel that `is_small` needs one column."""
    width = form.width or (palette.COLUMN if is_small and len(columns) == 1 else palette.PAGE)
    across = len(columns) if width > _WIDE else 1
    down = len(rows) * len(columns) // across
    figure = palette.new_figure(figsize=(width, min((_HEIGHT + _AROUND) * down, _HIGHEST)))
    sharex: Any = "col" if across == len(columns) else False
    axes = figure.subplots(down, across, squeeze=False, sharex=sharex, sharey=True)
    names = product(rows, columns)
    return figure, [(one, *name) for one, name in zip(axes.flat, names, strict=True)]


def _finish_axes(axes: Any, title: str, label: str = "closed-loop score") -> None:
    axes.set_title(title, fontsize=TEXT)
    axes.set_ylim(-3.0, 103.0)
    axes.set_ylabel(f"{label} × 100" if axes.get_subplotspec().is_first_col() else "")
    axes.yaxis.label.set_fontsize(SMALL)
    axes.grid(axis="y", color="0.9", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=SMALL)


def _finish(figure: Any, title: str, notes: str, form: FigureFormat, samples: Any = None) -> None:
    """Legend, title and what stands beside every score; `samples` are noises by their label."""
    from matplotlib.lines import Line2D

    handles, labels = figure.axes[0].get_legend_handles_labels()
    for label, noise in (samples or {}).items():
        labels.append(label)
        handles.append(Line2D([], [], linestyle=dashes(noise), **Style(_GREY, "o").marks(noise)))
    look = {"loc": "outside upper center", "frameon": False, "fontsize": SMALL, "handlelength": 3.2}
    for columns in range(min(4, max(1, len(labels))), 0, -1):  # as many as fit
        legend = figure.legend(handles, labels, ncols=columns, **look)
        box = legend.get_window_extent(figure.canvas.get_renderer())
        if box.width <= figure.bbox.width or columns == 1:
            break
        legend.remove()
    _add_words(figure, title, notes, form, legend)


def _add_words(figure: Any, title: str, notes: str, form: FigureFormat, legend: Any = None) -> None:
    """Title and notes around a figure, which grows by their height and by that of its legend."""
    for axes in figure.axes:
        if len(axes.get_shared_x_axes().get_siblings(axes)) > 1:
            axes.label_outer()
    width, words, below = figure.get_figwidth(), list[str](), list[str]()
    if not form.plain:
        words = wrap(title, palette.characters(width, TEXT))
        for note in notes.splitlines():
            below += wrap(note, palette.characters(width))
    figure.supxlabel("\n".join(below), fontsize=SMALL, color=_GREY)
    height = figure.get_figheight() + _LINE * len([*words, *below])
    if legend:
        legend.set_title("\n".join(words), {"size": TEXT})
        height += legend.get_window_extent(figure.canvas.get_renderer()).height / figure.dpi
    else:
        figure.suptitle("\n".join(words), fontsize=TEXT)
    figure.set_figheight(height)
    figure.draw_without_rendering()
