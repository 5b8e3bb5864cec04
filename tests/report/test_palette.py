"""Planners can be told apart by anybody, also on a black and white print."""

import colorsys
from itertools import combinations

import numpy as np
import pytest

from shiftsim.report.palette import _KNOWN, _OTHERS, AGENTS, RECORDED, planner_styles

# dichromatic vision after Machado, Oliveira and Fernandes (2009), on linear RGB
VISION = {
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = np.array([0.9505, 1.0, 1.089])


def lab(colour, vision=VISION["normal"]):
    """CIELAB of `#rrggbb` as seen by some eyes."""
    value = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    ratio = TO_XYZ @ np.clip(np.array(vision) @ linear, 0.0, 1.0) / WHITE
    f = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@pytest.mark.parametrize("eyes", VISION)
def test_colours_stay_apart(eyes):
    seen = {name: lab(style.colour, VISION[eyes]) for name, style in _KNOWN.items()}
    for (one, a), (other, b) in combinations(seen.items(), 2):
        assert np.linalg.norm(a - b) >= 18.0, (one, other)


def test_greys_stay_apart():
    lightness = np.sort([lab(style.colour)[0] for style in _KNOWN.values()])
    assert np.diff(lightness).min() >= 6.0
    assert lightness.max() < 75.0  # still seen on white


def test_markers_are_all_different():
    assert len({style.marker for style in _KNOWN.values()}) == len(_KNOWN)


def test_own_planners_have_styles_of_their_own():
    found = planner_styles(["carl", "mine:A", "mine:B", "pluto"])
    assert len(set(found.values())) == 4
    assert found == planner_styles(["mine:B", "pluto", "mine:A", "carl"])  # in any figure


def hue(colour):
    red, green, blue = (int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return 360.0 * colorsys.rgb_to_hls(red, green, blue)[0]


def test_own_planners_share_no_marker_and_no_hue_with_a_known_one():
    assert not {s.marker for s in _OTHERS} & {s.marker for s in _KNOWN.values()}
    assert len({s.marker for s in _OTHERS}) == len(_OTHERS)
    grey = _KNOWN["log-future"]
    for other in _OTHERS:
        for known in {*_KNOWN.values()} - {grey}:
            apart = abs(hue(other.colour) - hue(known.colour))
            assert min(apart, 360.0 - apart) >= 12.0, (other, known)


@pytest.mark.parametrize("eyes", VISION)
def test_the_recorded_driver_has_the_colour_of_no_planner(eyes):
    recorded = lab(RECORDED, VISION[eyes])
    for style in (*_KNOWN.values(), *_OTHERS):
        assert np.linalg.norm(recorded - lab(style.colour, VISION[eyes])) >= 12.0, style
    assert RECORDED not in AGENTS.values()
