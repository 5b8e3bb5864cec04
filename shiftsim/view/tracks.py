"""A picture of a recording on its map: whether frame, units and axes fit is seen at once."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.readers.codes import KINDS
from shiftsim.data.readers.tracks.reader import TracksReader
from shiftsim.data.readers.tracks.table import TrackTable
from shiftsim.data.store.reading import open_store
from shiftsim.kernels import FloatArray
from shiftsim.report.palette import AGENTS, OTHER_AGENT, RECORDED, new_figure, save_picture
from shiftsim.view.drawing import View, draw_map
from shiftsim.view.scene import box_around, indices_near
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind

_MARGIN = 0.05  # of the extent
_NEAR = 100.0  # m beyond the map that tracks may be and still be drawn with it
_MAX_POINTS = 200_000
_MAX_ARROWS = 200
_MAX_EGOS = 40
Egos = dict[str, list[FloatArray]]  # poses (R, 3) of every scenario, by ego


def save_tracks_picture(path: Path, inspection: TracksReader, store: Path | None) -> None:
    """Draw map, tracks and, if a store has scenarios of them, their egos.

    Where the tracks are far from the map, or hardly seen beside it, both are also drawn alone.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    road, table = inspection.road, inspection.table
    egos = {} if store is None else _read_egos(store, f"{road.name}_{table.name}")
    bounds = road.edges.polygons.bounds
    road_box = box_around([bounds[:, :2], bounds[:, 2:]])
    points = table.xy[:: _step(table)]
    track_box = np.concatenate([*np.percentile(points, (0.1, 99.9), axis=0)])
    low, high = track_box[:2], track_box[2:]
    is_inside = (low >= road_box[:2] - _NEAR).all() and (high <= road_box[2:] + _NEAR).all()
    shown = {"the map: the tracks are elsewhere": road_box}
    if is_inside:
        corners = np.stack([road_box, track_box]).reshape(-1, 2)
        shown = {"map and tracks": box_around([corners])}
    if not is_inside or (high - low).max() < 0.2 * (road_box[2:] - road_box[:2]).max():
        shown["where the tracks are"] = track_box
    width = 7.0 if len(shown) > 1 else 9.0
    tall = max(float((box[3] - box[1]) / max(box[2] - box[0], 1e-9)) for box in shown.values())
    height = width * min(max(tall, 0.3), 1.2) + 1.6
    figure = new_figure(figsize=(width * len(shown), height))
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, (title, box) in zip(panels, shown.items(), strict=True):
        _draw_panel(axes, inspection, egos, box)
        axes.set_title(title)
    handles, labels = panels[-1].get_legend_handles_labels()
    look = {"loc": "outside lower center", "ncols": 5, "fontsize": 8, "frameon": False}
    for sample in figure.legend(handles, labels, **look).get_lines():
        sample.set_linewidth(2.0)  # lines of the tracks are too thin to tell colours
    words = "\n".join(_words(inspection, egos)).replace("$", r"\$")
    figure.suptitle(words, fontsize=9, wrap=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_picture(figure, path)


def _words(inspection: TracksReader, egos: Egos) -> list[str]:
    """What is drawn, and what is wrong with it, a line each."""
    table, diagnostics = inspection.table, inspection.diagnostics
    words = [f"{inspection.road.name}, {table.name}: {len(table.track_ids)} objects"]
    if (step := _step(table)) > 1:
        words[0] += f", of their {len(table.xy)} rows one in {step} drawn"
    if egos:
        words.append(f"{sum(map(len, egos.values()))} scenarios, {len(egos)} egos")
    return words + [found.what for found in (*diagnostics.errors, *diagnostics.warnings)]


def _draw_panel(axes: Any, inspection: TracksReader, egos: Egos, extent: FloatArray) -> None:
    pad = _MARGIN * max(float((extent[2:] - extent[:2]).max()), 10.0)
    box = box_around([extent.reshape(2, 2)], pad)
    view = View(np.zeros(3), box)
    draw_map(axes, inspection.road, (), view, {"drivable": "#c9cbca"}, {"centre": "#b8b8b2"})
    _draw_directions(axes, inspection.road, box)
    _draw_tracks(axes, inspection.table)
    _draw_egos(axes, egos)
    axes.set_xlim(box[0], box[2])
    axes.set_ylim(box[1], box[3])
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)


def _draw_directions(axes: Any, road: VectorMap, box: FloatArray) -> None:
    """Arrows that say which way the lanes lead."""
    lines = [road.baselines.at(edge) for edge in indices_near(road.edges, box)]
    for line in lines[:: max(1, len(lines) // _MAX_ARROWS)]:
        middle = len(line) // 2
        if 0 < middle < len(line) - 1:
            style = {"arrowstyle": "->", "color": "#8c8c86", "linewidth": 0.7}
            ends = {"xy": line[middle + 1], "xytext": line[middle - 1]}
            axes.annotate("", **ends, arrowprops=style, annotation_clip=True)


def _draw_tracks(axes: Any, table: TrackTable) -> None:
    """One line per object, broken between objects."""
    shown = np.arange(0, len(table.xy), _step(table))
    codes = np.array([KINDS.get(name, -1) for name in table.categories])
    kinds = codes[table.category[shown]]
    for kind in np.unique(kinds).tolist():
        rows = shown[kinds == kind]
        breaks = np.flatnonzero(np.diff(table.track[rows])) + 1
        xy = np.insert(table.xy[rows], breaks, np.nan, axis=0)
        colour, name = OTHER_AGENT, "unknown kind"
        if kind >= 0:
            known = AgentKind(kind)
            colour, name = AGENTS.get(known, OTHER_AGENT), known.name.lower().replace("_", " ")
        axes.plot(xy[:, 0], xy[:, 1], color=colour, linewidth=0.6, zorder=3, label=name)


def _step(table: TrackTable) -> int:
    """Every how many rows are drawn."""
    return max(1, len(table.xy) // _MAX_POINTS)


def _read_egos(store: Path, log_name: str) -> Egos:
    opened, egos = open_store(store), Egos()
    for token in opened.tokens:
        window = opened.window(token)
        if window.log_name == log_name:
            egos.setdefault(window.ego, []).append(opened.read(token).ego[:, :3])
    return egos


def _draw_egos(axes: Any, egos: Egos) -> None:
    named = f", {_MAX_EGOS} of {len(egos)} named" if len(egos) > _MAX_EGOS else ""
    for number, (name, paths) in enumerate(egos.items()):
        x, y, heading = np.concatenate(paths).T
        label = None if number else f"egos, from dot to arrow{named}"
        axes.plot(x, y, color=RECORDED, linewidth=1.3, zorder=4, label=label)
        if number < _MAX_EGOS:
            axes.plot(x[0], y[0], "o", color=RECORDED, markersize=4, zorder=5)
            to = x[-1] + 6.0 * np.cos(heading[-1]), y[-1] + 6.0 * np.sin(heading[-1])
            style = {"arrowstyle": "-|>", "color": RECORDED}
            axes.annotate("", xy=to, xytext=(x[-1], y[-1]), arrowprops=style, zorder=5)
            text: dict[str, Any] = {"xytext": (4, 3), "textcoords": "offset points", "fontsize": 7}
            axes.annotate(name, (x[0], y[0]), color=RECORDED, zorder=6, **text)
