"""The parts of a still or a film: map, driven paths, boxes, violations, and where words find room.

At the end comes the picture of a table of tracks on its map, in which whether frame, units and axes
fit is seen at once.

Planners and noise look as in all pictures (`report/palette.py`): a disturbed rollout has a dashed
path, and a hollow box.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from shiftsim.data.readers.codes import KINDS
from shiftsim.data.store.reading import open_store
from shiftsim.errors import plural
from shiftsim.geometry.boxes import boxes_to_corners, to_frame, turned
from shiftsim.kernels import FloatArray
from shiftsim.report.palette import (
    AGENTS,
    ALARM,
    OTHER_AGENT,
    RECORDED,
    SMALL,
    Style,
    dashes,
    new_figure,
    save_picture,
)
from shiftsim.report.words import violation_words, violations, worst_moment, worst_violation
from shiftsim.sim.log import as_recorded
from shiftsim.view.scene import ShownRollout, box_around, indices_near, map_lines
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, AgentKind, center_poses

if TYPE_CHECKING:
    from shiftsim.data.readers.tracks.reader import TracksReader
    from shiftsim.data.readers.tracks.table import TrackTable

_AREAS = {  # what is drawn first lies below
    "walkway": "#e8e0cc",
    "drivable": "#c9cbca",
    "route": "#98b8a2",
    "crosswalk": "#f7f4ea",
}
_LINES = {"boundary": "#8d908d"}
BURST = (8, 1, 0)  # where something went wrong: no planner has this mark
_EVERY = 50  # samples from mark to mark
_EDGE = "#30363c"
# which way from its mark a label may stand
_AROUND = ((0.8, 0.6), (-0.8, 0.6), (0.8, -0.6), (-0.8, -0.6), (1, 0), (-1, 0), (0, 1), (0, -1))
_AWAY = (8.0, 22.0, 40.0, 62.0, 90.0)  # points
# of pictures of tracks
_MARGIN = 0.05  # of the extent
_NEAR = 100.0  # m beyond the map that tracks may be and still be drawn with it
_MAX_POINTS = 200_000
_MAX_ARROWS = 200
_MAX_EGOS = 40
Egos = dict[str, list[FloatArray]]  # poses (R, 3) of every scenario, by ego


class View(NamedTuple):
    """A box of a frame, which a picture shows; its x axis points to the right."""

    frame: FloatArray  # (3,) pose of the frame in the map: x [m], y [m], heading [rad]
    box: FloatArray  # (4,) min x, min y, max x, max y in the frame [m]

    def place(self, points: FloatArray) -> FloatArray:
        """Points (K, 2) of the map in the frame."""
        return turned(points - self.frame[:2], float(self.frame[2]))

    @property
    def map_box(self) -> FloatArray:
        """(4,) min x, min y, max x, max y of all that the box covers of the map [m]."""
        x0, y0, x1, y1 = self.box
        corners = turned(np.array([(x0, y0), (x0, y1), (x1, y0), (x1, y1)]), -float(self.frame[2]))
        return box_around([corners + self.frame[:2]])


def draw_paths(
    axes: Any,
    scenario: Scenario,
    shown: Sequence[ShownRollout],
    styles: Mapping[str, Style],
    view: View,
    upto: int | None = None,
) -> list[Any]:
    """The paths of the recorded driver and of the rollouts, these up to a sample; their lines."""
    dotted = {"color": RECORDED, "linewidth": 1.1, "linestyle": ":", "zorder": 6.5}
    axes.plot(*view.place(scenario.expert[:, :2]).T, label="recorded path", **dotted)
    lines = []
    for number, item in enumerate(shown):
        ego, style = item.log.ego, styles[item.planner]
        every = (min(10 + number * _EVERY // len(shown), len(ego) - 1), _EVERY)
        look = {"linewidth": 1.8, "linestyle": dashes(item.noise), "markevery": every}
        look |= style.marks(item.noise, 5.5)
        path = view.place(ego[:upto, :2])
        lines += axes.plot(*path.T, zorder=6, label=caption(item), **look)
    return lines


def draw_moment(
    axes: Any,
    scenario: Scenario,
    shown: Sequence[ShownRollout],
    styles: Mapping[str, Style],
    row: int,
    view: View,
) -> list[Any]:
    """What moves, at one sample: the tracks, and the egos of the rollouts, or the recorded one."""
    drawn: list[Any] = []
    items = shown or [ShownRollout("", "none", 0, as_recorded(scenario))]
    tracks = items[0].log.tracks
    for kind in np.unique(tracks.kinds):
        there = tracks.valid[row] & (tracks.kinds == kind)
        colour = AGENTS.get(AgentKind(int(kind)), OTHER_AGENT)
        poses = to_frame(tracks.poses[row, there], view.frame)
        drawn += _boxes(axes, poses, tracks.sizes[row, there], facecolors=colour)
    size = np.array([[PACIFICA.length, PACIFICA.width]])
    for item in items:
        colour = styles[item.planner].colour if shown else RECORDED
        look: dict[str, Any] = {"facecolors": colour}
        if item.noise != "none":  # hollow and dashed
            look = {"facecolors": "#ffffffd0", "edgecolors": colour, "linewidths": 1.6}
            look["linestyles"] = [(0, (2.2, 1.0))]
        pose = to_frame(center_poses(item.log.ego[row : row + 1, :3]), view.frame)
        drawn += _boxes(axes, pose, size, zorder=7, **look)
    return drawn


def _boxes(
    axes: Any, poses: FloatArray, sizes: FloatArray, *, zorder: float = 3.0, **look: Any
) -> list[Any]:
    """(N, 3) centre poses and (N, 2) lengths and widths as boxes."""
    from matplotlib.collections import PolyCollection

    if not len(poses):
        return []
    look = {"edgecolors": _EDGE, "linewidths": 0.6, **look}
    boxes = PolyCollection(list(boxes_to_corners(poses, sizes)), zorder=zorder, **look)
    return [axes.add_collection(boxes, autolim=False)]


def draw_map(
    axes: Any,
    road: VectorMap,
    route: Sequence[str],
    view: View,
    areas: Mapping[str, str] = _AREAS,
    lines: Mapping[str, str] = _LINES,
) -> None:
    """Areas and lines of the map in their colours, and the route."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    layers = {
        name: [view.place(line) for line in found]
        for name, found in map_lines(road, route, view.map_box).items()
    }
    for name, colour in areas.items():
        if layers[name]:
            outline = Outline.make_compound_path(*(Outline(r, closed=True) for r in layers[name]))
            axes.add_patch(PathPatch(outline, facecolor=colour, edgecolor="none", zorder=1))
    for name, colour in lines.items():
        thin = LineCollection(layers[name], colors=colour, linewidths=0.5, zorder=1.5)
        axes.add_collection(thin, autolim=False)


def draw_scale(axes: Any, view: View) -> None:
    """A bar of a round length in the lower left corner."""
    width = view.box[2] - view.box[0]
    length = next(v for v in (100, 50, 20, 10, 5, 2, 1) if v <= max(width / 4.0, 1.0))
    x, y, frame = 0.04, 0.05, axes.transAxes
    axes.plot([x, x + length / width], [y, y], "k", lw=2, zorder=9, transform=frame)
    box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.0}
    place = {"xytext": (0, 3), "textcoords": "offset points", "ha": "center", "va": "bottom"}
    at = {"xy": (x + length / width / 2.0, y), "xycoords": frame}
    axes.annotate(f"{length} m", **at, fontsize=SMALL, bbox=box, zorder=9, **place)


def caption(item: ShownRollout) -> str:
    """Planner, noise, seed, score, and its cause, as "… at-fault collision at 4.3 s"."""
    name = item.planner
    name += "" if item.noise == "none" else f", {item.noise}, seed {item.seed}"
    score = "" if item.cls is None else f": score {100.0 * item.cls:.0f}"
    worst = worst_violation(violations(item.metrics))
    if worst is None:
        return f"{name}{score}"
    what, comma, more = violation_words(worst.row, item.log.tracks).partition(",")
    time = "" if worst.time is None else f" at {worst.time:.1f} s"
    return f"{name}{score}; {what} ({worst.short}){comma}{more}{time}"


class Mark(NamedTuple):
    """A violation that is marked."""

    time: float  # when it began [s from the start]
    burst: Any  # the mark
    label: Any  # its words


def draw_violation(
    axes: Any, item: ShownRollout, style: Style, view: View, *, in_short: bool = False
) -> Mark | None:
    """A burst where the worst violation began, and what it was; `in_short` without numbers."""
    worst = worst_moment(violations(item.metrics))
    if worst is None or worst.time is None:
        return None
    time_us = item.log.time_us
    row = int(np.searchsorted(time_us, time_us[0] + worst.time * 1e6 - 1.0))
    place = view.place(center_poses(item.log.ego[min(row, len(time_us) - 1), :3])[:2])
    look = {"linestyle": "none", "marker": BURST, "markersize": 11, "markeredgecolor": "white"}
    (burst,) = axes.plot(*place[:, None], color=ALARM, zorder=9, **look)
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": style.colour, "lw": 0.9}
    leader = {"arrowstyle": "-", "color": style.colour, "lw": 0.8, "shrinkA": 0, "shrinkB": 4}
    words = violation_words(worst.row, item.log.tracks)
    words = words.partition(",")[0] if in_short else words
    at: dict[str, Any] = {"xytext": (6, 6), "textcoords": "offset points", "zorder": 10}
    at |= {"annotation_clip": False, "in_layout": False}
    label = axes.annotate(words, place, fontsize=SMALL, bbox=box, arrowprops=leader, **at)
    return Mark(worst.time, burst, label)


def show_from(mark: Mark, time: float) -> None:
    """Show a mark if it is one of a moment up to a time, and inside the picture."""
    for artist in (mark.burst, mark.label):
        artist.set_visible(mark.time <= time + 1e-6)
    mark.label.set_annotation_clip(True)


def spread_labels(
    figure: Any, axes: Any, marks: Sequence[Mark], *, keep_inside: bool = True
) -> None:
    """Move the labels of marks to the nearest places around them that cover little else."""
    from matplotlib.transforms import Bbox

    figure.draw_without_rendering()
    renderer, frame = figure.canvas.get_renderer(), axes.get_window_extent()
    unit = figure.dpi / 72.0  # pixels per point
    paths = np.concatenate(
        [line.get_transform().transform(line.get_xydata()) for line in axes.lines]
    )
    taken = [mark.burst.get_window_extent(renderer).padded(6.0 * unit) for mark in marks]
    others = set(axes.texts) - {mark.label for mark in marks}  # the scale
    taken += [words.get_window_extent(renderer).padded(4.0 * unit) for words in others]

    def cost(spot: Any) -> float:
        inside = Bbox.intersection(spot, frame)
        cut = 1.0 - (inside.width * inside.height / (spot.width * spot.height) if inside else 0.0)
        covered = min(spot.count_contains(paths) / 20.0, 0.9)
        return float(sum(map(spot.overlaps, taken)) + 9.0 * cut * keep_inside + covered)

    for mark in marks:
        box = mark.label.get_bbox_patch().get_window_extent(renderer)
        x, y = axes.transData.transform(mark.label.xy)
        corners = [  # the label is right of a mark that it stands right of, and so on
            (
                x + away * unit * cos + (np.sign(cos) - 1.0) / 2.0 * box.width,
                y + away * unit * sin + (np.sign(sin) - 1.0) / 2.0 * box.height,
            )
            for away in _AWAY
            for cos, sin in _AROUND
        ]
        best = min((Bbox.from_bounds(*at, box.width, box.height) for at in corners), key=cost)
        mark.label.set_position(((best.x0 - x) / unit, (best.y0 - y) / unit))
        taken.append(best.padded(2.0 * unit))


def save_tracks_picture(path: Path, inspection: "TracksReader", store: Path | None) -> None:
    """Draw map, tracks and egos of a store; tracks alone as well where the map is far or large."""
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


def _words(inspection: "TracksReader", egos: Egos) -> list[str]:
    """What is drawn, and what is wrong with it, a line each."""
    table, diagnostics = inspection.table, inspection.diagnostics
    words = [f"{inspection.road.name}, {table.name}: {len(table.track_ids)} objects"]
    if (step := _step(table)) > 1:
        words[0] += f", of their {len(table.xy)} rows one in {step} drawn"
    if egos:
        count = sum(map(len, egos.values()))
        words.append(f"{plural(count, 'scenario')}, {plural(len(egos), 'ego')}")
    return words + [found.what for found in (*diagnostics.errors, *diagnostics.warnings)]


def _draw_panel(axes: Any, inspection: "TracksReader", egos: Egos, extent: FloatArray) -> None:
    pad = _MARGIN * max(float((extent[2:] - extent[:2]).max()), 10.0)
    box = box_around([extent.reshape(2, 2)], pad)
    view = View(np.zeros(3), box)
    draw_map(axes, inspection.road, (), view, {"drivable": "#c9cbca"}, {"centre": "#b8b8b2"})
    _draw_directions(axes, inspection.road, box)
    _draw_tracks(axes, inspection.table)
    _draw_egos(axes, egos)
    axes.set(xlim=box[::2], ylim=box[1::2], aspect="equal", xlabel="x [m]", ylabel="y [m]")
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


def _draw_tracks(axes: Any, table: "TrackTable") -> None:
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


def _step(table: "TrackTable") -> int:
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
