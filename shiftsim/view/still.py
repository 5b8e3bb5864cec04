"""Stills and films: the driven paths of several rollouts over the map, as the paper shows them."""

import re
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.kernels import FloatArray
from shiftsim.report.palette import Style, new_figure, planner_styles, save_picture
from shiftsim.view import drawing
from shiftsim.view.scene import Replay, ShownRollout, box_around
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

STILLS = (".pdf", ".png", ".svg")
FILMS = (".mp4", ".gif")
_PAD = 12.0  # m around the driven paths
_FPS = 10
_KEY = "dotted: the recorded driver; red mark: where most of the score was lost"
_FILM_DPI = 100
_LARGEST = 6.0  # inches, of a single scene
_EDITED = "#7b2fbf"  # as in replays
_EDIT_WIDTH = 110  # characters of the words below the picture of an edit
_WIDTH = 7.2  # inches, of a grid: the text of a paper in two columns


def save_figure(
    path: Path,
    scenario: Scenario,
    shown: Sequence[ShownRollout],
    *,
    at: Sequence[float] = (0.0,),
    in_grid: bool = False,
    note: str = "",
) -> None:
    """A still `at` seconds from the start, or a film of it all, by the ending of the file's name.

    Several times, or `in_grid`, give a figure with a row per rollout and a column per time. `note`
    says below the picture what it leaves out.

    Raises:
        ConfigError: The ending or a time is none of those possible.
        MissingExtraError: matplotlib, or for mp4 ffmpeg, is missing.
    """
    if path.suffix.lower() not in STILLS + FILMS:
        raise ConfigError(
            f"{str(path)!r} ends in {path.suffix!r}",
            hint=f"pictures: {' '.join(STILLS)}; films: {' '.join(FILMS)}",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() in FILMS:
        _film(path, scenario, shown, note)
    elif in_grid or len(at) > 1:
        save_picture(grid(scenario, shown, at=at, note=note), path)
    else:
        save_picture(still(scenario, shown, at=at[0], note=note), path)


def still(
    scenario: Scenario, shown: Sequence[ShownRollout] = (), *, at: float = 0.0, note: str = ""
) -> Any:
    """A matplotlib figure of the moment `at` seconds from the start, as recorded if none is shown.

    Raises:
        ConfigError: There is no such time.
        MissingExtraError: matplotlib is missing.
    """
    row = _sample_at(scenario, shown, at)
    figure, axes, _ = _scene(scenario, shown, at, note)
    drawing.draw_moment(axes, scenario, shown, _styles(shown), row)
    return figure


def _scene(
    scenario: Scenario, shown: Sequence[ShownRollout], at: float, note: str
) -> tuple[Any, Any, list[drawing.Mark]]:
    """Figure and axes with all that does not move, and the marks of violations."""
    extent, styles = _extent(Replay(scenario, shown).paths), _styles(shown)
    figure, ((axes,),) = _panels(1, 1, extent)
    drawing.draw_scene(axes, scenario, shown, styles, extent)
    found = (drawing.draw_violation(axes, item, styles[item.planner]) for item in shown)
    marks = [mark for mark in found if mark]
    drawing.draw_scale(axes, extent)
    _heading(axes, scenario, at)
    axes.set_xlabel(note, fontsize=drawing.SMALL)
    _add_legend(figure, axes)
    drawing.spread_labels(figure, axes, marks)
    return figure, axes, marks


def grid(
    scenario: Scenario, shown: Sequence[ShownRollout], *, at: Sequence[float], note: str = ""
) -> Any:
    """A matplotlib figure with a row per rollout and a column per moment [s from the start].

    Raises:
        ConfigError: There is no such time.
        MissingExtraError: matplotlib is missing.
    """
    rows = [_sample_at(scenario, shown, time) for time in at]
    extent, styles = _extent(Replay(scenario, shown).paths), _styles(shown)
    figure, panels = _panels(len(shown), len(at), extent)
    sides = extent[2:] - extent[:2]
    per_line = max(20, int(15 * sides[1] / sides[0] * _width(len(at), extent)))  # characters
    for item, line in zip(shown, panels, strict=True):
        for row, axes in zip(rows, line, strict=True):
            drawing.draw_scene(axes, scenario, [item], styles, extent)
            drawing.draw_moment(axes, scenario, [item], styles, row)
            drawing.draw_violation(axes, item, styles[item.planner], in_short=True)
        line[0].set_ylabel(
            _wrapped(drawing.caption(item, shown), per_line), fontsize=drawing.SMALL - 1
        )
    for time, axes in zip(at, panels[0], strict=True):
        axes.set_title(f"{time:g} s", fontsize=drawing.SMALL + 1)
    drawing.draw_scale(panels[-1][0], extent)
    figure.supxlabel("\n".join(filter(None, (_KEY, note))), fontsize=drawing.SMALL - 1)
    figure.suptitle(_words(scenario), fontsize=drawing.SMALL + 1)
    return figure


def overview(thing: Scenario | VectorMap) -> Any:
    """A matplotlib figure of a scenario at its first iteration, or of a whole map.

    Raises:
        MissingExtraError: matplotlib is missing.
    """
    if isinstance(thing, Scenario):
        return still(thing)
    bounds = thing.edges.polygons.bounds
    extent = _extent([bounds[:, :2], bounds[:, 2:]])
    figure, ((axes,),) = _panels(1, 1, extent)
    drawing.draw_map(axes, thing, (), extent)
    drawing.draw_scale(axes, extent)
    return figure


def before_and_after(recorded: Scenario, edited: Scenario) -> Any:
    """A matplotlib figure: both at the first iteration, tracks of the edit outlined.

    Raises:
        MissingExtraError: matplotlib is missing.
    """
    tracks, row = edited.tracks, int(edited.iteration_rows[0])
    names, words = (edited.script.tokens, edited.script.words) if edited.script else ((), ())
    is_edited = np.array([name in names for name in tracks.tokens], np.bool_)
    changed = tracks.poses[row, tracks.valid[row] & is_edited, :2]
    extent = _extent([recorded.expert[:, :2], edited.expert[:, :2], changed])
    figure, (both,) = _panels(1, 2, extent)
    for scenario, axes in zip((recorded, edited), both, strict=True):
        drawing.draw_scene(axes, scenario, (), {}, extent)
        drawing.draw_moment(axes, scenario, (), {}, 0)
        drawing.draw_scale(axes, extent)
        title = f"{scenario.token}  {scenario.scenario_type}"
        axes.set_title(title.replace("$", r"\$"), fontsize=9)
    ring = {"s": 90, "facecolors": "none", "edgecolors": _EDITED, "linewidths": 1.4, "zorder": 8}
    both[1].scatter(*changed.T, label="edited", **ring)
    lines = [part for line in words for part in wrap(line, _EDIT_WIDTH)]
    figure.supxlabel("\n".join(lines), fontsize=8)
    _add_legend(figure, both[1])
    return figure


def svg_of(figure: Any) -> str:
    """A figure as the text of an SVG element."""
    out = StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return "".join(out.getvalue().partition("<svg")[1:])


def _styles(shown: Sequence[ShownRollout]) -> dict[str, Style]:
    return planner_styles(item.planner for item in shown)


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
    half = np.maximum(half, half.max() * 0.5)  # never a mere strip
    return np.array([*(middle - half), *(middle + half)])


def _panels(rows: int, columns: int, extent: FloatArray) -> tuple[Any, Any]:
    """A figure with axes (rows, columns) that are as wide and high as the extent needs."""
    sides, width = extent[2:] - extent[:2], _width(columns, extent)
    height = width * sides[1] / sides[0]
    size = (width * columns + 0.4, (height + 0.1) * rows + 0.5)
    figure = new_figure(layout="compressed", figsize=size)
    grid_of_axes = figure.subplots(rows, columns, squeeze=False)
    for axes in grid_of_axes.flat:
        axes.set_xlim(extent[0], extent[2])
        axes.set_ylim(extent[1], extent[3])
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
    return figure, grid_of_axes


def _width(columns: int, extent: FloatArray) -> float:
    """Width of one scene of a row [inch]."""
    sides = extent[2:] - extent[:2]
    return float(min(_WIDTH / columns, _LARGEST * sides[0] / sides.max()))


def _add_legend(figure: Any, axes: Any) -> None:
    """Beside a tall scene, else below it; the figure grows by as much."""
    width, height = figure.get_size_inches()
    is_tall = height > 1.3 * width
    place = "outside right upper" if is_tall else "outside lower left"
    look: dict[str, Any] = {"fontsize": drawing.SMALL, "frameon": False, "handlelength": 3.0}
    handles, labels = axes.get_legend_handles_labels()
    length = 38 if is_tall else 85  # characters
    labels = [_wrapped(label, length, subsequent_indent="  ") for label in labels]
    legend = figure.legend(handles, labels, loc=place, **look)
    box = legend.get_window_extent(figure.canvas.get_renderer())
    own_width, own_height = box.width / figure.dpi + 0.1, box.height / figure.dpi + 0.1
    if is_tall:
        figure.set_size_inches(width + own_width, max(height, own_height))
    else:
        figure.set_size_inches(max(width, own_width), height + own_height)
    figure.draw_without_rendering()  # the layout settles in two steps


def _wrapped(text: str, length: int, **settings: Any) -> str:
    """A text in lines; a number stays with its unit."""
    return "\n".join(wrap(re.sub(r"(\d) (m|s|rad)\b", "\\1\u00a0\\2", text), length, **settings))


def _words(scenario: Scenario) -> str:
    words = (scenario.token, scenario.scenario_type, scenario.city)
    return "  ".join(words).replace("$", r"\$")


def _heading(axes: Any, scenario: Scenario, time: float) -> None:
    axes.set_title(f"{_words(scenario)}  {time:.1f} s", fontsize=drawing.SMALL + 1)


def _film(path: Path, scenario: Scenario, shown: Sequence[ShownRollout], note: str) -> None:
    """All samples, one after the other; a violation is marked from its first moment on."""
    figure, axes, marks = _scene(scenario, shown, 0.0, note)
    from matplotlib.animation import FFMpegWriter, PillowWriter

    writer: Any = PillowWriter(fps=_FPS)
    if path.suffix.lower() == ".mp4":
        if not _has_ffmpeg(FFMpegWriter):
            raise MissingExtraError(
                "mp4 needs ffmpeg",
                hint="install ffmpeg, or pip install imageio-ffmpeg, or write a .gif",
            )
        writer = FFMpegWriter(fps=_FPS, extra_args=["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"])
    styles = _styles(shown)
    figure.set_layout_engine("none")  # it is laid out, and each frame would be again
    with writer.saving(figure, str(path), _FILM_DPI):
        for row, time in enumerate(_times(scenario, shown).tolist()):
            drawn = drawing.draw_moment(axes, scenario, shown, styles, row)
            for mark in marks:
                for artist in (mark.burst, mark.label):
                    artist.set_visible(mark.time <= time + 1e-6)
            _heading(axes, scenario, time)
            writer.grab_frame()
            for artist in drawn:
                artist.remove()


def _has_ffmpeg(writer: Any) -> bool:
    """Whether there is ffmpeg, the system's or that of the package imageio-ffmpeg."""
    if not writer.isAvailable() and find_spec("imageio_ffmpeg"):
        from matplotlib import rcParams

        found = import_module("imageio_ffmpeg").get_ffmpeg_exe()
        rcParams["animation.ffmpeg_path"] = found
    return bool(writer.isAvailable())
