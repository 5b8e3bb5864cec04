"""Savitzky-Golay filters: polynomials fitted to windows of a signal, and their derivatives."""

from math import factorial

import numpy as np

from shiftsim.kernels import FloatArray


def fit_weights(window: int, degree: int, order: int, at: FloatArray | None = None) -> FloatArray:
    """Weights of the samples of a window, at unit spacing, that give a derivative of their fit.

    Args:
        window: How many samples there are, W.
        degree: Of the polynomial.
        order: Of the derivative; 0 is the fit itself.
        at: (N,) where it is wanted, from the middle of the window; without it, at the samples.

    Returns:
        (N, W).
    """
    samples = np.arange(window) - 0.5 * (window - 1)
    where = samples if at is None else at
    powers = samples[:, None] ** np.arange(degree + 1)
    fit = np.linalg.solve(powers.T @ powers, powers.T)  # samples -> coefficients
    derived = np.zeros((len(where), degree + 1))
    for power in range(order, degree + 1):
        scale = factorial(power) / factorial(power - order)
        derived[:, power] = scale * where ** (power - order)
    return np.ascontiguousarray(derived @ fit)
