"""Reference lines against closed forms and slow integration."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from opendrive_xml import geometry, parse, road
from scipy.integrate import quad
from scipy.special import fresnel

from shiftsim.data.maps.opendrive.curves import ReferenceLine, length_error
from shiftsim.data.maps.opendrive.records import SPIRAL, Geometry


def line_of(*plan: str) -> ReferenceLine:
    """Reference line of a road with these records."""
    return ReferenceLine(parse(road(plan=plan)).roads["1"].geometries)


def poses(line: ReferenceLine, *s: float) -> np.ndarray:
    """(K, 3) x, y, heading at distances."""
    found = line.evaluate(np.array(s, np.float64))
    return np.stack([found.x, found.y, found.heading], axis=1)


def test_line_runs_along_its_heading():
    line = line_of(geometry("<line/>", x=1, y=2, hdg=np.pi / 2))
    np.testing.assert_allclose(
        poses(line, 0, 10), [[1, 2, np.pi / 2], [1, 12, np.pi / 2]], atol=1e-12
    )


def test_quarter_of_a_left_circle():
    line = line_of(geometry('<arc curvature="0.1"/>'))
    np.testing.assert_allclose(poses(line, 5 * np.pi), [[10, 10, np.pi / 2]], atol=1e-12)


def test_right_arc_mirrors_the_left_one():
    left, right = (line_of(geometry(f'<arc curvature="{k}"/>')) for k in (0.03, -0.03))
    s = np.linspace(0, 100, 7)
    np.testing.assert_allclose(right.evaluate(s).y, -left.evaluate(s).y, atol=1e-12)


@pytest.mark.parametrize("curvature", [0.0, 1e-13, 1e-10])
def test_flat_arc_is_a_line(curvature: float):
    line = line_of(geometry(f'<arc curvature="{curvature}"/>'))
    np.testing.assert_allclose(poses(line, 100), [[100, 0, 0]], atol=1e-5)


def test_clothoid_equals_fresnel_integrals():
    length, end = 80.0, 0.05
    line = line_of(geometry(f'<spiral curvStart="0" curvEnd="{end}"/>', length=length))
    scale = np.sqrt(np.pi * length / end)
    s = np.linspace(0, length, 9)
    sine, cosine = fresnel(s / scale)
    found = line.evaluate(s)
    np.testing.assert_allclose(found.x, scale * cosine, atol=1e-10)
    np.testing.assert_allclose(found.y, scale * sine, atol=1e-10)
    np.testing.assert_allclose(found.heading, end * s**2 / (2 * length), atol=1e-12)


def test_clothoid_of_equal_curvatures_is_an_arc():
    spiral = line_of(geometry('<spiral curvStart="0.02" curvEnd="0.02"/>'))
    arc = line_of(geometry('<arc curvature="0.02"/>'))
    s = np.linspace(0, 100, 11)
    np.testing.assert_allclose(spiral.evaluate(s).offset(s), arc.evaluate(s).offset(s), atol=1e-11)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(1.0, 200.0))
def test_clothoid_equals_slow_integration(start: float, end: float, length: float):
    line = ReferenceLine((Geometry(0, 0, 0, 0, length, "spiral", (start, end)),))

    def turn(t: float) -> float:
        return start * t + (end - start) * t * t / (2 * length)

    steps = np.linspace(0, length, 65)
    x = sum(quad(lambda t: np.cos(turn(t)), a, b)[0] for a, b in pairwise(steps))
    y = sum(quad(lambda t: np.sin(turn(t)), a, b)[0] for a, b in pairwise(steps))
    np.testing.assert_allclose(poses(line, length)[0, :2], [x, y], atol=1e-9)


def test_poly3_is_measured_along_the_curve():
    line = line_of(geometry('<poly3 a="0" b="1" c="0" d="0"/>'))
    np.testing.assert_allclose(
        poses(line, 10), [[10 / np.sqrt(2), 10 / np.sqrt(2), np.pi / 4]], atol=1e-12
    )


def test_parameter_ranges_describe_the_same_curve():
    by_length = '<paramPoly3 pRange="arcLength" bU="1" cV="0.001" dV="0.00001"/>'
    length = 60.0
    normalized = (
        f'<paramPoly3 pRange="normalized" bU="{length}" cV="{0.001 * length**2}"'
        f' dV="{0.00001 * length**3}"/>'
    )
    without = normalized.replace(' pRange="normalized"', "")
    s = np.linspace(0, 55, 12)
    first, second, third = (
        line_of(geometry(shape, length=length)).evaluate(s).offset(np.zeros(12))
        for shape in (by_length, normalized, without)
    )
    np.testing.assert_allclose(first, second, atol=1e-9)
    np.testing.assert_allclose(second, third, atol=0)


def test_cubic_points_are_as_far_apart_as_their_arc_lengths():
    line = line_of(geometry('<paramPoly3 bU="30" cU="25" cV="30" dV="5"/>', length=71.5))
    s = np.linspace(0, 71.0, 20001)
    xy = line.evaluate(s).offset(np.zeros_like(s))
    steps = np.hypot(*np.diff(xy, axis=0).T)
    np.testing.assert_allclose(steps, steps.mean(), rtol=2e-3)


def test_cubic_of_wrong_length_is_run_through_from_end_to_end():
    line = line_of(geometry('<paramPoly3 bU="150"/>', length=100))
    assert length_error(line.geometries[0]) == pytest.approx(0.5)
    np.testing.assert_allclose(poses(line, 50, 100)[:, 0], [75, 150], atol=1e-9)


def test_line_stays_at_its_ends():
    line = line_of(geometry("<line/>"))
    np.testing.assert_allclose(poses(line, -5, 105)[:, 0], [0, 100])


def test_joint_belongs_to_the_later_record():
    line = line_of(
        geometry("<line/>", length=50), geometry("<line/>", s=50, x=50, hdg=0.2, length=50)
    )
    assert poses(line, 50)[0, 2] == 0.2
    gaps, turns = line.joints()
    np.testing.assert_allclose([gaps[0], turns[0]], [0.0, 0.2], atol=1e-12)


def test_curve_that_winds_a_million_times_does_not_hang():
    line = ReferenceLine((Geometry(0.0, 0.0, 0.0, 0.0, 100.0, SPIRAL, (0.0, 1e6)),))
    assert np.isfinite(poses(line, 50.0)).all()
