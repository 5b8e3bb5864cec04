"""Hypothesis strategies shared by all tests."""

import numpy as np
from hypothesis import strategies as st

# corner of a map as UTM coordinates have it; 0 for a local frame
OFFSETS = ((0.0, 0.0), (664_430.0, 3_998_750.0))

angles = st.floats(-np.pi, np.pi, allow_nan=False)
offsets = st.sampled_from(OFFSETS)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def rigid_motions(draw: st.DrawFn) -> tuple[float, float, float]:
    """A rotation [rad] and a translation [m] of the whole world."""
    return draw(angles), draw(st.floats(-1e3, 1e3)), draw(st.floats(-1e3, 1e3))
