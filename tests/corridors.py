"""Rings around a line: boxes of any size, and outlines of connectors."""

import numpy as np

from shiftsim.geometry.boxes import boxes_to_corners


def some_boxes(rng, centers):
    count = len(centers)
    poses = np.c_[centers, rng.uniform(-3, 3, count)]
    return boxes_to_corners(poses, rng.uniform(0.2, 5.0, (count, 2)))


def bent_band(rng, start, count=75):
    """The outline of a connector: two borders of many vertices."""
    turn = np.cumsum(np.full(count, rng.uniform(-0.03, 0.03))) + rng.uniform(-3, 3)
    line = start + np.cumsum(0.4 * np.c_[np.cos(turn), np.sin(turn)], axis=0)
    beside = 1.75 * np.c_[-np.sin(turn), np.cos(turn)]
    return np.concatenate([line + beside, (line - beside)[::-1]])
