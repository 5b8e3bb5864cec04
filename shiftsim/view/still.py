"""Stills and films: the driven paths of several rollouts over the map, as the paper shows them."""

from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.report.palette import new_figure, planner_styles, save_picture
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.view.scene import Shown, map_lines
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
_MARKER: dict[str, Any] = {"markersize": 6, "markeredgecolor": "white", "markeredgewidth": 0.5}
_OTHER, _LOG = "#8f8f8f", "#6e6e6e"


def save_figure(path: Path, scenario: Scenario, shown: Sequence[Shown], *, at: float) -> None:
    """A still `at` seconds from the start, or a film of it all, by the ending of the file's name.

    Raises:
        ConfigError: The ending or the time is none of those possible.
        MissingExtraError: matplotlib, or for mp4 ffmpeg, is missing.
    """
    if path.suffix.lower() not in STILLS + FILMS:
        raise ConfigError(
            f"{str(path)!r} ends in {path.suffix!r}",
            hint=f"pictures: {' '.join(STILLS)}; films: {' '.join(FILMS)}",
        )
    row = _sample_at(shown[0].log.time_us, at)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() in FILMS:
        _film(path, *_driven(scenario, shown), shown)
    else:
        save_picture(_still(scenario, shown, row), path)


def still(scenario: Scenario, shown: Sequence[Shown], *, at: float) -> Any:
    """A matplotlib figure of the moment `at` seconds from the start.

    Raises:
        ConfigError: There is no such time.
        MissingExtraError: matplotlib is missing.
    """
    return _still(scenario, shown, _sample_at(shown[0].log.time_us, at))


def overview(thing: Scenario | VectorMap) -> Any:
    """A matplotlib figure of a scenario at its first iteration, or of a whole map.

    Raises:
        MissingExtraError: matplotlib is missing.
    """
    if isinstance(thing, VectorMap):
        bounds = thing.edges.polygons.bounds
        corners = np.array([bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)])
        return _canvas(thing, (), corners)[0]
    log = as_recorded(thing)
    figure, axes = _driven(thing, ())
    _recorded(axes, log, 0)
    _draw_ego(axes, log, 0, _LOG)
    _legend(axes)
    _heading(axes, thing, 0.0)
    return figure


def svg_of(figure: Any) -> str:
    """A figure as the text of an SVG element."""
    out = StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue().partition("<svg")[1] + out.getvalue().partition("<svg")[2]


def _sample_at(time_us: IntArray, at: float) -> int:
    times = (time_us - time_us[0]) * 1e-6
    if not 0.0 <= at <= times[-1] + 1e-9:
        raise ConfigError(f"time {at} s is not within 0 … {times[-1]:.1f} s", hint="--at SECONDS")
    return int(np.argmin(np.abs(times - at)))


def _still(scenario: Scenario, shown: Sequence[Shown], row: int) -> Any:
    figure, axes = _driven(scenario, shown)
    _moment(axes, shown, row)
    time_us = shown[0].log.time_us
    _heading(axes, scenario, float(time_us[row] - time_us[0]) * 1e-6)
    return figure


def _driven(scenario: Scenario, shown: Sequence[Shown]) -> tuple[Any, Any]:
    paths = [scenario.expert[:, :2], *(item.log.ego[:, :2] for item in shown)]
    return _canvas(scenario.map, scenario.route, np.concatenate(paths))


def _canvas(road: VectorMap, route: Sequence[str], points: FloatArray) -> tuple[Any, Any]:
    """Axes with the map, as large as the points (N, 2) need."""
    low, high = points.min(axis=0) - _PAD, points.max(axis=0) + _PAD
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    half = np.maximum(half, half.max() * 0.5)  # never a mere strip
    extent = np.array([*(middle - half), *(middle + half)])
    width = 7.0
    height = width * half[1] / half[0]
    if height > 7.0:
        width, height = 7.0 * width / height, 7.0
    figure = new_figure(figsize=(max(width, 4.0), height + 0.9))
    axes = figure.subplots()
    _draw_map(axes, map_lines(road, route, extent))
    axes.set_xlim(extent[0], extent[2])
    axes.set_ylim(extent[1], extent[3])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    _scale_bar(axes, extent)
    return figure, axes


def _draw_map(axes: Any, layers: dict[str, list[FloatArray]]) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

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


def _heading(axes: Any, scenario: Scenario, time: float) -> None:
    words = (scenario.token, scenario.scenario_type, scenario.city, f"{time:.1f} s")
    axes.set_title("  ".join(words).replace("$", r"\$"), fontsize=9)


def _moment(axes: Any, shown: Sequence[Shown], row: int) -> list[Any]:
    """Everything that moves at one sample; returns what was drawn."""
    styles = planner_styles(item.planner for item in shown)
    drawn = _recorded(axes, shown[0].log, row)
    for item in shown:
        style, ego = styles[item.planner], item.log.ego
        clean = item.noise == "none"
        label = item.planner if clean else f"{item.planner} {item.noise}"
        line = {"color": style.colour, "linewidth": 1.8, "linestyle": "-" if clean else (0, (5, 3))}
        mark = {"marker": style.marker, "markevery": (min(10, len(ego) - 1), 30)}
        drawn += axes.plot(ego[:, 0], ego[:, 1], zorder=6, label=label, **line, **mark, **_MARKER)
        drawn += _draw_ego(axes, item.log, row, style.colour)
    _legend(axes)
    return drawn


def _legend(axes: Any) -> None:
    place = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "ncols": 3}
    axes.legend(fontsize=8, frameon=False, **place)


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


def _film(path: Path, figure: Any, axes: Any, shown: Sequence[Shown]) -> None:
    """All samples, one after the other."""
    from matplotlib.animation import FFMpegWriter, PillowWriter

    writer: Any = PillowWriter(fps=_FPS)
    if path.suffix.lower() == ".mp4":
        if not FFMpegWriter.isAvailable():
            raise MissingExtraError("mp4 needs ffmpeg", hint="install ffmpeg, or write a .gif")
        writer = FFMpegWriter(fps=_FPS, extra_args=["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"])
    times = (shown[0].log.time_us - shown[0].log.time_us[0]) * 1e-6
    with writer.saving(figure, str(path), _FILM_DPI):
        for row, time in enumerate(times):
            drawn = _moment(axes, shown, row)
            axes.set_title(f"{shown[0].log.token}  {time:.1f} s", fontsize=9)
            writer.grab_frame()
            for artist in drawn:
                artist.remove()
