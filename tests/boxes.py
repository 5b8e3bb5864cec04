"""Boxes and frames, as tests look at them."""

import numpy as np

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import kernel


def boxes_intersect(poses_a, sizes_a, poses_b, sizes_b):
    """(N,) whether box i of one list shares a point with box i of the other; touching counts."""
    return _pairs_intersect(boxes_to_corners(poses_a, sizes_a), boxes_to_corners(poses_b, sizes_b))


@kernel
def _pairs_intersect(a, b):
    out = np.empty(len(a), np.bool_)
    for index in range(len(a)):
        out[index] = convex_intersect(a[index], b[index])
    return out
