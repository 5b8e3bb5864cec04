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
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind

_ROAD, _LINE = "#dcdcd8", "#b8b8b2"
_MARGIN = 0.05  # of the extent
_MAX_POINTS = 200_000
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
    map_box = np.concatenate([bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)])
    track_box = np.concatenate([*np.percentile(table.xy[:: _step(table)], (0.1, 99.9), axis=0)])
    inside = (track_box[:2] >= map_box[:2] - 100.0).all() and (
        track_box[2:] <= map_box[2:] + 100.0
    ).all()
    alone = (
        not inside
        or (track_box[2:] - track_box[:2]).max() < 0.2 * (map_box[2:] - map_box[:2]).max()
    )
    both = np.concatenate(
        [np.minimum(map_box[:2], track_box[:2]), np.maximum(map_box[2:], track_box[2:])]
    )
    shown = [both if inside else map_box, *([track_box] if alone else [])]
    width = 7.0 if alone else 9.0
    tall = max(float((box[3] - box[1]) / max(box[2] - box[0], 1e-9)) for box in shown)
    height = width * min(max(tall, 0.3), 1.2) + 1.6
    figure = new_figure(figsize=(width * len(shown), height))
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    _panel(panels[0], inspection, egos, shown[0])
    panels[0].set_title("map and tracks" if inside else "the map: the tracks are elsewhere")
    if alone:
        _panel(panels[1], inspection, egos, track_box)
        panels[1].set_title("where the tracks are")
    words = [f"{road.name}, {table.name}: {len(table.track_ids)} objects"]
    if egos:
        words.append(f"{sum(map(len, egos.values()))} scenarios, {len(egos)} egos")
    diagnostics = inspection.diagnostics
    words += [finding.what for finding in (*diagnostics.errors, *diagnostics.warnings)]
    handles, labels = panels[-1].get_legend_handles_labels()
    look = {"loc": "outside lower center", "ncols": 5, "fontsize": 8, "frameon": False}
    for sample in figure.legend(handles, labels, **look).get_lines():
        sample.set_linewidth(2.0)  # lines of the tracks are too thin to tell colours
    figure.suptitle("\n".join(words).replace("$", r"\$"), fontsize=9, wrap=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_picture(figure, path)


def _panel(axes: Any, inspection: TracksReader, egos: Egos, extent: FloatArray) -> None:
    low, high = extent[:2], extent[2:]
    pad = _MARGIN * max(float((high - low).max()), 10.0)
    _draw_road(axes, inspection.road, np.concatenate([low - pad, high + pad]))
    _draw_tracks(axes, inspection.table)
    _draw_egos(axes, egos)
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)


def _draw_road(axes: Any, road: VectorMap, box: FloatArray) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    bounds = road.edges.polygons.bounds
    near = (bounds[:, :2] <= box[2:]).all(axis=1) & (bounds[:, 2:] >= box[:2]).all(axis=1)
    rings = [
        np.array(road.drivable_areas.shape(index).exterior.coords)
        for index in range(len(road.drivable_areas))
    ]
    edges = np.flatnonzero(near).tolist()
    rings += [np.array(road.edges.shape(edge).exterior.coords) for edge in edges]
    fill: dict[str, Any] = {"facecolors": _ROAD, "edgecolors": "none", "zorder": 1}
    axes.add_collection(PolyCollection(rings, **fill), autolim=False)
    lines = [road.baselines.at(edge) for edge in edges]
    thin: dict[str, Any] = {"colors": _LINE, "linewidths": 0.5, "zorder": 2}
    axes.add_collection(LineCollection(lines, **thin), autolim=False)
    for line in lines[:: max(1, len(lines) // 200)]:  # which way the lanes lead
        middle = len(line) // 2
        if 0 < middle < len(line) - 1:
            ends = line[middle - 1], line[middle + 1]
            style = {"arrowstyle": "->", "color": "#8c8c86", "linewidth": 0.7}
            axes.annotate("", xy=ends[1], xytext=ends[0], arrowprops=style, annotation_clip=True)


def _draw_tracks(axes: Any, table: TrackTable) -> None:
    """One line per object, broken between objects."""
    shown = np.arange(0, len(table.xy), _step(table))
    codes = np.array([KINDS.get(name, -1) for name in table.categories])
    kinds = codes[table.category[shown]]
    for kind in np.unique(kinds).tolist():
        rows = shown[kinds == kind]
        breaks = np.flatnonzero(np.diff(table.track[rows])) + 1
        xy = np.insert(table.xy[rows], breaks, np.nan, axis=0)
        known = AgentKind(kind) if kind >= 0 else None
        colour = OTHER_AGENT if known is None else AGENTS.get(known, OTHER_AGENT)
        name = known.name.lower().replace("_", " ") if known is not None else "unknown kind"
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
    for number, (name, paths) in enumerate(egos.items()):
        path = np.concatenate(paths)
        x, y = path[:, 0], path[:, 1]
        named = f", {_MAX_EGOS} of {len(egos)} named" if len(egos) > _MAX_EGOS else ""
        label = f"egos, from dot to arrow{named}" if not number else None
        axes.plot(x, y, color=RECORDED, linewidth=1.3, zorder=4, label=label)
        if number < _MAX_EGOS:
            axes.plot(x[0], y[0], "o", color=RECORDED, markersize=4, zorder=5)
            heading = path[-1, 2]
            to = x[-1] + 6.0 * np.cos(heading), y[-1] + 6.0 * np.sin(heading)
            style = {"arrowstyle": "-|>", "color": RECORDED}
            axes.annotate("", xy=to, xytext=(x[-1], y[-1]), arrowprops=style, zorder=5)
            text: dict[str, Any] = {"xytext": (4, 3), "textcoords": "offset points", "fontsize": 6}
            axes.annotate(name, (x[0], y[0]), color=RECORDED, zorder=6, **text)
