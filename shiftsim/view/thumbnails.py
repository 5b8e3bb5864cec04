"""Small pictures of scenarios as SVG paths: the road from above and who drove where.

Units are half metres, y down, turned so that the recorded ego travels from left to right. The
rollouts of a scenario share the road's surface, of which each shows its own window.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely

from shiftsim.kernels import FloatArray
from shiftsim.view.scene import box_around, indices_near
from shiftsim.world.scenario import Scenario

ASPECT = 16.0 / 9.0  # width of a picture over its height
_UNIT = 0.5  # m
_MARGIN = 24.0  # units around the paths
_LEAST = 160.0  # units of width that a picture shows at least
_STANDING = 2.0  # m, below which the heading is the direction of travel
_TOLERANCE = 0.7  # units


def thumbnails(
    scenario: Scenario, driven: Mapping[Any, tuple[FloatArray, int | None]]
) -> dict[Any, dict[str, Any]]:
    """The picture of every rollout as JSON values.

    Args:
        scenario: The scenario that was driven.
        driven: By any key, (T, 2) positions of the ego [m], and the row to be marked, if any.

    Returns:
        By the same keys: `scene`, the paths of the road's surface and of the recorded ego, the same
        for all; `path` of the rollout; `view`, its window, as left, top, width, height; `mark`, the
        place of the marked row.
    """
    place = _Placement(scenario.expert)
    expert = place(scenario.expert[:, :2])
    paths = {key: place(positions) for key, (positions, _) in driven.items()}
    views = {key: _window(box_around([expert, path], _MARGIN)) for key, path in paths.items()}
    corners = [np.array([view[:2], view[:2] + view[2:]]) for view in views.values()]
    scene = (_roads(scenario, place, box_around(corners)), _line(expert))
    out = {}
    for key, path in paths.items():
        row = driven[key][1]
        mark = None if row is None else _whole(path[min(row, len(path) - 1)])
        view = _whole(views[key])
        out[key] = {"scene": scene, "path": _line(path), "view": view, "mark": mark}
    return out


class _Placement:
    """From map positions (N, 2) [m] to units of the pictures, and back."""

    def __init__(self, expert: FloatArray) -> None:
        self._start = expert[0, :2]
        (dx, dy), heading = expert[-1, :2] - self._start, expert[0, 2]
        angle = np.arctan2(dy, dx) if np.hypot(dx, dy) > _STANDING else heading
        cos, sin = np.cos(angle) / _UNIT, np.sin(angle) / _UNIT
        self._turn = np.array([[cos, sin], [sin, -cos]])  # y down

    def __call__(self, points: FloatArray) -> FloatArray:
        return (points - self._start) @ self._turn

    def back(self, points: FloatArray) -> FloatArray:
        return points @ np.linalg.inv(self._turn) + self._start


def _window(box: FloatArray) -> FloatArray:
    """(4,) left, top, width, height of a picture that shows a box."""
    centre, (width, height) = (box[:2] + box[2:]) / 2.0, box[2:] - box[:2]
    width = max(width, height * ASPECT, _LEAST)
    size = np.array([width, width / ASPECT])
    return np.concatenate([centre - size / 2.0, size])


def _roads(scenario: Scenario, place: _Placement, box: FloatArray) -> str:
    layer, (x0, y0, x1, y1) = scenario.map.drivable_areas, box
    corners = place.back(np.array([(x0, y0), (x0, y1), (x1, y0), (x1, y1)]))
    shapes = [layer.shape(index) for index in indices_near(layer, box_around([corners]))]
    placed = shapely.make_valid(shapely.transform(np.array(shapes, object), place))
    union = shapely.union_all(shapely.clip_by_rect(placed, *box), grid_size=1.0)
    parts = shapely.get_parts(shapely.simplify(union, _TOLERANCE))
    areas = [part for part in parts if part.geom_type == "Polygon"]
    rings = [ring for area in areas for ring in (area.exterior, *area.interiors)]
    return "".join(f"{_steps(shapely.get_coordinates(ring)[:-1])}z" for ring in rings)


def _line(points: FloatArray) -> str:
    """(N, 2) a path as the commands of an SVG path."""
    return _steps(shapely.get_coordinates(shapely.LineString(points).simplify(_TOLERANCE)))


def _steps(points: FloatArray) -> str:
    """(N, 2) points in whole units, each relative to the one before."""
    first, whole = _whole(points[0]), np.rint(points).astype(int)
    joined = " ".join(f"{x} {y}" for x, y in np.diff(whole, axis=0).tolist())
    return f"M{first[0]} {first[1]}l{joined}".replace(" -", "-")


def _whole(values: FloatArray) -> list[int]:
    found: list[int] = np.rint(values).astype(int).tolist()
    return found
