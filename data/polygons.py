"""Polygons of maps: how much of them is shared, and their largest part."""

from collections.abc import Sequence

import numpy as np
import shapely


def shared_areas(polygons: Sequence[shapely.Polygon]) -> dict[tuple[int, int], float]:
    """Area that polygons i < j share [m^2], for all that meet, borders included; by i and j."""
    shapes = np.array(polygons, dtype=object)
    one, two = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    pairs = sorted((i, j) for i, j in zip(one.tolist(), two.tolist(), strict=True) if i < j)
    one, two = np.array(pairs, np.int64).reshape(-1, 2).T
    try:
        areas = shapely.area(shapely.intersection(shapes[one], shapes[two])).tolist()
    except shapely.errors.GEOSException:  # a polygon that crosses itself
        areas = [_common_area(polygons[i], polygons[j]) for i, j in pairs]
    return dict(zip(pairs, areas, strict=True))


def _common_area(a: shapely.Polygon, b: shapely.Polygon) -> float:
    try:
        return float(shapely.area(shapely.intersection(a, b)))
    except shapely.errors.GEOSException:
        return float(shapely.area(shapely.intersection(shapely.buffer(a, 0), shapely.buffer(b, 0))))


def largest_part(shape: shapely.Geometry) -> shapely.Polygon:
    """The largest valid polygon of a geometry; an empty polygon where there is none."""
    if not shape.is_valid:
        shape = shapely.make_valid(shape)
    if isinstance(shape, shapely.Polygon):
        return shape
    parts = [p for p in shapely.get_parts(shape) if isinstance(p, shapely.Polygon)]
    nested = [largest_part(p) for p in shapely.get_parts(shape) if hasattr(p, "geoms")]
    return max(parts + nested, key=lambda part: part.area, default=shapely.Polygon())
