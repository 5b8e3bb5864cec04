"""Stills and films: the driven paths of several rollouts over the map, as the paper shows them."""

from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.report.palette import Style, new_figure, planner_styles, save_picture
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.view.scene import Shown, map_lines, violations
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, AgentKind, center_poses

STILLS = (".pdf", ".png", ".svg")
FILMS = (".mp4", ".gif")
_PAD = 12.0  # m around the driven paths
_FPS = 10
_FILM_DPI = 100
_LAYERS = {  # what is drawn first lies below
    "walkway": "#ece6d8",
    "drivable": "#dcdcd8",
    "route": "#b9d2be",
    "crosswalk": "#f7f4ea",
}
_AGENTS = {
    AgentKind.VEHICLE: "#8797a8",
    AgentKind.PEDESTRIAN: "#a8791e",
    AgentKind.BICYCLE: "#8a5f9e",
}
_MARKER: dict[str, Any] = {"markersize": 5, "markeredgewidth": 1.0}
_OTHER, _LOG = "#8f8f8f", "#1f1f1f"
_ALARM = "#b00020"
_LARGEST = 7.0  # inches, of a single picture


def save_figure(
    path: Path,
    scenario: Scenario,
    shown: Sequence[Shown],
    *,
    at: Sequence[float] = (0.0,),
    in_grid: bool = False,
) -> None:
    """A still `at` seconds from the start, or a film of it all, by the ending of the file's name.

    Several times, or `in_grid`, give a figure with a row per rollout and a column per time.

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
        _film(path, scenario, shown)
    elif in_grid or len(at) > 1:
        save_picture(grid(scenario, shown, at=at), path)
    else:
        save_picture(still(scenario, shown, at=at[0]), path)


def still(scenario: Scenario, shown: Sequence[Shown], *, at: float) -> Any:
    """A matplotlib figure of the moment `at` seconds from the start.

    Raises:
        ConfigError: There is no such time.
        MissingExtraError: matplotlib is missing.
    """
    row = _sample_at(shown[0].log.time_us, at)
    extent = _extent_of(scenario, shown)
    figure, axes = panels(1, 1, extent)
    _draw_map(axes[0][0], scenario.map, scenario.route, extent)
    _moment(axes[0][0], shown, row, planner_styles(item.planner for item in shown))
    add_legend(axes[0][0])
    _scale_bar(axes[0][0], extent)
    _heading(axes[0][0], scenario, at)
    return figure


def grid(scenario: Scenario, shown: Sequence[Shown], *, at: Sequence[float]) -> Any:
    """A matplotlib figure with a row per rollout and a column per moment [s from the start].

    Raises:
        ConfigError: There is no such time.
        MissingExtraError: matplotlib is missing.
    """
    rows = [_sample_at(shown[0].log.time_us, time) for time in at]
    extent = _extent_of(scenario, shown)
    figure, lines = panels(len(shown), len(at), extent)
    styles = planner_styles(item.planner for item in shown)
    for item, line in zip(shown, lines, strict=True):
        for time, row, axes in zip(at, rows, line, strict=True):
            _draw_map(axes, scenario.map, scenario.route, extent)
            _moment(axes, [item], row, styles)
            if item is shown[0]:
                axes.set_title(f"{time:g} s", fontsize=9)
        line[0].set_ylabel(_caption(item).replace(", ", "\n", 1), fontsize=8)
    _scale_bar(lines[-1][0], extent)
    figure.suptitle(_words(scenario), fontsize=9)
    return figure


def overview(thing: Scenario | VectorMap) -> Any:
    """A matplotlib figure of a scenario at its first iteration, or of a whole map.

    Raises:
        MissingExtraError: matplotlib is missing.
    """
    if isinstance(thing, VectorMap):
        bounds = thing.edges.polygons.bounds
        extent = extent_of_points(np.array([bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)]))
        figure, ((axes,),) = panels(1, 1, extent)
        _draw_map(axes, thing, (), extent)
        _scale_bar(axes, extent)
        return figure
    extent = extent_of_points(thing.expert[:, :2])
    figure, ((axes,),) = panels(1, 1, extent)
    draw_start(axes, thing, extent)
    _heading(axes, thing, 0.0)
    return figure


def draw_start(axes: Any, scenario: Scenario, extent: FloatArray) -> None:
    """A scenario at its first iteration, within an extent (4,) [m]."""
    log = as_recorded(scenario)
    _draw_map(axes, scenario.map, scenario.route, extent)
    _recorded(axes, log, 0)
    _draw_ego(axes, log, 0, _LOG)
    add_legend(axes)
    _scale_bar(axes, extent)


def svg_of(figure: Any) -> str:
    """A figure as the text of an SVG element."""
    out = StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return "".join(out.getvalue().partition("<svg")[1:])


def _sample_at(time_us: IntArray, at: float) -> int:
    times = (time_us - time_us[0]) * 1e-6
    if not 0.0 <= at <= times[-1] + 1e-9:
        raise ConfigError(f"time {at} s is not within 0 … {times[-1]:.1f} s", hint="--at SECONDS")
    return int(np.argmin(np.abs(times - at)))


def _extent_of(scenario: Scenario, shown: Sequence[Shown]) -> FloatArray:
    paths = [scenario.expert[:, :2], *(item.log.ego[:, :2] for item in shown)]
    return extent_of_points(np.concatenate(paths))


def extent_of_points(points: FloatArray) -> FloatArray:
    """(4,) min x, min y, max x, max y of a picture that shows points (N, 2) [m]."""
    low, high = points.min(axis=0) - _PAD, points.max(axis=0) + _PAD
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    half = np.maximum(half, half.max() * 0.5)  # never a mere strip
    return np.array([*(middle - half), *(middle + half)])


def panels(rows: int, columns: int, extent: FloatArray) -> tuple[Any, Any]:
    """A figure with axes (rows, columns) that are as wide and high as the extent needs."""
    width, height = extent[2] - extent[0], extent[3] - extent[1]
    size = min(_LARGEST / max(width, height), _LARGEST * 2.0 / (columns * width))
    figure = new_figure(figsize=(columns * width * size + 0.1, rows * height * size + 0.4))
    axes_of = figure.subplots(rows, columns, squeeze=False)
    for axes in axes_of.flat:
        axes.set_xlim(extent[0], extent[2])
        axes.set_ylim(extent[1], extent[3])
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
    return figure, axes_of


def _draw_map(axes: Any, road: VectorMap, route: Sequence[str], extent: FloatArray) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    layers = map_lines(road, route, extent)
    for name, colour in _LAYERS.items():
        if layers[name]:
            outline = Outline.make_compound_path(*(Outline(r, closed=True) for r in layers[name]))
            axes.add_patch(PathPatch(outline, facecolor=colour, edgecolor="none", zorder=1))
    axes.add_collection(
        LineCollection(layers["boundary"], colors="#a9a9a3", linewidths=0.5, zorder=1.5)
    )


def _scale_bar(axes: Any, extent: FloatArray) -> None:
    width = extent[2] - extent[0]
    length = next(v for v in (100, 50, 20, 10, 5, 2, 1) if v <= max(width / 4.0, 1.0))
    x, y = extent[0] + 0.04 * width, extent[1] + 0.04 * (extent[3] - extent[1])
    axes.plot([x, x + length], [y, y], color="black", linewidth=2, zorder=9)
    axes.text(x + length / 2.0, y, f"{length} m\n", ha="center", va="bottom", fontsize=8, zorder=9)


def _words(scenario: Scenario) -> str:
    words = (scenario.token, scenario.scenario_type, scenario.city)
    return "  ".join(words).replace("$", r"\$")


def _heading(axes: Any, scenario: Scenario, time: float) -> None:
    axes.set_title(f"{_words(scenario)}  {time:.1f} s", fontsize=9)


def _caption(item: Shown) -> str:
    """Planner, noise, score and what cost most of it."""
    name = item.planner if item.noise == "none" else f"{item.planner} {item.noise}"
    score = "" if item.cls is None else f": {100.0 * item.cls:.0f}"
    found = _gravest(item)
    return f"{name}{score}" if found is None else f"{name}{score}, {_told(found)}"


def _told(found: Mapping[str, Any]) -> str:
    return f"{found['words']}, {found['t']:.1f} s"


def _gravest(item: Shown) -> dict[str, Any] | None:
    """The violation that cost most: the first of a multiplier, else the first."""
    found = violations(item)
    return next((one for one in found if one["multiplier"]), found[0] if found else None)


def _moment(axes: Any, shown: Sequence[Shown], row: int, styles: Mapping[str, Style]) -> list[Any]:
    """Everything that moves at one sample; returns what was drawn."""
    drawn = _recorded(axes, shown[0].log, row)
    for item in shown:
        style, ego = styles[item.planner], item.log.ego
        is_clean = item.noise == "none"
        line = {"color": style.colour, "linewidth": 1.8, "linestyle": "-" if is_clean else "--"}
        mark = {"marker": style.marker, "markevery": (min(10, len(ego) - 1), 50)}
        look = {"markerfacecolor": "white" if is_clean else style.colour, **line, **mark, **_MARKER}
        look["markeredgecolor"] = style.colour
        drawn += axes.plot(ego[:, 0], ego[:, 1], zorder=6, label=_caption(item), **look)
        drawn += _draw_ego(axes, item.log, row, style.colour)
        drawn += _draw_violation(axes, item, style.colour)
    return drawn


def _draw_violation(axes: Any, item: Shown, colour: str) -> list[Any]:
    """A cross where the gravest violation began; the caption says what it was."""
    found = _gravest(item)
    if found is None:
        return []
    time_us = item.log.time_us
    row = int(np.searchsorted(time_us, time_us[0] + found["t"] * 1e6 - 1.0))
    x, y = center_poses(item.log.ego[min(row, len(time_us) - 1), :3])[:2]
    place: dict[str, Any] = {"xytext": (6, 6), "textcoords": "offset points", "zorder": 10}
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": colour, "lw": 0.8, "alpha": 0.85}
    words = axes.annotate(found["short"], (x, y), fontsize=7, bbox=box, **place)
    cross = {"marker": "x", "color": _ALARM, "s": 60, "linewidths": 2.2, "zorder": 9}
    return [axes.scatter([x], [y], **cross), words]


def add_legend(axes: Any) -> None:
    """What the lines of a picture are."""
    axes.legend(fontsize=8, loc="best", framealpha=0.85, edgecolor="none").set_zorder(11)


def _draw_ego(axes: Any, log: SimulationLog, row: int, colour: str) -> list[Any]:
    pose, size = center_poses(log.ego[row : row + 1, :3]), [[PACIFICA.length, PACIFICA.width]]
    return _draw_boxes(axes, pose, np.array(size), colour, zorder=7)


def _recorded(axes: Any, log: SimulationLog, row: int) -> list[Any]:
    """The others at one sample, and the recorded path of the ego."""
    tracks, expert = log.tracks, log.expert_ego
    dotted = {"color": _LOG, "linewidth": 1, "linestyle": ":", "zorder": 4}
    drawn: list[Any] = axes.plot(expert[:, 0], expert[:, 1], label="recorded driver", **dotted)
    for kind in np.unique(tracks.kinds):
        there = tracks.valid[row] & (tracks.kinds == kind)
        colour = _AGENTS.get(AgentKind(int(kind)), _OTHER)
        drawn += _draw_boxes(axes, tracks.poses[row, there], tracks.sizes[row, there], colour)
    return drawn


def _draw_boxes(
    axes: Any, poses: FloatArray, sizes: FloatArray, colour: str, zorder: float = 3
) -> list[Any]:
    """(N, 3) centre poses and (N, 2) lengths and widths as filled boxes."""
    from matplotlib.collections import PolyCollection

    if not len(poses):
        return []
    corners = boxes_to_corners(poses, sizes)
    edge: dict[str, Any] = {"edgecolors": "#30363c", "linewidths": 0.6}
    boxes = PolyCollection(list(corners), facecolors=colour, zorder=zorder, **edge)
    return [axes.add_collection(boxes, autolim=False)]


def _film(path: Path, scenario: Scenario, shown: Sequence[Shown]) -> None:
    """All samples, one after the other."""
    extent = _extent_of(scenario, shown)
    figure, ((axes,),) = panels(1, 1, extent)
    from matplotlib.animation import FFMpegWriter, PillowWriter

    writer: Any = PillowWriter(fps=_FPS)
    if path.suffix.lower() == ".mp4":
        if not FFMpegWriter.isAvailable():
            raise MissingExtraError("mp4 needs ffmpeg", hint="install ffmpeg, or write a .gif")
        writer = FFMpegWriter(fps=_FPS, extra_args=["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"])
    _draw_map(axes, scenario.map, scenario.route, extent)
    _scale_bar(axes, extent)
    styles = planner_styles(item.planner for item in shown)
    times = (shown[0].log.time_us - shown[0].log.time_us[0]) * 1e-6
    with writer.saving(figure, str(path), _FILM_DPI):
        for row, time in enumerate(times):
            drawn = _moment(axes, shown, row, styles)
            if row == 0:
                add_legend(axes)  # of lines that look the same in all samples
            _heading(axes, scenario, float(time))
            writer.grab_frame()
            for artist in drawn:
                artist.remove()
