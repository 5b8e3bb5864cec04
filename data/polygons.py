"""Polygons of maps: which of them meet, how much they share, and their largest part."""

from collections.abc import Sequence

import numpy as np
import shapely


def touching(polygons: Sequence[shapely.Polygon]) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of polygons that meet, borders included; sorted."""
    from rtree.index import Index

    shapes = np.array(polygons, dtype=object)
    bounds = shapely.bounds(shapes).reshape(-1, 4)
    boxes = [(int(i), bounds[i].tolist(), None) for i in np.flatnonzero(~shapely.is_empty(shapes))]
    if not boxes:
        return []
    index = Index(iter(boxes))
    pairs = [(i, j) for i, box, _ in boxes for j in index.intersection(box) if i < j]
    one, two = np.array(pairs, np.int64).reshape(-1, 2).T
    meet = shapely.intersects(shapes[one], shapes[two])
    return sorted(zip(one[meet].tolist(), two[meet].tolist(), strict=True))


def shared_areas(polygons: Sequence[shapely.Polygon]) -> dict[tuple[int, int], float]:
    """Area that polygons i < j share [m^2], for all that meet."""
    pairs = touching(polygons)
    shapes = np.array(polygons, dtype=object)
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
