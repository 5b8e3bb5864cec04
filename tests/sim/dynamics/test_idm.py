import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.sim.dynamics.idm import idm_acceleration, idm_step

DEFAULTS = (1.0, 1.5, 1.0, 2.0)  # minimum gap, headway, largest acceleration, deceleration


def test_a_vehicle_at_its_target_speed_on_a_free_road_keeps_it_nearly():
    assert idm_acceleration(10.0, 1e9, 10.0, 10.0, *DEFAULTS) == pytest.approx(0.0, abs=1e-9)


def test_standing_at_the_minimum_gap_is_an_equilibrium():
    assert idm_acceleration(0.0, 1.0, 0.0, 10.0, *DEFAULTS) == 0.0


def test_a_gap_below_the_minimum_counts_as_the_minimum():
    touching = idm_acceleration(3.0, -5.0, 0.0, 10.0, *DEFAULTS)

    assert touching == idm_acceleration(3.0, 1.0, 0.0, 10.0, *DEFAULTS)


def test_braking_is_clipped_and_the_speed_is_not():
    distance, speed = idm_step(0.1, 1.0, 0.0, 10.0, *DEFAULTS, 0.1)
    _, hard = idm_step(0.1, 1.0, -20.0, 10.0, *DEFAULTS, 0.1)

    assert distance == pytest.approx(0.01, abs=1e-12)
    assert speed < 0.1
    assert hard == pytest.approx(-0.1, abs=1e-12)


@given(st.floats(0.0, 30.0), st.floats(0.0, 200.0), st.floats(-10.0, 30.0))
def test_the_step_stays_within_the_acceleration_bounds(speed, gap, lead):
    distance, after = idm_step(speed, gap, lead, 10.0, *DEFAULTS, 0.1)

    assert distance == pytest.approx(0.1 * speed, abs=1e-12)
    assert -0.2 - 1e-9 <= after - speed <= 0.1 + 1e-9
    np.testing.assert_allclose(
        idm_step.py_func(speed, gap, lead, 10.0, *DEFAULTS, 0.1), (distance, after), atol=1e-12
    )
