"""Stills and films: the driven paths of several rollouts over the map, as the paper shows them."""

import math
import re
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.geometry.boxes import to_frame
from shiftsim.kernels import FloatArray
from shiftsim.report import palette
from shiftsim.report.palette import DEFAULT_FORM, SMALL, TEXT, FigureFormat, Style, characters
from shiftsim.view import drawing
from shiftsim.view.drawing import View
from shiftsim.view.scene import Replay, ShownRollout, box_around
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

STILLS = (".pdf", ".png", ".svg")
FILMS = (".mp4", ".gif")
_PAD = 12.0  # m around the driven paths
_FPS, _MOST_FPS = 10, 20  # samples per second, pictures per second of a film
_KEY = "dotted: the recorded path; red mark: the worst violation"
_FILM_DPI = 100
_FLAT, _TALL = 0.5, 0.8  # height of a scene by its width, at least and at most
_NEAR = np.array([25.0, 15.0])  # m along and across around the ego, in grids and films
_HIGHEST = 9.0  # inches, of a grid: the text of a page
_NARROW = 5.0  # inches; there, marks are named without numbers
_EDITED = "#7b2fbf"  # as in replays


def save_figure(
    path: Path,
    scenario: Scenario,
    shown: Sequence[ShownRollout],
    *,
    at: Sequence[float] = (0.0,),
    in_grid: bool = False,
    form: FigureFormat = DEFAULT_FORM,
    speed: float = 1.0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """A picture, or a film of all samples that is so much faster, by the ending of the file."""
    if path.suffix.lower() not in STILLS + FILMS:
        what = f"{str(path)!r} ends in {path.suffix!r}"
        raise ConfigError(what, hint=f"pictures: {' '.join(STILLS)}; films: {' '.join(FILMS)}")
    if not 0.1 <= speed <= 100.0:
        raise ConfigError(f"speed {speed:g} is not within 0.1 … 100", hint="--speed 2")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() in FILMS:
        _film(path, scenario, shown, form=form, speed=speed, on_progress=on_progress)
    else:
        drawn = picture(scenario, shown, at=at, in_grid=in_grid, form=form)
        palette.save_picture(drawn, path)


@palette.in_format
def picture(
    scenario: Scenario,
    shown: Sequence[ShownRollout] = (),
    *,
    at: Sequence[float] = (0.0,),
    in_grid: bool = False,
    form: FigureFormat = DEFAULT_FORM,
) -> Any:
    """A matplotlib figure of moments [s from the start]: as recorded if no rollout is shown.

    One moment is a still, whose axes are those of the map. Several, or `in_grid`, give a row per
    rollout and a column per moment: every panel shows the surroundings of its ego, which drives to
    the right, with its path so far.

    Raises:
        ConfigError: There is no such time.
        MissingExtraError: matplotlib is missing.
    """
    if in_grid or len(at) > 1:
        return _grid(scenario, shown, at, form)
    view = View(np.zeros(3), _extent(Replay(scenario, shown).paths))
    row = _sample_at(scenario, shown, at[0])
    figure, axes, _, marks = _scene(scenario, shown, view, view, form)
    drawing.draw_moment(axes, scenario, shown, _styles(shown), row, view)
    _heading(axes, scenario, at[0], form)
    drawing.spread_labels(figure, axes, marks)
    return figure


def _scene(
    scenario: Scenario, shown: Sequence[ShownRollout], view: View, whole: View, form: FigureFormat
) -> tuple[Any, Any, list[Any], list[drawing.Mark]]:
    """Figure and axes with all that does not move, in the view `whole`, and marks of violations."""
    styles = _styles(shown)
    figure, (axes,) = _panels(1, view, form)
    drawing.draw_map(axes, scenario.map, scenario.route, whole)
    paths = drawing.draw_paths(axes, scenario, shown, styles, view)
    look = {"in_short": figure.get_figwidth() < _NARROW}
    found = [drawing.draw_violation(axes, one, styles[one.planner], view, **look) for one in shown]
    drawing.draw_scale(axes, view)
    _heading(axes, scenario, 0.0, form)
    note = "" if form.plain else form.note
    axes.set_xlabel(_wrapped(note, characters(figure.get_figwidth())), fontsize=SMALL)
    _add_legend(figure, axes)
    return figure, axes, paths, [mark for mark in found if mark]


def _grid(
    scenario: Scenario, shown: Sequence[ShownRollout], at: Sequence[float], form: FigureFormat
) -> Any:
    """The figure with a row per rollout and a column per moment."""
    rows = [_sample_at(scenario, shown, time) for time in at]
    styles, width = _styles(shown), form.width or palette.PAGE
    around, length = View(np.zeros(3), np.array([*-_NEAR, *_NEAR])), characters(width)
    captions = [_wrapped(drawing.caption(item), length) for item in shown]
    below = "\n".join(_wrapped(words, length) for words in (_KEY, form.note) if words)
    above = _wrapped(_words(scenario), characters(width, TEXT))
    above, below = ("", "") if form.plain else (above, below)
    figure, panels = _cells(width, len(at), captions, above, below)
    for item, line, caption in zip(shown, panels, captions, strict=True):
        line[0].set_title(caption, fontsize=SMALL, loc="left", pad=3)
        for row, time, axes in zip(rows, at, line, strict=True):
            view = around._replace(frame=item.log.ego[row, :3])
            _set_view(axes, view.box)
            drawing.draw_map(axes, scenario.map, scenario.route, view)
            drawing.draw_paths(axes, scenario, [item], styles, view, row + 1)
            drawing.draw_moment(axes, scenario, [item], styles, row, view)
            mark = drawing.draw_violation(axes, item, styles[item.planner], view, in_short=True)
            if mark:
                where = {"anncoords": "axes fraction", "position": (0.5, 0.95)}
                mark.label.set(**where, ha="center", va="top")
                drawing.show_from(mark, time)
    for time, axes in zip(at, panels[-1], strict=True):
        axes.set_xlabel(f"{time:g} s", fontsize=TEXT, labelpad=2)
    drawing.draw_scale(panels[-1][0], around)
    return figure


def _cells(
    width: float, columns: int, captions: Sequence[str], above: str, below: str
) -> tuple[Any, list[list[Any]]]:
    """A figure of a width [inch] with rows of axes, a caption above each row, and words around."""
    top, bottom = _height(above, TEXT), _height(below, SMALL) + 0.2  # where times stand
    strips = [_height(caption, SMALL) for caption in captions]
    room = (_HIGHEST - top - bottom - sum(strips)) / len(captions)
    side = min((width - 0.04 * (columns + 1)) / columns, room * _NEAR[0] / _NEAR[1])
    tall = side * _NEAR[1] / _NEAR[0]
    height = top + sum(strips) + tall * len(captions) + bottom
    figure, y, rows = palette.new_figure(None, figsize=(width, height)), height - top, []
    for strip in strips:
        y -= strip + tall
        first = (width - (side + 0.04) * columns + 0.04) / 2.0
        lefts = [first + (side + 0.04) * column for column in range(columns)]
        places = [(x / width, y / height, side / width, tall / height) for x in lefts]
        rows.append([figure.add_axes(place) for place in places])
    figure.text(0.5, 1.0 - 0.03 / height, above, fontsize=TEXT, ha="center", va="top")
    figure.text(0.5, 0.03 / height, below, fontsize=SMALL, ha="center", va="bottom")
    return figure, rows


def _height(text: str, size: float) -> float:
    """Height of lines [inch], with some room."""
    return len(text.splitlines()) * 1.25 * size / 72.0 + 0.06


@palette.in_format
def map_picture(thing: VectorMap, *, form: FigureFormat = DEFAULT_FORM) -> Any:
    """A matplotlib figure of a whole map."""
    bounds = thing.edges.polygons.bounds
    view = View(np.zeros(3), _extent([bounds[:, :2], bounds[:, 2:]]))
    figure, (axes,) = _panels(1, view, form)
    drawing.draw_map(axes, thing, (), view)
    drawing.draw_scale(axes, view)
    _trim(figure)
    return figure


def before_and_after(recorded: Scenario, edited: Scenario) -> Any:
    """A matplotlib figure: both at the first iteration, tracks of the edit outlined."""
    tracks, row = edited.tracks, int(edited.iteration_rows[0])
    names, words = (edited.script.tokens, edited.script.words) if edited.script else ((), ())
    is_edited = np.array([name in names for name in tracks.tokens], np.bool_)
    changed = tracks.poses[row, tracks.valid[row] & is_edited, :2]
    paths = [recorded.expert[:, :2], edited.expert[:, :2], changed]
    view = View(np.zeros(3), _extent(paths))
    figure, both = _panels(2, view, DEFAULT_FORM)
    for scenario, axes in zip((recorded, edited), both, strict=True):
        drawing.draw_map(axes, scenario.map, scenario.route, view)
        drawing.draw_paths(axes, scenario, (), {}, view)
        drawing.draw_moment(axes, scenario, (), {}, 0, view)
        drawing.draw_scale(axes, view)
        title = f"{scenario.token}  {scenario.scenario_type}"
        axes.set_title(_wrapped(title, characters(figure.get_figwidth(), TEXT) // 2), fontsize=TEXT)
    ring = {"s": 90, "facecolors": "none", "edgecolors": _EDITED, "linewidths": 1.4, "zorder": 8}
    both[1].scatter(*changed.T, label="edited", **ring)
    lines = [_wrapped(line, characters(figure.get_figwidth())) for line in words]
    figure.supxlabel("\n".join(lines), fontsize=SMALL)
    _add_legend(figure, both[1])
    return figure


def svg_of(figure: Any) -> str:
    """A figure as the text of an SVG element."""
    out = StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return "".join(out.getvalue().partition("<svg")[1:])


def _styles(shown: Sequence[ShownRollout]) -> dict[str, Style]:
    return palette.planner_styles(item.planner for item in shown)


def _times(scenario: Scenario, shown: Sequence[ShownRollout]) -> FloatArray:
    """Times of the samples [s from the start]."""
    time_us = shown[0].log.time_us if shown else scenario.iteration_times[:-1]
    return np.asarray((time_us - time_us[0]) * 1e-6)


def _sample_at(scenario: Scenario, shown: Sequence[ShownRollout], at: float) -> int:
    times = _times(scenario, shown)
    if not 0.0 <= at <= times[-1] + 1e-9:
        raise ConfigError(f"time {at} s is not within 0 … {times[-1]:.1f} s", hint="--at SECONDS")
    return int(np.argmin(np.abs(times - at)))


def _extent(paths: Sequence[FloatArray]) -> FloatArray:
    """(4,) min x, min y, max x, max y of a picture that shows paths (N, 2) [m]."""
    low, high = box_around(paths, _PAD).reshape(2, 2)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    half = np.maximum(half, (half[1] / _TALL, half[0] * _FLAT))  # neither a strip nor a tower
    return np.array([*(middle - half), *(middle + half)])


def _panels(columns: int, view: View, form: FigureFormat) -> tuple[Any, Any]:
    """A figure with axes side by side that are as high as the view needs."""
    width = form.width or palette.PAGE
    sides = view.box[2:] - view.box[:2]
    height = width / columns * sides[1] / sides[0] + 0.5
    figure = palette.new_figure("compressed", figsize=(width, height))
    axes = figure.subplots(1, columns, squeeze=False)[0]
    for one in axes:
        _set_view(one, view.box)
    return figure, axes


def _set_view(axes: Any, box: FloatArray) -> None:
    """Show a box, with neither ticks nor distortion."""
    axes.set(xlim=box[::2], ylim=box[1::2], aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set(linewidth=0.6)


def _add_legend(figure: Any, axes: Any) -> None:
    """Below the scene; the figure grows by as much."""
    look: dict[str, Any] = {"fontsize": SMALL, "frameon": False, "handlelength": 3.0}
    handles, labels = axes.get_legend_handles_labels()
    length = characters(figure.get_figwidth()) - 8  # beside a line of the legend
    labels = [_wrapped(label, length, subsequent_indent="  ") for label in labels]
    legend = figure.legend(handles, labels, loc="outside lower left", **look)
    box = legend.get_window_extent(figure.canvas.get_renderer())
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + box.height / figure.dpi + 0.05)
    _trim(figure)


def _trim(figure: Any) -> None:
    """Make a figure as high as what is in it; the layout settles in two steps."""
    figure.draw_without_rendering()
    figure.set_size_inches(figure.get_figwidth(), figure.get_tightbbox().height + 0.08)
    figure.draw_without_rendering()


def _wrapped(text: str, length: int, **settings: Any) -> str:
    """A text in lines; a number stays with its unit."""
    return "\n".join(wrap(re.sub(r"(\d) (m|s|rad)\b", "\\1\u00a0\\2", text), length, **settings))


def _words(scenario: Scenario) -> str:
    return "  ".join((scenario.token, scenario.scenario_type, scenario.city))


def _heading(axes: Any, scenario: Scenario, time: float, form: FigureFormat) -> None:
    words = "" if form.plain else f"{_words(scenario)}  {time:.1f} s"
    axes.set_title(_wrapped(words, characters(axes.figure.get_figwidth(), TEXT)), fontsize=TEXT)


@palette.in_format
def _film(
    path: Path,
    scenario: Scenario,
    shown: Sequence[ShownRollout],
    *,
    form: FigureFormat,
    speed: float,
    on_progress: Callable[[int, int], None],
) -> None:
    """The samples in a view that follows all egos; paths grow, violations are marked in turn."""
    view, centres = _following(scenario, shown)
    whole = view._replace(box=box_around([centres]) + view.box)
    figure, axes, lines, marks = _scene(scenario, shown, view, whole, form)
    drawing.spread_labels(figure, axes, marks, keep_inside=False)
    writer, step = _writer(path, speed)
    figure.set_layout_engine("none")  # it is laid out, and each frame would be again
    driven = [line.get_xydata() for line in lines]
    times = _times(scenario, shown).tolist()
    with writer.saving(figure, str(path), _FILM_DPI):
        for row in range(0, len(times), step):
            drawn = drawing.draw_moment(axes, scenario, shown, _styles(shown), row, view)
            for line, xy in zip(lines, driven, strict=True):
                line.set_data(*xy[: row + 1].T)
            for mark in marks:
                drawing.show_from(mark, times[row])
            box = view.box + np.tile(centres[row], 2)
            axes.set(xlim=box[::2], ylim=box[1::2])
            _heading(axes, scenario, times[row], form)
            writer.grab_frame()
            on_progress(min(row + step, len(times)), len(times))
            for artist in drawn:
                artist.remove()


def _following(scenario: Scenario, shown: Sequence[ShownRollout]) -> tuple[View, FloatArray]:
    """A view around its origin, and its centres (T, 2) as it follows all egos."""
    start, way = scenario.expert[0, :3], scenario.expert[-1, :2] - scenario.expert[0, :2]
    heading = np.arctan2(way[1], way[0]) if np.hypot(*way) > 1.0 else start[2]
    frame = np.array([*start[:2], heading])
    egos = np.array([to_frame(item.log.ego[:, :3], frame)[:, :2] for item in shown])
    low, high = egos.min(axis=0), egos.max(axis=0)
    half = ((high - low) / 2.0).max(axis=0) + _NEAR
    half = np.maximum(half, (half[1] / _TALL, half[0] * _FLAT))
    return View(frame, np.array([*-half, *half])), (low + high) / 2.0


def _writer(path: Path, speed: float) -> tuple[Any, int]:
    """What writes a film (of mp4 by any ffmpeg there is), and samples from picture to picture."""
    from matplotlib import rcParams
    from matplotlib.animation import FFMpegWriter, PillowWriter

    step = math.ceil(_FPS * speed / _MOST_FPS)
    fps: Any = _FPS * speed / step
    if path.suffix.lower() != ".mp4":
        return PillowWriter(fps=fps), step
    if not FFMpegWriter.isAvailable() and find_spec("imageio_ffmpeg"):
        rcParams["animation.ffmpeg_path"] = import_module("imageio_ffmpeg").get_ffmpeg_exe()
    if not FFMpegWriter.isAvailable():
        raise MissingExtraError(
            "mp4 needs ffmpeg",
            hint="install ffmpeg, or pip install imageio-ffmpeg, or write a .gif",
        )
    return FFMpegWriter(fps=fps, extra_args=["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]), step
