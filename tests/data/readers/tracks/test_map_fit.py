"""Which axes are tried where vehicles lie beside the map."""

import numpy as np

from shiftsim.data.readers.tracks.map_fit import _AXES


def test_axes_are_all_that_turn_by_quarters_or_mirror_and_stretch_nothing():
    axes = np.array([*_AXES.values()])
    assert len(np.unique(axes, axis=0)) == len(axes) == 8
    np.testing.assert_array_equal(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(2), (8, 1, 1)))
    mirrored = [name for name in _AXES if "mirrored" in name or "swapped" in name]
    assert [name for name, one in _AXES.items() if np.linalg.det(one) < 0.0] == mirrored
