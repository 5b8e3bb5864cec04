"""The filters of the comfort test on proposals, against SciPy's."""

import numpy as np
from scipy.signal import savgol_filter

from shiftsim.planners.proposals.comfort import make_filters

FILTERS = [(41, 2, 0), (8, 2, 0), (41, 2, 1), (5, 2, 1), (5, 3, 2)]  # window, degree, derivative


def test_filters_are_those_of_scipy():
    signals = np.random.default_rng(0).normal(size=(3, 41))
    matrices = make_filters().matrices
    for matrix, (window, degree, order) in zip(matrices, FILTERS, strict=True):
        theirs = savgol_filter(signals, window, degree, deriv=order, delta=0.1)
        np.testing.assert_allclose(signals @ matrix[:41, :41], theirs, rtol=1e-12, atol=1e-10)
        assert not matrix[41:].any()
        assert not matrix[:, 41:].any()
