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
    expert, start = scenario.expert, scenario.expert[0, :2]
    dx, dy = expert[-1, :2] - start
    angle = np.arctan2(dy, dx) if np.hypot(dx, dy) > _STANDING else expert[0, 2]
    cos, sin = np.cos(angle) / _UNIT, np.sin(angle) / _UNIT
    turn = np.array([[cos, sin], [sin, -cos]])  # metres to units, its own inverse but for scale

    def place(points: FloatArray) -> FloatArray:
        return (points - start) @ turn

    recorded = place(expert[:, :2])
    paths = {key: place(positions) for key, (positions, _) in driven.items()}
    views = {key: _window(box_around([recorded, path], _MARGIN)) for key, path in paths.items()}
    shown = box_around([np.array([view[:2], view[:2] + view[2:]]) for view in views.values()])
    corners = np.array([(x, y) for x in shown[::2] for y in shown[1::2]])
    layer = scenario.map.drivable_areas
    near = indices_near(layer, box_around([corners @ turn * _UNIT**2 + start]))
    shapes = shapely.transform(np.array([layer.shape(index) for index in near], object), place)
    scene = (_areas(shapes, shown), _line(recorded))
    return {
        key: {
            "scene": scene,
            "path": _line(path),
            "view": _whole(views[key]),
            "mark": None if (row := driven[key][1]) is None else _whole(path[row]),
        }
        for key, path in paths.items()
    }


def _window(box: FloatArray) -> FloatArray:
    """(4,) left, top, width, height of a picture that shows a box."""
    centre, (width, height) = (box[:2] + box[2:]) / 2.0, box[2:] - box[:2]
    size = np.array([1.0, 1.0 / ASPECT]) * max(width, height * ASPECT, _LEAST)
    return np.concatenate([centre - size / 2.0, size])


def _areas(shapes: Any, box: FloatArray) -> str:
    """Polygons within a box as one SVG path, for even-odd filling."""
    clipped = shapely.clip_by_rect(shapely.make_valid(shapes), *box)
    union = shapely.simplify(shapely.union_all(clipped, grid_size=1.0), _TOLERANCE)
    areas = [part for part in shapely.get_parts(union) if part.geom_type == "Polygon"]
    rings = [ring for area in areas for ring in (area.exterior, *area.interiors)]
    return "".join(f"{_steps(shapely.get_coordinates(ring)[:-1])}z" for ring in rings)


def _line(points: FloatArray) -> str:
    """(N, 2) a path of one point or more as the commands of an SVG path."""
    line = shapely.LineString(np.vstack([points[:1], points]))
    return _steps(shapely.get_coordinates(line.simplify(_TOLERANCE)))


def _steps(points: FloatArray) -> str:
    """(N, 2) points in whole units, each relative to the one before."""
    whole = np.rint(points).astype(int)
    steps = np.diff(whole, axis=0)
    moves = steps[steps.any(axis=1)].tolist() or [(0, 0)]
    joined = " ".join(f"{x} {y}" for x, y in moves)
    return f"M{whole[0, 0]} {whole[0, 1]}l{joined}".replace(" -", "-")


def _whole(values: FloatArray) -> list[int]:
    return np.rint(values).astype(int).tolist()
