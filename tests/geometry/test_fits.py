"""Weights of polynomial fits, against those of SciPy."""

import numpy as np
import pytest
from scipy.signal import savgol_coeffs, savgol_filter

from shiftsim.geometry.fits import fit_weights

WINDOWS = [(5, 2, 1), (5, 3, 2), (8, 2, 0), (15, 2, 1), (41, 2, 0), (41, 2, 1)]


@pytest.mark.parametrize(("window", "degree", "order"), WINDOWS)
def test_at_the_samples(window, degree, order):
    ours = fit_weights(window, degree, order)
    # a signal of one odd window lies on one fit; an even window is never centred on a sample
    if window % 2:
        theirs = savgol_filter(np.eye(window), window, degree, deriv=order, axis=0)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-13)
    time = np.arange(window) - 0.5 * (window - 1)
    values = np.polynomial.Polynomial([0.7, -0.3, 0.11])
    np.testing.assert_allclose(ours @ values(time), values.deriv(order)(time), atol=1e-12)


@pytest.mark.parametrize(("window", "degree", "order"), WINDOWS)
def test_in_the_middle(window, degree, order):
    ours = fit_weights(window, degree, order, np.zeros(1))
    theirs = savgol_coeffs(window, degree, deriv=order, use="dot")
    np.testing.assert_allclose(ours[0], theirs, rtol=0, atol=1e-13)
