"""The filters of the comfort test on proposals, against SciPy's."""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from shiftsim.geometry.fits import filter_signal, make_filter


@pytest.mark.parametrize("window", [(41, 2, 0), (8, 2, 0), (41, 2, 1), (5, 2, 1), (5, 3, 2)])
def test_filters_are_those_of_scipy(window):
    signal, out = np.random.default_rng(0).normal(size=41), np.empty(41)
    length, degree, order = window
    theirs = savgol_filter(signal, length, degree, deriv=order, delta=0.1)
    filter_signal(signal, make_filter(*window), 0.1**order, out)
    np.testing.assert_allclose(out, theirs, rtol=0, atol=1.1e-8)
