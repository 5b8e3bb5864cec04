"""Savitzky-Golay filters: polynomials fitted to windows of a signal, and their derivatives."""

from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray, kernel

# nuPlan rule 79: an even window is centred half a sample ahead, so that interior output n is the
# fitted value at n + 1/2, with a jump to the edge fits
SMOOTH_8 = np.array([-3.0, 3.0, 7.0, 9.0, 9.0, 7.0, 3.0, -3.0]) / 32.0


class Filter(NamedTuple):
    """A filter over a window of W samples."""

    interior: FloatArray  # (W,) weights
    fit: FloatArray  # (W, W) of each sample of the first or last window in each of its outputs


@lru_cache
def make_filter(window: int, degree: int, order: int) -> Filter:
    """The filter that gives a derivative, 0 for the value itself, per sample to the `order`."""
    fit = fit_weights(window, degree, order)
    is_smooth_8 = (window, degree, order) == (8, 2, 0)
    return Filter(SMOOTH_8 if is_smooth_8 else fit[window // 2].copy(), fit.T.copy())


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


@kernel
def filter_signal(values: FloatArray, how: Filter, scale: float, out: FloatArray) -> None:
    """Filter a signal (K,), divide it by `scale`, round it to 8 decimals; `out` (K,) is written.

    Output n is the sum of the samples from n - (W - 1) // 2 on, weighted by the interior; at the
    edges the fit gives it from the first or last W samples, W <= K.
    """
    interior, fit = how.interior, how.fit
    count, window = len(values), len(fit)
    half = window // 2
    middle, tail = out[half : count - half], out[count - half :]
    moved, tail_fit = values[half - (window - 1) // 2 :], fit[:, window - half :]
    out[:] = 0.0
    for j in range(window):
        first, weight, last = values[j], interior[j], values[count - window + j]
        for n in range(half):
            out[n] += fit[j, n] * first
            tail[n] += tail_fit[j, n] * last
        for n in range(len(middle)):
            middle[n] += weight * moved[n + j]
    for n in range(count):
        # nuPlan rule 81: rounded between smoothing and differentiation, and before comparison
        out[n] = np.rint(out[n] / scale * 1e8) / 1e8
